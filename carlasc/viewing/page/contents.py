"""The contents of a page: grids of one run or of two beside each other, with trajectory, evidence
and scores, in a compact encoding.

A frame consists of sparse voxels and thinned points, delta-coded, in byte planes, deflated.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import PurePath
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray, AnyIntArray, LabelArray
from carlasc.core.geometry import invert, transform_points
from carlasc.core.grids import Grid
from carlasc.core.scans import Scan
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.metrics.confusion import ConfusionMatrix
from carlasc.metrics.grids import check_same_geometry, compare_grids
from carlasc.storage.camera_files import cameras_of, has_image
from carlasc.viewing.actor_lines import Trail, Trails, box_lines, motion_arrows
from carlasc.viewing.photos import encode_photos
from carlasc.viewing.scene import (
    FrameContent,
    GridPanel,
    Scene,
    SceneReader,
    SceneSource,
    find_sequence,
)

Arrays = dict[str, AnyArray]

# positions of a point within its cell, per axis: 2.5 cm in a 0.2 m cell, about the noise of the
# sensor
OFFSET_STEPS = 8


def encode_grid(grid: Grid) -> Arrays:
    """Encode the occupied voxels of a grid.

    Returns:
        `index`: differences of the rising C-order indices of the voxels. `label`: of each voxel. If
        the grid has counts, also `votes` of each voxel, and `unknown`: lengths of the alternating
        runs of known and unknown cells, known ones first.
    """
    flat = grid.labels.reshape(-1)
    occupied = np.flatnonzero(flat)
    arrays: Arrays = {"index": _gaps(occupied), "label": _narrow(flat[occupied])}
    if grid.counts is not None:
        votes = grid.counts.reshape(-1)[occupied]
        whole = (votes == np.round(votes)).all() and votes.max(initial=0) < 2**32
        arrays["votes"] = _narrow(votes.astype(np.uint32)) if whole else votes.astype(np.float32)
        arrays["unknown"] = _narrow(
            _gaps(np.flatnonzero(np.diff(~grid.known.reshape(-1), prepend=False)))
        )
    return arrays


def encode_evidence(grid: Grid, fields: Mapping[str, AnyArray]) -> Arrays:
    """Encode the evidence of the occupied voxels of a grid (see `docs/format.md#evidence`).

    Args:
        grid: the grid.
        fields: those of "occupied", "views" and "flags" that it has, each (X, Y, Z).

    Returns:
        For each of these fields an array with a value of each occupied voxel. `occupied` is in
        1/255: 255 is the probability 1.
    """
    chosen = np.flatnonzero(grid.labels.reshape(-1))
    arrays = {name: field.reshape(-1)[chosen] for name, field in fields.items()}
    if "occupied" in arrays:
        arrays["occupied"] = np.round(
            255 * np.clip(arrays["occupied"].astype(np.float32), 0, 1)
        ).astype(np.uint8)
    return {name: _narrow(values) for name, values in arrays.items()}


def encode_scan(scan: Scan, cell_m: float) -> Arrays:
    """Encode a scan, thinned to one point per cell.

    Returns:
        `box` (6,) int32: first cell and number of cells along each axis. `index`: differences of
        the rising C-order indices of the cells in the box. `offset` (3 N,): position within the
        cell in steps, axis by axis. `label` of each point, if the scan has labels.
    """
    # by axis, which is fast
    cells = np.floor(scan.points.T.astype(np.float64, order="C") / cell_m).astype(np.int64)
    lower = cells.min(1) if len(scan) else np.zeros(3, np.int64)
    size = cells.max(1) - lower + 1 if len(scan) else np.ones(3, np.int64)
    index, first = np.unique(
        np.ravel_multi_index(tuple(cells - lower[:, None]), tuple(size)), return_index=True
    )
    inside = scan.points[first].T / cell_m - cells[:, first]
    offset = np.clip(np.floor(inside * OFFSET_STEPS), 0, OFFSET_STEPS - 1).astype(np.uint8)
    arrays: Arrays = {
        "box": np.concatenate([lower, size]).astype(np.int32),
        "index": _gaps(index),
        "offset": offset.reshape(-1),
    }
    if scan.labels is not None:
        arrays["label"] = _narrow(scan.labels[first])
    return arrays


def encode_actors(content: FrameContent, moving: Scan | None, trails: Sequence[Trail]) -> Arrays:
    """Encode the moving actors of a frame, metres, sensor frame.

    Args:
        content: the frame.
        moving: the moving points, with flow; None if motion is not known.
        trails: the tracks of the actors.

    Returns:
        Flat float32 arrays: `arrows`, start point and vector (m/s) of an arrow per moving actor,
        unless `moving` is None; `boxes` and `tracks`, both ends of each line, if there are any.
    """
    arrays: Arrays = {}
    if moving is not None:
        arrays["arrows"] = (
            np.concatenate(motion_arrows(moving), axis=1).astype(np.float32).reshape(-1)
        )
    if content.boxes is not None and len(content.boxes.tracks):
        arrays["boxes"] = box_lines(content.boxes).astype(np.float32).reshape(-1)
    if trails and content.pose is not None:
        lines = [
            np.stack([trail.points[:-1], trail.points[1:]], axis=1).reshape(-1, 3)
            for trail in trails
        ]
        arrays["tracks"] = (
            transform_points(invert(content.pose), np.concatenate(lines))
            .astype(np.float32)
            .reshape(-1)
        )
    return arrays


def pack_arrays(arrays: Mapping[str, AnyArray]) -> bytes:
    """Return named flat arrays as one deflated block.

    The block holds the length of a JSON header (uint32, little-endian), the header ([name, type,
    length], ...) and the arrays one after the other. An array is stored as the first bytes of all
    its values, then the second bytes, and so on, which compresses better.
    """
    header = json.dumps(
        [[name, array.dtype.name, array.size] for name, array in arrays.items()]
    ).encode()
    parts = [struct.pack("<I", len(header)), header]
    for array in arrays.values():
        little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        parts.append(little.view(np.uint8).reshape(-1, array.dtype.itemsize).T.tobytes())
    return zlib.compress(b"".join(parts), 5)  # level 6 takes twice as long for 4% fewer bytes


def _gaps(rising: AnyIntArray) -> LabelArray:
    """Return the first value and the differences of rising ones, in the narrowest type."""
    values = rising.astype(np.int64)
    return _narrow(np.concatenate([values[:1], values[1:] - values[:-1]]))


def _narrow(values: AnyIntArray) -> LabelArray:
    """Return non-negative integers in the narrowest unsigned type of at most 32 bits that holds
    them.
    """
    largest = int(values.max(initial=0))
    return values.astype(
        next(t for t in (np.uint8, np.uint16, np.uint32) if largest <= np.iinfo(t).max)
    )


EVIDENCE = ("occupied", "views", "flags", "instance")
"""The fields of a grid that a page shows, if they exist."""


@dataclass(frozen=True)
class PagePanel(GridPanel):
    """A grid of the page.

    Attributes:
        title: text above it; the name of the run if two are compared.
        run: number of the run that it belongs to: 0, or 1 for the run beside it.
        evidence: names from `EVIDENCE` of the fields that the grid has.
        beside: number of the panel that is drawn on the other side of the divider, or None.
    """

    run: int = 0
    evidence: tuple[str, ...] = ()
    beside: int | None = None


Scores = dict[str, list[float | None]]
"""The scores of a frame, one value per run, None where nothing was counted; empty without a truth.

