"""What is looked at: frames of a sequence with their grids, truth and errors beside them, and their points."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from carlasc.core.classes import ClassTable
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.scans import Scan
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.storage import Sequence, Source
from carlasc.viewing.rendering import colors as palette
from carlasc.viewing.rendering.colors import ClassColors, PaletteName
from carlasc.viewing.rendering.inputs import Input, find_truth, frames_in, in_one_table, open_input
from carlasc.viewing.rendering.scenes import check_same_spec

Path_ = str | os.PathLike[str]

RIGHT, WRONG, MISSED, INVENTED = 1, 2, 3, 4
_KINDS = (
    ("right class", palette.RIGHT),
    ("wrong class", palette.WRONG),
    ("missed: predicted free", palette.MISSED),
    ("invented: free in truth", palette.INVENTED),
)
ERRORS = ClassTable(
    "errors",
    {0: "nothing to compare", **{i: name for i, (name, _) in enumerate(_KINDS, 1)}},
    {0: (255, 255, 255), **{i: color for i, (_, color) in enumerate(_KINDS, 1)}},
)
"""What a prediction's voxels are, compared with the truth, where the truth is known."""


@dataclass(frozen=True)
class PanelSpec:
    """One of the grids that stand side by side.

    Attributes:
        title: what stands above it.
        spec: where its cells lie.
        colors: how its labels are drawn.
    """

    title: str
    spec: GridSpec
    colors: ClassColors


@dataclass(frozen=True)
class FrameContent:
    """What is seen of a frame.

    Attributes:
        grids: one for each of the clip's panels.
        scan: its points, or None where the sequence has none.
    """

    grids: tuple[Grid, ...]
    scan: Scan | None


@dataclass(frozen=True, eq=False)
class Clip:
    """Frames of a sequence to look at.

    Attributes:
        data: the sequence.
        truth: what a prediction is compared with, or None.
        grid: name of the grid, "" where the sequence has none.
        truth_grid: name of the truth's.
        frames: the frames' numbers.
        palette: "class" or "colorblind".
        notes: what was chosen where there was a choice.
    """

    data: Input
    truth: Input | None
    grid: str
    truth_grid: str
    frames: tuple[int, ...]
    palette: PaletteName = "class"
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """What to call the sequence: "Town01_Light", with its split where it has one."""
        sequence = self.data.sequence
        name = sequence.name or sequence.path or sequence.location
        return f"{sequence.split} / {name}" if sequence.split else name

    @property
    def left_handed(self) -> bool:
        """Whether y is on the right."""
        return self.data.sequence.metadata.axes == "left"

    @property
    def colors(self) -> ClassColors:
        """How classes are drawn."""
        return ClassColors(self.data.table, self.palette)

    @property
    def panels(self) -> tuple[PanelSpec, ...]:
        """What stands side by side; none where there is no grid."""
        if not self.grid:
            return ()
        spec = self.data.sequence.grids[self.grid]
        if self.truth is None:
            return (PanelSpec(str(spec), spec, self.colors),)
        return (
            PanelSpec("prediction", spec, self.colors),
            PanelSpec("truth", spec, self.colors),
            PanelSpec("errors", spec, ClassColors(ERRORS)),
        )

    def read(self, frame: int) -> FrameContent:
        """Read a frame.

        Raises:
            FormatError: what is there is not what the format says.
            ArgumentError: the prediction's cells are not the truth's.
        """
        scan = self.data.read_scan(frame) if self._has_points(frame) else None
        if scan is not None:
            finite = np.asarray(np.isfinite(scan.points).all(axis=1))
            scan = scan if finite.all() else scan.select(finite)
            if scan.labels is not None:
                self.data.table.check(scan.labels, f"{self.data.sequence.location}: labels, frame {frame}")
        if not self.grid:
            return FrameContent((), scan)
        own = self.data.read_grid(self.grid, frame)
        grids = [own]
        if self.truth is not None:
            reference = self.truth.read_grid(self.truth_grid, frame)
            grids += [reference, compare(own, reference)]
        for grid, panel in zip(grids, self.panels, strict=True):
            panel.colors.table.check(grid.labels, f"{self.data.sequence.location}: {panel.title}, frame {frame}")
        return FrameContent(tuple(grids), scan)

    def read_time(self, frame: int) -> float | None:
        """Return a frame's seconds since the first one, None where the sequence has no times."""
        try:
            return self.data.sequence.read_time(frame)
        except MissingDataError:
            return None

    def _has_points(self, frame: int) -> bool:
        return frame in self.data.sequence.frames("points")


