"""Scoring the predicted grids of a whole data set, one frame in memory at a time, by one convention or by all of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial

from carlasc.core.frames import FrameRange, Frames
from carlasc.errors import CarlascError, FormatError, MissingDataError
from carlasc.metrics.conventions import CONVENTIONS, Convention
from carlasc.metrics.pairs import Pair, Place, pair_grids
from carlasc.metrics.results import Evaluation
from carlasc.metrics.scorer import LabelPair, Options, Region, Scorer, Voxels
from carlasc.running.options import Run
from carlasc.running.processes import run_all

_TOGETHER = 8  # frames that a worker scores in one task


def evaluate(
    source: Place,
    truth: Place,
    *,
    convention: str | Convention | None = None,
    grid: str | None = None,
    truth_grid: str | None = None,
    source_classes: str | None = None,
    voxels: Voxels = "known",
    region: Region | None = None,
    by: Collection[str] = (),
    rays: bool = False,
    frames: Frames = None,
    name: str | None = None,
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
) -> Evaluation:
    """Score predicted grids against the ground truth, one frame in memory at a time.

    Args:
        source: the predictions: anything that `carlasc.open` opens, the folder of one grid, a folder of `.label` files, or files of
            SemanticKITTI, SSCBench, Occ3D or OpenOccupancy.
        truth: the ground truth, likewise.
        convention: the benchmark whose rules are used: a Convention or a name in `carlasc.metrics.CONVENTIONS`. It says which voxels
            count, in which classes, and how the mean is taken. "own" scores the unchanged classes of the data. None takes the benchmark
            whose files the ground truth consists of; otherwise "carlasc" for class tables that it has a map for, and "own" for others.
        grid: the grid that holds the predictions; None takes the name of the true grid, or the only grid of a sequence.
        truth_grid: the grid that holds the ground truth; None takes `evaluation`, or the only grid of a sequence.
        source_classes: name of the class table of the predictions, for data that do not name one. None takes the class table of the
            convention's own files.
        voxels: "known" scores the voxels that the convention scores; "all" also scores voxels that the truth never evaluated.
        region: function from a GridSpec to a mask, such as `lambda spec: distance_band(spec, 0, 10)`; only voxels in the mask count.
        by: also give scores by any of "distance", "height", "visibility" (from the sensor, at this instant) and "motion".
        rays: also compute RayIoU; this needs poses and a Cartesian grid.
        frames: the frames that are scored; None scores all frames of the ground truth.
        name: name of the predictions in tables.
        run: how the work is spread, and who is told of its progress. With several processes, `region` must be a function that can be pickled.

    Returns:
        The scores. Frames that could not be scored are listed in `failures`.

    Raises:
        ArgumentError: an argument has an unknown value, or `region`, `by` or `rays` needs data that do not exist.
        MissingDataError: no grid exists, a sequence has no ground truth, or no frame can be scored.
        FormatError: the grids or the classes of the two sides cannot be compared.
    """
    (result,) = _score_all(
        [convention], source, truth, grid=grid, truth_grid=truth_grid, source_classes=source_classes, name=name, frames=frames,
        run=run, options=Options(voxels, region, tuple(by), rays),
    )  # fmt: skip
    if isinstance(result, CarlascError):
        raise result
    return result


def evaluate_by_all_conventions(
    source: Place,
    truth: Place,
    *,
    grid: str | None = None,
    truth_grid: str | None = None,
    source_classes: str | None = None,
    frames: Frames = None,
    name: str | None = None,
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
) -> Mapping[str, Evaluation | CarlascError]:
    """Score predictions by every convention. Each frame is read once.

    Args:
        source: the predictions, as for `evaluate`.
        truth: the ground truth.
        grid: as for `evaluate`.
        truth_grid: as for `evaluate`.
        source_classes: as for `evaluate`.
        frames: as for `evaluate`.
        name: as for `evaluate`.
        run: how the work is spread, and who is told of its progress.

    Returns:
        For the name of each convention: the scores, or the error that says why the data cannot be scored by it.
    """
    results = _score_all(
        list(CONVENTIONS), source, truth, grid=grid, truth_grid=truth_grid, source_classes=source_classes, name=name, frames=frames,
        run=run, options=Options(),
    )  # fmt: skip
    return dict(zip(CONVENTIONS, results, strict=True))


def _score_all(
    conventions: Sequence[str | Convention | None],
    source: Place,
    truth: Place,
    *,
    grid: str | None,
    truth_grid: str | None,
    source_classes: str | None,
    frames: Frames,
    name: str | None,
    run: Run,
    options: Options,
) -> list[Evaluation | CarlascError]:
    """Read each frame once and score it by each convention."""
    chosen = FrameRange.of(frames)
    pairs, notes = pair_grids(source, truth, grid, truth_grid)
    jobs = [(pair, chosen.select(pair.truth.frames())) for pair in pairs]
    total = sum(len(numbers) for _, numbers in jobs)
    if total == 0:
        raise MissingDataError(
            pairs[0].truth.location, expected="labels of a frame to score", found=f"none in the range {chosen}"
        )
    label = name or getattr(source, "location", None) or str(source)
    scorers = [Scorer(convention, pairs, source_classes, options) for convention in conventions]
    size = 1 if run.is_alone else _TOGETHER
    tasks = [
        _Task(pair, tuple(numbers[first : first + size].tolist()))
        for pair, numbers in jobs
        for first in range(0, len(numbers), size)
    ]
    score, fail = partial(_score_task, scorers=scorers), partial(_fail_task, scorers=scorers)
    steps, done = run.progress or (lambda done, total: None), 0
    with closing(run_all(score, tasks, run, lost=fail)) as results:
        for task, parts in zip(tasks, results, strict=True):
            for scorer, part in zip(scorers, parts, strict=True):
                scorer.merge(part)
            done += len(task.frames)
            steps(done, total)
    return [scorer.result(label, notes) for scorer in scorers]


@dataclass(frozen=True)
class _Task:
    """Some frames to score. It pickles into a worker."""

    pair: Pair
    frames: tuple[int, ...]


def _score_task(task: _Task, scorers: Sequence[Scorer]) -> list[Scorer]:
    """Read frames and score them, in a worker: return what there is to add to each scorer."""
    parts = [scorer.empty() for scorer in scorers]
    predicted = set(task.pair.prediction.frames().tolist())
    for frame in task.frames:
        content: LabelPair | CarlascError
        try:
            content = _read(task.pair, frame, predicted)
        except CarlascError as error:
            content = error
        for part in parts:
            part.add(task.pair, frame, content)
    return parts


def _fail_task(task: _Task, message: str, scorers: Sequence[Scorer]) -> list[Scorer]:
    """Return what there is to add for frames that no worker could score."""
    parts = [scorer.empty() for scorer in scorers]
    for frame in task.frames:
        for part in parts:
            part.add(task.pair, frame, CarlascError("", problem=message))
    return parts


def _read(pair: Pair, frame: int, predicted: set[int]) -> LabelPair:
    """Return a frame's predicted and true labels, of one shape."""
    if frame not in predicted:
        raise MissingDataError(
            pair.prediction.location, expected=f"a prediction for frame {pair.truth.name_of(frame)}", found="none"
        )
    prediction, truth = pair.prediction.labels(frame), pair.truth.labels(frame)
    if prediction.size != truth.size:
        where = f"{pair.prediction.location}: frame {pair.truth.name_of(frame)}"
        raise FormatError(where, expected=f"the truth's shape {truth.shape}", found=str(prediction.shape))
    return prediction.reshape(truth.shape), truth