`miou` is the mean IoU over the classes that occur in the frame's truth or prediction, without free;
`iou` the intersection over union of the occupied voxels.
"""


@dataclass(frozen=True, eq=False)
class PageContent:
    """Reads the contents of a page frame by frame. No frame is kept in memory.

    Attributes:
        reader: the first run.
        beside: the run to compare it with, or None.
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
            PagePanel(**vars(panel), evidence=() if panel.name in ("truth", "errors") else own)
            for panel in self.reader.panels
        ]
        if self.beside is None:
            return tuple(panels)
        others = [panel for panel in panels if panel.name != "truth"]
        for number, panel in enumerate(others, len(panels)):
            prefix = "errors of " if panel.name == "errors" else ""
            first = panels.index(panel)
            panels[first] = replace(panel, title=prefix + self.runs[0], beside=number)
            spec, evidence = (
                (panel.spec, ())
                if prefix
                else (self.beside.data.spec, self._fields_of(self.beside))
            )
            panels.append(
                replace(panel, title=prefix + self.runs[1], spec=spec, run=1, evidence=evidence)
            )
        return tuple(panels)

    @cached_property
    def runs(self) -> tuple[str, ...]:
        """The names of the runs.

        Two runs are named by their grids, or by the last folders in which their paths differ.
        """
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

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """The names of the cameras with images of these frames; empty without Pillow, which scales
        the images.
        """
        sequence = self.reader.data.sequence
        if find_spec("PIL") is None or not self.reader.has_cameras:
            return ()
        return tuple(
            camera.name
            for camera in cameras_of(sequence).values()
            if any(has_image(sequence, camera, frame) for frame in self.frames)
        )

    def read(self, frame: int, trails: Trails | None = None) -> tuple[Arrays, Scores]:
        """Return the arrays of a frame, named `panel0/index`, `scan/index`, `actors/boxes`, ...,
        and its scores.

        Args:
            frame: frame number.
            trails: the tracks of the actors, for which frames must be read in order; None shows no
                tracks.

        Raises:
            FormatError: the data do not have the format.
        """
        content = self.reader.read(frame)
        grids = list(content.grids)
        if self.beside is not None:
            grids.append(self.beside.data.read_grid(frame))
            if self.reader.truth is not None:
                truth = content.grids[1]
                grids.append(Grid(truth.spec, compare_grids(grids[-1], truth), truth.counts))
        arrays: Arrays = {}

        def add(part: str, encoded: Arrays) -> None:
            arrays.update({f"{part}/{name}": array for name, array in encoded.items()})

        for number, (panel, grid) in enumerate(zip(self.panels, grids, strict=True)):
            data = (self.reader if panel.run == 0 or self.beside is None else self.beside).data
            evidence = {
                name: data.read_part(name, frame)
                for name in panel.evidence
                if frame in data.frames_with(f"{data.grid}/{name}")
            }
            add(f"panel{number}", encode_grid(grid) | encode_evidence(grid, evidence))
        moving = self.reader.read_motion(frame, content.scan)
        if content.scan is not None:
            add("scan", encode_scan(content.scan, self.thin_m))
        tracks = trails.follow(self.frames.index(frame), content, moving) if trails else ()
        add("actors", encode_actors(content, moving, tracks))
        if self.cameras:
            arrays |= encode_photos(self.reader.read_photos(frame))
        return arrays, self._score(grids)

    def describe(self, scores: Sequence[Scores]) -> dict[str, Any]:
        """Return the values for the scripts of the page, with the scores of the frames."""
        reader = self.reader
        poses = [pose for pose in map(reader.read_pose, self.frames) if pose is not None]
        tables = {
            colors.table.name: colors
            for colors in (reader.colors, *(panel.colors for panel in self.panels))
        }
        return {
            "name": reader.name,
            "leftHanded": reader.left_handed,
            "tables": {  # [name, "#rrggbb"] by class id
                name: [
                    [colors.table.names.get(i, f"class {i}"), "#" + bytes(rgb.tolist()).hex()]
                    for i, rgb in enumerate(colors.by_id)
                ]
                for name, colors in tables.items()
            },
            "pointTable": reader.table.name,
            "colorBy": "class" if self._has_classes() else "height",
            "panels": [_describe_panel(panel) for panel in self.panels],
            "runs": list(self.runs),
            "frames": list(self.frames),
            "times": [reader.read_time(frame) for frame in self.frames],
            "poses": [np.round(pose[:3].reshape(-1), 5).tolist() for pose in poses]
            or None,  # first_T_sensor
            "hasPoints": reader.has("points"),
            "hasFlow": reader.has_motion,
            "hasBoxes": reader.has("boxes"),
            "hasTracks": bool(poses)
            and any(map(reader.has, ("boxes", "instances", f"{reader.data.grid}/instance"))),
            "cameras": list(self.cameras),
            "pointCell": self.thin_m,
            "offsetSteps": OFFSET_STEPS,
            "scores": None
            if reader.truth is None
            else {
                name: [list(run) for run in zip(*(own[name] for own in scores), strict=True)]
                for name in ("miou", "iou")
            },
        }

    def _has_classes(self) -> bool:
        """Whether the first frame has classes, so that colours by class are more useful than
        colours by height.
        """
        content = self.reader.read(self.frames[0])
        labels = [grid.labels for grid in content.grids]
        if content.scan is not None and content.scan.labels is not None:
            labels.append(content.scan.labels)
        ids = [np.flatnonzero(np.bincount(some.reshape(-1), minlength=1)) for some in labels]
        labelled = [some for some in ids if some.any()]
        return not labelled or any(self.reader.colors.tell_shapes(some) for some in labelled)

    def _fields_of(self, reader: SceneReader) -> tuple[str, ...]:
        return tuple(name for name in EVIDENCE if reader.has(f"{reader.data.grid}/{name}"))

    def _score(self, grids: list[Grid]) -> Scores:
        """Return the scores of the predictions of the runs, in the shown classes and in voxels that
        the ground truth knows.
        """
        if self.reader.truth is None:
            return {}
        truth = grids[1]
        classes = self.reader.table.num_channels
        matrices = [
            ConfusionMatrix(classes).update(grid.labels, truth.labels, truth.known)
            for grid, panel in zip(grids, self.panels, strict=True)
            if panel.name == "prediction"
        ]
        values = {
            "miou": [matrix.mean_iou(with_free=False, absent="skip") for matrix in matrices],
            "iou": [matrix.completeness().iou for matrix in matrices],
        }
        return {
            name: [None if math.isnan(value) else round(value, 5) for value in own]
            for name, own in values.items()
        }


