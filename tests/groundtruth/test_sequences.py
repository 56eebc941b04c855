"""Which trajectories scans are merged by: estimated or given, rigid, without jumps, with increasing
times.
"""

import pickle

import numpy as np
import pytest

import carlasc
from carlasc.core.geometry import rotation_z, translation
from carlasc.errors import FormatError, MissingDataError
from carlasc.groundtruth import FromScans
from carlasc.groundtruth.from_scans.sequences import check_trajectory, with_estimated_poses
from carlasc.groundtruth.inputs import without_caches
from carlasc.motion import PoseOptions
from carlasc.storage import FolderSink, layout


def write(folder, poses, frames=None, times=None):
    """Write a sequence of scans of one point, and open it."""
    writer = FolderSink(folder).sequence("Val/Street/cartesian")
    for frame in range(len(poses)) if frames is None else frames:
        writer.write("points", frame, np.ones((1, 4), np.float32))
    writer.write_document(layout.POSES, layout.encode_poses(np.stack(poses)))
    if times is not None:
        writer.write_document(layout.TIMES, layout.encode_times(np.array(times)))
    (sequence,) = carlasc.open(folder).sequences().values()
    return sequence


def straight(speed_m_s, frames=6):
    return [translation((speed_m_s * 0.1 * frame, 0, 0)) for frame in range(frames)]


def turning(rad_s, frames=6):
    return [rotation_z(rad_s * 0.1 * frame) for frame in range(frames)]


@pytest.mark.parametrize(
    "poses", [straight(69), turning(4.9), turning(-4.9)], ids=["fast", "left", "right"]
)
def test_what_a_vehicle_can_do_is_accepted(tmp_path, poses):
    check_trajectory(write(tmp_path, poses), FromScans())


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (straight(71), "found a jump of 71 m/s and 0.0 rad/s at frame 1 .5 in all."),
        (turning(5.1), "found a jump of 0 m/s and 5.1 rad/s at frame 1 .5 in all."),
        (turning(-5.1), "found a jump of 0 m/s and 5.1 rad/s at frame 1"),
    ],
    ids=["fast", "left", "right"],
)
def test_what_no_vehicle_can_do_is_refused_unless_forced(tmp_path, poses, message):
    sequence = write(tmp_path, poses)
    with pytest.raises(
        FormatError, match=f"poses.txt: expected at most 70 m/s and 5 rad/s, {message}"
    ):
        check_trajectory(sequence, FromScans(poses=PoseOptions("file")))
    check_trajectory(sequence, FromScans(poses=PoseOptions(force=True)))


def test_times_say_how_long_a_vehicle_drove_and_turned(tmp_path):
    # of 2 Hz: 20 m/s and 1 rad/s
    poses = [pose @ turn for pose, turn in zip(straight(100), turning(5), strict=True)]
    check_trajectory(
        write(tmp_path / "slow", poses, times=[0.5 * frame for frame in range(6)]), FromScans()
    )
    with pytest.raises(
        FormatError, match="found a jump of 100 m/s and 3.6 rad/s at frame 1 .5 in all."
    ):
        check_trajectory(
            write(
                tmp_path / "without",
                [p @ t for p, t in zip(straight(100), turning(3.6), strict=True)],
            ),
            FromScans(),
        )
    fast = write(tmp_path / "fast", straight(10), times=[0.01 * frame for frame in range(6)])
    with pytest.raises(
        FormatError, match="found a jump of 100 m/s and 0.0 rad/s at frame 1 .5 in all."
    ):
        check_trajectory(fast, FromScans())


def test_one_scan_has_no_speed(tmp_path):
    check_trajectory(write(tmp_path, straight(10, 1)), FromScans())
    check_trajectory(write(tmp_path / "timed", straight(10, 1), times=[0.0]), FromScans())


