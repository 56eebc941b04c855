"""Instance grids and velocities of predictions, scored over a data set."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import carlasc
from carlasc import GridSpec, Scoring
from carlasc.cli import app
from carlasc.errors import ArgumentError
from carlasc.storage import FolderSink, field_files

SPEC = GridSpec.published().with_size((8, 8, 4))
CAR, ROAD = 10, 7


def write(
    folder, change=lambda frame, labels, instance, velocity: None, parts=("instance", "velocity")
):
    """Write three frames: road, and two cars of 16 voxels, of which the first moves at 8 m/s and
    the second stands.
    """
    writer = FolderSink(folder).sequence("Val/Town01/cartesian")
    writer.write_document(
        "evaluation/params.json",
        json.dumps(
            {"grid_size": [8, 8, 4], "min_bound": list(SPEC.lower), "max_bound": list(SPEC.upper), "num_channels": 25,
             "coordinates": "cartesian"}
        ).encode(),
    )  # fmt: skip
    for frame in range(3):
        labels, instance = np.zeros(SPEC.size, np.uint8), np.zeros(SPEC.size, np.uint32)
        labels[:, :, 0] = ROAD
        labels[frame : frame + 4, 0:2, 1:3], instance[frame : frame + 4, 0:2, 1:3] = CAR, 5
        labels[2:6, 5:7, 1:3], instance[2:6, 5:7, 1:3] = CAR, 900
        velocity = np.zeros(16, field_files.VELOCITY_DTYPE)
        velocity["voxel"], velocity["velocity"] = np.flatnonzero(instance == 5), (8, 0, 0)
        change(frame, labels, instance, velocity)
        arrays = {"instance": instance, "velocity": velocity}
        writer.write("evaluation/labels", frame, labels)
        writer.write("evaluation/counts", frame, np.ones(SPEC.size, np.float32))
        for part in parts:
            writer.write(f"evaluation/{part}", frame, arrays[part])
    return folder


@pytest.fixture
def truth(tmp_path):
    return write(tmp_path / "truth")


def score(folder, truth):
    return carlasc.evaluate(folder, truth, convention="own", scoring=Scoring(actors=True)).actors


def test_the_truth_itself_is_perfect(truth):
    found = score(truth, truth)
    assert found.panoptic.pq[CAR] == found.panoptic.pq[ROAD] == 1
    assert found.tracking.lstq == 1 and found.tracking.actors == 2
    assert (
        found.velocity_m_s == 0
        and found.velocity_by_speed[5.0] == 0
        and np.isnan(found.velocity_by_speed[0.0])
    )


def test_other_numbers_in_each_frame_cost_lstq_but_not_pq(truth, tmp_path):
    def renumber(frame, labels, instance, velocity):
        instance[instance == 5] = 50 + frame
        velocity["velocity"] += (0, 3, 0)

    found = score(write(tmp_path / "a", renumber), truth)
    assert found.panoptic.pq[CAR] == 1
    # the first car has three numbers, each with a third of it; the second has one
    assert (
        found.tracking.association == pytest.approx((1 / 3 + 1) / 2)
        and found.tracking.classification == 1
    )
    assert found.velocity_m_s == pytest.approx(3, abs=0.01)
    assert found.velocity_by_class["Vehicle"] == pytest.approx(3, abs=0.01)


def test_cars_in_one_piece_are_two_false_negatives_and_a_false_positive(truth, tmp_path):
    def join(frame, labels, instance, velocity):
        instance[instance > 0] = 1

    found = score(write(tmp_path / "a", join), truth)
    assert found.panoptic.pq[CAR] == 0 and found.panoptic.rq[CAR] == 0
    assert found.tracking.association == pytest.approx(0.5)


def test_a_prediction_without_velocities_stands_still(truth, tmp_path):
    assert score(write(tmp_path / "a", parts=("instance",)), truth).velocity_m_s == pytest.approx(8)


def test_true_actors_without_a_number_do_not_count(tmp_path):
    def forget(frame, labels, instance, velocity):
        instance[instance == 900] = 0

    folder = write(tmp_path / "truth", forget)
    found = score(write(tmp_path / "a"), folder)
    assert found.panoptic.pq[CAR] == 1 and found.tracking.actors == 1 and found.tracking.lstq == 1


def test_grids_without_instances_and_velocities_that_are_not_finite_are_named(truth, tmp_path):
    bare = write(tmp_path / "bare", parts=())
    with pytest.raises(
        ArgumentError,
        match="actors: expected grids with instances for prediction and ground truth, found .*bare",
    ):
        score(bare, truth)

    def break_it(frame, labels, instance, velocity):
        velocity["velocity"][3] = np.nan

    result = carlasc.evaluate(
        write(tmp_path / "nan", break_it), truth, convention="own", scoring=Scoring(actors=True)
    )
    assert len(result.failures) == 3 and "finite velocities" in result.failures[0][1]


def test_instance_grids_of_another_geometry_are_named(truth, tmp_path):
    folder = write(tmp_path / "small")
    for file in folder.rglob("*.instance"):
        file.write_bytes(file.read_bytes()[:-64])
    result = carlasc.evaluate(folder, truth, convention="own", scoring=Scoring(actors=True))
    assert (
        len(result.failures) == 3
        and "000000.instance: expected 1024 bytes (8 x 8 x 4" in result.failures[0][1]
    )


def test_the_command_prints_the_table(truth):
    given = ["evaluate", str(truth), str(truth), "--convention", "own", "--actors"]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0, result.output
    assert (
        "LSTQ" in result.output
        and "mean velocity error of moving voxels: 0.00 m/s" in result.output
    )
    result = CliRunner().invoke(app, [*given, "--json"])
    values = json.loads(result.stdout)["actors"]
    assert (
        values["class_pq"]["Vehicle"] == 1
        and values["lstq"] == 1
        and values["velocity_by_speed"]["from 5 m/s"] == 0
    )
