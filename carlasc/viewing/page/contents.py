"""What a page shows: the grids of one run or of two beside each other, with the path, the evidence and the scores of their frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import Grid, GridSpec
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.metrics.confusion import ConfusionMatrix
from carlasc.metrics.grids import check_same_geometry, compare_grids
from carlasc.viewing.colors import ClassColors
from carlasc.viewing.finding import SceneSource, find_truth
from carlasc.viewing.page.coding import OFFSET_STEPS, Arrays, encode_evidence, encode_grid, encode_scan
from carlasc.viewing.scene import Scene, SceneReader

EVIDENCE = ("occupied", "views", "flags")  # the fields of a grid that a page shows, where they exist


@dataclass(frozen=True)
class PagePanel:
    """A grid of the page.

    Attributes:
        name: "prediction", "truth", "errors", or "grid" if there is only one.
        title: what is written above it: the name, the size of the grid if there is only one, or that of the run if two are compared.
        spec: geometry.
        colors: colours of its labels.
        run: number of the run that it belongs to: 0, or 1 for the run beside it.
        evidence: names from `EVIDENCE` of the fields that the grid has.
        beside: number of the panel that is drawn on the other side of the divider, or None.
    """

    name: str
    title: str
    spec: GridSpec
    colors: ClassColors
    run: int = 0
    evidence: tuple[str, ...] = ()
    beside: int | None = None


@dataclass(frozen=True)
class FrameScores:
    """The scores of a frame, one value per run; NaN where nothing was counted.

    Attributes:
        miou: mean IoU over the classes that occur in the frame's truth or prediction, without free.
        iou: intersection over union of the occupied voxels.
    """

    miou: tuple[float, ...]
    iou: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class PageContent:
    """Reads what a page shows of each frame. Nothing of a frame is kept.

    Attributes:
        reader: the run that is shown.
        beside: the run that it is compared with, or None.
        frames: the frame numbers.
        thin_m: side length of the cells to which points are thinned, metres.
    """

    reader: SceneReader
    beside: SceneReader | None
    frames: tuple[int, ...]
    thin_m: float

    @cached_property
    def panels(self) -> tuple[PagePanel, ...]:
        """The grids of the page: those of the first run, then those of the run beside it."""
        own = self._fields_of(self.reader)
        panels = [
            PagePanel(p.name, p.title, p.spec, p.colors, evidence=() if p.name in ("truth", "errors") else own)
            for p in self.reader.panels
        ]
        if self.beside is None:
            return tuple(panels)
        others = [panel for panel in panels if panel.name != "truth"]
        for number, panel in enumerate(others, len(panels)):
            prefix = "errors of " if panel.name == "errors" else ""
            first = panels.index(panel)
            panels[first] = replace(panel, title=prefix + self.runs[0], beside=number)
            spec, evidence = (panel.spec, ()) if prefix else (self.beside.data.spec, self._fields_of(self.beside))
            panels.append(replace(panel, title=prefix + self.runs[1], spec=spec, run=1, evidence=evidence))
        return tuple(panels)

    @cached_property
    def runs(self) -> tuple[str, ...]:
        """The names of the runs: what tells two runs apart, their grids, or the last folders in which their paths differ."""
        parts = [
            (*PurePath(reader.data.sequence.location).parts, reader.data.grid)
            for reader in (self.reader, self.beside)
            if reader is not None
        ]
        if len(parts) < 2:
            return ("",)
        for first, second in zip(reversed(parts[0]), reversed(parts[1]), strict=False):
            if first != second:
                return first, second
        return "left", "right"

    def read(self, frame: int) -> tuple[Arrays, FrameScores | None]:
        """Return the arrays of a frame, named `panel0/index`, ... and `scan/index`, ..., and its scores if there is a truth.

        Raises:
            FormatError: the data do not have the format.
        """
        content = self.reader.read(frame)
        grids = [*content.grids, *self._read_beside(frame, content.grids)]
        arrays: Arrays = {}
        for number, (panel, grid) in enumerate(zip(self.panels, grids, strict=True)):
            found = encode_grid(grid) | encode_evidence(grid, self._read_evidence(panel, frame))
            arrays |= {f"panel{number}/{name}": array for name, array in found.items()}
        if content.scan is not None:
            arrays |= {f"scan/{name}": array for name, array in encode_scan(content.scan, self.thin_m).items()}
        return arrays, self._score(grids)

    def describe(self) -> dict[str, Any]:
        """Return what the scripts of the page need to know besides the frames and their scores."""
        reader = self.reader
        tables = {colors.table.name: colors for colors in (reader.colors, *(panel.colors for panel in self.panels))}
        return {
            "name": reader.name,
            "leftHanded": reader.left_handed,
            "tables": {name: _describe_classes(colors) for name, colors in tables.items()},
            "pointTable": reader.table.name,
            "panels": [_describe_panel(panel) for panel in self.panels],
            "runs": list(self.runs),
            "frames": list(self.frames),
            "times": [reader.read_time(frame) for frame in self.frames],
            "poses": self._read_poses(),
            "hasPoints": reader.has("points"),
            "hasFlow": reader.has("flow"),
            "pointCell": self.thin_m,
            "offsetSteps": OFFSET_STEPS,
        }

    def _fields_of(self, reader: SceneReader) -> tuple[str, ...]:
        return tuple(name for name in EVIDENCE if reader.has(f"{reader.data.grid}/{name}"))

    def _read_beside(self, frame: int, grids: tuple[Grid, ...]) -> list[Grid]:
        if self.beside is None:
            return []
        grid = self.beside.data.read_grid(frame)
        if self.reader.truth is None:
            return [grid]
        truth = grids[1]
        return [grid, Grid(truth.spec, compare_grids(grid, truth), truth.counts)]

    def _read_evidence(self, panel: PagePanel, frame: int) -> dict[str, NDArray[Any]]:
        reader = self.reader if panel.run == 0 or self.beside is None else self.beside
        sequence, grid = reader.data.sequence, reader.data.grid
        names = (name for name in panel.evidence if frame in sequence.frames(f"{grid}/{name}"))
        return {name: sequence.read(f"{grid}/{name}", frame) for name in names}

    def _score(self, grids: list[Grid]) -> FrameScores | None:
        """Return the scores of the runs' predictions in the classes that are shown, where the truth is known."""
        if self.reader.truth is None:
            return None
        truth = grids[1]
        predictions = [grids[n] for n, panel in enumerate(self.panels) if panel.name == "prediction"]
        classes = self.reader.table.num_channels
        found = [ConfusionMatrix(classes).update(grid.labels, truth.labels, truth.known) for grid in predictions]
        return FrameScores(
            tuple(matrix.mean_iou(with_free=False, absent="skip") for matrix in found),
            tuple(matrix.completeness().iou for matrix in found),
        )

    def _read_poses(self) -> list[list[float]] | None:
        """Return the first three rows of the pose of each frame, in the frame of the first scan; None if there are none."""
        poses = [pose for pose in map(self.reader.read_pose, self.frames) if pose is not None]
        return [np.round(pose[:3].reshape(-1), 5).tolist() for pose in poses] or None