def test_missing_scans_leave_a_vehicle_time_to_drive_and_to_turn(tmp_path):
    poses = [pose @ turn for pose, turn in zip(straight(20, 30), turning(1, 30), strict=True)]
    check_trajectory(write(tmp_path / "gap", poses, frames=[0, 1, 12, 29]), FromScans())
    poses[12:] = [translation((800, 0, 0)) @ pose for pose in poses[12:]]
    with pytest.raises(FormatError, match="a jump of 7.. m/s and 1.0 rad/s at frame 12 .1 in all."):
        check_trajectory(write(tmp_path / "jump", poses, frames=[0, 1, 12, 29]), FromScans())


def test_a_pose_that_is_not_rigid_is_refused_even_if_forced(tmp_path):
    poses = straight(10)
    poses[3] = poses[3] @ np.diag([1.0, -1.0, 1.0, 1.0])
    with pytest.raises(FormatError) as error:
        check_trajectory(write(tmp_path, poses), FromScans(poses=PoseOptions(force=True)))
    assert error.value.where.endswith("poses.txt: transform 3")
    assert "reflection" in f"{error.value.found} {error.value.expected}"


@pytest.mark.parametrize(
    ("last", "message"),
    [
        (0.2, "expected increasing times, found 0.2 s and 0.2 s at frames 2 and 3"),
        (0.1, "expected increasing times, found 0.2 s and 0.1 s at frames 2 and 3"),
        (float("nan"), "line 4: expected times in seconds, .*found nan"),
    ],
)
def test_times_must_increase_even_if_forced(tmp_path, last, message):
    sequence = write(tmp_path, straight(10, 4), times=[0.0, 0.1, 0.2, last])
    with pytest.raises(FormatError, match=f"times.txt: {message}"):
        check_trajectory(sequence, FromScans(poses=PoseOptions(force=True)))


def test_a_sequence_without_poses_offers_to_estimate_them(tmp_path):
    sequence = write(tmp_path, straight(10))
    (tmp_path / "Val/Street/cartesian/poses.txt").unlink()
    (sequence,) = carlasc.open(tmp_path).sequences().values()
    with pytest.raises(
        MissingDataError, match='poses.txt: expected poses.*`poses=PoseOptions\\("kiss-icp"\\)`'
    ):
        check_trajectory(sequence, FromScans(poses=PoseOptions("file")))


def test_frames_without_a_scan_take_the_estimated_pose_of_the_scan_before(tmp_path, monkeypatch):
    sequence = write(tmp_path, straight(10, 6), frames=[0, 2, 5])
    sizes = []

    def estimate(scans, times, max_range_m, voxel_m):
        sizes.extend(scan.shape for scan in scans)
        assert times == pytest.approx([0.0, 0.2, 0.5])
        assert (max_range_m, voxel_m) == (100.0, None)
        return np.stack([translation((number, 0, 0)) for number in range(len(sizes))])

    monkeypatch.setattr("carlasc.groundtruth.from_scans.sequences.estimate_poses", estimate)
    estimated = with_estimated_poses(sequence, FromScans())
    assert sizes == [(1, 3)] * 3
    assert estimated.poses[:, 0, 3].tolist() == [0, 0, 1, 1, 1, 2]
    assert [estimated.read_pose(frame)[0, 3] for frame in (0, 2, 5)] == [0, 1, 2]


class TestSequenceWithOtherPoses:
    def test_it_keeps_them_in_light_copies_and_pickles(self, tmp_path):
        sequence = write(tmp_path, straight(10))
        assert sequence.read_pose(2)[0, 3] == pytest.approx(2.0)
        other = sequence.with_poses(np.stack(straight(20)))
        for copy in (other, without_caches(other), pickle.loads(pickle.dumps(other))):
            assert copy.read_pose(2)[0, 3] == pytest.approx(4.0)
            assert np.array_equal(copy.read("points", 1), sequence.read("points", 1))

    def test_the_first_one_keeps_its_own(self, tmp_path):
        sequence = write(tmp_path, straight(10))
        document = sequence.read_document(layout.POSES)
        other = sequence.with_poses(np.stack(straight(20)))
        assert sequence.poses[2, 0, 3] == pytest.approx(2.0)
        assert other.read_document(layout.POSES) == document
