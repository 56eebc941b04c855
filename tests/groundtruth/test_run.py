import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.captures import make_recording, read_tree, write_capture

from carlasc import Run
from carlasc.captures.raw import Capture
from carlasc.captures.writing import CaptureWriter
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import invert, rotation_z, transform_points, translation
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, ConflictError, MissingDataError
from carlasc.groundtruth import FromCapture, FromScans, Observation, Voting, count_votes, regrid
from carlasc.groundtruth.inputs import choose_frames
from carlasc.storage import FolderSource, Sink, layout
from carlasc.storage.protocol import SequenceWriter

SMALL = GridSpec.published().with_size((32, 32, 4))
KEYS = ("grid_size", "min_bound", "max_bound", "num_channels", "coordinates")
GOLDEN = {
    "cartesian": (GridSpec.published(), 1.5),
    "cylindrical": (GridSpec.published("cylindrical"), 1.5),
    "cartesian_fine": (GridSpec.published("fine"), 1.5),
    "cartesian_step0.5": (GridSpec.published().with_size((64, 64, 8)), 0.5),
}


@pytest.mark.parametrize(
    ("variant", "workers"), [(variant, 1) for variant in GOLDEN] + [("cartesian", 2)]
)
def test_the_golden_files_come_out_byte_for_byte(golden_capture, tmp_path, variant, workers):
    spec, free_step = GOLDEN[variant]
    result = regrid(
        golden_capture,
        spec,
        tmp_path,
        voting=Voting(free_step_m=free_step),
        name="evaluation",
        run=Run(workers=workers),
    )
    assert (result.made, result.skipped, result.failures) == (3, 0, ())
    made, golden = read_tree(tmp_path / spec.coordinates), read_tree(golden_capture / variant)
    assert set(golden) <= set(made)
    for name, data in golden.items():
        if name == "poses.txt":
            ours, theirs = (layout.decode_poses(text, name) for text in (made[name], data))
            assert np.abs(ours - theirs).max() < 1e-12
        elif name.endswith("params.json"):
            ours, theirs = json.loads(made[name]), json.loads(data)
            assert list(theirs) == list(KEYS) == list(ours)[:5]
            assert [ours[key] for key in KEYS] == [theirs[key] for key in KEYS]
        else:
            assert made[name] == data, name


def test_what_we_add_stands_beside_the_published_files_only(golden_capture, tmp_path):
    regrid(golden_capture, GridSpec.published(), tmp_path, run=Run(workers=1))
    added = set(read_tree(tmp_path / "cartesian")) - set(read_tree(golden_capture / "cartesian"))
    assert added == {
        *(f"instances/{frame:06d}.label" for frame in range(3)),
        "evaluation/carlasc-report.json",
    }
    instances = np.fromfile(tmp_path / "cartesian/instances/000001.label", "<u4")
    assert np.array_equal(instances, Capture(golden_capture).read(0, 101).scan.instances)


def test_the_run_is_recorded_in_params_json(tmp_path):
    write_capture(tmp_path)
    regrid(tmp_path, SMALL, voting=Voting("sample", 0.7), run=Run(workers=1))
    params = json.loads((tmp_path / "cartesian/evaluation_32x32x4/params.json").read_bytes())
    assert params["carlasc"] == {
        "format": 1,
        "rule": 1,
        "observe": "capture",
        "frames": "100:",
        "sensors": 2,
        "free_step_m": 0.7,
        "voting": "sample",
    }


def test_what_is_written_is_read_back_by_a_source(tmp_path):
    capture = write_capture(tmp_path)
    regrid(tmp_path, SMALL, run=Run(workers=1))
    (sequence,) = FolderSource(tmp_path).sequences().values()
    scan, recording = sequence.scan(1), capture.read(0, 101)
    assert np.array_equal(scan.points, recording.scan.points)
    assert np.array_equal(scan.flow, recording.flow())
    assert np.array_equal(scan.instances, recording.scan.instances)
    assert sequence.read("bev", 1).tobytes() == b"picture 101"
    assert sequence.times.tolist() == [0.0, 0.1, 0.2]
    expected = np.linalg.inv(capture.read_pose(0, 100)) @ capture.read_pose(0, 101)
    assert np.allclose(sequence.read_pose(1), expected, rtol=0, atol=1e-12)
    assert sequence.grid("evaluation_32x32x4", 2).known.any()


