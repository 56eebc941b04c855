"""Sequences whose grids are made from scans: the frames with their windows of scans, and the check
of the trajectory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from carlasc.core.arrays import FloatArray, IntArray
from carlasc.core.geometry import check_rigid, invert, transform_points
from carlasc.core.grids import Grid
from carlasc.errors import ArgumentError, CarlascError, FormatError, MissingDataError
from carlasc.groundtruth.from_scans.actor_voxels import with_numbers
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import (
    TRACKS,
    Kept,
    find_actors,
    pose_notes,
    refine_sequence,
    with_refined_poses,
)
from carlasc.groundtruth.inputs import (
    FrameData,
    FrameInput,
    GridPlan,
    SequenceInput,
    StoredFrame,
    StoredSequence,
)
from carlasc.groundtruth.options import FromScans
from carlasc.groundtruth.reporting import PoseFacts, Residual
from carlasc.motion import ground_points
from carlasc.motion.box_table import BoxTable
from carlasc.motion.odometry import estimate_poses
from carlasc.motion.refinement import MIN_SCANS, RefinedPoses
from carlasc.motion.tracks import FIRST_FOUND, MovingActors, is_doubtful, is_possible
from carlasc.running.spreading import Run
from carlasc.storage import as_source, layout
from carlasc.storage.files import AnyPath
from carlasc.storage.inputs import combined
from carlasc.storage.protocol import Sequence, SequenceWriter, Source
from carlasc.storage.resuming import RECORD

_MAX_SPEED_M_S, _MAX_TURN_RAD_S = 70.0, 5.0  # no vehicle moves or turns faster
_RANGE_M = 100.0  # range of a sensor if carlasc.json does not give it
_TENTH = 10
_LOOKED_AT = 3  # number of scans in which ground below the grid is measured
_BELOW = (
    0.2  # with a greater share of ground points below the grid, there is a note: on hills, some are
)

_UNEXPLAINED = 0.03  # with a greater share of points that move without an actor, there is a warning
_UNEVEN, _APART_M = 3.0, 0.05  # its causes: steps of time over their median, and scans apart


@dataclass(frozen=True)
class ScanWindow:
    """The part of a sequence that a worker needs for one frame: its scans, and the actors in the
    window of the frame.
    """

    feed: ScanFeed
    actors: MovingActors


@dataclass(frozen=True)
class ScanFrame(StoredFrame):
    """One frame of a sequence, with the scans that vote on it, and the actors in them."""

    inputs: ScanSequence | ScanWindow
    number: int
    source_frame: int

    def __reduce__(self) -> tuple[type[Self], tuple[Any, ...]]:
        # Only the actors of the window go to the worker: those of a long drive take megabytes, and
        # each frame is pickled on its own.
        near = ScanWindow(self.inputs.feed, self.actors)
        return type(self), (near, self.number, self.source_frame)

    @property
    def actors(self) -> MovingActors:
        """The actors in the window of the frame."""
        first, last = self.inputs.feed.options.window
        return self.inputs.actors.between(self.number + first, self.number + last)

    def stored(self) -> Sequence:
        """Return the sequence."""
        return self.inputs.feed.sequence

    def make(self, plan: GridPlan) -> FrameData:
        """Read the files of the frame, and count the votes of the scans in its window."""
        feed, (first, last) = self.inputs.feed, self.inputs.feed.options.window
        lost = [one for one in feed.sequence.awaited if first <= one - self.number <= last]
        if lost:
            raise MissingDataError(
                f"frame {self.number}",
                expected=f"the scan of frame {min(lost)}",
                found="a frame that failed",
                advice="repair that one, or finish without it with `allow_gaps=True`",
            )
        fields = self.read()
        window = feed.reaching(self.number, plan.spec)
        merged = merge_frame(plan, feed, self.actors, self.number, window)
        return replace(merged, fields=fields)

    def thinned(self, plan: GridPlan) -> Grid:
        """Return the grid without every tenth of the scans of other frames."""
        feed = self.inputs.feed
        window = feed.reaching(self.number, plan.spec)
        # Every tenth one, from the middle of the first ten: never the scan of the frame itself,
        # which says most about its grid.
        others = [frame for frame in window if frame != self.number]
        left_out = set(others[_TENTH // 2 :: _TENTH])
        kept = [frame for frame in window if frame not in left_out]
        return merge_frame(plan, feed, self.actors, self.number, kept).grid

    def residuals(self) -> Mapping[int, Residual]:
        """Return how well the observations of the moving actors in the frame align with the next
        ones, by number of the actor.
        """
        feed, frame, by_actor = self.inputs.feed, self.number, {}
        for number, track in self.actors.tracks.items():
            later = min((other for other in track.members if frame < other), default=None)
            if later is None or frame not in track.members:
                continue
            here, there = track.pose(frame), track.pose(later)
            own, others = track.members[frame], track.members[later]
            if here is None or there is None or not len(own) or not len(others):
                continue
            one, other = (
                transform_points(feed.pose(f), feed.read(f).points[members].astype(np.float64))
                for f, members in ((frame, own), (later, others))
            )
            by_actor[number] = Residual.between(one, other, here, there)
        return by_actor


class ScanSequence(StoredSequence):
    """A sequence whose scans are merged over time."""

    def __init__(self, sequence: Sequence, plan: GridPlan, options: FromScans) -> None:
        super().__init__(sequence, plan)
        self.options = options
        self.actors = MovingActors()
        self.refined: RefinedPoses | None = None
        self._is_prepared = False

    @cached_property
    def estimates_poses(self) -> bool:
        """Whether poses are estimated from the scans: because the options require it, or the
        sequence has none except those of an earlier run.
        """
        sequence, grid = self.sequence, self.plan.grid
        if self.options.poses.source != "auto" or must_estimate(sequence, self.options):
            return must_estimate(sequence, self.options)
        record = sequence.params(grid).get(RECORD) if grid in sequence.grids else None
        return isinstance(record, dict) and record.get("poses") == "kiss-icp"

    @cached_property
    def posed(self) -> Sequence:
        """The sequence with its own poses, or estimated ones, not refined; poses and times are
        checked.

        Raises:
            MissingDataError: there are no poses.
            FormatError: poses or times are not valid.
        """
        sequence = self.sequence
        if self.estimates_poses:
            sequence = with_estimated_poses(sequence, self.options)
        check_trajectory(sequence, self.options)
        return sequence

    @cached_property
    def feed(self) -> ScanFeed:
        """The scans of the sequence, under refined poses after `refine`.

        It raises the same errors as `posed`.
        """
        return ScanFeed(self.posed, self.options)

    def _frame(self, number: int) -> FrameInput:
        return ScanFrame(self, number, number)

    def frame(self, number: int) -> FrameInput | None:
        """Return a frame of the sequence, chosen or not; None if it has no scan."""
        return self._frame(number) if number in self.feed.frames else None

    def depended(self) -> list[int]:
        """Return all frames if actors or poses are found in them; otherwise those of windows, and
        those in which classes are looked at.
        """
        feed = self.feed
        if feed.needs_actors or self.refines or self.estimates_poses or self.plan.needs_all:
            return feed.frames.tolist()
        near = {other for one in self.frames for other in feed.window_of(one.number)}
        return sorted(near | {*feed.sampled} | {one.number for one in self.frames})

    def take_contents(self, contents: Mapping[int, str]) -> None:
        """Take the digests of the files of frames, which identify actors and refined poses, too."""
        self.feed.contents |= contents

    def about(self, frame: int) -> object:
        """Return the given pose and the time of a frame."""
        pose = b"" if self.estimates_poses else self.posed.read_pose(frame).tobytes()
        return pose, self.feed.time(frame)

    def shared(self) -> object:
        """Return what all frames depend on, besides the settings in params.json."""
        return super().shared(), self.feed.min_range_m, self.feed.max_range_m

    def made_from(self, number: int, own: Mapping[str, str], whole: str) -> str:
        """Return a digest of the scans of the window, their poses, and the actors in it."""
        feed, (first, last) = self.feed, self.options.window
        if self.plan.needs_all or self.estimates_poses:
            return whole
        window = [*feed.window_of(number), number]
        scans = [(other, own[str(other)], feed.pose(other).tobytes()) for other in window]
        near = self.actors.between(number + first, number + last)
        actors = near.to_bytes("", is_compressed=False)  # to compress them costs half a grid
        return combined(scans, actors, self.shared(), feed.must_find_ground)

    @property
    def steps_before(self) -> int:
        """Number of scans that the passes before the grids read: to refine poses, and to find
        actors.
        """
        return self.feed.reads_for_actors + (len(self.feed.frames) if self.refines else 0)

    def prepare(
        self, writer: SequenceWriter | None, run: Run, steps: Callable[[int], None]
    ) -> None:
        """Refine the poses of the sequence, and find its actors, or read the results of an earlier
        run with `writer`.
        """
        if self._is_prepared:
            return
        self._is_prepared = True
        if self.refines:
            self.use_refined(refine_sequence(self.feed, writer, run, steps))
        if self.feed.needs_actors:
            feed, speed = self.feed, self.options.motion.min_speed_m_s
            file = Kept.of(writer, TRACKS, feed, run, motion=feed.motion, min_speed_m_s=speed)
            kept = file.read(MovingActors.from_bytes)
            if kept is None:
                self.actors = find_actors(feed, run, steps)
                file.write(self.actors)
            else:
                self.actors = kept
                steps(feed.reads_for_actors)
        if self.plan.voting.keep_actors:
            self.actors = with_numbers(self.actors, self.feed)

    @property
    def refines(self) -> bool:
        """Whether poses may be refined."""
        return self.options.poses.refine != "never" and len(self.feed.frames) >= MIN_SCANS

    def use_refined(self, refined: RefinedPoses) -> None:
        """Give the feed the refined poses, if any pose was refined."""
        self.refined = refined
        if refined.refined.any():
            self.feed = self.feed.with_poses_of(
                with_refined_poses(self.posed, self.feed.frames, refined)
            )

    def box_table(self, frames: list[int], *, refined: bool = False) -> BoxTable:
        """Return the boxes of the moving actors, which were found, at some frames: in the frame of
        the sequence's own poses, or of the refined ones.
        """
        times = dict(zip(frames, self.posed.times_of(frames).tolist(), strict=True))
        feed = self.feed if refined else ScanFeed(self.posed, self.options)
        return BoxTable.of_tracks(
            self.actors.tracks,
            {f: (times[f], feed.pose(f) @ invert(self.feed.pose(f))) for f in frames},
            self.metadata.classes.names,
            left=self.metadata.axes == "left",
            numbers=self.actors.numbers,
        )

    def summaries(self) -> Series[Mapping[str, Any]] | None:
        """Return the facts of each actor, by number; None if actors are not tracked."""
        return self.actors.summary if self.feed.needs_actors else None

    def pose_facts(self) -> PoseFacts | None:
        """Return how poses were refined; None if refinement is off."""
        return None if self.refined is None else PoseFacts.of(self.refined, self.feed.frames)

    def record(self) -> dict[str, Any]:
        """Return how scans are merged."""
        # Values that change nothing are left out: runs with and without them continue each other.
        options, record = self.options, dict[str, Any]()
        motion = "+".join(self.feed.motion) or "none"
        record |= {"observe": "scans", "motion": motion, "dynamic": options.dynamic}
        record |= {"complete": options.complete} if options.dynamic == "align" else {}
        record |= {} if options.own_path else {"own_path": False}
        record |= {"poses": "kiss-icp"} if self.estimates_poses else {}
        record |= {"refine": options.poses.refine} if self.refines else {}
        record |= {} if options.poses.loops == "auto" or not self.refines else {"loops": "never"}
        record |= {"window": f"{options.window[0]}:{options.window[1]}", "stride": options.stride}
        record |= {} if options.window_m is None else {"window_m": options.window_m}
        limits = {"min_range_m": self.feed.min_range_m, "max_range_m": self.feed.max_range_m}
        return record | {
            name: value for name, value in limits.items() if np.isfinite(value) and value > 0
        }

    def poses(self) -> FloatArray | None:
        """Return the poses to write beside the grids; None if poses were estimated although the
        sequence has its own.
        """
        has_own = layout.POSES in self.sequence.documents()
        return None if has_own and self.estimates_poses else self.posed.poses

    def notes(self) -> list[str]:
        """Return remarks on missing fields, and on the results."""
        where, notes = self.location, self.findings()
        if not self.feed.has_labels:
            notes.append(
                f"{where}: the scans have no labels: grids contain geometry only, in one class"
            )
        below = self._share_below()
        if below > _BELOW:
            notes.append(
                f"{where}: {below:.0%} of the points on the ground are below the grid, which "
                f"begins at {self.plan.spec.lower[2]:g} m"
            )
        if len(self.feed.frames) == 1:
            notes.append(
                f"{where}: there is one scan only: nothing is merged, and what it did not see is "
                f"unknown"
            )
        return notes

    def findings(self) -> list[str]:
        """Return remarks on poses and on moving actors."""
        where, notes = self.location, list[str]()
        if self.estimates_poses and self.options.poses.source == "auto":
            notes.append(
                f"{where}: there are no poses: they were estimated from the scans (kiss-icp)"
            )
        if self.refined is not None:
            notes += [f"{where}: {line}" for line in pose_notes(self.refined, self.feed.frames)]
        if self.feed.has_labels and not self.feed.motion and self.options.dynamic != "tube":
            notes.append(f"{where}: no field shows motion: all points were treated as static")
        actors = sum(track.instance >= FIRST_FOUND for track in self.actors.tracks.values())
        left_out = sum(len(points) for points in self.actors.moving.values())
        if "evidence" in self.feed.motion and (actors or left_out):
            doubtful = sum(
                is_doubtful(actor["confidence"]) for actor in self.actors.summary if actor["moves"]
            )
            shown = [f"{actors} actors that move ({doubtful} of them doubtful)"] if actors else []
            out = ""
            if left_out:
                shown.append(f"{left_out} {'more ' if actors else ''}points that moved")
                out = ": these points were left out of other frames"
            notes.append(
                f"{where}: free space shows {' and '.join(shown)}, although no field of the data "
                f"shows it{out}"
            )
        share = left_out / max(self.actors.seen, 1)
        if share > _UNEXPLAINED:
            notes.append(
                f"{where}: warning: {share:.0%} of all points seem to move and belong to no actor, "
                f"more than in any street: {self._cause()}"
            )
        if self.actors.own:
            notes.append(
                f"{where}: points near the sensor move with it: they are on the recording vehicle, "
                "or on a person who walks beside it at exactly its pace, and were left out"
            )
        wrong = sum(not is_possible(actor["size_m"]) for actor in self.actors.summary)
        if wrong:
            notes.append(
                f"{where}: {wrong} actors are larger than any vehicle, so their numbers or boxes "
                f"are wrong: their points were treated as static"
            )
        return notes

    def _cause(self) -> str:
        """Return why points that stand seem to move, and what to do."""
        steps = np.diff([self.feed.times[frame] for frame in self.feed.frames.tolist()])
        apart = None if self.refined is None else self.refined.disagreements_m[1]
        if len(steps) and (steps.min() <= 0 or steps.max() > _UNEVEN * np.median(steps)):
            return (
                f"the clock is wrong or scans are missing, as scans are {steps.min():.3f} to "
                f"{steps.max():.3f} s apart: check times.txt"
            )
        if apart is not None and apart > _APART_M:
            return (
                f"the poses are wrong, as neighbouring scans disagree by {100 * apart:.1f} cm: try "
                "`--poses kiss-icp` or `--refine always`, and check the calibration"
            )
        return (
            "neighbouring scans agree, so it is rain, snow or dust, or poses drift over seconds: "
            "look at these points, and compare with `--poses kiss-icp`"
        )

    def _share_below(self) -> float:
        """Return the share of the ground points of some scans that are below the grid.

        Scans that cannot be read are skipped here.
        """
        feed, spec = self.feed, self.plan.spec
        # the first, the last, and the one in the middle
        rows = np.unique(np.linspace(0, len(feed.frames) - 1, _LOOKED_AT).astype(int))
        heights = [np.empty(0, np.float32)]
        for frame in feed.frames[rows].tolist():
            try:
                scan = feed.sequence.scan(frame, () if feed.must_find_ground else ("labels",))
            except CarlascError:
                continue
            points = scan.points
            if scan.labels is None or not feed.classes.ground:
                ground = ground_points(points)
            else:
                ground = np.isin(scan.labels, sorted(feed.classes.ground))
            ground &= np.hypot(points[:, 0], points[:, 1]) < abs(spec.upper[0])
            heights.append(points[ground, 2])
        below = np.concatenate(heights) < spec.lower[2]
        return float(below.mean()) if len(below) else 0.0


def scan_sequences(
    source: AnyPath | Source, plan: GridPlan, options: FromScans
) -> list[SequenceInput]:
    """Find the sequences of a source that have scans.

    Raises:
        MissingDataError: there is none.
    """
    sequences: dict[str, Sequence] = {}
    for sequence in as_source(source).sequences().values():
        parent = layout.place_of(sequence.path)
        # scans may exist beside the grids of both coordinates: take the folder with more
        other = sequences.get(parent)
        if other is None or len(sequence.frames("points")) > len(other.frames("points")):
            sequences[parent] = sequence
    chosen = [sequence for sequence in sequences.values() if "points" in sequence.fields()]
    if not chosen:
        raise MissingDataError(source, expected="sequences with scans (velodyne/)", found="none")
    return [ScanSequence(sequence, plan, options) for sequence in chosen]


def must_estimate(sequence: Sequence, options: FromScans) -> bool:
    """Return whether poses are estimated from the scans: because the options require it, or the
    sequence has none and they allow it.
    """
    source = options.poses.source
    return source == "kiss-icp" or (source == "auto" and layout.POSES not in sequence.documents())


def with_estimated_poses(sequence: Sequence, options: FromScans) -> Sequence:
    """Return a sequence with poses estimated by odometry, from points within the range of the
    options, in voxels of their size.

    Lines of frames without a scan repeat the pose of the last scan.

    Raises:
        DependencyError: kiss-icp is not installed.
        FormatError: a scan has too few points.
    """
    frames = sequence.frames("points")
    scans = (sequence.read("points", int(frame))[:, :3] for frame in frames)
    times = sequence.times_of(frames)
    try:
        poses = estimate_poses(
            scans,
            times=times,
            max_range_m=options.max_range_m or sequence.metadata.max_range_m or _RANGE_M,
            voxel_m=options.poses.odometry_voxel_m,
        )
    except ArgumentError as error:  # an argument there, data here
        raise FormatError(
            sequence.location,
            expected=f"poses, or {error.expected}",
            found=error.found,
            advice=error.advice,
        ) from error
    lines = np.clip(np.searchsorted(frames, np.arange(frames[-1] + 1), side="right") - 1, 0, None)
    return sequence.with_poses(poses[lines])


def check_trajectory(sequence: Sequence, options: FromScans) -> None:
    """Check that a sequence has rigid poses without jumps, and that its times, if it has any,
    increase.

    Raises:
        MissingDataError: it has no poses.
        FormatError: the position of the sensor is unknown, or a pose is not rigid, or jumps without
            `options.poses.force`, or a time does not increase; names the frame.
    """
    where = f"{sequence.location}/{layout.POSES}"
    if not sequence.metadata.has_rays:
        raise FormatError(
            sequence.location,
            expected="scans of a sensor whose place is known",
            found='"rays": false in carlasc.json',
            advice="free space cannot be told from unknown space: take the grids that came with "
            "the data",
        )
    if options.poses.source == "file" and layout.POSES not in sequence.documents():
        raise MissingDataError(
            where,
            expected="poses, which merging scans needs",
            found="none",
            advice='estimate them with KISS-ICP (`poses=PoseOptions("kiss-icp")`)',
        )
    check_rigid(sequence.poses, where)
    frames = sequence.frames("points")
    _check_times(sequence, frames)
    if not options.poses.force:
        _check_speed(sequence, frames, where)


def _check_speed(sequence: Sequence, frames: IntArray, where: str) -> None:
    poses = np.stack([sequence.read_pose(int(frame)) for frame in frames])
    # Speeds, not distances: frames may be missing, and then the distance is longer.
    elapsed_s = np.diff(sequence.times_of(frames))
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / elapsed_s
    # The trace of R1' R0 is 1 + 2 cos(angle) of the rotation between them.
    traces = np.einsum("fij,fij->f", poses[1:, :3, :3], poses[:-1, :3, :3])
    turn = np.arccos(np.clip((traces - 1) / 2, -1, 1)) / elapsed_s
    jumps = np.flatnonzero((speed > _MAX_SPEED_M_S) | (turn > _MAX_TURN_RAD_S))
    if len(jumps):
        row = int(jumps[0])
        jump = f"a jump of {speed[row]:.0f} m/s and {turn[row]:.1f} rad/s"
        raise FormatError(
            where,
            expected=f"at most {_MAX_SPEED_M_S:g} m/s and {_MAX_TURN_RAD_S:g} rad/s",
            found=f"{jump} at frame {frames[row + 1]} ({len(jumps)} in all)",
            advice="fix the poses (estimated ones jump where scans do not overlap), or continue "
            "with `force=True`",
        )


def _check_times(sequence: Sequence, frames: IntArray) -> None:
    if layout.TIMES not in sequence.documents():
        return
    times = np.array([sequence.read_time(int(frame)) for frame in frames])
    falls = np.flatnonzero(~(np.diff(times) > 0))
    if len(falls):
        row = int(falls[0])
        raise FormatError(
            f"{sequence.location}/{layout.TIMES}",
            expected="increasing times",
            found=f"{times[row]:g} s and {times[row + 1]:g} s at frames {frames[row]} and "
            f"{frames[row + 1]}",
            advice="fix the file, or remove it: frames are then 0.1 s apart",
        )
