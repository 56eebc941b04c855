"""A data set with refined poses: motions nearer to the truth, everything else as it was, and a word
of what was done to the poses.
"""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from carlasc_recorders import SimulatedCapture
from helpers.scenes.winding import record
from numpy.testing import assert_array_equal

import carlasc
from carlasc import GridSpec, Run
from carlasc.captures import Lidar
from carlasc.core.geometry import invert, multiply, slerp, translation
from carlasc.errors import (
    ArgumentError,
    CompleteError,
    ConflictError,
    FormatError,
    MissingDataError,
)
from carlasc.inspection import validate
from carlasc.motion import PoseOptions
from carlasc.relabelling import refining
from carlasc.storage import FolderSink, Metadata, layout
from carlasc.storage import open as open_store
from carlasc.testing import wrong_poses

ALONE = Run(workers=1)
FRAMES = 20
ONE, TWO = "Train/One/cartesian", "Train/Two/cartesian"
SPEC = GridSpec(lower=(-8, -8, -2), upper=(8, 8, 2), size=(16, 16, 4), coordinates="cartesian")
GRID = layout.grid_folder(SPEC)
FINE = GridSpec(
    lower=(-15, -15, -3), upper=(15, 15, 3), size=(300, 300, 60), coordinates="cartesian"
)


