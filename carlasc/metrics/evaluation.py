"""Scoring the predicted grids of a whole data set, one frame in memory at a time, by one or all
conventions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from copy import copy
from dataclasses import replace
from functools import cache, partial

import numpy as np

from carlasc.core.arrays import BoolArray, LabelArray
from carlasc.core.classes import ClassTable, Remap, TableUse, times
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, CarlascError, FormatError, MissingDataError, check_types
from carlasc.metrics.actor_scores import ActorScores
from carlasc.metrics.confusion import ConfusionMatrix
from carlasc.metrics.conventions import CONVENTIONS, Convention, convention_named, own_convention
from carlasc.metrics.grids import SequenceGrid
from carlasc.metrics.pairs import Pair, Place, pair_grids
from carlasc.metrics.rays import RayIoU, ray_origins
from carlasc.metrics.regions import (
    Breakdown,
    Masks,
    distance_bands,
    height_bands,
    motion,
    visibility,
)
from carlasc.metrics.results import Evaluation, FrameScore
from carlasc.metrics.scoring import Scoring
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage.class_files import read_classes
from carlasc.storage.files import AnyPath
from carlasc.storage.voxel_files import IGNORED_ID, SeenBy

_FrameBatch = tuple[Pair, list[int]]  # frames of one pair that a worker scores in one task
_Known = Callable[[SeenBy], BoolArray | None]
# Labels of prediction and ground truth, and `known` of the ground truth, which is read once for all
# conventions.
LabelPair = tuple[LabelArray, LabelArray, _Known]
# edges and number of the bands of `by`
_DISTANCES_M = (0, 10, 20, 30)
_HEIGHTS = 4
_TOGETHER = 8  # frames that a worker scores in one task
_TRIED = 4  # sequences whose first and last frames are read to find a table by its ids


class Scorer:
    """Accumulates the frames of all sequences by one convention."""

    def __init__(
        self,
        convention: str | Convention | None,
        pairs: list[Pair],
        source_classes: AnyPath | ClassTable | None,
        scoring: Scoring,
    ) -> None:
        self.scoring = scoring
        self.impossible: CarlascError | None = None
        given, remap = (
            (None, None)
            if source_classes is None
            else read_classes(source_classes, "source_classes")
        )
        self.convention = _resolve(convention, pairs, remap)
        self.found = None if given is not None else _find_by_ids(pairs, self.convention)
        self.tables: dict[str, tuple[ClassTable, ClassTable]] = {}
        self.uses: tuple[set[TableUse], set[TableUse]] = (set(), set())
        try:
            for pair in pairs:
                self.tables[pair.truth.path] = self._check(pair, given)
        except CarlascError as error:
            self.impossible = error
        self.reset()

    def reset(self) -> None:
        """Set all sums to zero."""
        classes = self.convention.num_classes
        free = self.convention.free
        self.matrices = {path: self._matrix() for path in self.tables}
        self.failures: list[tuple[str, str]] = []
        self.unknown: dict[str, Counter[int]] = {"prediction": Counter(), "truth": Counter()}
        self.frames: list[FrameScore] = []
        self.breakdown = Breakdown(classes, free=free)
        self.rays = RayIoU(classes, free=free) if self.scoring.rays else None
        self.actors = ActorScores(self.convention) if self.scoring.actors else None

    def empty(self) -> Scorer:
        """Return an empty scorer with the same rules."""
        other = copy(self)
        other.reset()
        return other

    def merge(self, other: Scorer) -> None:
        """Add the sums of another scorer with the same rules."""
        for path, matrix in other.matrices.items():
            self.matrices[path] += matrix
        self.failures += other.failures
        self.frames += other.frames
        for side, ids in other.unknown.items():
            self.unknown[side] += ids
        self.breakdown.merge(other.breakdown)
        if self.rays is not None and other.rays is not None:
            self.rays.merge(other.rays)
        if self.actors is not None and other.actors is not None:
            self.actors.merge(other.actors)

    def add(self, pair: Pair, frame: int, content: LabelPair | CarlascError) -> None:
        """Score a frame, or record the error that prevents it."""
        if self.impossible is not None:
            return
        path = pair.truth.path
        frame_name = pair.truth.name_of(frame)
        try:
            if isinstance(content, CarlascError):
                raise content
            matrix = self._score(pair, frame, content)
        except ArgumentError:
            raise  # the error is the same in every frame
        except CarlascError as error:
            self.failures.append((f"{path}:{frame_name}", str(error)))
            return
        self.matrices[path] += matrix
        self.frames.append(FrameScore(path, frame_name, self.convention.score(matrix)))

    def result(self, name: str, notes: tuple[str, ...]) -> Evaluation | CarlascError:
        """Return the scores of all added frames, or the error that prevented them."""
        if self.impossible is not None:
            return self.impossible
        summed = sum(self.matrices.values(), self._matrix())
        return Evaluation(
            name,
            self.convention,
            summed,
            self.matrices,
            len(self.frames),
            self.scoring.voxels,
            self.failures,
            tuple(self.frames),
            (*notes, *self._notes(summed)),
            self.breakdown.compute(),
            None if self.rays is None else self.rays.compute(),
            None if self.actors is None else self.actors.compute(),
            tuple(sorted(self.uses[0])),
            tuple(sorted(self.uses[1])),
            {side: dict(sorted(ids.items())) for side, ids in self.unknown.items() if ids},
        )

    def _notes(self, summed: ConfusionMatrix) -> Iterator[str]:
        """Yield remarks about ids without a class, and about predictions that seem to have other
        ids than those of their assumed table.
        """
        for side, become in (("prediction", "count as free"), ("truth", "are not scored")):
            if ids := self.unknown[side]:
                yield (
                    f"{sum(ids.values())} voxels of the {side} have ids that are no class and "
                    f"{become}: {times(dict(sorted(ids.items())))}"
                )
        if self.rays is not None and np.isnan(self.rays.compute().rayiou):
            yield (
                "no ray was cast (RayIoU): no known position of the sensor is at least 1 m inside "
                "of a grid; poses.txt gives those of other frames"
            )
        guessed = [use.table for use in sorted(self.uses[0]) if use.found in ("assumed", "ids")]
        predicted, true = (np.flatnonzero(summed.counts.sum(axis=axis)) for axis in (0, 1))
        if guessed and len(predicted) and len(true) and predicted[-1] < true[-1]:
            yield (
                f"the ids of the predictions end at {predicted[-1]}, those of the ground truth at "
                f"{true[-1]}, in the classes {self.convention.classes.name}: if the predictions "
                f"are not in {guessed[0]}, name their table (`source_classes`)"
            )

    def _matrix(self) -> ConfusionMatrix:
        return ConfusionMatrix(self.convention.num_classes, free=self.convention.free)

    def _check(self, pair: Pair, given: ClassTable | None) -> tuple[ClassTable, ClassTable]:
        """Return the class tables of prediction and ground truth, after checking that the
        convention can score them.
        """
        truth = pair.truth.classes or self.convention.usual_truth
        prediction = given or pair.prediction.classes or self.convention.usual_prediction
        how = "option" if given is not None else pair.prediction.named
        if how == "assumed" and self.found is not None:
            prediction = self.found
            how = "ids"
        self.convention.check(truth, pair.truth.location)
        self.convention.check(prediction, pair.prediction.location)
        self.uses[0].add(TableUse(prediction.name, how))
        self.uses[1].add(TableUse(truth.name, pair.truth.named))
        needs_seen = self.convention.seen_by == "camera" or "seen" in self.scoring.by
        if needs_seen and pair.truth.known(int(pair.truth.frames()[0]), "camera") is None:
            raise MissingDataError(
                pair.truth.location,
                expected="cameras and the field `seen`, which voxels a camera observed",
                found="data without one of them",
                advice="make the grids with --keep-seen, or leave out the scores by `seen`",
            )
        true_spec = pair.truth.spec
        predicted_spec = pair.prediction.spec
        if true_spec and predicted_spec and true_spec != predicted_spec:
            raise FormatError(
                pair.prediction.location,
                expected=f"the geometry of the ground truth, {true_spec} {true_spec.lower} .. "
                f"{true_spec.upper}",
                found=f"{predicted_spec} {predicted_spec.lower} .. {predicted_spec.upper}",
            )
        if self.scoring.actors:
            ActorScores.check(pair)
        for argument in ("region", "by", "rays"):
            asked = getattr(self.scoring, argument)
            if asked and pair.spec is None:
                raise ArgumentError(
                    argument,
                    expected="None for grids without geometry",
                    found="a region" if argument == "region" else str(asked),
                    advice=f"add params.json to {pair.truth.location}",
                )
        if self.scoring.rays and pair.truth.origin is None:
            raise ArgumentError(
                "rays",
                expected="ground truth with the position of the sensor: poses.txt, or files of a "
                "benchmark",
                found=f"none in {pair.truth.location}",
            )
        if "motion" in self.scoring.by and not isinstance(pair.truth, SequenceGrid):
            raise ArgumentError(
                "by",
                expected="a data set with poses and scans as ground truth",
                found="files of grids",
            )
        return prediction, truth

    def _score(self, pair: Pair, frame: int, content: LabelPair) -> ConfusionMatrix:
        (prediction, truth, known_by) = content
        tables = self.tables[pair.truth.path]
        known = self._known(pair, frame, known_by, truth.shape)
        spec = pair.spec
        region = None
        if self.scoring.region is not None and spec is not None:
            region = self.scoring.region(spec).reshape(truth.shape)
        try:
            if self.scoring.allow_unknown:
                for name, labels, table in zip(
                    self.unknown, (prediction, truth), tables, strict=True
                ):
                    self.unknown[name].update(self.convention.unknown_ids(labels, table))
            pred, true, counted = self.convention.prepare(
                (prediction, tables[0]),
                (truth, tables[1]),
                known,
                region,
                self.scoring.allow_unknown,
            )
            matrix = self._matrix().update(pred, true, counted)
            if (self.scoring.by or self.scoring.rays or self.scoring.actors) and spec is not None:
                pred = pred.reshape(spec.size)
                true = true.reshape(spec.size)
                counted = counted.reshape(spec.size)
                if self.actors is not None:
                    self.actors.update(pair, frame, (pred, true, counted))
                for masks in self._masks(pair, frame, spec, true, known, tables[1]):
                    self.breakdown.update(pred, true, masks, counted)
                if self.rays is not None and (origin := pair.truth.origin) is not None:
                    # Rays begin at the sensor positions of the frames with ground truth, or at that
                    # of this frame if the files have no poses.
                    poses = pair.truth.poses()
                    row = pair.truth.frames().tolist().index(frame)
                    poses, row = (np.eye(4)[None], 0) if poses is None else (poses, row)
                    self.rays.update(pred, true, spec, ray_origins(poses, row, spec, origin))
        except (
            FormatError
        ) as error:  # add the location of prediction or ground truth to the message
            side = pair.prediction if error.where == "prediction" else pair.truth
            raise error.within(f"{side.location}: frame {pair.truth.name_of(frame)}") from error
        return matrix

    def _known(
        self, pair: Pair, frame: int, known_by: _Known, shape: tuple[int, ...]
    ) -> BoolArray | None:
        """Return the known voxels of the ground truth; None for all."""
        if self.scoring.voxels == "all":
            return None
        known = known_by(self.convention.seen_by)
        if known is None and self.convention.unknown == "left out":
            raise MissingDataError(
                f"{pair.truth.location}: frame {pair.truth.name_of(frame)}",
                expected="counts or a mask of known voxels",
                found="none",
                advice="give `voxels=all` to score all voxels",
            )
        return None if known is None else known.reshape(shape)

    def _masks(
        self,
        pair: Pair,
        frame: int,
        spec: GridSpec,
        truth: LabelArray,
        known: BoolArray | None,
        table: ClassTable,
    ) -> Iterator[Masks]:
        """Yield the masks of each requested breakdown."""
        counts = None if known is None else known.astype(np.float32).reshape(spec.size)
        if "distance" in self.scoring.by:
            yield distance_bands(spec, _DISTANCES_M)
        if "height" in self.scoring.by:
            yield height_bands(
                spec, np.linspace(spec.lower[2], spec.upper[2], _HEIGHTS + 1).tolist()
            )
        if "visibility" in self.scoring.by:
            yield visibility(Grid(spec, truth, counts), free=self.convention.free)
        if "seen" in self.scoring.by and (seen := pair.truth.known(frame, "camera")) is not None:
            seen = seen.reshape(spec.size)
            yield {"seen": seen, "not seen": ~seen}
        if "motion" in self.scoring.by and isinstance(pair.truth, SequenceGrid):
            labels = pair.truth.labels(frame).reshape(spec.size)
            yield motion(
                Grid(spec, labels, counts),
                pair.truth.sequence.scan(frame, ("flow",)),
                sorted(table.movable),
            )


def _resolve(
    convention: str | Convention | None, pairs: list[Pair], remap: Remap | None
) -> Convention:
    if isinstance(convention, Convention):
        return convention
    sides = (side for pair in pairs for side in (pair.truth, pair.prediction))
    table = next((side.classes for side in sides if side.classes is not None), CARLA)
    if convention is None:
        convention = pairs[0].truth.benchmark or "carlasc"
        # classes of one's own, with a map from those of the ground truth
        own = remap is not None and remap.target.name not in CONVENTIONS["carlasc"].maps
        if own or table.name not in CONVENTIONS[convention].maps:
            convention = "own"
    if convention == "own":
        return own_convention(table if remap is None else remap.target, remap=remap)
    return convention_named(convention)


def _find_by_ids(pairs: list[Pair], convention: Convention) -> ClassTable | None:
    """Return the usual table of predictions if no file names another one, all of their ids are in
    it, and the ids of the ground truth go beyond it; otherwise None.

    The first and the last frame of some sequences are read.
    """
    usual = convention.usual_prediction
    ids = (set[int](), set[int]())
    for pair in pairs[:_TRIED]:
        if pair.prediction.named != "assumed" or pair.truth.classes == usual:
            continue
        common = np.intersect1d(pair.prediction.frames(), pair.truth.frames()).tolist()
        for frame in {*common[:1], *common[-1:]}:
            try:
                for found, side in zip(ids, (pair.prediction, pair.truth), strict=True):
                    found.update(np.unique(side.labels(frame)).tolist())
            except CarlascError:
                continue  # scoring names it
    predicted = ids[0] - {IGNORED_ID}
    true = ids[1]
    beyond = true and max(true) > max(usual.names)
    return usual if predicted and predicted <= usual.names.keys() and beyond else None


def evaluate(
    source: Place,
    truth: Place,
    *,
    convention: str | Convention | None = None,
    grid: str | None = None,
    truth_grid: str | None = None,
    source_classes: AnyPath | ClassTable | None = None,
    scoring: Scoring = Scoring(),  # noqa: B008 (frozen)
    sequences: Collection[str] = (),
    frames: Frames = None,
    name: str | None = None,
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
) -> Evaluation:
    """Score predicted grids against the ground truth, one frame in memory at a time.

    Args:
        source: the predictions: anything that `carlasc.open` opens, the folder of one grid, a
            folder of `.label` files, or files of SemanticKITTI, SSCBench, Occ3D, OpenOccupancy,
            SurroundOcc, OccNet or CarlaOcc.
        truth: the ground truth, in the same forms.
        convention: the rules of a benchmark: a Convention or a name in
            `carlasc.metrics.CONVENTIONS`. It defines the scored voxels, the classes, and the mean.
            "own" scores the unchanged classes of the data. None takes the benchmark of the ground
            truth files; for other data "carlasc" if it has a map for the class table, otherwise
            "own".
        grid: name of the grid with the predictions. None: the name of the true grid, or the only
            grid of a sequence.
        truth_grid: name of the grid with the ground truth. None: evaluation, or the only grid of a
            sequence.
        source_classes: class table of the predictions, for data whose metadata name none: a table,
            its name, or a JSON or YAML file. None: the default table of the convention.
        sequences: paths or names of the sequences to score; empty scores all.
        scoring: voxels to score, and additional scores.
        frames: frames to score; None scores all frames of the ground truth.
        name: name of the predictions in the tables. None: the name of the source.
        run: how the work is distributed, and the progress callback.

    Returns:
        The scores. Frames that could not be scored are in `failures`.

    Raises:
        ArgumentError: an argument has an unknown value, or `scoring` needs data that do not exist.
        MissingDataError: no grid exists, a sequence has no ground truth, or no frame can be scored.
        FormatError: the grids or classes of prediction and ground truth cannot be compared.
    """
    check_types(evaluate, locals())
    pairs, notes = pair_grids(source, truth, grid, truth_grid, sequences)
    return score_pairs(
        pairs, convention, source_classes, scoring, frames, name or _name_of(source), run, notes
    )


def score_pairs(
    pairs: list[Pair],
    convention: str | Convention | None,
    source_classes: AnyPath | ClassTable | None,
    scoring: Scoring,
    frames: Frames,
    name: str,
    run: Run,
    notes: tuple[str, ...],
) -> Evaluation:
    """Return the scores of pairs of predicted and true grids. For the arguments, see `evaluate`.

    Raises:
        CarlascError: no frame can be scored.
    """
    kinds = _by_coordinates(pairs)
    if len(kinds) > 1:
        first, *others = (
            score_pairs(part, convention, source_classes, scoring, frames, name, run, notes)
            for part in kinds.values()
        )
        return replace(first, apart=dict(zip([*kinds][1:], others, strict=True)))
    scorer = Scorer(convention, pairs, source_classes, scoring)
    _score_frames([scorer], pairs, frames, run)
    result = scorer.result(name, notes)
    if isinstance(result, CarlascError):
        raise result
    return result


def evaluate_by_all_conventions(
    source: Place,
    truth: Place,
    *,
    grid: str | None = None,
    truth_grid: str | None = None,
    source_classes: AnyPath | ClassTable | None = None,
    sequences: Collection[str] = (),
    frames: Frames = None,
    name: str | None = None,
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
) -> Mapping[str, Evaluation | CarlascError]:
    """Score predictions by every convention. Each frame is read once. For defaults, see `evaluate`.

    Args:
        source: the predictions: a data set, a sequence, the folder of a grid, or files of a
            benchmark.
        truth: the ground truth, in the same forms.
        grid: name of the predicted grid.
        truth_grid: name of the true grid.
        source_classes: class table of the predictions, as in `evaluate`.
        sequences: paths or names of the sequences to score; empty scores all.
        frames: frames to score.
        name: name of the predictions in tables.
        run: how the work is distributed, and the progress callback.

    Returns:
        By name of the convention: the scores, or the error that prevented them.
    """
    pairs, notes = pair_grids(source, truth, grid, truth_grid, sequences)
    first, *others = _by_coordinates(pairs).items()
    pairs = first[1]
    for kind, _ in others:
        notes = (*notes, f"{kind} grids are not in these scores, which are of {first[0]} grids")
    scorers = {
        convention: Scorer(convention, pairs, source_classes, Scoring())
        for convention in CONVENTIONS
    }
    _score_frames(list(scorers.values()), pairs, frames, run)
    return {
        convention: scorer.result(name or _name_of(source), notes)
        for convention, scorer in scorers.items()
    }


def _by_coordinates(pairs: list[Pair]) -> dict[str, list[Pair]]:
    """Return the pairs by the coordinates of their grids, Cartesian ones first."""
    kinds: dict[str, list[Pair]] = {}
    for pair in sorted(pairs, key=lambda pair: pair.coordinates):
        kinds.setdefault(pair.coordinates, []).append(pair)
    return kinds


def _name_of(source: Place) -> str:
    return getattr(source, "location", None) or str(source)


def _score_frames(scorers: Sequence[Scorer], pairs: list[Pair], frames: Frames, run: Run) -> None:
    """Read each requested frame once, and add its scores to each scorer.

    Raises:
        MissingDataError: no frame can be scored.
    """
    chosen = FrameRange.of(frames)
    frames_of = [(pair, chosen.select(pair.truth.frames()).tolist()) for pair in pairs]
    total = sum(len(numbers) for _, numbers in frames_of)
    if not total:
        raise MissingDataError(
            pairs[0].truth.location,
            expected="labels of a frame to score",
            found=f"none in the range {chosen}",
        )
    size = 1 if run.is_alone else _TOGETHER
    batches = [
        (pair, numbers[first : first + size])
        for pair, numbers in frames_of
        for first in range(0, len(numbers), size)
    ]
    step = StepCounter(run.progress, total)
    score = partial(_score_batch, scorers=scorers)
    with closing(run_all(score, batches, run, lost=score)) as results:
        for (_, numbers), parts in zip(batches, results, strict=True):
            for scorer, part in zip(scorers, parts, strict=True):
                scorer.merge(part)
            step(len(numbers))


def _score_batch(
    batch: _FrameBatch, lost: str | None = None, *, scorers: Sequence[Scorer]
) -> list[Scorer]:
    """Read and score frames in a worker, and return one new scorer for each of `scorers`.

    With the message `lost`, every worker died with these frames: they are not read, and the message
    is recorded as failure.
    """
    parts = [scorer.empty() for scorer in scorers]
    pair, frames = batch
    predicted = set(pair.prediction.frames().tolist())
    for frame in frames:
        content: LabelPair | CarlascError
        try:
            if lost is not None:
                raise CarlascError("", problem=lost)
            content = _read(pair, frame, predicted)
        except CarlascError as error:
            content = error
        for part in parts:
            part.add(pair, frame, content)
    return parts


def _read(pair: Pair, frame: int, predicted: set[int]) -> LabelPair:
    """Return predicted and true labels of a frame, of equal shape, and the known voxels."""
    if frame not in predicted:
        raise MissingDataError(
            pair.prediction.location,
            expected=f"a prediction for frame {pair.truth.name_of(frame)}",
            found="none",
        )
    prediction = pair.prediction.labels(frame)
    truth = pair.truth.labels(frame)
    if prediction.size != truth.size:
        where = f"{pair.prediction.location}: frame {pair.truth.name_of(frame)}"
        raise FormatError(
            where,
            expected=f"the shape of the ground truth {truth.shape}",
            found=prediction.shape,
        )
    return prediction.reshape(truth.shape), truth, cache(partial(pair.truth.known, frame))