def open_clip(
    path: Path_ | Source | Sequence,
    *,
    sequence: str | None = None,
    frames: tuple[int | None, int | None] | None = None,
    every: int = 1,
    at_most: int | None = None,
    grid: str | None = None,
    truth: Path_ | Source | Sequence | None = None,
    truth_grid: str | None = None,
    classes: str | None = None,
    path_classes: str | None = None,
    palette: PaletteName = "class",
) -> Clip:
    """Choose what to look at.

    Args:
        path: anything `carlasc.open` takes, a grid's folder, a frame's file in it, a Source or a Sequence.
        sequence: path or name of the sequence where there are several; None takes the first.
        frames: half-open range of frames; None takes all.
        every: take each `every`-th of them.
        at_most: how many frames are taken where no range is given.
        grid: name of the grid; None takes `evaluation`, or the first.
        truth: what a prediction is compared with: anything that `path` may be.
        truth_grid: name of the truth's grid; None as for `grid`.
        classes: name of the class table to show; None shows the data's own.
        path_classes: class table of the labels at `path` where nothing beside them says.
        palette: "class" or "colorblind".

    Raises:
        ArgumentError: arguments that make no sense.
        MissingDataError: there is no such sequence, grid or frame.
        FormatError: what is there is not what the format says.
    """
    if every < 1:
        raise ArgumentError("every", expected="1 or more", found=f"{every}")
    if palette not in ("class", "colorblind"):
        raise ArgumentError(f"palette {palette!r}: expected class or colorblind")
    data = open_input(path, sequence, path_classes)
    reference = None if truth is None else find_truth(truth, data.sequence)
    wants_grid = grid is not None or data.grid is not None or reference is not None or bool(data.sequence.grids)
    own_grid = data.choose_grid(grid) if wants_grid and not (data.scan and grid is None) else ""
    truth_name = "" if reference is None else reference.choose_grid(truth_grid)
    data, reference = in_one_table(data, own_grid, reference, truth_name, classes)
    notes = [data.note] if data.note else []

    available = _available(data, reference, own_grid, truth_name)
    if frames is None and data.frame is not None:
        frames = (data.frame, data.frame + 1)
    chosen = frames_in(available, frames)[::every]
    if not chosen:
        start, stop = ("" if value is None else value for value in frames or (None, None))
        raise MissingDataError(
            data.sequence.location,
            expected=f"frames {start}:{stop}",
            found=f"{_span(available)}",
            advice="choose others with --frames",
        )
    if frames is None and at_most is not None and len(chosen) > at_most:
        notes.append(f"{len(chosen)} frames there: took the first {at_most}; choose with --frames")
        chosen = chosen[:at_most]
    clip = Clip(data, reference, own_grid, truth_name, tuple(chosen), palette, tuple(notes))
    if reference is not None:
        check_same_spec(data.read_grid(own_grid, chosen[0]), reference.read_grid(truth_name, chosen[0]))
    return clip


def compare(prediction: Grid, truth: Grid) -> Grid:
    """Return where a prediction is right, wrong, misses and invents, in the ids of `ERRORS`.

    Raises:
        ArgumentError: the grids differ in their geometry.
    """
    check_same_spec(prediction, truth)
    predicted, occupied = prediction.labels > 0, truth.labels > 0
    kinds = np.select(
        [
            ~truth.known,
            occupied & (prediction.labels == truth.labels),
            occupied & predicted,
            occupied,
            predicted,
        ],
        [0, RIGHT, WRONG, MISSED, INVENTED],
        default=0,
    )
    return Grid(truth.spec, kinds.astype(np.uint8), truth.counts)


def _available(data: Input, truth: Input | None, grid: str, truth_grid: str) -> np.ndarray:
    """The frames that have all grids, or points where there is no grid."""
    field = f"{grid}/labels" if grid else "points"
    frames = data.sequence.frames(field)
    if not len(frames):
        there = ", ".join(sorted(data.sequence.fields())) or "nothing"
        raise MissingDataError(data.sequence.location, expected="a grid or points", found=f"{there}")
    if truth is not None:
        common = np.intersect1d(frames, truth.sequence.frames(f"{truth_grid}/labels"))
        if not len(common):
            raise MissingDataError(
                truth.sequence.location,
                expected=f"frames of the prediction ({_span(frames)})",
                found=f"{_span(truth.sequence.frames(f'{truth_grid}/labels'))}",
            )
        return common
    return frames


def _span(frames: np.ndarray) -> str:
    return f"{frames[0]} to {frames[-1]} ({len(frames)} frames)" if len(frames) else "none"
