"""The number of points and voxels of each class, and the class weights computed from them."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from carlasc.core.arrays import IntArray
from carlasc.core.classes import ClassTable, Remap, TableUse, class_weights
from carlasc.core.notebook import data_frame
from carlasc.core.tables import benchmark_remap, remaps_between, to_table
from carlasc.errors import ArgumentError, CarlascError, FormatError, MissingDataError, check_types
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import as_source, layout
from carlasc.storage.class_files import read_classes, read_remap
from carlasc.storage.files import AnyPath
from carlasc.storage.layout import EVALUATION
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.shares import sample_of, source_in
from carlasc.storage.voxel_files import VoxelSequence

if TYPE_CHECKING:
    import pandas

    from carlasc.metrics.results import Interval

Kind = Literal["points", "voxels"]
KINDS: tuple[Kind, ...] = ("points", "voxels")
_COUNT_APART = "count the sequences of each table separately"
_COUNTED = ("scans", "grids", "actor_voxels", "moving_voxels")
_CHUNK = 32  # frames per task of a worker


@dataclass(frozen=True)
class Histogram:
    """The number of points and voxels of each class in some frames.

    Attributes:
        points: (K,) int64 number of points of each class, by id; class 0 is unlabelled.
        voxels: (K,) int64 number of known voxels of each class; class 0 is free.
        unknown: number of unknown voxels (count 0).
        scans: number of scans counted.
        grids: number of grids counted.
        actor_voxels: number of voxels that belong to an actor, in grids with the field `actors`.
        moving_voxels: number of voxels that move, in grids with the field `actors`.
        unlisted: number of points and voxels by id that is no class, which are not in `points` and
            `voxels`.
    """

    points: IntArray
    voxels: IntArray
    unknown: int = 0
    scans: int = 0
    grids: int = 0
    actor_voxels: int = 0
    moving_voxels: int = 0
    unlisted: Counter[int] = dataclasses.field(default_factory=Counter)

    @classmethod
    def empty(cls, classes: ClassTable) -> Histogram:
        """Return the histogram of no frames."""
        zeros = np.zeros(classes.num_channels, np.int64)
        return cls(zeros, zeros)

    def __add__(self, other: Histogram) -> Histogram:
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Histogram(*(own + others for own, others in pairs))

    def of(self, kind: Kind) -> IntArray:
        """Return the (K,) counts of points or of voxels."""
        return self.points if kind == "points" else self.voxels

    @property
    def known_share(self) -> float:
        """Share of the voxels that are known; NaN if there are no grids."""
        total = int(self.voxels.sum()) + self.unknown
        return int(self.voxels.sum()) / total if total else float("nan")


@dataclass(frozen=True)
class Statistics:
    """What `stats` counted.

    Attributes:
        location: the source.
        classes: the class table of the labels.
        remap: the remap to the classes of the second table; None if there is no second table.
        sequences: the histogram of each sequence, by its path.
        splits: the split of each sequence, by its path; "none" if the path names no split.
        failures: (file, message) of the frames that could not be read.
        uses: the class tables of the labels, and what named them.
        places: number of folders of sequences by split; empty if all were counted.
    """

    location: str
    classes: ClassTable
    remap: Remap | None
    sequences: dict[str, Histogram]
    splits: dict[str, str]
    failures: tuple[tuple[str, str], ...] = ()
    uses: tuple[TableUse, ...] = ()
    places: Mapping[str, int] = dataclasses.field(default_factory=dict)

    @property
    def total(self) -> Histogram:
        """All sequences together."""
        return sum(self.sequences.values(), Histogram.empty(self.classes))

    @property
    def frames(self) -> int:
        """Number of scans and grids counted."""
        return self.total.scans + self.total.grids

    def by_split(self) -> dict[str, Histogram]:
        """Return the sums of the histograms of each split."""
        sums: dict[str, Histogram] = {}
        for path, histogram in self.sequences.items():
            split = self.splits[path]
            sums[split] = sums.get(split, Histogram.empty(self.classes)) + histogram
        return sums

    def summed(self, counts: IntArray) -> dict[str, int]:
        """Return (C,) counts of the classes by the names of the remapped classes."""
        if self.remap is None:
            return self.named(counts)
        summed = dict.fromkeys(self.remap.target.names.values(), 0)
        for old, new in self.remap.mapping.items():
            summed[self.remap.target.names[new]] += int(counts[old]) if old < len(counts) else 0
        return summed

    def named(self, counts: IntArray) -> dict[str, int]:
        """Return (C,) counts of the classes by their names."""
        return {name: int(counts[index]) for index, name in self.classes.names.items()}

    def intervals(self, kind: Kind, *, remapped: bool = False) -> dict[str, Interval]:
        """Return the share of each class in all sequences, estimated from those that were counted,
        with its interval.
        """
        from carlasc.metrics.results import estimate  # compiles loops, for scores

        names = self.summed if remapped else self.named
        rows = [names(histogram.of(kind)) for histogram in self.sequences.values()]
        sizes = [sum(row.values()) for row in rows]
        return {name: estimate([row[name] for row in rows], self.places, sizes) for name in rows[0]}

    def weights(self) -> dict[str, float]:
        """Return the loss weight of each class, remapped if there is a remap, from the known voxels
        of all sequences.
        """
        weights = class_weights(self.total.voxels, self.remap)
        table = self.classes if self.remap is None else self.remap.target
        return {name: float(weights[index]) for index, name in table.names.items()}

    def to_pandas(self) -> pandas.DataFrame:
        """Return a row per sequence and class: split, class, and the numbers of points and of
        voxels.

        Raises:
            DependencyError: pandas is not installed.
        """
        rows = (
            {
                "sequence": path,
                "split": self.splits[path],
                "class": name,
                "points": points,
                "voxels": self.summed(histogram.voxels)[name],
            }
            for path, histogram in self.sequences.items()
            for name, points in self.summed(histogram.points).items()
        )
        return data_frame(rows, "sequence")

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""

        def plain(histogram: Histogram) -> dict[str, Any]:
            share = histogram.known_share
            figures: dict[str, Any] = {kind: self.named(histogram.of(kind)) for kind in KINDS}
            if self.remap:
                figures |= {f"{kind}_remapped": self.summed(histogram.of(kind)) for kind in KINDS}
            return figures | {
                "unknown_voxels": histogram.unknown,
                **{name: getattr(histogram, name) for name in _COUNTED},
                "unlisted": {str(i): n for i, n in sorted(histogram.unlisted.items())},
                "known_share": None if np.isnan(share) else share,
            }

        return {
            "location": self.location,
            "classes": self.classes.name,
            "source_classes": [vars(use) for use in self.uses],
            "remap": self.remap.name if self.remap else None,
            "total": plain(self.total),
            "splits": {split: plain(histogram) for split, histogram in self.by_split().items()},
            "sequences": {path: plain(histogram) for path, histogram in self.sequences.items()},
            "class_weights": self.weights(),
            "places": dict(self.places),
            "intervals": {
                kind: {name: [one.low, one.high] for name, one in self.intervals(kind).items()}
                for kind in KINDS
            }
            if self.places
            else {},
            "failures": [list(failure) for failure in self.failures],
        }


def stats(
    source: AnyPath | Source,
    *,
    grid: str = EVALUATION,
    remap: str | Remap | None = "auto",
    every: int = 1,
    sample: int | None = None,
    source_classes: ClassTable | AnyPath | None = None,
    allow_unknown: bool = False,
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
) -> Statistics:
    """Count the classes of points and of a grid's known voxels, frame by frame.

    Args:
        source: a path or URL that `carlasc.open` knows, or a Source.
        grid: grid whose voxels are counted. A sequence that has only one grid uses that one.
        remap: the remap to the classes of a second table: a remap, its name, or a JSON or YAML file
            of classes with a map, None for no second table, or "auto", which takes the paper's 11
            classes or SemanticKITTI's 19.
        every: count only every N-th frame.
        sample: number of sequences to count, evenly spaced, if there are more. None: all.
        source_classes: class table of the labels, if the metadata do not name it: a table, its
            name, or a JSON or YAML file. None: that of the metadata.
        allow_unknown: count points and voxels whose id is no class apart, instead of listing their
            frames as failures.
        run: how the work is spread, with a callback for progress.

    Returns:
        The histograms. Frames that could not be read are listed in `failures`.

    Raises:
        ArgumentError: `every` or `sample` is less than 1, or the remap is unknown.
        FormatError: the sequences have different class tables, or the remap is of another table.
        MissingDataError: there is no data set, or it has no labels.
    """
    check_types(stats, locals())
    if every < 1:
        raise ArgumentError("every", expected="1 or more", found=every)
    opened = as_source(source)
    chosen, places = sample_of(opened, sample)
    sequences = source_in(opened, chosen).sequences()
    if source_classes is not None:
        given = read_classes(source_classes, "source_classes")[0]
        sequences = {path: one.with_classes(given) for path, one in sequences.items()}
    tasks = [task for sequence in sequences.values() for task in _tasks(sequence, grid, every)]
    if not tasks:
        expected = f"labels of points or the grid {grid}"
        advice = "name another grid with `grid`"
        raise MissingDataError(opened.location, expected=expected, found="neither", advice=advice)
    classes = _common_table(tasks, opened.location)
    target = _choose_remap(remap, classes)
    step = StepCounter(run.progress, sum(len(frames) for _, _, frames in tasks))
    histograms = {path: Histogram.empty(classes) for path in sequences}
    failures: list[tuple[str, str]] = []
    counted = run_all(
        partial(_count, classes=classes, allow_unknown=allow_unknown),
        tasks,
        run,
        lost=lambda task, message: (Histogram.empty(classes), _failures(task, message)),
    )
    for (sequence, _, frames), (histogram, failed) in zip(tasks, counted, strict=True):
        histograms[sequence.path] += histogram
        failures += failed
        step(len(frames))
    splits = {path: sequence.split or "none" for path, sequence in sequences.items()}
    uses = {sequence.table_use(field.rpartition("/")[0]) for sequence, field, _ in tasks}
    return Statistics(
        opened.location,
        classes,
        target,
        histograms,
        splits,
        tuple(failures),
        tuple(sorted(uses)),
        places,
    )


# a sequence, a field with classes, some of its frames
_Task = tuple[Sequence, str, tuple[int, ...]]


def _tasks(sequence: Sequence, grid: str, every: int) -> list[_Task]:
    grids = sequence.grids
    if grid not in grids and (len(grids) == 1 or isinstance(sequence, VoxelSequence)):
        grid = next(iter(grids))
    tasks: list[_Task] = []
    for name in ("labels", f"{grid}/labels"):
        frames = sequence.frames(name)[::every].tolist() if name in sequence.fields() else []
        tasks += [
            (sequence, name, tuple(frames[i : i + _CHUNK])) for i in range(0, len(frames), _CHUNK)
        ]
    return tasks


def _count(
    task: _Task, classes: ClassTable, allow_unknown: bool
) -> tuple[Histogram, list[tuple[str, str]]]:
    """Count the classes of some frames; runs in a worker."""
    histogram = Histogram.empty(classes)
    failures = []
    for frame in task[2]:
        try:
            histogram += _count_frame(*task[:2], frame, classes, allow_unknown)
        except CarlascError as error:
            failures += _failures((*task[:2], (frame,)), str(error))
    return histogram, failures


def _failures(task: _Task, message: str) -> list[tuple[str, str]]:
    sequence, field, frames = task
    return [(f"{sequence.path} {field} {frame:06d}", message) for frame in frames]


def _count_frame(
    sequence: Sequence, field: str, frame: int, classes: ClassTable, allow_unknown: bool
) -> Histogram:
    where = f"{sequence.location}: {field} of frame {frame}"
    stored = _table_of(sequence, field)
    labels = sequence.read(field, frame)
    labels = labels.reshape(-1)
    unlisted = Counter[int]()
    listed = np.ones(labels.shape, np.bool_)
    if allow_unknown and (others := stored.unknown(labels)):
        listed = ~np.isin(labels, list(others))
        unlisted = Counter(others)
        labels = np.where(listed, labels, 0)
    stored.check(labels, where)
    labels = to_table(labels, stored, classes, where)
    unknown = 0
    histogram = Histogram.empty(classes)
    grid = field.removesuffix("labels")
    if not grid:
        points = np.bincount(labels[listed], minlength=classes.num_channels)
        return replace(histogram, points=points, scans=1, unlisted=unlisted)
    if f"{grid}counts" in sequence.fields():
        known = sequence.read(f"{grid}counts", frame).reshape(-1) > 0
        listed = listed & known
        unknown = int(np.count_nonzero(~known))
    who = list[int]()
    for part in layout.ACTOR_FIELDS:
        has = f"{grid}{part}" in sequence.fields() and frame in sequence.frames(f"{grid}{part}")
        array = sequence.read(f"{grid}{part}", frame) if has else np.empty(0, np.uint8)
        who.append(len(array) if part == "velocity" else int(np.count_nonzero(array)))
    voxels = np.bincount(labels[listed], minlength=classes.num_channels)
    return Histogram(histogram.points, voxels, unknown, 0, 1, who[0], who[1], unlisted)


def _table_of(sequence: Sequence, field: str) -> ClassTable:
    return (
        sequence.metadata.classes
        if field == "labels"
        else sequence.classes_of(field.removesuffix("/labels"))
    )


def _common_table(tasks: Iterable[_Task], where: str) -> ClassTable:
    """Return the class table of the grids, or of the points if there are no grids: points beside a
    prediction are counted in its classes.
    """
    fields = {(sequence.path, field): _table_of(sequence, field) for sequence, field, _ in tasks}
    grids = [table for (_, field), table in fields.items() if field != "labels"]
    tables = {table.name: table for table in grids or fields.values()}
    place = f"{where}: classes"
    if len(tables) > 1:
        found = ", ".join(sorted(tables))
        raise FormatError(place, expected="one table", found=found, advice=_COUNT_APART)
    (classes,) = tables.values()
    for table in fields.values():
        try:
            remaps_between(table, classes)
        except ArgumentError as error:
            expected = f"classes that remap to {classes.name}"
            raise FormatError(
                place, expected=expected, found=table.name, advice=_COUNT_APART
            ) from error
    return classes


def _choose_remap(remap: str | Remap | None, classes: ClassTable) -> Remap | None:
    if remap is None:
        return None
    if remap == "auto":
        return benchmark_remap(classes)
    chosen = read_remap(remap) if isinstance(remap, str) else remap
    if chosen.source.name != classes.name:
        raise FormatError(
            f"remap {chosen.name}", expected=f"labels of {chosen.source.name}", found=classes.name
        )
    return chosen
