"""Held-out rays, a score without a reference: scans are left out and compared with the grids that
are made from the other scans.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import reduce
from typing import Any

import numpy as np

from carlasc.core.frames import FrameRange, Frames
from carlasc.core.geometry import invert
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, CarlascError, MissingDataError
from carlasc.groundtruth import FrameFailure, FromScans, Voting
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import find_actors, refine_sequence
from carlasc.groundtruth.from_scans.sequences import (
    ScanFrame,
    ScanSequence,
    ScanWindow,
    scan_sequences,
)
from carlasc.groundtruth.inputs import GridPlan
from carlasc.inspection.findings import State
from carlasc.inspection.heldout_scores import HeldOutScores
from carlasc.metrics.casting import check_cartesian
from carlasc.motion.options import PoseOptions
from carlasc.motion.tracks import MovingActors
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import as_source, layout
from carlasc.storage.files import AnyPath
from carlasc.storage.protocol import Sequence, Source

EVERY = 10
"""Default of `every`: every tenth scan is left out."""
# greatest shares of grids that are right
_FREE = 0.02
_PASSED = 0.35
_SWEPT = 0.25
_RETURNS = 1000  # fewer returns within the grid tell nothing
# a frame is measured if its window has this share of the scans of a whole window
_NEARLY_WHOLE = 0.8


@dataclass(frozen=True)
class HoldoutResult:
    """What `holdout` measured.

    Attributes:
        location: what was measured.
        spec: geometry of the grids.
        every: every N-th scan was left out.
        sequences: the scores of each sequence, by its path.
        given_poses: for each sequence with refined poses, the scores under the given poses.
        failures: frames that could not be measured.
        elapsed_s: duration, in seconds.
    """

    location: str
    spec: GridSpec
    every: int
    sequences: Mapping[str, HeldOutScores]
    failures: tuple[FrameFailure, ...] = ()
    elapsed_s: float = field(default=0.0, compare=False)
    given_poses: Mapping[str, HeldOutScores] = field(default_factory=dict)

    @property
    def total(self) -> HeldOutScores | None:
        """The scores of all sequences together; None if their class tables differ."""
        scores = list(self.sequences.values())
        if any(other.classes != scores[0].classes for other in scores):
            return None
        return reduce(HeldOutScores.merge, scores)

    @property
    def faults(self) -> dict[str, str]:
        """What is wrong with the grids of each sequence, in words: see docs/commands/validate.md.

        It is empty for a grid that is right, and one of another sequence is left out if it could
        not be tested.
        """
        found = {}
        for path, scores in self.sequences.items():
            rays = scores.all
            limits = (
                (rays.free, _FREE, "of the returns are in voxels called free"),
                (rays.passed_object, _PASSED, "of the rays pass through objects"),
                (scores.swept_share, _SWEPT, "of what the vehicle drove through is occupied"),
            )
            if rays.returns >= _RETURNS:
                found[path] = ", ".join(
                    f"{share:.1%} {what} (at most {most:.0%} is right)"
                    for share, most, what in limits
                    if share is not None and share > most
                )
        return found

    @property
    def state(self) -> State:
        """What the rays say: "untested" if too few of them return from the grids of a sequence."""
        faults = self.faults
        if any(faults.values()):
            return "wrong"
        return "right" if len(faults) == len(self.sequences) else "untested"

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        total = self.total
        return {
            "location": self.location,
            "state": self.state,
            "faults": self.faults,
            "grid": asdict(self.spec),
            "every": self.every,
            "total": None if total is None else total.to_dict(),
            "sequences": {path: scores.to_dict() for path, scores in self.sequences.items()},
            "given_poses": {path: scores.to_dict() for path, scores in self.given_poses.items()},
            "failures": [asdict(failure) for failure in self.failures],
            "elapsed_s": self.elapsed_s,
        }


def holdout(
    source: AnyPath | Source,
    spec: GridSpec | None = None,
    *,
    observe: FromScans | None = None,
    voting: Voting = Voting(),  # noqa: B008 (frozen)
    every: int = EVERY,
    frames: Frames = None,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> HoldoutResult:
    """Leave out every N-th scan, make the grids at these frames from the other scans, and follow
    the rays of the left-out scans through them.

    A left-out scan does not vote in any grid and is not used to track actors; it is used only to
    refine poses. If poses are refined, the same frames are also measured under the given poses.
    Frames at the ends of a drive are not measured if their window has less than 80% of the scans
    of a whole window, unless all windows are like that. A frame that cannot be read is reported in
    the result. Nothing is written.

    Args:
        source: anything that `carlasc.open` takes; its sequences have scans and poses, labels or
            not.
        spec: geometry of the grids, Cartesian; None for that of the grid that exists, or the
            published one.
        observe: how scans are merged; None for what the record of the grid that exists says, or the
            defaults, under the given poses.
        voting: how votes are counted.
        every: leave out every N-th scan.
        frames: range of the frames that may be left out; None for all.
        run: how the work is spread, with a callback for progress.

    Raises:
        ArgumentError: `every` is less than 2, or the grid is cylindrical.
        MissingDataError: there is no sequence with scans, no poses, or no frame.
        FormatError: poses or times are not valid.
    """
    start = time.perf_counter()
    existing, made = _existing_grid(as_source(source))
    spec = spec or existing
    observe = observe or made
    if every < 2:
        raise ArgumentError("every", expected="2 or more", found=every)
    check_cartesian(spec)
    plan = GridPlan(spec, layout.grid_folder(spec), observe, voting, FrameRange.of(frames))
    inputs = [
        sequence
        for sequence in scan_sequences(source, plan, observe)
        if isinstance(sequence, ScanSequence)
    ]
    drives = [_HeldOutDrive.of(sequence, every) for sequence in inputs]
    refining = sum(len(sequence.feed.frames) for sequence in inputs if sequence.refines)
    steps = StepCounter(run.progress, refining + sum(drive.steps for drive in drives))
    steps(0)
    for row, sequence in enumerate(inputs):
        given = sequence.feed
        if sequence.refines:
            sequence.use_refined(refine_sequence(given, None, run, steps))
        if sequence.feed is not given:
            steps.expect(drives[row].steps)
            drives.append(replace(drives[row], is_used=False))
            drives[row] = _HeldOutDrive.of(sequence, every)
    tasks = [task for drive in drives for task in drive.tasks(run, steps)]
    measured = [(drive, frame) for drive in drives for frame in drive.frames]
    scores: dict[str, HeldOutScores] = {}
    before: dict[str, HeldOutScores] = {}
    failures = []
    with closing(run_all(_measure, tasks, run, lost=lambda _, message: message)) as results:
        for (drive, frame), outcome in zip(measured, results, strict=True):
            totals = scores if drive.is_used else before
            path = drive.inputs.path
            if not isinstance(outcome, str):
                totals[path] = totals[path].merge(outcome) if path in totals else outcome
            elif drive.is_used:
                failures.append(FrameFailure(drive.inputs.location, frame, outcome))
            steps(1)
    for sequence in inputs:
        scores.setdefault(sequence.path, HeldOutScores.empty(sequence.metadata.classes))
    location = source.location if isinstance(source, Source) else str(source)
    return HoldoutResult(
        location, spec, every, scores, tuple(failures), time.perf_counter() - start, before
    )


def _existing_grid(source: Source) -> tuple[GridSpec, FromScans]:
    """Return the geometry of the first Cartesian grid of a data set, and how it was made; the
    published one without any.
    """
    poses = PoseOptions("file")
    for sequence in source.sequences().values():
        for name, spec in sequence.grids.items():
            if spec.coordinates == "cartesian" and sequence.predicted_by(name) is None:
                record = sequence.params(name).get("carlasc", {})
                if record.get("observe") != "scans":
                    return spec, FromScans(poses=poses)
                names = ("dynamic", "complete", "own_path", "stride", "window_m")
                made = {key: record[key] for key in names if key in record}
                first, _, last = record["window"].partition(":")
                return spec, FromScans((int(first), int(last)), poses=poses, **made)
    return GridSpec.published(), FromScans(poses=poses)


@dataclass(frozen=True)
class _HeldOutDrive:
    """One sequence: the scans that are left out, and the frames that are measured."""

    inputs: ScanSequence
    feed: ScanFeed
    frames: tuple[int, ...]
    is_used: bool = True

    @classmethod
    def of(cls, inputs: ScanSequence, every: int) -> _HeldOutDrive:
        """Choose the scans to leave out."""
        whole = inputs.feed
        hidden = whole.frames[every // 2 :: every].tolist() or whole.frames[-1:].tolist()
        enough = _NEARLY_WHOLE * max(len(whole.window_of(int(frame))) for frame in whole.frames)
        chosen = [frame for frame in hidden if frame in inputs.plan.frames]
        if not chosen:
            raise MissingDataError(
                inputs.location,
                expected=f"frames to leave out in {inputs.plan.frames}",
                found=f"only {hidden}",
                advice="choose a smaller `every`",
            )
        measured = [frame for frame in chosen if len(whole.window_of(frame)) >= enough] or chosen
        return cls(inputs, whole.without(hidden), tuple(measured))

    @property
    def steps(self) -> int:
        """Number of steps: scans that are read to find the actors, and frames."""
        return self.feed.reads_for_actors + len(self.frames)

    def tasks(self, run: Run, steps: Callable[[int], None]) -> Iterator[_Task]:
        """Find the actors in the scans that are left; yield a task for each frame to measure."""
        actors = MovingActors()
        if self.feed.needs_actors:
            actors = find_actors(self.feed, run, steps)
        for frame in self.frames:
            others = ScanFrame(ScanWindow(self.feed, actors), frame, frame)
            yield others, self.inputs.feed.sequence, self.inputs.plan


# a frame with the scans that make its grid, and the sequence that also has its own scan
_Task = tuple[ScanFrame, Sequence, GridPlan]


def _measure(task: _Task) -> HeldOutScores | str:
    """Measure one frame, in a worker; return why it failed if it did."""
    others, whole, plan = task
    feed = others.inputs.feed
    frame = others.number
    try:
        window = [other for other in feed.window_of(frame) if other != frame]
        if not window:
            raise MissingDataError(
                f"{whole.location}: frame {frame}",
                expected="other scans in its window",
                found="none",
                advice="leave out fewer scans, or choose another stride",
            )
        scan = whole.scan(frame, ("labels", "origins"))
        origins = scan.others.get("origins", np.zeros_like(scan.points))
        distance = np.linalg.norm((scan.points - origins).astype(np.float64), axis=1)
        keep = (distance >= feed.min_range_m) & (distance <= feed.max_range_m)
        if scan.labels is not None:
            feed.classes.check(scan.labels, f"{whole.location}: labels of frame {frame}")
            keep &= scan.labels > 0
        reaching = feed.reaching(frame, plan.spec)
        grid = merge_frame(plan, feed, others.inputs.actors, frame, reaching).grid
        here = invert(feed.pose(frame))
        poses = [here @ feed.pose(other) for other in window]
        labels = None if scan.labels is None else scan.labels[keep]
        return HeldOutScores.of(grid, feed.classes, scan.points[keep], labels, poses, origins[keep])
    except (CarlascError, OSError) as error:
        return str(error)
