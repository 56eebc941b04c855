"""Scoring predicted grids of a whole data set, a frame at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable, Remap
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA, REMAPS, SEMANTICKITTI, remap_named, table_named
from carlasc.errors import ArgumentError, CarlascError, FormatError, MissingDataError
from carlasc.metrics.confusion import Absent, ConfusionMatrix
from carlasc.metrics.masks import semantickitti
from carlasc.metrics.pairs import Pair, Where, pair_grids
from carlasc.metrics.tables import Table, geometric_table, semantic_table

Mask = Literal["known", "semantickitti", "all"]
Region = Callable[[GridSpec], NDArray[np.bool_]]


@dataclass(frozen=True)
class Evaluation:
    """How good predictions are. All figures are taken from the sum over every frame.

    Attributes:
        name: of the predictions: a network's, or where they lie.
        classes: the classes scored.
        matrix: the confusion over all frames.
        sequences: the confusion of each sequence, by path.
        frames: how many were scored.
        mask: which voxels counted.
        absent: what a class in neither prediction nor truth counts in the mean: "zero", or "skip".
        failures: (frame, message) of frames that could not be scored: no prediction, cut short, ids out of range.
    """

    name: str
    classes: ClassTable
    matrix: ConfusionMatrix
    sequences: Mapping[str, ConfusionMatrix]
    frames: int
    mask: Mask
    absent: Absent
    failures: list[tuple[str, str]]

    @property
    def class_iou(self) -> dict[str, float]:
        """IoU of each class by name; NaN for a class in neither prediction nor truth."""
        return {name: float(self.matrix.iou[index]) for index, name in sorted(self.classes.names.items())}

    @property
    def miou(self) -> float:
        """Mean IoU over all classes, free among them: the paper's."""
        return self._mean_iou(with_free=True)

    @property
    def miou_without_free(self) -> float:
        """Mean IoU over the classes of things: SemanticKITTI's."""
        return self._mean_iou(with_free=False)

    def _mean_iou(self, *, with_free: bool) -> float:
        values = [v for i, v in enumerate(self.matrix.iou) if i in self.classes.names and (with_free or i)]
        present = [v for v in values if not np.isnan(v)]
        count = len(values) if self.absent == "zero" else len(present)
        return sum(present) / count if count else float("nan")

    def tables(self) -> tuple[Table, Table]:
        """Return the paper's two tables: IoU of each class, and completeness."""
        return semantic_table([self]), geometric_table([self])

    def figures(self) -> dict[str, Any]:
        """Return every figure by name, as fractions, None where there is nothing to divide by."""
        found = self.matrix.completeness()
        figures = {
            "miou": self.miou,
            "miou_without_free": self.miou_without_free,
            "accuracy": self.matrix.accuracy,
            "precision": found.precision,
            "recall": found.recall,
            "iou": found.iou,
        }
        return {
            "name": self.name,
            "frames": self.frames,
            "voxels": self.matrix.total,
            "mask": self.mask,
            "absent": self.absent,
            **{name: _number(value) for name, value in figures.items()},
            "class_iou": {name: _number(value) for name, value in self.class_iou.items()},
            "confusion": self.matrix.counts.tolist(),
        }