def test_sensors_that_stand_turned_see_the_same_world(tmp_path):
    """A point in the world votes for the same voxel whichever way the sensor that saw it is turned."""
    upright, turned = CaptureWriter(tmp_path / "upright"), CaptureWriter(tmp_path / "turned")
    ego, other = make_recording(seed=1), make_recording(seed=2)
    tilt = (
        translation((1, 2, 0.5))
        @ rotation_z(1.1)
        @ np.array([[1, 0, 0, 0], [0, 0.8, -0.6, 0], [0, 0.6, 0.8, 0], [0, 0, 0, 1]])
    )
    points = transform_points(
        invert(tilt), transform_points(other.world_T_sensor, other.scan.points)
    )
    rotated = replace(
        other, scan=replace(other.scan, points=points.astype(np.float32)), world_T_sensor=tilt
    )
    for writer, second in ((upright, other), (turned, rotated)):
        writer.write(0, 0, ego)
        writer.write(1, 0, second)
        # endpoints alone: rays start elsewhere
        regrid(writer.location, SMALL, voting=Voting(free_step_m=1000), run=Run(workers=1))
    grids = [
        FolderSource(w.out).sequences()["cartesian"].grid("evaluation_32x32x4", 0)
        for w in (upright, turned)
    ]
    assert grids[0].counts.sum() > 100
    # float32 may move a point over a cell's edge
    assert np.mean(grids[0].labels == grids[1].labels) > 0.999


def test_votes_are_kept_when_asked_for_and_added_to_a_grid_that_is_there(tmp_path):
    capture = write_capture(tmp_path, frames=2)
    regrid(tmp_path, SMALL, run=Run(workers=1))
    result = regrid(tmp_path, SMALL, voting=Voting(keep=True), run=Run(workers=1))
    assert (result.made, result.skipped) == (2, 0)
    (sequence,) = FolderSource(tmp_path).sequences().values()
    votes = sequence.read("evaluation_32x32x4/votes", 1)
    counts = np.bincount(votes["voxel"], votes["votes"], SMALL.num_voxels).reshape(SMALL.size)
    assert np.array_equal(counts, sequence.grid("evaluation_32x32x4", 1).counts)
    ego = capture.read_pose(0, 101)
    observations = [
        Observation(r.scan.points, r.scan.labels, np.linalg.inv(ego) @ r.world_T_sensor)
        for r in (capture.read(s, 101) for s in (0, 1))
    ]
    assert np.array_equal(votes, count_votes(observations, SMALL).to_sparse())


def test_a_second_run_skips_what_is_there_and_makes_what_is_missing(tmp_path):
    write_capture(tmp_path)
    regrid(tmp_path, SMALL, run=Run(workers=1))
    whole = read_tree(tmp_path)
    again = regrid(tmp_path, SMALL, run=Run(workers=1))
    assert (again.made, again.skipped) == (0, 3)
    for name in ("evaluation_32x32x4/000001.bin", "velodyne/000002.bin"):
        (tmp_path / "cartesian" / name).unlink()
    again = regrid(tmp_path, SMALL, run=Run(workers=1))
    assert (again.made, again.skipped) == (2, 1)
    assert read_tree(tmp_path) == whole


def test_a_run_goes_on_when_the_capture_has_grown(tmp_path):
    write_capture(tmp_path, frames=2)
    regrid(tmp_path, SMALL, run=Run(workers=1))
    write_capture(tmp_path, frames=3)
    result = regrid(tmp_path, SMALL, run=Run(workers=1))
    assert (result.made, result.skipped) == (1, 2)
    assert len((tmp_path / "cartesian/poses.txt").read_text().splitlines()) == 3


def test_frames_are_chosen_by_their_number_in_the_capture_and_renumbered(tmp_path):
    capture = write_capture(tmp_path, frames=5)
    for chosen, expected in (
        ((101, 103), [101, 102]),
        ((None, 102), [100, 101]),
        ((103, None), [103, 104]),
    ):
        out = tmp_path / f"out{expected[0]}"
        regrid(tmp_path, SMALL, out, frames=chosen, run=Run(workers=1))
        (sequence,) = FolderSource(out).sequences().values()
        assert sequence.scan_frames().tolist() == [0, 1]
        assert len(sequence.poses) == len(sequence.times) == 2
        assert np.allclose(sequence.read_pose(0), np.eye(4), atol=1e-12)
        for number, frame in enumerate(expected):
            assert np.array_equal(sequence.scan(number).points, capture.read(0, frame).scan.points)