def open_content(
    scene: Scene, thin_m: float, beside: SceneSource | None = None, beside_grid: str | None = None
) -> PageContent:
    """Find the runs of a page and the frames that both have; see `carlasc.viewing.view` for the arguments and errors."""
    reader = scene.open()
    if beside is None and beside_grid is None:
        return PageContent(reader, None, reader.frames, thin_m)
    if not reader.data.grid:
        raise ArgumentError("beside", problem="only grids can be compared", advice="choose a source that has a grid")
    found = None if beside is None else find_truth(beside, reader.data.sequence)
    sequence = reader.data.sequence if found is None else found.sequence
    grid = beside_grid or (None if found is None else found.grid) or scene.grid
    classes = scene.classes or reader.table
    second = Scene(sequence, grid=grid, classes=classes, source_classes=scene.source_classes, palette=scene.palette)
    other = second.open("grid")
    if other.left_handed != reader.left_handed:
        raise ArgumentError("beside", expected="a run in the same axes", found="one in the other axes")
    if reader.truth is not None:
        check_same_geometry(other.data.spec, reader.truth.spec)
    frames = tuple(sorted({*reader.frames} & {*other.frames}))
    if not frames:
        raise MissingDataError(
            other.data.sequence.location,
            expected=f"one of the frames {reader.frames[0]} to {reader.frames[-1]}",
            found=f"frames {other.frames[0]} to {other.frames[-1]}",
        )
    return PageContent(reader, other, frames, thin_m)


def json_number(value: float) -> float | None:
    """Return a number that JSON can hold: None for NaN."""
    return None if math.isnan(value) else round(value, 5)


def _describe_panel(panel: PagePanel) -> dict[str, Any]:
    spec = panel.spec
    return {
        "name": panel.name,
        "title": panel.title,
        "run": panel.run,
        "beside": panel.beside,
        "evidence": list(panel.evidence),
        "table": panel.colors.table.name,
        "coordinates": spec.coordinates,
        "size": list(spec.size),
        "lower": list(spec.lower),
        "upper": list(spec.upper),
        "voxel": spec.voxel_size.tolist(),
    }


def _describe_classes(colors: ClassColors) -> list[list[Any]]:
    """Return [name, "#rrggbb"] by class id."""
    return [
        [colors.table.names.get(number, f"class {number}"), "#" + bytes(color.tolist()).hex()]
        for number, color in enumerate(colors.by_id)
    ]
