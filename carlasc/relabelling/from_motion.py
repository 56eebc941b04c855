"""Motion labels: a copy of a data set whose scans have the instance and the flow of each point."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from carlasc.core.arrays import AnyArray, BoolArray, Float32Array, FloatArray, Uint32Array
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import invert, moved_back, rotate_vectors, transform_points
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, check_types, only
from carlasc.groundtruth.from_scans.actor_voxels import velocity_at
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.sequences import ScanSequence
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.options import FromScans, Voting
from carlasc.motion.box_table import ONE_FRAME, check_box_file
from carlasc.motion.ground import ground_points
from carlasc.motion.tracks import MovingActors, Track
from carlasc.relabelling.copies import timed, write_in_stages
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import as_source, layout
from carlasc.storage.derived_copies import (
    CopyResult,
    DerivedCopy,
    DerivedSequence,
    sequences_with_scans,
)
from carlasc.storage.files import AnyPath
from carlasc.storage.protocol import Sequence, SequenceWriter, Source
from carlasc.storage.shares import Share

_WRITTEN = ("flow", "instances")
_FOUND = "found by carlasc from "  # words of carlasc.json about motion, before its source


@dataclass
class MotionResult(CopyResult):
    """The result of `label_motion`.

    Attributes:
        actors: number of moving actors.
        notes: remarks on each sequence, one line each.
    """

    actors: int = 0
    notes: list[str] = field(default_factory=list)


def label_motion(
    source: AnyPath | Source,
    out: AnyPath,
    *,
    observe: FromScans = FromScans(),  # noqa: B008 (frozen)
    boxes_out: AnyPath | None = None,
    overwrite: bool = False,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> MotionResult:
    """Write a copy of a data set whose scans have the actor and the velocity of each point.

    The source is not changed.

    The fields `instances` and `flow` are made from the bodies of moving actors, which are found as
    `observe` says: by default from the best field that exists, and from free space. An actor has
    one number in the whole sequence: its number in the data, if it has one. Points of static actors
    keep the numbers of the data. Points of moving actors get moving classes, if the class table has
    any, as SemanticKITTI's. Grids are left out. Files that do not change are hard links to those of
    the source, where both are folders of one file system: do not edit such files in place. An
    interrupted run leaves `<out>.part`; the same call again finishes it.

    Args:
        source: the data set with the points: anything that `carlasc.open` takes, or a source.
        out: the folder to write: a path, or a URL of an object store.
        observe: how moving points are found, and where poses come from. `dynamic` is "align".
        boxes_out: .csv, .json or .parquet file of the boxes of the moving actors of one sequence,
            which is replaced: one row per actor and scan, in the frame of the poses, right-handed.
        overwrite: replace a data set at `out` that this function has made.
        run: how the work is spread. Steps of progress are scans, then files.

    Returns:
        The files that were written, and the actors that were found.

    Raises:
        ArgumentError: `observe` does not find actors, or `boxes_out` has an unknown ending or is
            given for several sequences.
        ConflictError: something exists at `out`, or `out` lies inside `source`, or an interrupted
            run had other options.
        MissingDataError: there are no scans, or not the field that `observe` asks for.
        FormatError: poses or times are not valid.
        StorageError: the files cannot be written.
    """
    check_types(label_motion, locals())
    began = time.perf_counter()
    if observe.dynamic != "align" or observe.motion.source == "none":
        found = f'dynamic="{observe.dynamic}", motion "{observe.motion.source}"'
        raise ArgumentError(
            "observe", expected='dynamic="align", and something that shows motion', found=found
        )
    share = Share(as_source(source), run)
    given = sequences_with_scans(share)
    if boxes_out is not None:
        only("boxes_out", given, ONE_FRAME)
        check_box_file("boxes_out", Path(boxes_out))
    inputs = scan_sequences_of(given, observe)
    copy = DerivedCopy(
        share,
        out,
        {"observe": repr(observe)},
        kind="motion found by carlasc",
        is_kind=lambda metadata: str(metadata.extra.get("motion")).startswith(_FOUND),
        overwrite=overwrite,
        run=run,
    )

    def find(
        path: str, writer: SequenceWriter | None, pool: Run, step: StepCounter
    ) -> _MovingSequence:
        inputs[path].prepare(writer, pool, step)
        if boxes_out is not None:
            inputs[path].box_table(given[path].frames("points").tolist()).write(boxes_out)
        return _MovingSequence(given[path], inputs[path].feed, inputs[path].actors)

    scans = sum(one.steps_before for one in inputs.values())
    moving, copied = write_in_stages(copy, given, find, share.run, scans=scans, made=_WRITTEN)
    notes = [note for one in inputs.values() for note in one.notes() if "grids" not in note]
    tables = [one.metadata.classes for one in given.values()]
    lacking = sorted({table.name for table in tables if not table.standing})
    if lacking and any("labels" in one.fields() for one in given.values()):
        notes.append(
            f"the classes {', '.join(lacking)} do not separate moving and static actors: labels do "
            f"not change; instances and flow show motion"
        )
    return MotionResult(
        **timed(copied, began),
        actors=sum(len(set(one.actors.numbers.values())) for one in moving.values()),
        notes=notes,
    )


def scan_sequences_of(given: Mapping[str, Sequence], observe: FromScans) -> dict[str, ScanSequence]:
    """Return sequences whose actors can be found and numbered, by path.

    It raises the errors of their poses, times and fields, before anything is written.
    """
    voting = Voting(keep_actors=True)
    plan = GridPlan(GridSpec.published(), layout.EVALUATION, observe, voting, FrameRange())
    inputs = {path: ScanSequence(one, plan, observe) for path, one in given.items()}
    for one in inputs.values():
        _ = one.feed.motion
    return inputs


class _MovingSequence(DerivedSequence):
    """A sequence with the instances and the flow of the actors that were found."""

    def __init__(self, whole: Sequence, feed: ScanFeed, actors: MovingActors) -> None:
        words = {"motion": f"{_FOUND}{' and '.join(feed.motion) or 'nothing'}"}
        metadata = replace(whole.metadata, extra={**whole.metadata.extra, **words})
        made = dict.fromkeys(_WRITTEN, whole.frames("points"))
        if whole.metadata.classes.standing and "labels" in whole.fields():
            made["labels"] = whole.frames("labels")
        super().__init__(whole, {layout.METADATA: metadata.to_json()}, made=made)
        self._feed = feed
        self.actors = actors

    def make(self, frame: int) -> dict[str, AnyArray]:
        """Return the new fields of a frame, and its labels if they change."""
        instances, flow = points_of_actors(self._feed, self.actors.between(frame, frame), frame)
        fields: dict[str, AnyArray] = {"instances": instances, "flow": flow}
        if frame in self.made.get("labels", ()):
            labels = self.whole.read("labels", frame).astype(np.uint32)
            for moving, standing in self.whole.metadata.classes.standing.items():
                labels[(labels == standing) & flow.any(axis=1)] = moving
            fields["labels"] = labels
        return fields


def points_of_actors(
    feed: ScanFeed, actors: MovingActors, frame: int
) -> tuple[Uint32Array, Float32Array]:
    """Return the actor and the velocity of each point of a scan.

    Args:
        feed: the scans.
        actors: the moving actors, with numbers.
        frame: number of the scan.

    Returns:
        (N,) uint32 numbers, 0 for none, and (N, 3) float32 m/s, sensor frame, ego motion removed.
    """
    fields = {"labels", "instances", "seconds"} & feed.sequence.fields()
    scan = feed.sequence.scan(frame, tuple(sorted(fields)))
    pose = feed.pose(frame)
    moving = [track.instance for track in actors.tracks.values()]
    numbers = np.zeros(len(scan), np.uint32)
    if scan.instances is not None:  # points of moving actors get the numbers of tracks
        numbers[:] = np.where(np.isin(scan.instances, moving), 0, scan.instances)
    flow = np.zeros((len(scan), 3))
    world = transform_points(pose, scan.points)
    classes = feed.classes
    if scan.labels is not None and feed.trusts_ground_labels and classes.ground:
        ground = np.isin(scan.labels, sorted(classes.ground))
    else:
        ground = ground_points(scan.points)
        if scan.labels is not None:  # wheels are near the ground, but not ground
            ground &= ~np.isin(scan.labels, sorted(classes.movable))
    if "boxes" in feed.sequence.fields() and (boxes := feed.sequence.boxes(frame)) is not None:
        static = boxes.select(~np.isin(boxes.tracks, moving))
        row = static.owners(scan.points)
        boxed = (row >= 0) & (numbers == 0) & ~ground
        numbers[boxed] = static.tracks[row[boxed]]
    # Merging leaves out some points and sorts the others. Points are found again by their
    # coordinates: equal points have the same place among all points in order.
    both = np.concatenate([scan.points, feed.read(frame).points])
    order = np.lexsort(both.T)
    is_new = np.ones(len(both), np.bool_)
    is_new[1:] = (both[order[1:]] != both[order[:-1]]).any(axis=1)
    place = np.empty(len(both), np.int64)
    place[order] = np.cumsum(is_new)
    of_scan, of_merged = np.split(place, [len(scan)])
    tracks = [(n, t) for n, t in actors.tracks.items() if t.pose(frame) is not None]
    times = scan.others.get("seconds")
    for number, track in sorted(tracks, key=lambda item: -float(np.prod(item[1].size))):
        settled = moved_back(world, times, track.velocity[frame - track.first])
        own = _inside(track, frame, settled) & ~ground
        own |= np.isin(of_scan, of_merged[track.members.get(frame, [])])
        velocity = rotate_vectors(invert(pose), velocity_at(track, frame, settled[own], feed))
        is_fast = np.square(velocity).sum(axis=1) > feed.options.motion.min_speed_m_s**2
        numbers[own] = actors.numbers[number]
        flow[own] = np.where(is_fast[:, None], velocity, 0)
    return numbers, flow.astype(np.float32)


def _inside(track: Track, frame: int, world: FloatArray) -> BoolArray:
    """Return (N,) bool: which (N, 3) positions, metres, world, are in the body of a track."""
    pose = track.world_T_actor[frame - track.first]
    near = (
        np.abs(world - pose[:3, 3]) <= np.linalg.norm(np.maximum(-track.lower, track.upper))
    ).all(axis=1)
    local = transform_points(invert(pose), world[near])
    near[near] = ((local >= track.lower) & (local <= track.upper)).all(axis=1)
    return near
