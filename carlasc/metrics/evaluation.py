"""Scoring the predicted grids of a whole data set, one frame in memory at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable, Remap
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA, REMAPS, SEMANTICKITTI, remap_named, table_named
from carlasc.errors import ArgumentError, CarlascError, FormatError, MissingDataError
from carlasc.metrics.confusion import Absent, ConfusionMatrix, check_absent
from carlasc.metrics.masks import semantickitti
from carlasc.metrics.pairs import Pair, Place, pair_grids
from carlasc.metrics.scores import Evaluation, Mask

Region = Callable[[GridSpec], NDArray[np.bool_]]


def evaluate(
    source: Place,
    truth: Place,
    *,
    grid: str | None = None,
    truth_grid: str | None = None,
    remap: str | Remap | None = "auto",
    source_classes: str | None = None,
    mask: Mask = "known",
    region: Region | None = None,
    frames: Frames = None,
    absent: Absent = "zero",
    name: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Score predicted grids against the ground truth, one frame in memory at a time.

    Args:
        source: the predictions: anything that `carlasc.open` opens, the folder of one grid, or a folder of `.label` files.
        truth: the ground truth, likewise.
        grid: the grid that holds the predictions; None takes the name of the true grid, or the only grid of a sequence.
        truth_grid: the grid that holds the ground truth; None takes `evaluation`, or the only grid of a sequence.
        remap: the remap to the classes that are scored, or its name; None scores ids as they are; "auto" takes the paper's 11
            classes for CARLA's ids and the benchmark's 19 for SemanticKITTI's. A side that has these classes already is not remapped.
        source_classes: name of the class table of the predictions, for data that do not name one. None takes the scored classes, or,
            with SemanticKITTI's mask, its raw ids, as its benchmark does.
        mask: which voxels count: "known" (votes > 0, or not invalid), "semantickitti" (the rule of its benchmark), or "all".
        region: makes a mask of a GridSpec, such as `lambda spec: distance_band(spec, 0, 10)`: only voxels in it count.
        frames: the frames that are scored; None scores all frames of the ground truth.
        absent: how a class counts in the mean that is in neither the prediction nor the truth: "zero" (the paper), or "skip".
        name: what to call the predictions in tables.
        progress: called with (frames done, frames in total).

    Returns:
        The scores. Frames that could not be scored are listed in `failures`.

    Raises:
        ArgumentError: `mask`, `absent`, `frames`, `remap` or `source_classes` has no such value, or `region` is given for grids of
            unknown geometry.
        MissingDataError: there is no grid, a sequence has no ground truth, or there is no frame to score.
        FormatError: the grids or the classes of the two sides cannot be compared.
    """
    if mask not in ("known", "semantickitti", "all"):
        raise ArgumentError("mask", expected="known, semantickitti or all", found=repr(mask))
    check_absent(absent)
    chosen = FrameRange.of(frames)
    pairs = pair_grids(source, truth, grid, truth_grid)
    jobs = [(pair, chosen.select(pair.truth.frames())) for pair in pairs]
    total = sum(len(numbers) for _, numbers in jobs)
    if total == 0:
        raise MissingDataError(
            pairs[0].truth.location, expected="labels of a frame to score", found=f"none in the range {chosen}"
        )

    classes: ClassTable | None = None
    sequences: dict[str, ConfusionMatrix] = {}
    failures: list[tuple[str, str]] = []
    done = 0
    for pair, numbers in jobs:
        scorer = _Scorer(pair, remap, source_classes, mask, region)
        if classes is not None and scorer.classes.name != classes.name:
            raise FormatError(pair.truth.location, expected=f"the classes {classes.name}", found=scorer.classes.name)
        classes = scorer.classes
        predicted = set(pair.prediction.frames().tolist())
        matrix = sequences.setdefault(pair.truth.path, ConfusionMatrix(max(classes.names) + 1))
        for frame in numbers.tolist():
            try:
                if frame not in predicted:
                    raise MissingDataError(
                        pair.prediction.location, expected=f"a prediction for frame {frame}", found="none"
                    )
                matrix += scorer.score(frame)
            except CarlascError as error:
                failures.append((f"{pair.truth.path}:{frame}", str(error)))
            done += 1
            if progress:
                progress(done, total)
    assert classes is not None  # there is at least one pair
    summed = sum(sequences.values(), ConfusionMatrix(max(classes.names) + 1))
    label = name or getattr(source, "location", None) or str(source)
    return Evaluation(label, classes, summed, sequences, total - len(failures), mask, absent, failures)


