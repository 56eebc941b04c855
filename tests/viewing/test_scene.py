"""What a scene reads: which sequence, grid and frames, in which class table."""

import json
import pickle
import shutil

import numpy as np
import pytest
from helpers import foreign_voxels
from helpers.scenes.road_blocks import write_blocks

import carlasc
from carlasc.core.frames import FrameRange
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA, CARLASC11, REMAPS
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.metrics import VoxelOutcome
from carlasc.storage import FolderSink
from carlasc.viewing import Scene
from carlasc.viewing.colors import ERRORS


@pytest.fixture
def predicted(tmp_path):
    """A sequence with a second grid, `completion`, in the paper's eleven classes."""
    folder = write_blocks(tmp_path / "Train" / "Town01_Light" / "cartesian")
    shutil.copytree(folder / "evaluation", folder / "completion")
    params = json.loads((folder / "evaluation" / "params.json").read_text())
    (folder / "completion" / "params.json").write_text(
        json.dumps(params | {"carlasc": {"classes": "carlasc11"}})
    )
    for path in (folder / "completion").glob("*.label"):
        path.write_bytes(
            REMAPS["carlasc11"](np.fromfile(path, np.uint32)).astype(np.uint32).tobytes()
        )
    return folder


def test_a_scene_reads_grids_scan_flow_and_time_of_each_frame(blocks):
    reader = Scene(blocks, frames=(1, 3)).open()
    assert (reader.frames, reader.contents, reader.name) == (
        (1, 2),
        ("grid",),
        "Train / Town01_Light",
    )
    assert reader.left_handed and reader.table == CARLA and reader.truth is None
    (sequence,) = carlasc.open(blocks).sequences().values()
    for frame in reader.frames:
        content = reader.read(frame)
        (grid,) = content.grids
        np.testing.assert_array_equal(grid.labels, sequence.grid("evaluation", frame).labels)
        np.testing.assert_array_equal(content.scan.points, sequence.scan(frame).points)
        np.testing.assert_array_equal(content.scan.labels, sequence.scan(frame).labels)
        np.testing.assert_array_equal(content.scan.flow, sequence.scan(frame).flow)
        assert content.time_s == pytest.approx(0.1 * frame)


@pytest.mark.parametrize(
    ("frames", "every", "expected"),
    [
        (None, 1, (0, 1, 2)),
        (None, 2, (0, 2)),
        ((1, None), 1, (1, 2)),
        ((None, 2), 1, (0, 1)),
        (FrameRange(1, 2), 1, (1,)),
        ((1, 3), 5, (1,)),
    ],
)
def test_the_range_and_the_step_choose_the_frames(blocks, frames, every, expected):
    assert Scene(blocks, frames=frames, every=every).open().frames == expected


def test_the_file_of_a_frame_is_that_frame_unless_a_range_is_given(blocks):
    assert Scene(blocks / "evaluation" / "000001.label").open().frames == (1,)
    assert Scene(blocks / "evaluation" / "000001.label", frames=(0, 3)).open().frames == (0, 1, 2)
    scan = Scene(blocks / "velodyne" / "000002.bin").open()
    assert (scan.frames, scan.contents, scan.panels) == ((2,), ("scan",), ())
    assert Scene(blocks / "velodyne" / "000002.bin", grid="evaluation").open().contents == ("grid",)


def test_only_frames_that_have_everything_are_shown(blocks, tmp_path):
    folder = shutil.copytree(blocks, tmp_path / "cartesian")
    (folder / "velodyne" / "000000.bin").unlink()
    (folder / "evaluation" / "000001.label").unlink()
    assert Scene(folder).open().frames == (0, 2)
    assert Scene(folder).open("scan").frames == (1, 2)
    assert Scene(folder).open(["grid", "scan"]).frames == (2,)
    assert Scene(blocks, truth=folder).open().frames == (0, 2)
    assert Scene(folder).open().read(0).scan is None
    with pytest.raises(MissingDataError, match="expected frames 1:2, found 0 to 2"):
        Scene(folder, frames=(1, 2)).open()
    (folder / "evaluation" / "000002.label").unlink()
    with pytest.raises(MissingDataError, match="found frames 0 to 0"):
        Scene(folder).open("scan,grid")


def test_the_grid_is_the_one_named_or_evaluation_or_the_first(predicted):
    assert Scene(predicted).open().data.grid == "evaluation"
    assert Scene(predicted, grid="completion").open().data.grid == "completion"
    assert Scene(predicted / "completion").open().data.grid == "completion"
    assert Scene(predicted / "completion", grid="evaluation").open().data.grid == "evaluation"
    compared = Scene(predicted, truth=predicted, truth_grid="completion").open()
    assert (compared.data.grid, compared.truth.grid) == ("evaluation", "completion")
    shutil.rmtree(predicted / "evaluation")
    assert Scene(predicted).open().data.grid == "completion"
    with pytest.raises(MissingDataError, match="expected the grid evaluation, found completion"):
        Scene(predicted, grid="evaluation").open()


def test_a_prediction_in_eleven_classes_is_shown_with_its_truth_in_the_same(blocks, tmp_path):
    prediction = write_blocks(
        tmp_path / "Town01_Light" / "cartesian", metadata={"classes": "carlasc11"}, points=False
    )
    reader = Scene(prediction, truth=blocks).open()
    assert [panel.title for panel in reader.panels] == ["prediction", "truth", "errors"]
    assert [panel.colors.table for panel in reader.panels] == [CARLASC11, CARLASC11, ERRORS]
    assert reader.read(0).grids[1].labels.max() <= 10
    # there is no way from eleven classes to CARLA's
    swapped = Scene(blocks, truth=prediction).open()
    assert swapped.table == CARLASC11 and swapped.read(0).scan.labels.max() <= 10


