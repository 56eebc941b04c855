"""How long a frame from merged scans takes, with its votes in a table, and how much memory.

Small inputs where benchmarks are off.
"""

from __future__ import annotations

import time
import tracemalloc
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from carlasc import FromScans, GridSpec, Run, Voting
from carlasc.core.frames import FrameRange
from carlasc.core.tables import CARLA
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.groundtruth.inputs import FrameData, GridPlan
from carlasc.motion import MotionOptions
from carlasc.motion.tracks import MovingActors
from carlasc.storage import FolderSink, FolderSource, layout
from carlasc.testing.drives import KINDS, SimulatedDrive

# of one thread, whatever else runs
pytestmark = [
    pytest.mark.slow,
    pytest.mark.benchmark(timer=time.process_time),
]

IDS = {
    "road": "Road",
    "building": "Building",
    "vegetation": "Vegetation",
    "pole": "Pole",
    "pedestrian": "Pedestrian",
}
LABELS = np.array([0, *(CARLA.id_of(IDS.get(kind, "Vehicle")) for kind in KINDS[1:])], np.uint32)


def feed_of(folder: Path, full: bool, **options: Any) -> ScanFeed:
    """Write a drive of 31 scans of 57,600 rays, or of 3 small ones, and return what reads them,
    merged with options.
    """
    drive = (
        SimulatedDrive(frames=31, channels=32, columns=1800) if full else SimulatedDrive(frames=3)
    )
    with FolderSink(folder) as sink, sink.sequence("cartesian") as writer:
        for frame in range(drive.frames):
            scan = drive.scan(frame)
            writer.write(
                "points",
                frame,
                np.hstack([scan.points[:, :3], np.zeros((len(scan.points), 1), np.float32)]),
            )
            writer.write("labels", frame, LABELS[scan.kinds])
        mount = drive.sensors[0].vehicle_T_sensor
        poses = drive.world_T_vehicle(drive.times) @ mount
        writer.write_document(layout.POSES, layout.encode_poses(np.linalg.inv(poses[0]) @ poses))
    (sequence,) = FolderSource(folder).sequences().values()
    return ScanFeed(sequence, FromScans(motion=MotionOptions("none"), **options))


@pytest.mark.parametrize("keep_evidence", [False, True], ids=["grid", "and evidence"])
@pytest.mark.parametrize("res", [0.4, 0.2, 0.1])
def test_a_frame_from_merged_scans(
    benchmark: Any, tmp_path: Path, res: float, keep_evidence: bool
) -> None:
    feed = feed_of(tmp_path, benchmark.enabled)
    spec = GridSpec.published().with_resolution(res)
    plan = GridPlan(
        spec,
        "evaluation",
        feed.options,
        Voting(keep=True, keep_evidence=keep_evidence),
        FrameRange(),
    )
    frame = int(feed.frames[len(feed.frames) // 2])

    def make() -> tuple[FrameData, Any]:
        feed._free = None  # a frame alone: all rays are followed
        merged = merge_frame(plan, feed, MovingActors(), frame, feed.window_of(frame))
        assert merged.votes is not None
        return merged, merged.votes.to_sparse()

    make()  # compiled, and the scans are read
    tracemalloc.start()
    make()
    benchmark.extra_info["peak_mb"] = round(tracemalloc.get_traced_memory()[1] / 1e6)
    tracemalloc.stop()
    merged, votes = benchmark.pedantic(make, rounds=3 if benchmark.enabled else 1)
    assert merged.grid.known.any() and len(votes)


@pytest.mark.parametrize("kind", ["consecutive", "turning"])
@pytest.mark.parametrize("res", [0.4, 0.2])
def test_a_frame_after_the_one_before(
    benchmark: Any, tmp_path: Path, res: float, kind: str
) -> None:
    feed, places = feed_of(tmp_path, benchmark.enabled, window=(-10, 10)), 1
    if kind == "turning":  # the LiDAR turns while the vehicle moves: a step of a centimetre each
        places = 20
        with FolderSink(tmp_path) as sink, sink.sequence("cartesian") as writer:
            for frame in feed.frames.tolist():
                part = (
                    np.arange(len(feed.sequence.read("points", frame)), dtype=np.float32) * places
                )
                steps = np.floor(part / len(part)) - places // 2
                writer.write("origins", frame, np.outer(steps, [0.01, 0, 0]).astype(np.float32))
        (feed.sequence,) = FolderSource(tmp_path).sequences().values()
    spec = GridSpec.published().with_resolution(res)
    plan = GridPlan(spec, "evaluation", feed.options, Voting(), FrameRange())
    frames = iter(feed.frames[len(feed.frames) // 3 :].tolist())

    def make() -> FrameData:
        frame = next(frames)
        return merge_frame(plan, feed, MovingActors(), frame, feed.window_of(frame))

    make()  # compiled, and the scans are read
    assert len(feed.read(int(feed.frames[0])).rays.ends) == places
    assert benchmark.pedantic(make, rounds=9 if benchmark.enabled else 1).grid.known.any()


def test_the_pass_that_finds_what_moves(benchmark: Any, tmp_path: Path) -> None:
    feed = feed_of(tmp_path, benchmark.enabled)
    feed = ScanFeed(feed.sequence, FromScans(motion=MotionOptions("evidence")))
    run = partial(find_actors, feed, Run(workers=1))
    run()  # compiled
    actors = benchmark.pedantic(run, rounds=3 if benchmark.enabled else 1)
    assert bool(actors.tracks) == benchmark.enabled  # three scans show nothing that moves