class _Scorer:
    """Scores the frames of one pair of grids."""

    def __init__(
        self, pair: Pair, remap: str | Remap | None, source_classes: str | None, mask: Mask, region: Region | None
    ) -> None:
        self.pair, self.mask = pair, mask
        usual = SEMANTICKITTI if mask == "semantickitti" else CARLA
        self.remap = _choose_remap(remap, pair, usual)
        self.classes = self.remap.target if self.remap else (pair.truth.classes or pair.prediction.classes or usual)
        self.truth_classes = pair.truth.classes or (self.remap.source if self.remap else self.classes)
        if mask == "semantickitti" and self.truth_classes != SEMANTICKITTI:
            raise FormatError(
                pair.truth.location,
                expected="SemanticKITTI's raw ids for its mask",
                found=self.truth_classes.name,
                advice="give `mask=known`",
            )
        self.source_classes = pair.prediction.classes or (SEMANTICKITTI if mask == "semantickitti" else self.classes)
        if source_classes is not None:
            self.source_classes = table_named(source_classes)
        spec = pair.truth.spec or pair.prediction.spec
        if pair.truth.spec and pair.prediction.spec and pair.truth.spec != pair.prediction.spec:
            raise FormatError(
                pair.prediction.location,
                expected=f"the truth's grid {pair.truth.spec} {pair.truth.spec.lower} .. {pair.truth.spec.upper}",
                found=f"{pair.prediction.spec} {pair.prediction.spec.lower} .. {pair.prediction.spec.upper}",
            )
        if region is not None and spec is None:
            raise ArgumentError(
                "region",
                expected="None for grids without geometry",
                found="a region",
                advice=f"add params.json to {pair.truth.location}",
            )
        self.region = None if region is None or spec is None else region(spec)

    def score(self, frame: int) -> ConfusionMatrix:
        """Return the confusion matrix of a frame."""
        sides = self.pair.prediction, self.pair.truth
        prediction, truth = (side.labels(frame) for side in sides)
        source_place, truth_place = (f"{side.location}: frame {frame}" for side in sides)
        if prediction.size != truth.size:
            raise FormatError(source_place, expected=f"the truth's shape {truth.shape}", found=str(prediction.shape))
        counted = self._counted(truth, frame)
        prediction = self._to_scored(prediction, self.source_classes, source_place).reshape(-1)
        truth = self._to_scored(truth, self.truth_classes, truth_place).reshape(-1)
        try:
            return ConfusionMatrix(max(self.classes.names) + 1).update(
                prediction, truth, None if counted is None else counted.reshape(-1)
            )
        except FormatError as error:  # it says which side it is about
            raise error.within(source_place if error.where == "prediction" else truth_place) from error

    def _counted(self, truth: NDArray[np.unsignedinteger], frame: int) -> NDArray[np.bool_] | None:
        """Return the voxels that count; None for all."""
        counted: NDArray[np.bool_] | None = None
        if self.mask != "all":
            counted = self.pair.truth.known(frame)
            if counted is None and self.mask == "known":
                raise MissingDataError(
                    f"{self.pair.truth.location}: frame {frame}",
                    expected="counts, which say what is known",
                    found="none",
                    advice="give `mask=all` to score all voxels",
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
    """Return the remap to the scored classes, after checking that each side has ids of its source or of its target."""
    if remap == "auto":
        table = pair.truth.classes or pair.prediction.classes or usual
        candidates = [REMAPS["carlasc11"], REMAPS["semantickitti19"]]
        remap = next((r for r in candidates if table.name in (r.source.name, r.target.name)), None)
    elif isinstance(remap, str):
        remap = remap_named(remap)
    for side in (pair.truth, pair.prediction):
        if remap and side.classes and side.classes.name not in (remap.source.name, remap.target.name):
            raise FormatError(
                side.location,
                expected=f"classes of {remap.source.name} or {remap.target.name} (remap {remap.name})",
                found=side.classes.name,
            )
    return remap
