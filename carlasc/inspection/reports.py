"""The reports of grids: read from the files of a run, or made from the grids."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from carlasc.core.frames import FrameRange
from carlasc.errors import ArgumentError, CarlascError, ConflictError, MissingDataError, check_types
from carlasc.groundtruth import FrameFailure, FromScans, Voting
from carlasc.groundtruth.from_scans.sequences import ScanSequence
from carlasc.groundtruth.inputs import FrameInput, GridPlan, without_caches
from carlasc.groundtruth.reporting import Changes, FrameFacts, Report, sample_frames
from carlasc.inspection.heldout import EVERY
from carlasc.inspection.heldout import holdout as leave_out
from carlasc.motion.options import MotionOptions, PoseOptions
from carlasc.running.processes import one_pool, run_all
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import as_source, layout
from carlasc.storage.files import AnyPath, write_output
from carlasc.storage.folder import FolderSequence
from carlasc.storage.layout import identity_of
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.resuming import RECORD, read_record
from carlasc.storage.shares import sample_of, source_in
from carlasc.storage.views import ChosenSequences

if TYPE_CHECKING:
    from carlasc.metrics.results import Interval

_SUMMED = ("voxels", "known", "occupied")
_MOST_LEFT_OUT = 20  # scans that are left out of a long sequence for its held-out scores


@dataclass(frozen=True)
class ReportResult:
    """The reports of a data set.

    Attributes:
        location: location of the data set.
        reports: the report of each grid, by the path of its sequence and the name of the grid:
            "Val/Town/cartesian/evaluation".
        failures: frames that could not be read, for reports that were made.
        places: number of folders of sequences by split; empty if all were looked at.
    """

    location: str
    reports: Mapping[str, Report]
    failures: tuple[FrameFailure, ...] = ()
    places: Mapping[str, int] = field(default_factory=dict)

    def known(self) -> Interval:
        """Return the share of known voxels in all grids, estimated with its interval if only some
        were looked at.
        """
        from carlasc.metrics.results import estimate  # compiles loops, for scores

        seen = [report.coverage for report in self.reports.values()]
        return estimate([one.known for one in seen], self.places, [one.voxels for one in seen])

    def by_split(self) -> dict[str, dict[str, int]]:
        """Return sums of the grids of each name in each split, such as "Train/evaluation"."""
        kinds: dict[str, Counter[str]] = {}
        for name, report in self.reports.items():
            path, _, grid = name.rpartition("/")
            sums = kinds.setdefault(f"{identity_of(path)[0] or 'none'}/{grid}", Counter())
            voxels = {key: getattr(report.coverage, key) for key in _SUMMED}
            sums.update({"grids": 1, "frames": len(report.frames), **voxels})
        return {kind: dict(sums) for kind, sums in kinds.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        return {
            "location": self.location,
            "splits": self.by_split(),
            "reports": {name: report.to_dict() for name, report in self.reports.items()},
            "failures": [asdict(failure) for failure in self.failures],
            "places": dict(self.places),
        }


def report(
    source: AnyPath | Source,
    *,
    grid: str | None = None,
    remake: bool = False,
    holdout: bool = False,
    save: bool = False,
    sample: int | None = None,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> ReportResult:
    """Return the report of each grid of a data set: the report that its run wrote, or one that is
    made from the files.

    A report that is made from the files equals that of the run, if the scans that the grids were
    made from are in the same sequence.

    Args:
        source: anything that `carlasc.open` takes.
        grid: only the grid of this name. None: all grids.
        remake: make all reports from the files, also where reports exist.
        holdout: also measure held-out rays, as `carlasc validate --holdout` does, of Cartesian
            grids that were made from scans.
        save: write the reports into the folders of the grids (only of grids that carlasc made).
        sample: number of sequences to look at, evenly spaced, if there are more. None: all.
        run: how the work is spread, with a callback for the progress of reports that are made.

    Raises:
        MissingDataError: there is no data set, or no grid of this name.
        FormatError: a report is damaged; `remake` makes it again.
        ArgumentError: `sample` is less than 1, or `save` with a source that is not a folder.
        ConflictError: `save` with a grid that carlasc did not make.
    """
    check_types(report, locals())
    opened = as_source(source)
    chosen, places = sample_of(opened, sample)
    grids = [
        (path, sequence, name)
        for path, sequence in source_in(opened, chosen).sequences().items()
        for name in sequence.grids
        if grid in (None, name) and sequence.predicted_by(name) is None
    ]
    if not grids:
        raise MissingDataError(
            opened.location,
            expected="a grid" if grid is None else f"the grid {grid}",
            found="none",
            advice="make grids with `carlasc regrid`",
        )
    if save:
        for _, sequence, name in grids:
            _check_writable(sequence, name)
    makers = [_ReportMaker(sequence, name) for _, sequence, name in grids]
    existing = [None if remake else report_beside(sequence, name) for _, sequence, name in grids]
    total = sum(maker.steps for maker, one in zip(makers, existing, strict=True) if one is None)
    steps = StepCounter(run.progress, total)
    steps(0)
    failures: list[FrameFailure] = []
    reports: dict[str, Report] = {}
    with one_pool(run) as spread:
        for (path, sequence, name), maker, found in zip(grids, makers, existing, strict=True):
            one, failed = (found, []) if found else maker.make(spread, steps)
            failures += failed
            if holdout and one.holdout is None:
                one = replace(one, holdout=maker.held_out(spread))
            if save and isinstance(sequence, FolderSequence):
                write_output(sequence.folder / layout.report_file(name), one.to_json())
            reports[f"{path}/{name}" if path else name] = one
    return ReportResult(opened.location, reports, tuple(failures), places)


def report_beside(sequence: Sequence, grid: str) -> Report | None:
    """Return the report beside a grid; None if there is none.

    Raises:
        FormatError: it is damaged.
    """
    name = layout.report_file(grid)
    if name not in sequence.documents():
        return None
    return Report.from_json(sequence.read_document(name), f"{sequence.location}/{name}")


@dataclass(frozen=True)
class _ReportedFrame:
    """One frame to measure. It pickles into a worker."""

    sequence: Sequence
    grid: str
    number: int
    scans: FrameInput | None  # the scans that it was made from
    plan: GridPlan | None  # to make the grid again without a tenth of the scans


class _ReportMaker:
    """Makes the report of one grid of one sequence."""

    def __init__(self, sequence: Sequence, grid: str) -> None:
        self.sequence = sequence
        self.grid = grid
        self.frames: list[int] = sequence.frames(f"{grid}/labels").tolist()

    @cached_property
    def inputs(self) -> ScanSequence | None:
        """The scans that the grid was made from: see `inputs_of`."""
        return inputs_of(self.sequence, self.grid)

    @property
    def steps(self) -> int:
        """Number of frames, and of scans of the passes that refine poses and find the actors."""
        return len(self.frames) + (0 if self.inputs is None else self.inputs.steps_before)

    def make(self, run: Run, steps: StepCounter) -> tuple[Report, list[FrameFailure]]:
        """Measure the frames, and make the report; return also the frames that cannot be read."""
        sequence = self.sequence
        inputs = self.inputs
        try:
            if inputs is not None:
                inputs.prepare(None, run, steps)
        except (CarlascError, OSError):  # the error is reported when the frame is measured
            self.inputs = inputs = None
        facts = list[FrameFacts]()
        failures = list[FrameFailure]()
        with closing(run_all(_measure, self._tasks(), run, lost=_fail)) as results:
            for result in results:
                if isinstance(result, FrameFacts):
                    facts.append(result)
                else:
                    failures.append(result)
                steps(1)
        names = (layout.POSES, layout.TIMES, layout.METADATA, layout.params_file(self.grid))
        documents = {
            name: sequence.read_document(name) for name in names if name in sequence.documents()
        }
        classes = sequence.classes_of(self.grid)
        params = sequence.params(self.grid)
        actors = None if inputs is None else inputs.summaries()
        poses = None if inputs is None else inputs.pose_facts()
        made = Report.make(self.grid, facts, params, classes, documents, actors=actors, poses=poses)
        return made, failures

    def _tasks(self) -> Iterator[_ReportedFrame]:
        light = without_caches(self.sequence)
        sampled = sample_frames(self.frames)
        for number in self.frames:
            scans = None if self.inputs is None else self.inputs.frame(number)
            plan = self.inputs.plan if self.inputs is not None and number in sampled else None
            yield _ReportedFrame(light, self.grid, number, scans, plan)

    def held_out(self, run: Run) -> Mapping[str, Any] | None:
        """Measure held-out scores; None if the grid is cylindrical, or was not made from the scans
        beside it.
        """
        spec = self.sequence.grids[self.grid]
        if self.inputs is None or spec.coordinates != "cartesian":
            return None
        every = max(EVERY, len(self.inputs.feed.frames) // _MOST_LEFT_OUT)
        result = leave_out(
            ChosenSequences(self.sequence.location, {self.sequence.path: self.sequence}),
            spec,
            observe=self.inputs.options,
            voting=self.inputs.plan.voting,
            every=every,
            run=replace(run, progress=None),
        )
        if result.total is None:
            return None
        # of the one sequence
        given = [asdict(scores.all) for scores in result.given_poses.values()]
        return {**result.total.to_dict(), **({"given_poses": given[0]} if given else {})}


def inputs_of(sequence: Sequence, grid: str) -> ScanSequence | None:
    """Return the scans that a grid was made from; None if they are not in the same sequence."""
    record = sequence.params(grid).get(RECORD)
    if not isinstance(record, dict) or "points" not in sequence.fields():
        return None
    try:
        known = read_record(record, f"{sequence.location}/{layout.params_file(grid)}")
        if known.get("observe") != "scans":
            return None
        options = _options_of(known)
        voting = Voting(
            known.get("voting"),
            float(known.get("free_step_m", Voting().free_step_m)),
            min_confidence=float(known.get("min_confidence", 0.0)),
        )
        plan = GridPlan(sequence.grids[grid], grid, options, voting, FrameRange.of(None))
        inputs = ScanSequence(sequence, plan, options)
        return inputs if len(inputs.feed.frames) else None
    except (
        CarlascError,
        ValueError,
        TypeError,
        OverflowError,
    ):  # a record of another version, or invalid poses
        return None


def _options_of(record: Mapping[str, Any]) -> FromScans:
    """Return the options in the record of a run; others have their defaults."""
    given = {
        option.name: record[option.name] for option in fields(FromScans) if option.name in record
    }
    # The record names all sources of motion; several sources mean that "auto" chose them.
    if "+" in str(given.get("motion", "")) or given.get("dynamic") == "tube":
        del given["motion"]
    if "window" in given:
        first, _, last = str(given["window"]).partition(":")
        given["window"] = (int(first), int(last))
    given["poses"] = PoseOptions(
        record.get("poses", "file"),
        record.get("refine", "never"),
        force=True,
        loops=record.get("loops", "auto"),
    )
    if "motion" in given:
        given["motion"] = MotionOptions(given["motion"])
    return FromScans(**given)


def _measure(task: _ReportedFrame) -> FrameFacts | FrameFailure:
    """Measure one frame; return why it failed if it did."""
    sequence = task.sequence
    number = task.number
    grid = task.grid
    names = (*layout.SCAN_FIELDS, *(f"{grid}/{part}" for part in layout.GRID_FIELDS))
    try:
        present = sequence.fields()
        arrays = {
            n: sequence.read(n, number)
            for n in names
            if n in present and number in sequence.frames(n)
        }
        classes = sequence.classes_of(grid)
        changes = None
        residuals = None if task.scans is None else task.scans.residuals()
        thinned = None
        if task.scans is not None and task.plan is not None:
            thinned = task.scans.thinned(task.plan)
        if thinned is not None:
            changes = Changes.between(sequence.grid(grid, number), thinned)
        return FrameFacts.of(number, arrays, grid, classes, changes, residuals)
    except (CarlascError, OSError) as error:
        return FrameFailure(sequence.location, number, str(error))


def _fail(task: _ReportedFrame, message: str) -> FrameFailure:
    """Return the result of a frame that no worker could measure."""
    return FrameFailure(task.sequence.location, task.number, message)


def _check_writable(sequence: Sequence, grid: str) -> None:
    if not isinstance(sequence, FolderSequence):
        raise ArgumentError("save", expected="a source that is a folder", found=sequence.location)
    if not isinstance(sequence.params(grid).get(RECORD), dict):
        raise ConflictError(
            f"{sequence.location}/{grid}",
            expected="a grid that carlasc made",
            found="published data, which are never written to",
            advice="leave out `save=True`",
        )