def test_a_prediction_beside_the_data_brings_points_and_truth_to_its_classes(predicted):
    reader = Scene(predicted, grid="completion", truth=predicted).open()
    content = reader.read(0)
    assert reader.table == CARLASC11
    assert set(np.unique(content.grids[2].labels)) == {
        VoxelOutcome.NOT_COMPARED,
        VoxelOutcome.RIGHT,
    }
    # stored as CARLA's 4 and 7
    assert set(np.unique(content.scan.labels)) == {
        4,
        CARLASC11.id_of("Road"),
    }
    assert Scene(predicted).open().table == CARLA


def test_errors_have_the_counts_of_the_truth(blocks, tmp_path):
    prediction = write_blocks(tmp_path / "Town01_Light" / "cartesian", shift=3.0, points=False)
    own, truth, errors = Scene(prediction, truth=blocks).open().read(0).grids
    assert errors.counts is truth.counts
    assert (
        errors.labels[(own.labels == 4) & (truth.labels == 0) & truth.known]
        == VoxelOutcome.INVENTED
    ).all()
    assert (errors.labels[(own.labels == 0) & (truth.labels == 4)] == VoxelOutcome.MISSED).all()


def test_classes_may_be_chosen_and_those_of_the_source_told(blocks, tmp_path):
    assert Scene(blocks, classes="carlasc11").open().read(0).grids[0].labels.max() <= 10
    assert Scene(blocks, classes=CARLASC11).open().table == CARLASC11
    told = Scene(blocks, source_classes="carlasc11", frames=(0, 1)).open()
    assert told.table == CARLASC11 and told.read(0).grids[0].labels.max() == 10
    with pytest.raises(ArgumentError, match="semantickitti19"):
        Scene(blocks, classes="semantickitti19").open()


def test_points_that_are_not_finite_are_left_out(tmp_path):
    writer = FolderSink(tmp_path).sequence("scan")
    points = np.zeros((5, 4), np.float32)
    points[1, 0], points[3, 2] = np.nan, np.inf
    writer.write("points", 0, points)
    writer.write("labels", 0, np.arange(5, dtype=np.uint32))
    scan = Scene(tmp_path / "scan").open().read(0).scan
    assert scan.labels.tolist() == [0, 2, 4]


def test_the_truth_is_found_by_path_by_name_or_as_the_only_sequence(tmp_path):
    for name in ("Town01_Light", "Town02_Heavy"):
        write_blocks(tmp_path / "set" / "Test" / name / "cartesian", frames=1, points=False)
    prediction = write_blocks(tmp_path / "a" / "Town02_Heavy" / "cartesian", frames=1, points=False)
    assert Scene(prediction, truth=tmp_path / "set").open().truth.sequence.name == "Town02_Heavy"
    other = write_blocks(tmp_path / "b" / "Town03_Light" / "cartesian", frames=1, points=False)
    only = tmp_path / "set" / "Test" / "Town01_Light"
    assert Scene(other, truth=only).open().truth.sequence.name == "Town01_Light"
    with pytest.raises(MissingDataError, match="expected the sequence Town03_Light"):
        Scene(other, truth=tmp_path / "set").open()


def test_a_truth_of_another_geometry_is_refused_when_errors_are_shown(blocks, tmp_path):
    spec = GridSpec.published().with_size((32, 32, 4))
    other = write_blocks(tmp_path / "Town01_Light" / "cartesian", spec=spec, points=False)
    with pytest.raises(ArgumentError, match="truth: expected the geometry of the predicted grid"):
        Scene(blocks, truth=other).open()
    assert Scene(blocks, truth=other).open("grid,truth").contents == ("grid", "truth")


def test_a_sequence_without_grids_and_points_is_refused(tmp_path):
    writer = FolderSink(tmp_path).sequence("s")
    writer.write("labels", 0, np.zeros(3, np.uint32))
    with pytest.raises(MissingDataError, match="expected a grid or points, found labels"):
        Scene(tmp_path / "s").open()
    with pytest.raises(
        MissingDataError, match="expected the field points, found evaluation/counts"
    ):
        Scene(write_blocks(tmp_path / "b", points=False)).open("flow")


def test_a_sequence_without_times_has_none(tmp_path):
    assert Scene(write_blocks(tmp_path / "cartesian", points=False)).open().read(1).time_s is None


def test_a_reader_can_be_sent_to_another_process(blocks):
    reader = Scene(blocks, truth=blocks).open()
    assert reader.panels  # computed before it is pickled
    again = pickle.loads(pickle.dumps(reader))
    np.testing.assert_array_equal(again.read(1).grids[2].labels, reader.read(1).grids[2].labels)


def test_data_with_y_on_the_left_say_so(tmp_path):
    folder = write_blocks(
        tmp_path / "cartesian", frames=1, metadata={"frame": "kitti"}, points=False
    )
    assert not Scene(folder).open().left_handed


def test_frames_with_tokens_are_compared_with_the_truth_of_the_same_token(tmp_path):
    truth = foreign_voxels.write_occ3d(tmp_path / "occ3d", tokens=("aa0", "bb1"))
    pred = foreign_voxels.write_challenge(tmp_path / "pred", tokens=("bb1",))
    reader = Scene(pred, truth=truth).open()
    assert reader.frames == (1,)
    assert reader.data.sequence.frames_of["pred"].name_of(1) == "bb1"
    assert reader.table_use.table == "occ3d"
