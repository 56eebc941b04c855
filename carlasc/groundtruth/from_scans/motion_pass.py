"""The passes over the scans of a sequence, before the first grid is made: poses are refined, then
actors are found.

Several workers read scans in batches. Segments are linked in order of time, and the track of an
actor is estimated after its last observation. Memory does not grow with the length of a drive,
except for the result.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice
from typing import Any, TypeVar

import numpy as np

from carlasc.core.arrays import AnyIntArray, FloatArray, IntArray
from carlasc.core.geometry import invert, multiply, thin, transform_points
from carlasc.errors import CarlascError
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.motion import (
    HORIZON_S,
    Chain,
    FreeSpaceEvidence,
    Linker,
    Segment,
    Track,
    complete_bodies,
    find_evidence,
    follow_actors,
    make_track,
    seen_from,
    tracks_from_boxes,
)
from carlasc.motion.bodies import surface_of
from carlasc.motion.boxes import register_boxes
from carlasc.motion.refinement import RefinedPoses, ThinnedScan, refine_poses
from carlasc.motion.tracks import FIRST_FOUND, MovingActors, with_surfaces
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.protocol import Sequence as StoredScans
from carlasc.storage.resuming import derived_key, read_derived
from carlasc.storage.sinks import SequenceWriter

TRACKS, POSES = "tracks", "poses"
"""The names of the files with actors and with refined poses, in the folder of derived results."""

# of the methods: a version changes only when the same input gives another result
_VERSIONS = {
    TRACKS: 5,
    POSES: 1,
}
_NOTED_M = 0.04  # if scans disagree by more and poses do not change, there is a note
_BATCH = 200  # number of frames between estimates of finished tracks
_ACTORS = 32  # number of actors whose tracks are estimated together
_SHAPE_POINTS = 128  # number of points of a boxed object in a scan, for its shape and its motion
_BLOCK = 100, 400  # least and greatest number of frames whose evidence is found in one piece

Item = TypeVar("Item")
Result = TypeVar("Result")


def _find_evidence(
    block: tuple[int, ...], feed: ScanFeed, boxes: tuple[Track, ...]
) -> list[FreeSpaceEvidence]:
    """Find evidence of motion in the scans of a block, in a worker.

    It also reads the scans of some seconds before and after.
    """
    times = feed.times
    begin, end = times[block[0]] - HORIZON_S, times[block[-1]] + HORIZON_S
    near = (frame for frame, seconds in times.items() if begin <= seconds <= end)
    scans = (feed.evidence_scan(frame, boxes) for frame in near)
    # labels that are often wrong must not split actors
    movable = feed.classes.movable if feed.trusts_ground_labels else ()
    chosen = set(block)
    return [one.thinned() for one in find_evidence(scans, movable=movable) if one.frame in chosen]


def _make_track(
    actor: tuple[Chain, bool | None, float], times: dict[int, float], deformable: frozenset[int]
) -> Track:
    """Estimate the track of one actor, in a worker."""
    chain, rigid, confidence = actor
    return make_track(chain, times, deformable=deformable, rigid=rigid, confidence=confidence)


def _follow_box(boxed: tuple[Track, list[Segment]], times: dict[int, float]) -> Track:
    """Register the track of a box to the points in it, in a worker."""
    track, segments = boxed
    return _with_members(register_boxes(track, segments, times), segments)


@dataclass(frozen=True)
class _MotionPass:
    """The steps of `find_actors`.

    Attributes:
        feed: the scans of the sequence.
        run: how the work is spread.
        steps: called with the number of scans that were read since the last call.
    """

    feed: ScanFeed
    run: Run
    steps: Callable[[int], None]

    def _each(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> closing[Generator[Result]]:
        """Return the results of a function of each item, in a context that stops the work at its
        end.
        """
        return closing(run_all(function, items, self.run))

    def linked(self) -> list[Track]:
        """Return the tracks of the actors that flow or instances show."""
        frames, times = list(self.feed.times), self.feed.times
        linker, tracks = Linker(), list[Track]()
        if not {"flow", "instances"} & set(self.feed.motion):
            if "boxes" in self.feed.motion:  # a sequence of boxes without any box
                self.steps(len(frames))
            return tracks
        # Linking is in order of time and in this process; segments before it and tracks after it
        # are made in workers. Batches bound the chains that wait for their track.
        for begin in range(0, len(frames), _BATCH):
            ended: list[Chain] = []
            with self._each(
                partial(self.feed.segments, boxes=()), frames[begin : begin + _BATCH]
            ) as scans:
                for scan in scans:
                    ended += linker.add(scan.frame, times[scan.frame], scan.segments, scan.static)
                    self.steps(1)
            if begin + _BATCH >= len(frames):
                ended += linker.finish()
            tracks += self._estimate([(linked, None, 1.0) for linked in ended])
        return tracks

    def boxed(self, boxes: list[Track], moving: tuple[Track, ...]) -> list[Track]:
        """Return the tracks of annotated boxes, with the points in them."""
        segments: dict[int, list[Segment]] = {}
        with self._each(partial(self.feed.segments, boxes=moving), list(self.feed.times)) as scans:
            for scan in scans:
                for segment in scan.segments:
                    few = replace(segment, points=thin(segment.points, _SHAPE_POINTS))
                    segments.setdefault(segment.instance, []).append(few)
                self.steps(1)
        boxed = [(track, segments.get(track.instance, [])) for track in boxes]
        with self._each(partial(_follow_box, times=self.feed.times), boxed) as tracks:
            return with_surfaces(list(tracks))

    def found(
        self, boxes: tuple[Track, ...]
    ) -> tuple[list[Track], dict[int, AnyIntArray], list[FloatArray]]:
        """Return the tracks of found actors, and `moving` and `own` of `MovingActors`."""
        frames = list(self.feed.times)
        # A block reads the seconds around it too: longer blocks repeat less, and shorter ones keep
        # all processes busy.
        size = min(max(-(-len(frames) // self.run.processes), _BLOCK[0]), _BLOCK[1])
        blocks = [tuple(frames[begin : begin + size]) for begin in range(0, len(frames), size)]

        find = partial(_find_evidence, feed=self.feed, boxes=boxes)

        def evidence() -> Iterator[FreeSpaceEvidence]:
            with self._each(find, blocks) as results:
                for found in chain.from_iterable(results):
                    yield found
                    self.steps(1)

        classes = self.feed.classes
        label = 0 if self.feed.has_labels else classes.geometry_id
        moved: dict[int, IntArray] = {}
        own: list[FloatArray] = []
        actors = follow_actors(
            evidence(),
            moved,
            deformable=classes.deformable,
            first_instance=FIRST_FOUND,
            default_label=label,
            own=own,
        )
        tracks: list[Track] = []
        while batch := list(islice(actors, _ACTORS)):
            # their paths are estimated again: integrated velocities would drift
            chains = [
                ([replace(s, velocity=None) for s in m.segments], m.rigid, m.confidence)
                for m in batch
            ]
            tracks += self._estimate(chains)
        return tracks, _untracked(moved, tracks), own

    def _estimate(self, actors: Sequence[tuple[Chain, bool | None, float]]) -> list[Track]:
        make = partial(_make_track, times=self.feed.times, deformable=self.feed.classes.deformable)
        with self._each(make, actors) as tracks:
            return list(tracks)


def find_actors(
    feed: ScanFeed,
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
    steps: Callable[[int], None] | None = None,
) -> MovingActors:
    """Find the actors of a sequence.

    Args:
        feed: the scans of the sequence.
        run: how the work is spread over its scans, blocks of scans and tracks.
        steps: called with the number of scans that were read since the last call.

    Raises:
        FormatError: a scan is not valid.
    """
    # Boxes and fields first: evidence from free space explains only what they leave unexplained.
    by = _MotionPass(feed, run, steps or (lambda scans: None))
    boxes = _box_tracks(feed)
    moving_boxes = tuple(track for track in boxes if track.moves)
    tracks = by.boxed(boxes, moving_boxes) if boxes else by.linked()
    moving: dict[int, AnyIntArray] = {}
    own: list[FloatArray] = []
    if "evidence" in feed.motion:
        found, moving, own = by.found(moving_boxes)
        tracks += found
    return MovingActors.of(tracks if boxes else complete_bodies(tracks), moving, own)


def _untracked(moved: dict[int, IntArray], tracks: list[Track]) -> dict[int, AnyIntArray]:
    """Return the moved points of each frame that belong to no track."""
    tracked: dict[int, list[AnyIntArray]] = {}
    for track in tracks:
        for frame, members in track.members.items():
            tracked.setdefault(frame, []).append(members)
    nothing = np.empty(0, np.int64)
    return {
        frame: np.setdiff1d(points, np.concatenate([nothing, *tracked.get(frame, [])])).astype(
            np.int32
        )
        for frame, points in moved.items()
    }


def _with_members(track: Track, segments: list[Segment]) -> Track:
    """Return the track of a box with the points in it, and the faces that they show."""
    present = [
        (segment, pose) for segment in segments if (pose := track.pose(segment.frame)) is not None
    ]
    if not present:
        return track
    counts = np.array([len(segment.members) for segment, _ in present])
    sensors = np.stack(
        [transform_points(invert(pose), segment.origin) for segment, pose in present]
    )
    members = {segment.frame: segment.members.astype(np.int32) for segment, _ in present}
    extent = seen_from(track.extent.lower, track.extent.upper, counts, sensors)
    body = np.concatenate(
        [transform_points(invert(pose), segment.points) for segment, pose in present]
    )
    surface = surface_of(body if extent.exemplary else body[:0])
    return replace(track, members=members, extent=extent, surface=surface)


def _box_tracks(feed: ScanFeed) -> list[Track]:
    """Return the tracks of the boxes of a sequence, if they show motion.

    Boxes without a scan have no time, and are left out.

    Raises:
        FormatError: the class of a box is not in the table.
    """
    if "boxes" not in feed.motion:
        return []
    frames = [frame for frame in feed.sequence.frames("boxes").tolist() if frame in feed.times]
    boxes = {
        frame: of_frame for frame in frames if (of_frame := feed.sequence.boxes(frame)) is not None
    }
    for frame, of_frame in boxes.items():
        feed.classes.check(of_frame.labels, f"{feed.sequence.location}: boxes of frame {frame}")
    poses = {frame: feed.pose(frame) for frame in boxes}
    return tracks_from_boxes(boxes, poses, feed.times, deformable=feed.classes.deformable)


def read_or_find_actors(
    feed: ScanFeed, writer: SequenceWriter | None, run: Run, steps: Callable[[int], None]
) -> MovingActors:
    """Return the actors that an earlier run kept for the same scans and options; without any, find
    and keep them. Without a writer, nothing is kept.
    """
    if writer is None:
        return find_actors(feed, run, steps)
    about = {"motion": feed.motion, "min_speed_m_s": feed.options.motion.min_speed_m_s}
    key = _key_of(TRACKS, feed, **about)
    actors = read_derived(writer, TRACKS, key, MovingActors.from_bytes)
    if actors is None:
        actors = find_actors(feed, run, steps)
        writer.write_document(layout.derived(TRACKS, key), actors.to_bytes(key))
    else:
        steps(feed.reads_for_actors)
    return actors


def refine_sequence(
    feed: ScanFeed,
    writer: SequenceWriter | None = None,
    run: Run = Run(),  # noqa: B008 (frozen)
    steps: Callable[[int], None] | None = None,
) -> RefinedPoses:
    """Refine the poses of the frames of a sequence, or return what an earlier run kept.

    Args:
        feed: the scans, under the given poses.
        writer: keeps the result; None: it is not kept.
        run: how the work is spread. All workers read scans, and this process aligns them.
        steps: called with the number of scans that were read since the last call.
    """
    frames, mode = feed.frames.tolist(), feed.options.poses.refine
    key = (
        ""
        if writer is None
        else _key_of(POSES, feed, refine=mode, movable=sorted(feed.classes.movable))
    )
    kept = None if writer is None else read_derived(writer, POSES, key, RefinedPoses.from_bytes)
    if kept is not None:
        if steps is not None:
            steps(len(frames))
        return kept
    # The digest of scans, not of poses, is in the key: `derived_key` adds the given poses.
    given = np.stack([feed.pose(frame) for frame in frames])
    with closing(run_all(partial(_thin_scan, feed=feed), frames, run)) as scans:
        refined = refine_poses(scans, given, always=mode == "always", steps=steps)
    if writer is not None:
        writer.write_document(layout.derived(POSES, key), refined.to_bytes(key))
    return refined


def _thin_scan(frame: int, feed: ScanFeed) -> ThinnedScan:
    """Read a scan for the refinement, in a worker."""
    try:
        points = feed.static_points(frame)
    except CarlascError:  # making the frame raises the same error, which is reported
        points = np.empty((0, 3), np.float32)
    return ThinnedScan.of(points, feed.pose(frame))


def _key_of(name: str, feed: ScanFeed, **settings: Any) -> str:
    ranges = [feed.min_range_m, str(feed.max_range_m)]
    return derived_key(
        feed.sequence, feed.frames, feed.digest, version=_VERSIONS[name], range_m=ranges, **settings
    )


def with_refined_poses(
    sequence: StoredScans, frames: IntArray, refined: RefinedPoses
) -> StoredScans:
    """Return a sequence with refined poses.

    Lines of frames without a scan get the correction of the last scan before them.
    """
    given = sequence.poses
    lines = np.array(
        [sequence.line_of(frame, len(given), layout.POSES) for frame in frames.tolist()]
    )
    # The corrections are applied on the left, in the world: the motion from a scan to a line
    # without one stays as it was given.
    row = np.clip(np.searchsorted(lines, np.arange(len(given)), side="right") - 1, 0, None)
    correction = multiply(refined.poses, invert(refined.given))
    poses = multiply(correction[row], given)
    poses[lines] = refined.poses
    return sequence.with_poses(poses)


def pose_notes(refined: RefinedPoses, frames: IntArray) -> Iterator[str]:
    """Yield a line on the result of the refinement; none if the given poses are good."""
    before, after = (f"{100 * (value or 0.0):.1f} cm" for value in refined.disagreements_m)
    left = ", ".join(f"{a} to {b}" for a, b in refined.left(frames)[:3])
    if refined.refined.any():
        but = f"; those of frames {left} were left alone" if left else ""
        yield (f"poses were refined: neighbouring scans disagreed by {before}, now by {after}{but}")
    if not refined.fits.all():
        rows = np.flatnonzero(~refined.fits)
        yield (
            f"scans do not fit each other under the poses of frames {frames[rows[0]]} to "
            f"{frames[rows[-1]]}, which were not refined: check that these belong to them"
        )
    elif not refined.refined.any() and (refined.disagreements_m[0] or 0.0) > _NOTED_M:
        yield (f"poses could not be refined, although neighbouring scans disagree by {before}")