def test_frames_that_the_capture_skipped_keep_their_time(tmp_path):
    capture = write_capture(tmp_path, frames=4)
    for kind in ("velodyne", "labels", "instances", "velocities", "pose"):
        (Path(capture.location) / f"{kind}0" / "101.npy").unlink()
    regrid(tmp_path, SMALL, run=Run(workers=1))
    (sequence,) = FolderSource(tmp_path).sequences().values()
    assert sequence.scan_frames().tolist() == [0, 1, 2]
    assert np.allclose(sequence.times, [0.0, 0.2, 0.3])


@pytest.mark.parametrize("frames", [(200, None), (3, 50)])
def test_a_range_without_frames_says_which_there_are(tmp_path, frames):
    write_capture(tmp_path)
    with pytest.raises(MissingDataError) as error:
        regrid(tmp_path, SMALL, frames=frames)
    assert error.value.found == "only 100 to 102"
    assert not (tmp_path / "cartesian").exists()


def test_a_sequence_without_any_frame_says_so():
    with pytest.raises(MissingDataError) as error:
        choose_frames(FrameRange(), np.array([], np.int64), "a sequence")
    assert error.value.where == "a sequence" and error.value.expected == "frames"


def test_several_sequences_keep_their_paths(tmp_path):
    for path in ("Train/Town01_Light", "Val/Town07_Light"):
        write_capture(tmp_path / "in" / path, frames=2)
    result = regrid(tmp_path / "in", SMALL, tmp_path / "out", run=Run(workers=2))
    assert result.made == 4
    assert list(FolderSource(tmp_path / "out").sequences()) == [
        "Train/Town01_Light/cartesian",
        "Val/Town07_Light/cartesian",
    ]
    cylindrical = GridSpec.published("cylindrical").with_size((16, 16, 4))
    regrid(tmp_path / "in", cylindrical, run=Run(workers=1))
    assert list(FolderSource(tmp_path / "in").sequences()) == [
        "Train/Town01_Light/cylindrical",
        "Val/Town07_Light/cylindrical",
    ]


def test_raw_itself_as_the_source_writes_beside_it(tmp_path):
    write_capture(tmp_path, frames=1)
    regrid(tmp_path / "raw", SMALL, run=Run(workers=1))
    assert (tmp_path / "cartesian/velodyne/000000.bin").is_file()


def test_progress_counts_what_was_there_and_ends_at_the_total(tmp_path):
    write_capture(tmp_path)
    seen: list[tuple[int, int]] = []
    regrid(
        tmp_path,
        SMALL,
        run=Run(workers=1, progress=lambda *counts: seen.append(counts)),
        frames=(100, 102),
    )
    assert seen == [(0, 2), (1, 2), (2, 2)]
    seen.clear()
    regrid(
        tmp_path,
        SMALL,
        run=Run(workers=1, progress=lambda *counts: seen.append(counts)),
        frames=(100, 102),
    )
    assert seen == [(2, 2)]


def test_a_callers_executor_makes_the_same_files(tmp_path):
    write_capture(tmp_path)
    regrid(tmp_path, SMALL, tmp_path / "own", run=Run(workers=1))
    with ThreadPoolExecutor(2) as executor:
        regrid(tmp_path, SMALL, tmp_path / "threads", run=Run(executor=executor))
    assert read_tree(tmp_path / "threads") == read_tree(tmp_path / "own")


class MemorySink(Sink):
    """A store that only one process can write to, in rising order, as archives are."""

    location = "memory"

    def __init__(self):
        self.writers = {}

    def sequence(self, path):
        return self.writers.setdefault(path, MemoryWriter())


class MemoryWriter(SequenceWriter):
    location = "memory"

    def __init__(self):
        self.fields, self.texts, self.closed = {}, {}, 0

    def has(self, field, frame):
        return (field, frame) in self.fields

    def write(self, field, frame, array):
        assert frame == 1 + max((f for name, f in self.fields if name == field), default=-1)
        self.fields[field, frame] = array

    def write_document(self, name, data):
        self.texts[name] = data

    def read_document(self, name):
        return self.texts.get(name)

    def close(self):
        self.closed += 1


