"""What a conversion reads and keeps: each frame once, and nothing that grows with the scans."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from helpers.converters.drive_converter import DriveConverter, DriveFrame
from helpers.datasets.recordings import MemoryWriter

import carlasc
from carlasc.converting import Sensor, convert
from carlasc.motion import PoseOptions
from carlasc.running import Run
from carlasc.storage import Sink
from carlasc.testing import SimulatedDrive, Thing

FRAMES = list(range(8))


class Labelled(DriveConverter):
    """Numbered actors and poses."""


class Boxed(DriveConverter):
    gives = frozenset({"boxes", "poses", "times"})


class Unposed(DriveConverter):
    gives = frozenset({"labels", "instances", "times"})


class UnposedBoxes(DriveConverter):
    gives = frozenset({"boxes", "times"})


class UnposedRolling(DriveConverter):
    gives = frozenset({"labels", "instances", "times"})
    drive = SimulatedDrive(
        sensors=(Sensor("turns", SimulatedDrive().sensors[0].vehicle_T_sensor, deskewed=False),),
        rolling=True,
    )


def reads_of(converter, out, workers=1):
    DriveFrame.reads.clear()
    (out.parent / "nothing").mkdir(exist_ok=True)
    result = convert(
        converter,
        out.parent / "nothing",
        out,
        grids=None,
        poses=PoseOptions(force=True),
        run=Run(workers),
    )
    assert result.failures == ()
    return sorted(DriveFrame.reads), result


@pytest.mark.parametrize("converter", [Labelled, Boxed, Unposed, UnposedBoxes])
def test_each_frame_is_read_once_and_none_is_read_again(converter, tmp_path):
    reads, result = reads_of(converter, tmp_path / "out")
    assert (reads, result.made, result.skipped) == (FRAMES, 8, 0)
    reads, result = reads_of(converter, tmp_path / "out")
    assert (reads, result.made, result.skipped) == ([], 0, 8)


def test_scans_that_are_corrected_by_estimated_poses_are_read_twice(tmp_path):
    reads, _ = reads_of(UnposedRolling, tmp_path / "out")
    assert reads == sorted(FRAMES * 2)
    reads, result = reads_of(UnposedRolling, tmp_path / "out")
    assert (reads, result.skipped) == ([], 8)


def test_boxes_that_are_missing_are_made_from_what_was_written(tmp_path):
    reads_of(Boxed, tmp_path / "out")
    for path in (tmp_path / "out").rglob("predictions/*.bin"):
        path.unlink()
    reads, result = reads_of(Boxed, tmp_path / "out")
    assert (reads, result.made) == ([], 8)


class Kept(MemoryWriter):
    """A store that cannot be read back."""


class Memory(Sink):
    location = "memory"

    def __init__(self):
        self.writer = Kept()

    def sequence(self, path):
        return self.writer


def test_a_store_that_cannot_be_read_back_gets_the_same(tmp_path):
    sink = Memory()
    (tmp_path / "nothing").mkdir()
    convert(
        Boxed,
        tmp_path / "nothing",
        sink,
        poses=PoseOptions(force=True),
        grids=None,
        run=Run(workers=1),
    )
    reads_of(Boxed, tmp_path / "out")
    (sequence,) = carlasc.open(tmp_path / "out").sequences().values()
    for name in sequence.fields():
        for frame in FRAMES:
            np.testing.assert_array_equal(
                sink.writer.fields[name, frame], sequence.read(name, frame)
            )


def test_two_workers_write_the_same_bytes(tmp_path):
    reads_of(Boxed, tmp_path / "one")
    reads_of(Boxed, tmp_path / "two", workers=2)
    files = sorted(
        path.relative_to(tmp_path / "one")
        for path in (tmp_path / "one").rglob("*")
        if path.is_file()
    )
    assert files
    for path in files:
        assert (tmp_path / "one" / path).read_bytes() == (tmp_path / "two" / path).read_bytes()


@pytest.mark.slow
def test_what_is_kept_of_a_drive_with_boxes_are_the_boxes_and_not_the_scans(tmp_path):
    def peak(frames):
        class Long(Boxed):
            drive = SimulatedDrive(
                frames=frames,
                things=(Thing("car", (12.0, 1.0, 0.8), (4.4, 1.8, 1.5), 0.0, 6.0),),
                channels=30,
                columns=120,
            )

        tracemalloc.start()
        try:
            reads_of(Long, tmp_path / str(frames))
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(4)
    few, many = peak(16), peak(64)
    assert many - few < 48 * 20_000  # a scan alone has 50 kB


class Sparse(Unposed):
    """A drive in which something covers the sensor in one frame."""

    def sequences(self):
        (recording,) = super().sequences()
        handle = recording.frames[3]
        read = handle.read
        handle.read = lambda: [
            replace(read()[0], points=read()[0].points[:20], labels=None, instances=None)
        ]
        return [recording]


def test_a_scan_with_too_few_points_gets_the_pose_of_the_frame_before(tmp_path):
    reads_of(Sparse, tmp_path / "out")
    (sequence,) = carlasc.open(tmp_path / "out").sequences().values()
    assert len(sequence.read("points", 3)) == 20
    assert np.array_equal(sequence.poses[3], sequence.poses[2])
    # a few points, and a gap
    assert np.linalg.norm(sequence.poses[7, :3, 3]) == pytest.approx(7 * 0.6, abs=0.7)