def files_of(folder):
    """Return the bytes of all files of a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and ".carlasc" not in path.parts
    }


def write_poses(folder, poses):
    (folder / "poses.txt").unlink(missing_ok=True)  # it may be a link
    (folder / "poses.txt").write_bytes(layout.encode_poses(poses))


def disturbed(poses):
    """Return poses with a jitter of 3 cm and 0.1 degrees; the first one is right, as the format
    says.
    """
    wrong = wrong_poses(poses, jitter_m=0.03, jitter_rad=0.002, seed=4)
    wrong[0] = poses[0]
    return wrong


def off_m(poses, truth):
    """Return the mean error of the motions from each scan to the next one, in metres."""
    one, other = (multiply(invert(p[:-1]), p[1:]) for p in (poses, truth))
    return float(np.linalg.norm(multiply(invert(one), other)[:, :3, 3], axis=1).mean())


def poses_of(folder, path=ONE):
    return open_store(folder).sequences()[path].poses


@pytest.fixture(scope="session")
def drive(tmp_path_factory):
    """A simulated drive with exact poses, and a grid."""
    capture = SimulatedCapture(
        count=FRAMES, sensors=1, seed=3, bev=False, lidar=Lidar(channels=32, points=30_000)
    )
    folder = tmp_path_factory.mktemp("drive")
    carlasc.regrid(capture, SPEC, folder / "Train" / "One", run=ALONE)
    return folder


@pytest.fixture
def exact(drive, tmp_path):
    return shutil.copytree(drive, tmp_path / "exact", copy_function=os.link)


@pytest.fixture
def truth(drive):
    return poses_of(drive)


@pytest.fixture
def data(exact, truth, tmp_path):
    """The drive with wrong poses, and once more with exact ones."""
    shutil.copytree(exact / ONE, tmp_path / "data" / TWO, copy_function=os.link)
    shutil.copytree(exact / ONE, tmp_path / "data" / ONE, copy_function=os.link)
    write_poses(tmp_path / "data" / ONE, disturbed(truth))
    described = tmp_path / "data" / ONE / "carlasc.json"
    described.unlink()  # it is a link
    described.write_text('{"format": 2, "sensor": "a", "poses": "file"}')
    return tmp_path / "data"


def test_motions_are_nearer_to_the_truth_and_everything_else_is_the_same_file(
    data, truth, tmp_path
):
    before = files_of(data)
    result = carlasc.refine(data, tmp_path / "out", run=ALONE)
    assert files_of(data) == before
    assert off_m(poses_of(data), truth) > 0.05
    assert off_m(poses_of(tmp_path / "out"), truth) < 0.005
    assert_array_equal(poses_of(tmp_path / "out")[0], truth[0])
    made = files_of(tmp_path / "out")
    for path, written in ((ONE, {"poses.txt", "carlasc.json"}), (TWO, {"carlasc.json"})):
        for file in (tmp_path / "out" / path).rglob("*"):
            if file.is_file() and file.name not in written:
                assert file.samefile(data / file.relative_to(tmp_path / "out"))
        kept = {name for name in before if name.startswith(path) and GRID not in name}
        assert {name for name in made if name.startswith(path)} == kept | {f"{path}/carlasc.json"}
    assert result.sequences == [ONE, TWO] and result.refined == [ONE] and result.scans == FRAMES
    assert result.files == result.kept == 0 and result.linked == len(made) - 6
    assert result.left_out == [f"{GRID}/"]
    assert result.notes[0].startswith(
        f"{ONE}: poses were refined: neighbouring scans disagreed by 4."
    )
    assert result.notes[1].startswith(
        f"{TWO}: poses left as they are: neighbouring scans disagree by 1."
    )
    assert not list(tmp_path.glob("out.*"))


@pytest.mark.slow
def test_carlasc_json_says_what_was_done_and_keeps_what_it_said(data, tmp_path):
    carlasc.refine(data, tmp_path / "out", run=ALONE)
    found = [
        json.loads((tmp_path / "out" / path / "carlasc.json").read_text()) for path in (ONE, TWO)
    ]
    assert found[0] == {
        "format": 2,
        "axes": "left",
        "classes": "carla",
        "sensor": "a",
        "poses": "file, refined",
    }
    assert found[1] == {
        "format": 2,
        "axes": "left",
        "classes": "carla",
        "simulated": True,
        "poses": "left as given",
    }
    again = carlasc.refine(tmp_path / "out", tmp_path / "again", run=ALONE)
    assert again.refined == []
    for path in (ONE, TWO):
        for name in ("carlasc.json", "poses.txt"):
            assert (tmp_path / "again" / path / name).read_bytes() == (
                tmp_path / "out" / path / name
            ).read_bytes()


def test_exact_poses_stay_the_same_bytes_unless_they_are_always_refined(exact, truth, tmp_path):
    carlasc.refine(exact, tmp_path / "out", run=ALONE)
    assert (tmp_path / "out" / ONE / "poses.txt").samefile(exact / ONE / "poses.txt")
    result = carlasc.refine(
        exact, tmp_path / "always", poses=PoseOptions(refine="always"), run=ALONE
    )
    assert result.refined == [ONE]
    assert 0 < off_m(poses_of(tmp_path / "always"), truth) < 0.005


@pytest.mark.slow
def test_stacks_of_aligned_scans_agree_better(data, exact, tmp_path):
    carlasc.refine(data, tmp_path / "out", run=ALONE)

    def shares(folder):
        """Return the share of the voxels of 0.1 m of a stack that at least four of 16 scans have in
        common.
        """
        stacks = carlasc.Dataset(
            folder, ["One"], history=16, grid=FINE, fields=("occupancy",), remap=None
        )
        scans = stacks[FRAMES - 1]["occupancy"].sum(axis=0)
        return (scans >= 4).sum() / (scans > 0).sum()

    wrong, refined, right = (shares(folder) for folder in (data, tmp_path / "out", exact))
    assert wrong < 0.75 * right
    assert refined > 0.97 * right


def test_lines_of_frames_without_a_scan_move_with_the_scan_before_them(data, truth, tmp_path):
    for field in ("velodyne", "labels", "instances", "predictions"):
        for path in (data / ONE / field).glob("000007.*"):
            path.unlink()
    carlasc.refine(data, tmp_path / "out", run=ALONE)
    found = poses_of(tmp_path / "out")
    assert len(found) == FRAMES
    given = poses_of(data)
    correction = multiply(found[6], invert(given[6]))
    assert np.abs(found[7] - multiply(correction, given[7])).max() < 1e-9
    assert off_m(np.delete(found, 7, axis=0), np.delete(truth, 7, axis=0)) < 0.005


def test_missing_poses_are_estimated_unless_those_of_the_data_are_asked_for(
    exact, truth, tmp_path, monkeypatch
):
    pytest.importorskip("kiss_icp")
    monkeypatch.setattr(
        refining, "find_mounting", lambda *_: pytest.fail("estimated poses are those of the sensor")
    )
    (exact / ONE / "poses.txt").unlink()
    with pytest.raises(MissingDataError) as error:
        carlasc.refine(exact, tmp_path / "file", poses=PoseOptions("file"), run=ALONE)
    assert error.value.where.endswith("poses.txt") and error.value.found == "none"
    result = carlasc.refine(exact, tmp_path / "out", run=ALONE)
    assert "poses were estimated from the scans (kiss-icp); poses " in result.notes[0]
    said = json.loads((tmp_path / "out" / ONE / "carlasc.json").read_text())["poses"]
    assert said == ("kiss-icp, refined" if result.refined else "kiss-icp, left as given")
    assert len(poses_of(tmp_path / "out")) == FRAMES
    assert off_m(poses_of(tmp_path / "out"), truth) < 0.02


def test_too_few_scans_are_left_alone_and_sequences_without_scans_are_left_out(exact, tmp_path):
    whole = open_store(exact).sequences()[ONE]
    writer = FolderSink(tmp_path / "few").sequence("Val/Few/cartesian")
    for frame in range(2):
        writer.write("points", frame, whole.read("points", frame))
    writer.write_document("poses.txt", layout.encode_poses(whole.poses[:2]))
    result = carlasc.refine(tmp_path / "few", tmp_path / "out", run=ALONE)
    assert result.notes == [
        "Val/Few/cartesian: poses left as they are: the distance between neighbouring scans is "
        "unknown"
    ]
    for path in (tmp_path / "few/Val/Few/cartesian/velodyne").iterdir():
        path.unlink()
    writer.write("labels", 0, np.zeros(3, np.uint32))
    with pytest.raises(MissingDataError) as error:
        carlasc.refine(tmp_path / "few", tmp_path / "none", run=ALONE)
    assert error.value.expected == "sequences with points"


@pytest.mark.slow
def test_what_exists_is_not_replaced_unless_it_was_refined_and_that_is_asked_for(data, tmp_path):
    carlasc.refine(data, tmp_path / "out", run=ALONE)
    with pytest.raises(CompleteError):
        carlasc.refine(data, tmp_path / "out", run=ALONE)
    with pytest.raises(ConflictError) as error:
        carlasc.refine(data, tmp_path / "out", poses=PoseOptions(refine="always"), run=ALONE)
    assert error.value.expected == "a new path"
    carlasc.refine(
        data, tmp_path / "out", poses=PoseOptions(refine="always"), overwrite=True, run=ALONE
    )
    assert open_store(tmp_path / "out").sequences()[TWO].metadata.extra["poses"] == "refined"
    assert not list(tmp_path.glob("out.*"))
    before = shutil.copytree(data, tmp_path / "other")
    with pytest.raises(ConflictError) as error:
        carlasc.refine(data, tmp_path / "other", overwrite=True, run=ALONE)
    assert error.value.expected == "a data set with refined poses to overwrite"
    assert files_of(before) == files_of(data)
    with pytest.raises(ConflictError) as error:
        carlasc.refine(data, data / "inside", run=ALONE)
    assert error.value.where.endswith("inside")


KILLED = """
import os, sys
from carlasc import Run, refine
def progress(done, total):
    if done >= eval(sys.argv[3]):
        os._exit(9)