@pytest.mark.slow
def test_a_store_with_one_writer_gets_its_frames_in_order_from_the_workers(tmp_path):
    write_capture(tmp_path, frames=6)
    sink = MemorySink()
    assert regrid(tmp_path, SMALL, sink, run=Run(workers=2)).made == 6
    (writer,) = sink.writers.values()
    assert writer.closed == 1
    regrid(tmp_path, SMALL, run=Run(workers=1))
    (sequence,) = FolderSource(tmp_path).sequences().values()
    for name in sequence.fields():
        for frame in range(6):
            assert np.array_equal(writer.fields[name, frame], sequence.read(name, frame)), name
    with pytest.raises(
        ConflictError, match="memory: this store cannot replace its grid evaluation_32x32x4"
    ):
        regrid(tmp_path, SMALL, sink, run=Run(workers=1), overwrite=True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"observe": "capture"},
            "observe: expected a FromCapture or a FromScans or a FromGrid or None, found 'capture'",
        ),
        ({"frames": (5, 5)}, "frames: expected a range that holds a frame, found 5:5"),
        ({"frames": "a:b"}, "frames: expected .*, found 'a:b'"),
        ({"name": "a/b"}, "name: expected letters, digits and _ . [+] -, found 'a/b'"),
        ({"name": ".."}, "name: expected letters"),
        ({"name": ""}, "name: expected letters"),
        (
            {"name": "velodyne"},
            "name: expected a name that the layout does not reserve, found 'velodyne'",
        ),
        (
            {"name": "poses.txt"},
            "name: expected a name that the layout does not .*, found 'poses.txt'",
        ),
    ],
)
def test_arguments_that_are_not_valid_are_refused_before_anything_is_written(
    tmp_path, arguments, message
):
    write_capture(tmp_path, frames=1)
    with pytest.raises(ArgumentError, match=message):
        regrid(tmp_path, SMALL, **arguments)
    assert not (tmp_path / "cartesian").exists()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"free_step_m": 0}, "free_step_m: expected a positive number"),
        ({"free_step_m": float("nan")}, "free_step_m: expected a positive number"),
        ({"rule": "majority"}, "rule: expected one of sensor, sample, ray, found 'majority'"),
    ],
)
def test_voting_checks_itself(settings, message):
    with pytest.raises(ArgumentError, match=message):
        Voting(**settings)


def test_a_source_object_must_be_told_where_to_write(golden_capture):
    with pytest.raises(ArgumentError) as error:
        regrid(FolderSource(golden_capture), SMALL, observe=FromScans())
    assert error.value.where == "out"
    with pytest.raises(ArgumentError) as error:
        regrid(FolderSource(golden_capture), SMALL, golden_capture, observe=FromCapture())
    assert error.value.where == "source"


@pytest.mark.parametrize("coordinates", ["cartesian", "cylindrical"])
def test_a_real_scan_of_a_street_gives_a_sane_grid(real, tmp_path, coordinates):
    points = np.fromfile(real / "kitti_000008.bin", "<f4").reshape(-1, 4)[:, :3] * np.float32(
        [1, -1, 1]
    )
    recording = make_recording()
    scan = replace(
        recording.scan,
        points=np.ascontiguousarray(points),
        labels=np.full(len(points), 3, np.uint32),
        instances=np.zeros(len(points), np.uint32),
    )
    CaptureWriter(tmp_path).write(0, 0, replace(recording, scan=scan))
    spec = GridSpec.published(coordinates).with_resolution(0.2)
    assert regrid(tmp_path, spec, run=Run(workers=1)).failures == ()
    (sequence,) = FolderSource(tmp_path).sequences().values()
    (name,) = sequence.grids
    grid = sequence.grid(name, 0)
    inside = spec.flat_index(points)
    # one sensor: one vote for Other wherever a point fell, at most one for free elsewhere
    occupied = np.zeros(spec.num_voxels, bool)
    occupied[inside[inside >= 0]] = True
    assert occupied.sum() > 3000
    assert set(np.unique(grid.labels)) == {0, 3}
    assert not (grid.labels[~occupied.reshape(spec.size)] == 3).any()
    assert grid.known.reshape(-1)[occupied].all()
    assert set(np.unique(grid.counts)) == {0, 1, 2}
    assert 0.02 < grid.known.mean() < 0.9
    assert np.mean(grid.known & (grid.labels == 0)) > np.mean(grid.labels == 3)
