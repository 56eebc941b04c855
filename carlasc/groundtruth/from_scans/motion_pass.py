"""The passes over the scans of a sequence, before the first grid is made: poses are refined, then
actors are found.

Several workers read scans in batches. Segments are linked in order of time, and the track of an
actor is estimated after its last observation. Memory does not grow with the length of a drive,
except for the result.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any, TypeVar

import numpy as np

from carlasc.core.arrays import AnyIntArray, Int32Array, IntArray
from carlasc.core.geometry import invert, multiply, thin, transform_points
from carlasc.errors import CarlascError, count
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.motion import (
    HORIZON_S,
    ActorFollower,
    Chain,
    FreeSpaceEvidence,
    Linker,
    Segment,
    Track,
    complete_bodies,
    find_evidence,
    make_track,
    seen_from,
    tracks_from_boxes,
)
from carlasc.motion.bodies import surface_of
from carlasc.motion.boxes import register_boxes
from carlasc.motion.found_actors import FoundActor
from carlasc.motion.refinement import RefinedPoses, ThinnedScan, refine_poses
from carlasc.motion.tracks import FIRST_FOUND, MovingActors, with_surfaces
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.protocol import Sequence as StoredScans
from carlasc.storage.protocol import SequenceWriter
from carlasc.storage.resuming import derived_key, read_derived

TRACKS, POSES, STRETCHES = "tracks", "poses", "stretches"
"""The names of the files with actors, with refined poses, and with those of the first stretches of
a drive until all are refined, in the folder of derived results.
"""

# of the methods: a version changes only when the same input gives another result
_VERSIONS = {
    TRACKS: 13,
    POSES: 2,
}
_NOTED_M = 0.04  # if scans disagree by more and poses do not change, there is a note
_BATCH = 200  # number of frames between estimates of finished tracks
_ACTORS = 32  # number of actors whose tracks are estimated together
_SHAPE_POINTS = 128  # number of points of a boxed object in a scan, for its shape and its motion
_BLOCK = 50, 200  # least and greatest number of frames whose evidence is found in one piece

Item = TypeVar("Item")
Result = TypeVar("Result")


def _evidence_of(
    block: tuple[int, ...], feed: ScanFeed, boxes: tuple[Track, ...]
) -> Iterator[FreeSpaceEvidence]:
    """Find evidence of motion in the scans of a block.

    It also reads the scans of some seconds before and after.
    """
    times = feed.times
    begin, end = times[block[0]] - HORIZON_S, times[block[-1]] + HORIZON_S
    near = [frame for frame, seconds in times.items() if begin <= seconds <= end]
    scans = map(partial(feed.evidence_scan, boxes=boxes), near)
    # labels that are often wrong must not split actors
    movable = feed.classes.movable if feed.trusts_ground_labels else ()
    found = find_evidence(scans, movable=movable, frames=frozenset(block))
    return map(FreeSpaceEvidence.thinned, found)


def _find_evidence(*args: Any, **options: Any) -> list[FreeSpaceEvidence]:
    """As `_evidence_of`, in a worker."""
    return list(_evidence_of(*args, **options))


def track_of(actor: FoundActor, times: dict[int, float], deformable: frozenset[int]) -> Track:
    """Estimate the track of one actor, in a worker."""
    chain, rigid, sure, path = actor
    return make_track(chain, times, deformable=deformable, rigid=rigid, confidence=sure, path=path)


def _follow_box(boxed: tuple[Track, list[Segment]], times: dict[int, float]) -> Track:
    """Register the track of a box to the points in it, in a worker."""
    track, segments = boxed
    return _with_members(register_boxes(track, segments, times), segments)


def _each(
    function: Callable[[Item], Result], items: Iterable[Item], run: Run
) -> closing[Generator[Result]]:
    """Return the results of a function of items, in a context that stops the work at its end."""
    return closing(run_all(function, items, run))


def find_actors(
    feed: ScanFeed,
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
    steps: Callable[[int], None] = lambda scans: None,
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
    boxes = _box_tracks(feed)
    moving_boxes = tuple(track for track in boxes if track.moves)
    tracks = _boxed(feed, run, steps, boxes, moving_boxes) if boxes else _linked(feed, run, steps)
    if "evidence" not in feed.motion:
        return MovingActors.of(tracks if boxes else complete_bodies(tracks))
    frames = list(feed.times)
    # A block reads the seconds around it too: longer blocks repeat less, and shorter ones keep all
    # processes busy.
    size = min(max(-(-len(frames) // run.processes), _BLOCK[0]), _BLOCK[1])
    blocks = [tuple(frames[begin : begin + size]) for begin in range(0, len(frames), size)]
    follower = follower_of(feed)
    found, waiting = list[Track](), list[FoundActor]()
    # This process gives each scan as soon as it can, so that progress moves.
    is_here = run.executor is None and (run.processes == 1 or len(blocks) == 1)
    find, blocks = (_evidence_of, [tuple(frames)]) if is_here else (_find_evidence, blocks)
    with _each(partial(find, feed=feed, boxes=moving_boxes), blocks, run) as results:
        for evidence in chain.from_iterable(results):
            waiting += follower.add(evidence)
            steps(1)
            if len(waiting) >= _ACTORS:
                found += _estimate(feed, run, waiting)
                waiting = []
    found += _estimate(feed, run, [*waiting, *follower.finish()])
    found = [track for track in found if track.instance not in follower.riders]
    tracks += found
    # points of what is too large for one actor moved, but not together
    moving = untracked(follower.moved, [track for track in found if track.is_possible])
    tracks = tracks if boxes else complete_bodies(tracks)
    return MovingActors.of(tracks, moving, follower.own, follower.seen)


def follower_of(feed: ScanFeed) -> ActorFollower:
    """Return what follows the actors that the evidence of a sequence shows."""
    return ActorFollower(
        deformable=feed.classes.deformable,
        first_instance=FIRST_FOUND,
        default_label=0 if feed.has_labels else feed.classes.geometry_id,
    )


def _linked(feed: ScanFeed, run: Run, steps: Callable[[int], None]) -> list[Track]:
    """Return the tracks of the actors that flow or instances show."""
    frames, times, tracks = list(feed.times), feed.times, list[Track]()
    if not {"flow", "instances"} & set(feed.motion):
        if "boxes" in feed.motion:  # a sequence of boxes without any box
            steps(len(frames))
        return tracks
    linker = Linker()
    # Linking is in order of time and in this process; segments before it and tracks after it are
    # made in workers. Batches bound the chains that wait for their track.
    for begin in range(0, len(frames), _BATCH):
        ended: list[Chain] = []
        with _each(partial(feed.segments, boxes=()), frames[begin : begin + _BATCH], run) as scans:
            for scan in scans:
                ended += linker.add(scan.frame, times[scan.frame], scan.segments, scan.static)
                steps(1)
        if begin + _BATCH >= len(frames):
            ended += linker.finish()
        tracks += _estimate(feed, run, map(FoundActor, ended))
    return tracks


def _boxed(
    feed: ScanFeed,
    run: Run,
    steps: Callable[[int], None],
    boxes: list[Track],
    moving: tuple[Track, ...],
) -> list[Track]:
    """Return the tracks of annotated boxes, with the points in them."""
    segments: dict[int, list[Segment]] = {}
    with _each(partial(feed.segments, boxes=moving), list(feed.times), run) as scans:
        for scan in scans:
            for segment in scan.segments:
                few = replace(segment, points=thin(segment.points, _SHAPE_POINTS))
                segments.setdefault(segment.instance, []).append(few)
            steps(1)
    boxed = [(track, segments.get(track.instance, [])) for track in boxes]
    with _each(partial(_follow_box, times=feed.times), boxed, run) as tracks:
        return with_surfaces(list(tracks))


def _estimate(feed: ScanFeed, run: Run, actors: Iterable[FoundActor]) -> list[Track]:
    """Return the tracks of actors."""
    make = partial(track_of, times=feed.times, deformable=feed.classes.deformable)
    with _each(make, actors, run) as tracks:
        return list(tracks)


def untracked(moved: dict[int, Int32Array], tracks: list[Track]) -> dict[int, AnyIntArray]:
    """Return the moved points of each frame that belong to no track."""
    tracked: dict[int, list[AnyIntArray]] = {}
    for track in tracks:
        for frame, members in track.members.items():
            tracked.setdefault(frame, []).append(members)
    nothing = np.empty(0, np.int32)
    return {
        frame: points[
            ~np.isin(points, np.concatenate([nothing, *tracked.get(frame, [])]), kind="table")
        ]
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


@dataclass(frozen=True)
class Kept:
    """A file of actors or of refined poses, for later runs with the same scans and settings.

    Attributes:
        writer: keeps the file beside the grids; None: nothing is kept.
        name: `TRACKS` or `POSES`.
        key: digest of the scans, their given poses, and the settings.
    """

    writer: SequenceWriter | None
    name: str
    key: str

    @classmethod
    def of(
        cls, writer: SequenceWriter | None, name: str, feed: ScanFeed, run: Run, **settings: Any
    ) -> Kept:
        """Return the file for the scans of a feed."""
        if writer is None:
            return cls(writer, name, "")
        # The digest of scans, not of poses, is given: `derived_key` adds the given poses.
        settings = {"range_m": [feed.min_range_m, str(feed.max_range_m)], **settings}
        args = feed.sequence, feed.frames, feed.digest(writer, run)
        return cls(writer, name, derived_key(*args, version=_VERSIONS[name], **settings))

    def read(self, parse: Callable[[bytes, str], tuple[Result, str]]) -> Result | None:
        """Return what the file holds; None without one."""
        return (
            None if self.writer is None else read_derived(self.writer, self.name, self.key, parse)
        )

    def write(self, made: RefinedPoses | MovingActors) -> None:
        """Keep a result."""
        if self.writer is not None:
            self.writer.write_document(self.document, made.to_bytes(self.key))

    @property
    def document(self) -> str:
        """Name of the file in the folder of the sequence."""
        return layout.derived(self.name, self.key)


def refine_sequence(
    feed: ScanFeed,
    writer: SequenceWriter | None = None,
    run: Run = Run(),  # noqa: B008 (frozen)
    steps: Callable[[int], None] = lambda scans: None,
) -> RefinedPoses:
    """Refine the poses of the frames of a sequence, or return what an earlier run kept.

    Args:
        feed: the scans, under the given poses.
        writer: keeps the result; None: it is not kept.
        run: how the work is spread. All workers read scans, and this process aligns them.
        steps: called with the number of scans that were read since the last call.
    """
    frames, options = feed.frames.tolist(), feed.options.poses
    asked = {"refine": options.refine, "loops": options.loops}
    file = Kept.of(writer, POSES, feed, run, **asked, movable=sorted(feed.classes.movable))
    refined = file.read(RefinedPoses.from_bytes)
    if refined is not None:
        steps(len(frames))
        return refined
    given = np.stack([feed.pose(frame) for frame in frames])
    begun = replace(file, name=STRETCHES)
    with _each(partial(_thin_scan, feed=feed), frames, run) as scans:
        refined = refine_poses(
            scans,
            given,
            always=options.refine == "always",
            loops=options.loops,
            steps=steps,
            begun=begun.read(RefinedPoses.from_bytes),
            keep=begun.write,
        )
    file.write(refined)
    if writer is not None:
        writer.remove_document(begun.document)
    return refined


def _thin_scan(frame: int, feed: ScanFeed) -> ThinnedScan:
    """Read a scan for the refinement, in a worker."""
    try:
        points = feed.static_points(frame)
    except CarlascError:  # making the frame raises the same error, which is reported
        points = np.empty((0, 3), np.float32)
    return ThinnedScan.of(points, feed.pose(frame))


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
    if refined.refined.any() and (before != after or not len(refined.loops)):
        but = f"; those of frames {left} were left alone" if left else ""
        yield f"poses were refined: neighbouring scans disagreed by {before}, now by {after}{but}"
    if len(refined.loops):
        was, now = 100 * np.sqrt(np.square(refined.loops[:, 2:]).mean(axis=0))
        yield (
            f"{count(len(refined.loops), 'loop')} closed: surfaces that are met again disagreed by "
            f"{was:.1f} cm, now by {now:.1f} cm"
        )
    if not refined.fits.all():
        rows = np.flatnonzero(~refined.fits)
        yield (
            f"scans do not fit each other under the poses of frames {frames[rows[0]]} to "
            f"{frames[rows[-1]]}, which were not refined: check that these belong to them"
        )
    elif not refined.refined.any() and (refined.disagreements_m[0] or 0.0) > _NOTED_M:
        yield f"poses could not be refined, although neighbouring scans disagree by {before}"