refine(sys.argv[1], sys.argv[2], run=Run(workers=1, progress=progress))
"""


@pytest.mark.slow
@pytest.mark.parametrize("when", ["25", "total"])
def test_an_interrupted_run_is_continued_by_the_same_call_and_by_no_other(data, tmp_path, when):
    out = tmp_path / "out"
    ran = subprocess.run([sys.executable, "-c", KILLED, data, out, when], check=False)
    assert ran.returncode == 9 and not out.exists()
    assert len(list((tmp_path / "out.part").glob("*/*/*/.carlasc/poses-*.npz"))) == (
        1 if when == "25" else 2
    )
    with pytest.raises(ConflictError) as error:
        carlasc.refine(data, out, poses=PoseOptions(refine="always"), run=ALONE)
    assert error.value.where.endswith("out.part") and error.value.found == "files of another run"
    given = poses_of(data)
    write_poses(data / ONE, given + 1e-9)
    with pytest.raises(ConflictError) as error:
        carlasc.refine(data, out, run=ALONE)
    assert error.value.where.endswith("out.part")
    write_poses(data / ONE, given)
    result = carlasc.refine(data, out, run=ALONE)
    whole = carlasc.refine(data, tmp_path / "whole", run=ALONE)
    assert files_of(out) == files_of(tmp_path / "whole")
    assert result.notes == whole.notes and result.refined == whole.refined
    assert not list(tmp_path.glob("out.*"))


@pytest.mark.slow
def test_several_processes_parts_and_packed_sources_make_the_same_files(data, tmp_path):
    carlasc.refine(data, tmp_path / "alone", run=ALONE)
    steps = []
    carlasc.refine(
        data, tmp_path / "two", run=Run(workers=2, progress=lambda *step: steps.append(step))
    )
    # scans, then the files of four fields
    assert steps[-1] == (2 * FRAMES * 5,) * 2 and steps == sorted(steps)
    for number in (1, 2):
        carlasc.refine(data, tmp_path / "parts", run=Run(1, part=carlasc.running.Part(number, 2)))
    carlasc.pack(data, tmp_path / "data.zarr", run=ALONE)
    packed = carlasc.refine(tmp_path / "data.zarr", tmp_path / "packed", run=ALONE)
    assert packed.linked == 0 and packed.files == 2 * FRAMES * 4
    for name in ("two", "parts", "packed"):
        assert files_of(tmp_path / name) == files_of(tmp_path / "alone"), name


@pytest.mark.slow
def test_a_refined_data_set_is_valid_and_is_regridded_without_refining_again(data, tmp_path):
    carlasc.refine(data, tmp_path / "out", run=ALONE)
    assert not [
        one for one in validate(tmp_path / "out", run=ALONE).findings if one.severity == "error"
    ]
    observe = carlasc.FromScans(window=(-1, 1))
    made = carlasc.regrid(tmp_path / "out" / ONE, SPEC, observe=observe, frames=(0, 1), run=ALONE)
    assert not any("refined" in note for note in made.notes)


def test_wrong_arguments_and_wrong_poses_are_refused_before_anything_is_written(data, tmp_path):
    with pytest.raises(ArgumentError) as error:
        carlasc.refine(data, tmp_path / "out", poses=PoseOptions(refine="never"), run=ALONE)
    assert error.value.where == "refine" and error.value.found == "'never'"
    poses = poses_of(data)
    poses[9:, 0, 3] += 30
    write_poses(data / ONE, poses)
    with pytest.raises(FormatError) as error:
        carlasc.refine(data, tmp_path / "out", run=ALONE)
    assert error.value.where.endswith("poses.txt") and "at frame 9 " in error.value.found
    assert not list(tmp_path.glob("out*"))
    result = carlasc.refine(data, tmp_path / "out", poses=PoseOptions(force=True), run=ALONE)
    assert result.sequences == [ONE, TWO]


@pytest.mark.slow
def test_poses_of_another_point_and_late_ones_are_corrected(tmp_path):
    scans, true = record(frames=40)
    numbers = np.arange(len(true), dtype=np.float64)
    given = slerp(true @ invert(translation((0.81, -0.32, 0.0))), numbers, numbers - 0.5)
    source, out = tmp_path / "imu", tmp_path / "out"
    with FolderSink(source).sequence("cartesian") as writer:
        writer.write_document(layout.POSES, layout.encode_poses(invert(given[0]) @ given))
        writer.write_document(layout.METADATA, Metadata("right").to_json())
        for frame, points in enumerate(scans):
            writer.write(
                "points", frame, np.column_stack([points, np.zeros(len(points))]).astype(np.float32)
            )
    (note,) = carlasc.refine(source, out, run=Run(workers=1)).notes
    assert (
        "poses were corrected for the sensor in their frame: x 0.8" in note and "late 0.05" in note
    )
    (sequence,) = carlasc.open(out).sequences().values()
    off = (
        invert(invert(true[:-10]) @ true[10:]) @ invert(sequence.poses[:-10]) @ sequence.poses[10:]
    )
    assert np.abs(off[:, :3, 3]).max() < 0.04
    assert sequence.metadata.extra["poses"] == "refined"