def evaluate(
    pred: Where,
    truth: Where,
    *,
    pred_grid: str | None = None,
    truth_grid: str | None = None,
    remap: str | Remap | None = "auto",
    pred_classes: str | None = None,
    mask: Mask = "known",
    region: Region | None = None,
    frames: tuple[int | None, int | None] | None = None,
    absent: Absent = "zero",
    name: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Score predicted grids against true ones, one frame in memory at a time.

    Args:
        pred: the predictions: anything `carlasc.open` opens, one grid's folder, or a plain folder of `.label` files.
        truth: the ground truth, likewise.
        pred_grid: the grid that holds the predictions; None takes the truth's name, or the only one there is.
        truth_grid: the true grid; None takes `evaluation`, or the only one there is.
        remap: to the classes that are scored, a name or a table; None scores ids as they are; "auto" takes the 11 classes of the
            paper for CARLA's ids and the 19 of the benchmark for SemanticKITTI's. Sides that have these classes already stay.
        pred_classes: the table of the predictions' ids where nothing beside them says. None: the scored classes, or, under
            SemanticKITTI's mask, its raw ids, as its benchmark takes them.
        mask: "known" voxels of the truth (counts > 0, or not invalid), SemanticKITTI's rule, or "all".
        region: makes a mask of a GridSpec, such as `lambda spec: distance_band(spec, 0, 10)`: only these voxels count, too.
        frames: (first, last + 1) frames; None is open.
        absent: what a class in neither prediction nor truth counts in the mean: "zero" (the paper), or "skip".
        name: what to call the predictions in tables.
        progress: called with (frames done, frames in total).

    Returns:
        The scores. Frames that could not be scored are in `failures`; the others are done.

    Raises:
        ArgumentError: an argument makes no sense.
        MissingDataError: there is no grid, no truth for a sequence, or no frame to score.
        FormatError: classes that cannot be compared.
    """
    if mask not in ("known", "semantickitti", "all"):
        raise ArgumentError("mask", expected="known, semantickitti or all", found=f"{mask!r}")
    pairs = pair_grids(pred, truth, pred_grid, truth_grid)
    jobs = [(pair, _pick(pair.truth.frames(), frames)) for pair in pairs]
    total = sum(len(numbers) for _, numbers in jobs)
    if total == 0:
        raise MissingDataError(pairs[0].truth.location, expected="frames to score", found="none in the range")

    classes: ClassTable | None = None
    sequences: dict[str, ConfusionMatrix] = {}
    failures: list[tuple[str, str]] = []
    done = 0
    for pair, numbers in jobs:
        scorer = _Scorer(pair, remap, pred_classes, mask, region)
        if classes is not None and scorer.classes.name != classes.name:
            raise FormatError(
                pair.truth.location, expected=f"the classes {classes.name}", found=f"{scorer.classes.name}"
            )
        classes = scorer.classes
        predicted = set(pair.pred.frames().tolist())
        matrix = sequences.setdefault(pair.truth.path, ConfusionMatrix(max(classes.names) + 1))
        for frame in numbers.tolist():
            try:
                if frame not in predicted:
                    raise MissingDataError(pair.pred.location, expected=f"a prediction for frame {frame}", found="none")
                matrix += scorer.score(frame)
            except CarlascError as error:
                failures.append((f"{pair.truth.path}:{frame}", str(error)))
            done += 1
            if progress:
                progress(done, total)
    assert classes is not None  # there is at least one pair
    summed = sum(sequences.values(), ConfusionMatrix(max(classes.names) + 1))
    label = name or getattr(pred, "location", None) or str(pred)
    return Evaluation(label, classes, summed, sequences, total - len(failures), mask, absent, failures)


class _Scorer:
    """Scores the frames of one pair of grids."""

    def __init__(
        self, pair: Pair, remap: str | Remap | None, pred_classes: str | None, mask: Mask, region: Region | None
    ) -> None:
        self.pair, self.mask = pair, mask
        usual = SEMANTICKITTI if mask == "semantickitti" else CARLA
        self.remap = _choose_remap(remap, pair, usual)
        self.classes = self.remap.target if self.remap else (pair.truth.classes or pair.pred.classes or usual)
        self.truth_classes = pair.truth.classes or (self.remap.source if self.remap else self.classes)
        if mask == "semantickitti" and self.truth_classes is not SEMANTICKITTI:
            raise FormatError(
                pair.truth.location,
                expected="SemanticKITTI's raw ids for its mask",
                found=f"{self.truth_classes.name}",
                advice="take the mask known",
            )
        self.pred_classes = pair.pred.classes or (SEMANTICKITTI if mask == "semantickitti" else self.classes)
        if pred_classes is not None:
            self.pred_classes = table_named(pred_classes)
        spec = pair.truth.spec or pair.pred.spec
        if pair.truth.spec and pair.pred.spec and pair.truth.spec != pair.pred.spec:
            raise FormatError(
                pair.pred.location,
                expected=f"the truth's grid {pair.truth.spec} {pair.truth.spec.lower} .. {pair.truth.spec.upper}",
                found=f"{pair.pred.spec} {pair.pred.spec.lower} .. {pair.pred.spec.upper}",
            )
        if region is not None and spec is None:
            raise ArgumentError(pair.truth.location, expected="a params.json to find the region in", found="none")
        self.region = None if region is None or spec is None else region(spec)

    def score(self, frame: int) -> ConfusionMatrix:
        pred, truth = self.pair.pred.labels(frame), self.pair.truth.labels(frame)
        if pred.size != truth.size:
            raise FormatError(
                f"{self.pair.pred.location}: frame {frame}",
                expected=f"the truth's shape {truth.shape}",
                found=f"{pred.shape}",
            )
        counted = self._counted(truth, frame)
        matrix = ConfusionMatrix(max(self.classes.names) + 1)
        try:
            return matrix.update(
                self._to_scored(pred, self.pred_classes, self.pair.pred.location).reshape(-1),
                self._to_scored(truth, self.truth_classes, self.pair.truth.location).reshape(-1),
                None if counted is None else counted.reshape(-1),
            )
        except FormatError as error:
            raise FormatError(f"{self.pair.pred.location}: frame {frame}: {error}") from error

    def _counted(self, truth: NDArray[np.unsignedinteger], frame: int) -> NDArray[np.bool_] | None:
        """The voxels that count, None for all."""
        counted: NDArray[np.bool_] | None = None
        if self.mask != "all":
            counted = self.pair.truth.known(frame)
            if counted is None and self.mask == "known":
                raise MissingDataError(
                    f"{self.pair.truth.location}: frame {frame}",
                    expected="counts to tell what is known",
                    found="none",
                    advice="score all voxels (mask all)",
                )
        if self.mask == "semantickitti":
            scored = semantickitti(truth).reshape(-1)
            counted = scored if counted is None else scored & counted.reshape(-1)
        if self.region is not None:
            counted = self.region.reshape(-1) if counted is None else counted.reshape(-1) & self.region.reshape(-1)
        return counted

    def _to_scored(
        self, labels: NDArray[np.unsignedinteger], table: ClassTable, where: str
    ) -> NDArray[np.unsignedinteger]:
        if self.remap is None or table.name == self.remap.target.name:
            return labels
        return self.remap(labels, where)


def _choose_remap(remap: str | Remap | None, pair: Pair, usual: ClassTable) -> Remap | None:
    """Find the remap to the scored classes, and check that each side has its source's or its target's ids."""
    if remap == "auto":
        table = pair.truth.classes or pair.pred.classes or usual
        candidates = [REMAPS["carlasc11"], REMAPS["semantickitti19"]]
        remap = next((r for r in candidates if table.name in (r.source.name, r.target.name)), None)
    elif isinstance(remap, str):
        remap = remap_named(remap)
    for side in (pair.truth, pair.pred):
        if remap and side.classes and side.classes.name not in (remap.source.name, remap.target.name):
            raise FormatError(
                side.location,
                expected=f"classes of {remap.source.name} or {remap.target.name} (remap {remap.name})",
                found=f"{side.classes.name}",
            )
    return remap


def _pick(numbers: NDArray[np.int64], frames: tuple[int | None, int | None] | None) -> NDArray[np.int64]:
    first, stop = frames or (None, None)
    keep = np.ones(len(numbers), np.bool_)
    if first is not None:
        keep &= numbers >= first
    if stop is not None:
        keep &= numbers < stop
    return numbers[keep]


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