def open_content(
    scene: Scene, thin_m: float, beside: SceneSource | None = None, beside_grid: str | None = None
) -> PageContent:
    """Find the runs of a page and the frames that both have; see `carlasc.viewing.view` for the
    arguments and errors.
    """
    reader = scene.open()
    if beside is None and beside_grid is None:
        return PageContent(reader, None, reader.frames, thin_m)
    if not reader.data.grid:
        raise ArgumentError(
            "beside", problem="only grids can be compared", advice="choose a source that has a grid"
        )
    run = None if beside is None else find_sequence(beside, reader.data.sequence)
    other = Scene(
        reader.data.sequence if run is None else run.sequence,
        grid=beside_grid or (None if run is None else run.grid) or scene.grid,
        classes=scene.classes or reader.table,
        source_classes=scene.source_classes,
        palette=scene.palette,
    ).open("grid")
    if other.left_handed != reader.left_handed:
        raise ArgumentError(
            "beside", expected="a run in the same axes", found="one in the other axes"
        )
    if reader.truth is not None:
        check_same_geometry(other.data.spec, reader.truth.spec)
    frames = tuple(sorted({*reader.frames} & {*other.frames}))
    if not frames:
        raise MissingDataError(
            other.data.sequence.location,
            expected=f"one of the frames {reader.frames[0]} to {reader.frames[-1]}",
            found=f"frames {other.frames[0]} to {other.frames[-1]}",
            advice="choose others with `frames`",
        )
    return PageContent(reader, other, frames, thin_m)


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
