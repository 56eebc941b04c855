"""The scores of predictions over a data set, confidence intervals, and tables as text, LaTeX and
CSV.

Confidence intervals hold for other sequences, and a paired test compares two predictions. Both
take sequences instead of frames, because the frames of one sequence show nearly the same scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from carlasc.core.arrays import IntArray
from carlasc.core.classes import ClassTable, TableUse
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.metrics.actor_scores import ActorScore
from carlasc.metrics.confusion import ConfusionMatrix, json_number
from carlasc.metrics.conventions import Convention, ConventionScore
from carlasc.metrics.rays import RayScore
from carlasc.storage.files import csv_text

Cell = str | float
Score = Callable[[ConfusionMatrix], float]
_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_FEWEST_SEQUENCES = 5
_LEVEL = 0.95  # of confidence
_DRAWS = 2000  # of swaps; fact: draws
_SEED = 0
_EXACT = 12  # of sequences, up to which all swaps are made
_NEARLY_NORMAL = 1000.0  # degrees of freedom of Student's t


@dataclass(frozen=True)
class FigureTable:
    """A table with a header. Numbers are percentages; undefined scores, NaN, are written as a dash.

    Attributes:
        title: title of the table.
        header: names of the columns.
        rows: one row per prediction: its name, then numbers.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def texts(self) -> list[list[str]]:
        """Return the rows as text, numbers with two decimals."""
        return [[_text(cell) for cell in row] for row in self.rows]

    def to_csv(self) -> str:
        """Return the table as CSV with a header."""
        return csv_text([self.header, *self.texts()])

    def to_markdown(self) -> str:
        """Return the table as Markdown, with the title above."""
        lines = [self.header, ["---"] + ["---:"] * (len(self.header) - 1), *self.texts()]
        escaped = str.maketrans({"|": "\\|", "<": "&lt;"})  # HTML in a name is shown, not run
        rows = (
            "| " + " | ".join(cell.translate(escaped) for cell in line) + " |" for line in lines
        )
        return f"{self.title}\n\n" + "\n".join(rows) + "\n"

    def to_latex(self) -> str:
        r"""Return the table as a LaTeX `tabular` with the lines of the package booktabs (\toprule,
        \midrule, \bottomrule).
        """
        escaped = str.maketrans({letter: f"\\{letter}" for letter in "&%$#_{}"} | _LATEX)
        rows = [
            [cell.translate(escaped) for cell in row] for row in [list(self.header), *self.texts()]
        ]
        lines = [" & ".join(row) + r" \\" for row in rows]
        body = "\n".join([r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"])
        columns = "l" + "r" * (len(self.header) - 1)
        return f"% {self.title}\n\\begin{{tabular}}{{{columns}}}\n{body}\n\\end{{tabular}}\n"


def _text(cell: Cell) -> str:
    if isinstance(cell, str):
        return cell
    return "-" if math.isnan(cell) else f"{cell:.2f}"


@dataclass(frozen=True)
class FrameScore:
    """The scores of one frame.

    Attributes:
        sequence: path of the sequence.
        frame: number or token of the frame.
        score: scores of the frame.
    """

    sequence: str
    frame: str
    score: ConventionScore


@dataclass(frozen=True)
class Evaluation:
    """The scores of predictions.

    All scores are computed from the sum of the confusion matrices of all frames.

    Attributes:
        name: name of the predictions: of a network, or of the place where they are stored.
        convention: the rules of scoring.
        matrix: the confusion matrix over all frames, in the classes of the convention.
        sequences: the confusion matrix of each sequence, by path.
        frames: number of frames scored.
        voxels: scored voxels: "known" voxels of the ground truth, or "all".
        failures: (frame, message) of the frames that could not be scored.
        frame_scores: the scores of each frame.
        notes: remarks about the scores.
        breakdown: the confusion matrix of each requested region, by name.
        rays: RayIoU, if requested; otherwise None.
        actors: scores of actors and velocities, if requested; otherwise None.
        source_classes: class tables by which the predictions were read.
        truth_classes: class tables by which the ground truth was read.
        unknown_ids: number of voxels by id that is no class, for "prediction" and "truth", if such
            ids were allowed.
        apart: scores of the grids with other coordinates, by their name; `matrix` has none of them.
    """

    name: str
    convention: Convention
    matrix: ConfusionMatrix
    sequences: Mapping[str, ConfusionMatrix]
    frames: int
    voxels: Literal["known", "all"]
    failures: list[tuple[str, str]]
    frame_scores: tuple[FrameScore, ...] = ()
    notes: tuple[str, ...] = ()
    breakdown: Mapping[str, ConfusionMatrix] = field(default_factory=dict)
    rays: RayScore | None = None
    actors: ActorScore | None = None
    source_classes: tuple[TableUse, ...] = ()
    truth_classes: tuple[TableUse, ...] = ()
    unknown_ids: Mapping[str, Mapping[int, int]] = field(default_factory=dict)
    apart: Mapping[str, Evaluation] = field(default_factory=dict)

    @property
    def classes(self) -> ClassTable:
        """The scored classes."""
        return self.convention.classes

    @property
    def score(self) -> ConventionScore:
        """The scores of the convention."""
        return self.convention.score(self.matrix)

    @property
    def class_iou(self) -> dict[str, float]:
        """IoU by name of each class of the mean; NaN for classes that do not occur in the
        prediction or the ground truth.
        """
        return dict(self.score.class_iou)

    @property
    def miou(self) -> float:
        """Mean IoU by the rules of the convention."""
        return self.score.miou

    @property
    def absent_classes(self) -> list[str]:
        """The classes of the mean that occur neither in the predictions nor in the ground truth."""
        return [name for name, value in self.class_iou.items() if math.isnan(value)]

    @property
    def miou_of_present(self) -> float:
        """Mean IoU over the classes of the convention that occur; NaN for none."""
        values = [value for value in self.class_iou.values() if not math.isnan(value)]
        return sum(values) / len(values) if values else math.nan

    def about_absent(self) -> str:
        """Return what the absent classes do to the mean, one sentence; "" without such classes."""
        names = self.absent_classes
        rule = self.convention.absent
        if not names or not self.matrix.total:
            return ""
        effect = {"zero": "count 0 in the mean", "nan": "make the mean undefined"}
        what = effect.get(rule, "are left out of the mean")
        others = f"; mean of the others {100 * self.miou_of_present:.2f}" if rule in effect else ""
        plural = "classes" if len(names) > 1 else "class"
        return (
            f"{plural} in neither predictions nor ground truth {what}: {', '.join(names)}{others}"
        )

    @property
    def miou_without_free(self) -> float:
        """Mean IoU over the classes of the convention except free.

        Absent classes count as zero, as in the paper.
        """
        free = self.classes.names[self.convention.free]
        values = [0.0 if math.isnan(v) else v for name, v in self.class_iou.items() if name != free]
        return sum(values) / len(values) if values and self.matrix.total else math.nan

    def interval(self) -> Interval | None:
        """Return the confidence interval of `miou`; None for fewer than five sequences."""
        if len(self.sequences) < _FEWEST_SEQUENCES:
            return None
        return confidence_interval(
            list(self.sequences.values()), lambda m: self.convention.score(m).miou
        )

    def compare(self, other: Evaluation) -> Comparison:
        """Compare with other predictions of the same sequences by a paired test.

        Raises:
            ArgumentError: the conventions differ, or fewer than five sequences are common.
        """
        if other.convention.name != self.convention.name:
            raise ArgumentError(
                "other", expected=f"scores by {self.convention.name}", found=other.convention.name
            )
        return compare(self.sequences, other.sequences, lambda m: self.convention.score(m).miou)

    def tables(self) -> tuple[FigureTable, ...]:
        """Return the two tables of the paper, IoU of each class and completeness, and a table of
        regions if requested.
        """
        tables = semantic_table([self]), geometric_table([self]), *self._actor_tables()
        if not self.breakdown:
            return tables
        rows: list[tuple[Cell, ...]] = [
            (name, *_percent(*part.values())) for name, part in self._by_region().items()
        ]
        header = ("Region", "mIoU", "Precision", "Recall", "IoU", "False free")
        return (*tables, FigureTable("By region", header, tuple(rows)))

    def _by_region(self) -> dict[str, dict[str, float]]:
        scores = {name: self.convention.score(matrix) for name, matrix in self.breakdown.items()}
        return {name: _figures_of(score) for name, score in scores.items()}

    def _actor_tables(self) -> tuple[FigureTable, ...]:
        """Return the table of panoptic quality and LSTQ, if actors were scored."""
        if self.actors is None:
            return ()
        score = self.actors.panoptic
        names = self.classes.names
        present = [label for label in sorted(names) if not math.isnan(score.pq[label])]
        lstq = (self.actors.tracking.lstq, self.actors.tracking.association)
        row = _percent(*score.pq[present].tolist(), score.mean(), score.mean(which="things"), *lstq)
        figures = ("PQ", "PQ of things", "LSTQ", "S_assoc")
        header = ("Network", *(names[label] for label in present), *figures)
        title = "Actors: panoptic quality of each class, and over time"
        return (FigureTable(title, header, ((self.name, *row),)),)

    def to_csv(self) -> str:
        """Return the scores of each frame as CSV."""
        names = ["miou", "iou", "precision", "recall", "false_free"]
        rows = [["sequence", "frame", *names, *self.class_iou]]
        for frame in self.frame_scores:
            figures = _figures_of(frame.score)
            values = [*(figures[name] for name in names), *frame.score.class_iou.values()]
            cells = ["" if math.isnan(value) else f"{value:.6f}" for value in values]
            rows.append([frame.sequence, frame.frame, *cells])
        return csv_text(rows)

    def to_dict(self) -> dict[str, Any]:
        """Return all scores by name, as fractions, for JSON; None for undefined scores."""
        interval = self.interval()
        means = {
            "miou": self.miou,
            "miou_without_free": self.miou_without_free,
            "miou_of_present": self.miou_of_present,
        }
        figures = means | {"accuracy": self.matrix.accuracy} | _figures_of(self.score)
        return {
            "name": self.name,
            "convention": self.convention.name,
            "classes": self.classes.name,
            "source_classes": [vars(use) for use in self.source_classes],
            "truth_classes": [vars(use) for use in self.truth_classes],
            "unknown_ids": {
                side: {str(i): n for i, n in ids.items()} for side, ids in self.unknown_ids.items()
            },
            "absent_classes": self.absent_classes,
            "absent": self.convention.absent,
            "frames": self.frames,
            "voxels": self.voxels,
            "scored_voxels": self.matrix.total,
            **{name: json_number(value) for name, value in figures.items()},
            "miou_interval": None if interval is None else [interval.low, interval.high],
            "class_iou": {name: json_number(value) for name, value in self.class_iou.items()},
            "rayiou": None if self.rays is None else json_number(self.rays.rayiou),
            "actors": None if self.actors is None else self.actors.to_dict(self.classes),
            "breakdown": {
                name: {key: json_number(part[key]) for key in ("miou", "iou", "false_free")}
                for name, part in self._by_region().items()
            },
            "confusion": self.matrix.counts.tolist(),
            "notes": list(self.notes),
            "failures": [list(failure) for failure in self.failures],
            "apart": {name: other.to_dict() for name, other in self.apart.items()},
        }


def semantic_table(evaluations: Sequence[Evaluation]) -> FigureTable:
    """Return the table of IoU per class, mean IoU, and accuracy, with one row per evaluation.

    Raises:
        ArgumentError: `evaluations` is empty, or the conventions differ.
    """
    conventions = {evaluation.convention.name for evaluation in evaluations}
    if len(conventions) != 1:
        raise ArgumentError(
            "evaluations",
            expected="evaluations by one convention",
            found=", ".join(sorted(conventions)) or "none",
        )
    first = evaluations[0].convention
    with_free = first.free in first.averaged
    rayed = any(e.rays is not None for e in evaluations)
    header = ["Network", *evaluations[0].class_iou, "mIoU"]
    header += ["mIoU w/o free"] * with_free + ["Accuracy"] + ["RayIoU"] * rayed
    rows: list[tuple[Cell, ...]] = []
    for e in evaluations:
        means = [e.miou, *[e.miou_without_free] * with_free, e.matrix.accuracy]
        means += [math.nan if e.rays is None else e.rays.rayiou] * rayed
        rows.append((e.name, *_percent(*e.class_iou.values(), *means)))
    return FigureTable(
        f"Semantic scene completion, IoU of each class, by {first.title}",
        tuple(header),
        tuple(rows),
    )


def geometric_table(evaluations: Sequence[Evaluation]) -> FigureTable:
    """Return the table of completeness: precision, recall and IoU of occupied against free space,
    with one row per evaluation.
    """
    rows: list[tuple[Cell, ...]] = [
        (evaluation.name, *_percent(*list(_figures_of(evaluation.score).values())[1:]))
        for evaluation in evaluations
    ]
    header = ("Network", "Precision", "Recall", "IoU", "False free")
    return FigureTable(
        "Scene completion: all classes other than free count as one", header, tuple(rows)
    )


def _figures_of(score: ConventionScore) -> dict[str, float]:
    """Return the means of a score by name, mIoU first."""
    names = "miou", "precision", "recall", "iou", "false_free"
    return {name: getattr(score, name) for name in names}


def _percent(*values: float) -> tuple[float, ...]:
    return tuple(100 * value for value in values)


@dataclass(frozen=True)
class Interval:
    """A confidence interval of 95%.

    Attributes:
        value: the score over all sequences.
        low: lower bound.
        high: upper bound.
    """

    value: float
    low: float
    high: float

    def __format__(self, spec: str) -> str:
        """Return "value (low to high)", each in a format of numbers."""
        return "{:{spec}} ({:{spec}} to {:{spec}})".format(*vars(self).values(), spec=spec)


@dataclass(frozen=True)
class Comparison:
    """Comparison of two predictions of the same sequences.

    Attributes:
        difference: score of the first minus score of the second, with its interval.
        p_value: probability of a difference at least as large if both are equally good.
        sequences: the common sequences.
    """

    difference: Interval
    p_value: float
    sequences: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the values by name, as fractions, for JSON."""
        return {
            "difference": self.difference.value,
            "interval": [self.difference.low, self.difference.high],
            "p_value": self.p_value,
            "sequences": list(self.sequences),
        }


def interval_of(value: float, *parts: tuple[float, float]) -> Interval:
    """Return the interval of a value whose variance is a sum of independent parts, by Student's t
    with the degrees of freedom of Welch and Satterthwaite.

    Args:
        value: the value.
        parts: variance and degrees of freedom of each part.
    """
    variance = sum(part for part, _ in parts)
    if not variance > 0:
        bound = 0.0 if variance == 0 else math.nan
        return Interval(value, value - bound, value + bound)
    freedom = variance**2 / sum(part**2 / degrees for part, degrees in parts)
    # With t = sqrt(freedom) * tan(angle), the density over the angle is cos(angle)^(freedom - 1).
    angle = np.linspace(0, np.pi / 2, 2_001)
    mass = np.cos(angle) ** (min(freedom, _NEARLY_NORMAL) - 1)
    below = np.concatenate(([0], np.cumsum(mass[1:] + mass[:-1])))
    tangent = math.tan(np.interp(_LEVEL, below / below[-1], angle))
    bound = math.sqrt(min(freedom, _NEARLY_NORMAL) * variance) * tangent
    return Interval(value, value - bound, value + bound)


def estimate(
    summed: Sequence[float], places: Mapping[str, int], of: Sequence[float] = ()
) -> Interval:
    """Return a sum over all sequences, or the ratio of two, estimated from a sample of them.

    Args:
        summed: what is summed, of each sequence of the sample.
        places: numbers of all sequences by split; empty if the sample has all.
        of: what the sum is divided by; empty for the sum itself.
    """
    number = sum(places.values()) or len(summed)
    values = np.array(summed)
    sizes = np.array(of or [1 / number] * len(summed))
    ratio = values.sum() / (sizes.sum() or math.nan)
    degrees = len(values) - 1
    if not degrees:
        return Interval(ratio, math.nan, math.nan)
    error = (values - ratio * sizes) / sizes.mean()
    missed = 1 - len(values) / number
    return interval_of(ratio, (missed * error.var(ddof=1) / len(values), degrees))


def jackknife(figure: Callable[[IntArray], float], counts: IntArray) -> tuple[float, float]:
    """Return the variance of a figure over independent samples, and its degrees of freedom, for
    `interval_of`: the figure is computed without each sample in turn.

    Args:
        figure: the figure of the samples that are left.
        counts: (N, ...) what was counted in each sample.
    """
    left = np.array([figure(np.delete(counts, i, 0)) for i in range(len(counts))])
    left = left[np.isfinite(left)]
    degrees = len(left) - 1
    return (float(degrees * left.var()), degrees) if degrees > 0 else (math.nan, 1)


def confidence_interval(matrices: Sequence[ConfusionMatrix], score: Score) -> Interval:
    """Return a score with its confidence interval, by the jackknife over sequences.

    Args:
        matrices: confusion matrix of each sequence.
        score: function that computes the score from the sum of the matrices.

    Raises:
        ArgumentError: fewer than five sequences are given.
    """
    _check_number(len(matrices))
    counts = np.stack([matrix.counts for matrix in matrices])

    def figure(counts: IntArray) -> float:
        return score(_matrix(counts.sum(axis=0), matrices[0]))

    return interval_of(figure(counts), jackknife(figure, counts))


def compare(
    first: Mapping[str, ConfusionMatrix],
    second: Mapping[str, ConfusionMatrix],
    score: Score,
) -> Comparison:
    """Compare two predictions, sequence by sequence.

    The interval is that of the difference by the jackknife over sequences. For the p-value, the
    predictions are swapped in subsets of the sequences: all subsets for up to twelve sequences,
    2,000 random subsets for more.

    Args:
        first: confusion matrix of each sequence of the first prediction, by path.
        second: confusion matrix of each sequence of the second prediction, by path. Only common
            sequences are used.
        score: function that computes the score from a sum of matrices.

    Raises:
        MissingDataError: no sequence is common.
        ArgumentError: fewer than five sequences are common.
    """
    common = tuple(sorted(set(first) & set(second)))
    if not common:
        raise MissingDataError(
            "second", expected="sequences of the first", found=", ".join(sorted(second)) or "none"
        )
    _check_number(len(common))
    like = first[common[0]]

    def difference(pairs: IntArray) -> float:
        one, other = pairs.sum(axis=0)
        return score(_matrix(one, like)) - score(_matrix(other, like))

    pairs = np.array([(first[path].counts, second[path].counts) for path in common])
    interval = interval_of(difference(pairs), jackknife(difference, pairs))
    if len(common) <= _EXACT:
        swaps = (np.arange(2 ** len(common))[:, None] >> np.arange(len(common)) & 1).astype(bool)
    else:
        swaps = np.random.default_rng(_SEED).random((_DRAWS, len(common))) < 0.5
        swaps[0] = False  # the first one is the actual assignment
    swapped = [difference(np.where(s[:, None, None, None], pairs[:, ::-1], pairs)) for s in swaps]
    p_value = float(np.mean(np.abs(swapped) >= abs(interval.value) - 1e-12))
    return Comparison(interval, p_value, common)


def _check_number(sequences: int) -> None:
    if sequences < _FEWEST_SEQUENCES:
        raise ArgumentError(
            "sequences",
            expected=f"at least {_FEWEST_SEQUENCES} sequences",
            found=sequences,
        )


def _matrix(counts: IntArray, like: ConfusionMatrix) -> ConfusionMatrix:
    return ConfusionMatrix(like.num_classes, free=like.free, counts=counts)
