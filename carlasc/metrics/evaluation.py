"""Scoring the predicted grids of a whole data set, one frame in memory at a time, by one convention or by all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial

from carlasc.core.frames import FrameRange, Frames
from carlasc.errors import CarlascError, FormatError, MissingDataError
from carlasc.metrics.conventions import CONVENTIONS, Convention
from carlasc.metrics.pairs import Pair, Place, pair_grids
from carlasc.metrics.results import Evaluation
from carlasc.metrics.scorer import LabelPair, Scorer, Scoring
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run

_TOGETHER = 8  # frames that a worker scores in one task


def evaluate(
    source: Place,
    truth: Place,
    *,
    convention: str | Convention | None = None,
    grid: str | None = None,
    truth_grid: str | None = None,
    source_classes: str | None = None,
    scoring: Scoring = Scoring(),  # noqa: B008 (frozen)
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
        scoring: which voxels count, and what is scored beside the classes.
        frames: the frames that are scored; None scores all frames of the ground truth.
        name: name of the predictions in tables.
        run: how the work is spread, and who is told of its progress.

    Returns:
        The scores. Frames that could not be scored are listed in `failures`.

    Raises:
        ArgumentError: an argument has an unknown value, or `scoring` needs data that do not exist.
        MissingDataError: no grid exists, a sequence has no ground truth, or no frame can be scored.
        FormatError: the grids or the classes of the two sides cannot be compared.
    """
    pairs, notes = pair_grids(source, truth, grid, truth_grid)
    frames_of = _choose_frames(pairs, frames)
    scorer = Scorer(convention, pairs, source_classes, scoring)
    _score_frames([scorer], frames_of, run)
    result = scorer.result(name or _name_of(source), notes)
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
    """Score predictions by every convention. Each frame is read once. The arguments have the meaning that they have in `evaluate`.

    Args:
        source: the predictions: a data set, a sequence, the folder of a grid, or files of a benchmark.
        truth: the ground truth, likewise.
        grid: the grid that holds the predictions.
        truth_grid: the grid that holds the ground truth.
        source_classes: name of the class table of the predictions.
        frames: the frames that are scored.
        name: name of the predictions in tables.
        run: how the work is spread, and who is told of its progress.

    Returns:
        For the name of each convention: the scores, or the error that says why the data cannot be scored by it.
    """
    pairs, notes = pair_grids(source, truth, grid, truth_grid)
    frames_of = _choose_frames(pairs, frames)
    scorers = {convention: Scorer(convention, pairs, source_classes, Scoring()) for convention in CONVENTIONS}
    _score_frames(list(scorers.values()), frames_of, run)
    return {convention: scorer.result(name or _name_of(source), notes) for convention, scorer in scorers.items()}


def _name_of(source: Place) -> str:
    return getattr(source, "location", None) or str(source)


def _choose_frames(pairs: list[Pair], frames: Frames) -> list[tuple[Pair, list[int]]]:
    """Return the frames of each pair that are scored.

    Raises:
        MissingDataError: there are none.
    """
    chosen = FrameRange.of(frames)
    found = [(pair, chosen.select(pair.truth.frames()).tolist()) for pair in pairs]
    if not any(numbers for _, numbers in found):
        raise MissingDataError(
            pairs[0].truth.location, expected="labels of a frame to score", found=f"none in the range {chosen}"
        )
    return found


@dataclass(frozen=True)
class _FrameBatch:
    """Frames of one pair, which a worker scores together. It pickles into a worker."""

    pair: Pair
    frames: tuple[int, ...]


def _score_frames(scorers: Sequence[Scorer], frames_of: list[tuple[Pair, list[int]]], run: Run) -> None:
    """Read each frame once, and add its scores to each scorer."""
    size = 1 if run.is_alone else _TOGETHER
    batches = [
        _FrameBatch(pair, tuple(numbers[first : first + size]))
        for pair, numbers in frames_of
        for first in range(0, len(numbers), size)
    ]
    total, done = sum(len(numbers) for _, numbers in frames_of), 0
    score, fail = partial(_score_batch, scorers=scorers), partial(_fail_batch, scorers=scorers)
    with closing(run_all(score, batches, run, lost=fail)) as results:
        for batch, parts in zip(batches, results, strict=True):
            for scorer, part in zip(scorers, parts, strict=True):
                scorer.merge(part)
            done += len(batch.frames)
            if run.progress is not None:
                run.progress(done, total)


def _score_batch(batch: _FrameBatch, scorers: Sequence[Scorer]) -> list[Scorer]:
    """Read frames and score them, in a worker: return what there is to add to each scorer."""
    parts = [scorer.empty() for scorer in scorers]
    predicted = set(batch.pair.prediction.frames().tolist())
    for frame in batch.frames:
        content: LabelPair | CarlascError
        try:
            content = _read(batch.pair, frame, predicted)
        except CarlascError as error:
            content = error
        for part in parts:
            part.add(batch.pair, frame, content)
    return parts


def _fail_batch(batch: _FrameBatch, message: str, scorers: Sequence[Scorer]) -> list[Scorer]:
    """Return what there is to add for frames that no worker could score."""
    parts = [scorer.empty() for scorer in scorers]
    for frame in batch.frames:
        for part in parts:
            part.add(batch.pair, frame, CarlascError("", problem=message))
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
