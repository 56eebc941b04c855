"""The cells of a growing map.

Distant cells are kept on disk, so memory does not grow with the length of a drive.

Each scan has one vote per cell: for the most frequent class of its points in the cell. All sums are
whole numbers, so that they do not depend on the order in which scans are added.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from carlasc.core.arrays import AnyArray, Float32Array, FloatArray, IntArray, LabelArray
from carlasc.core.cells import run_starts
from carlasc.groundtruth.maps.cloud_files import POINT_DTYPE

Part = tuple[int, int, int]
"""Cells that are kept together: a group (`STATIC`, or the number of an actor), and x and y of a
tile.
"""

STATIC, UNDER = -1, -2
"""The groups of static points, and of ground that may be of an actor: see `finish`."""
ROW_DTYPE = np.dtype(
    [
        ("key", "<i8"),
        ("seen", "<u4"),
        ("points", "<u4"),
        ("votes", "<i8"),
        ("x", "<i8"),
        ("y", "<i8"),
        ("z", "<i8"),
    ]
)
"""A cell and a class: scans, points, votes in 1 / `_VOTE`, and the sums of the positions of points
in the cell, in 1 / `_STEPS` of it.
"""

# of a key: x and y in the tile, z, and the class
_SIDE_BITS = 9
_HEIGHT_BITS = 24
_LABEL_BITS = 16
_SIDE = 1 << _SIDE_BITS
_MIDDLE = 1 << (_HEIGHT_BITS - 1)
_STEPS = 1024
_VOTE = 65535
# least distance of points from the faces of a cell, so that float32 rounding keeps them inside
_EDGE = 1 / 64
_MOST_ROWS = 1_000_000  # in memory: 48 MB
_REPEATED = 2  # rows of a part on disk, over those that are left when they are summed
# What is so far above the lowest static point of a column, of this width, is no ground.
_ABOVE_M = 0.06
_COLUMN_M = 0.25


def rows_of_scan(
    points: FloatArray,
    labels: LabelArray,
    sure: Float32Array | None,
    group: int,
    cell_m: float,
) -> tuple[IntArray, AnyArray]:
    """Return the cells in which a scan has points.

    Args:
        points: (N, 3) metres, map frame, or the frame of their actor.
        labels: (N,) classes.
        sure: (N,) probability of each class; None: 1.
        group: `STATIC`, `UNDER`, or the number of an actor.
        cell_m: size of a cell, metres.

    Returns:
        (M, 3) the parts, and (M,) rows.
    """
    if not len(points):
        return np.empty((0, 3), np.int64), np.empty(0, ROW_DTYPE)
    scaled = points / cell_m
    cells = np.floor(scaled).astype(np.int64)
    places = np.minimum(np.floor((scaled - cells) * _STEPS), _STEPS - 1).astype(np.int64)
    order = np.lexsort((labels, *cells.T[::-1]))
    changed = np.append(True, np.diff(cells[order], axis=0).any(axis=1))
    begins = np.flatnonzero(changed)
    rows = np.zeros(len(begins), ROW_DTYPE)
    rows["seen"] = 1
    rows["points"] = np.diff(np.append(begins, len(order)))
    for axis, name in enumerate("xyz"):
        rows[name] = np.add.reduceat(places[order, axis], begins)

    # The most frequent class, the lowest of several: in each cell, the longest run of equal
    # classes.
    sorted_labels = labels[order].astype(np.int64)
    runs = np.flatnonzero(changed | np.append(True, np.diff(sorted_labels) != 0))
    lengths = np.diff(np.append(runs, len(order)))
    cell_of = np.searchsorted(begins, runs, side="right") - 1
    best = np.lexsort((sorted_labels[runs], -lengths, cell_of))
    best = best[run_starts(cell_of[best])]
    certain = np.ones(len(order)) if sure is None else sure[order].astype(np.float64)
    votes = np.add.reduceat(certain, runs)[best] / rows["points"]
    rows["votes"] = np.maximum(np.rint(votes * _VOTE), 1)

    at = cells[order[begins]]
    tile = at[:, :2] >> _SIDE_BITS
    x, y = (at[:, :2] & (_SIDE - 1)).T
    z = np.clip(at[:, 2] + _MIDDLE, 0, 2 * _MIDDLE - 1)
    rows["key"] = (((x << _SIDE_BITS | y) << _HEIGHT_BITS | z) << _LABEL_BITS) | sorted_labels[
        runs[best]
    ]
    return np.column_stack([np.full(len(tile), group), tile]), rows


def split(parts: IntArray, rows: AnyArray) -> list[tuple[Part, AnyArray]]:
    """Return the rows of each part, in order; rows of the same cell and class are summed."""
    order = np.lexsort((rows["key"], *parts.T[::-1]))
    parts = parts[order]
    rows = rows[order]
    begins = np.flatnonzero(
        (np.diff(parts, axis=0, prepend=np.iinfo(np.int64).min) != 0).any(axis=1)
    )
    places: list[Part] = [(group, x, y) for group, x, y in parts[begins].tolist()]
    pieces = np.split(rows, begins)[1:]  # without the empty piece before the first part
    return [(place, _added([piece])) for place, piece in zip(places, pieces, strict=True)]


def _added(pieces: Iterable[AnyArray]) -> AnyArray:
    """Return rows in order of their keys; rows with the same key are summed."""
    rows = np.concatenate(list(pieces))
    rows = rows[np.argsort(rows["key"], kind="stable")]
    begins = run_starts(rows["key"])
    added = rows[begins]
    for name in ROW_DTYPE.names[1:] if ROW_DTYPE.names else ():
        added[name] = np.add.reduceat(rows[name], begins)
    return added


class GrowingCells:
    """The cells of a map, to which scans are added.

    Args:
        folder: an empty folder for cells that do not fit into memory.
        cell_m: size of a cell, metres.
        most_rows: rows in memory, of 48 bytes each.
    """

    def __init__(self, folder: Path, cell_m: float, most_rows: int = _MOST_ROWS) -> None:
        self.folder = folder
        self.cell_m = cell_m
        self.most_rows = most_rows
        self.counts: dict[Part, int] = {}
        self._rows: OrderedDict[Part, list[AnyArray]] = OrderedDict()
        self._held = 0
        # of each part on disk: its rows, and how many they are at most until they are summed
        self._stored: dict[Part, tuple[int, int]] = {}

    def add(self, pieces: Iterable[tuple[Part, AnyArray]]) -> None:
        """Add the cells of some scans: see `split`."""
        for part, rows in pieces:
            self._rows.setdefault(part, []).append(rows)
            self._rows.move_to_end(part)
            self._held += len(rows)
        if self._held > self.most_rows:
            for part, added in self._rows.items():
                self._rows[part] = [_added(added)]
            self._held = sum(len(rows) for (rows,) in self._rows.values())
            while self._held > self.most_rows // 2:  # the least recent ones first
                part, (rows,) = self._rows.popitem(last=False)
                self._held -= len(rows)
                self._store(part, rows)

    def _store(self, part: Part, rows: AnyArray) -> None:
        """Append rows to those of a part on disk, and sum these when many of them are repeated."""
        stored, most = self._stored.get(part, (0, _REPEATED * len(rows)))
        mode = "ab"
        if stored + len(rows) > most:
            rows = self._whole(part, [rows])
            stored = 0
            mode = "wb"
            most = _REPEATED * len(rows)
        with self._path(part).open(mode) as file:
            rows.tofile(file)
        self._stored[part] = stored + len(rows), most

    def _path(self, part: Part) -> Path:
        return self.folder / "_".join(map(str, part))

    def _whole(self, part: Part, rows: list[AnyArray]) -> AnyArray:
        stored = [np.fromfile(self._path(part), ROW_DTYPE)] if part in self._stored else []
        return _added([*stored, *rows])

    def finish(self) -> None:
        """Elect the class of each cell.

        Cells of `UNDER` become static, unless other static ones are clearly below them.
        Afterwards `counts` has the number of points of each part, and `points` yields them.
        """
        parts = {*self._rows, *self._stored}
        for part in sorted({(max(group, STATIC), x, y) for group, x, y in parts}):
            rows = self._take(part)
            if part[0] == STATIC:
                rows = _added([rows, self._on_ground(self._take((UNDER, *part[1:])), rows)])
            points = self._elect(part, rows)
            self.counts[part] = len(points)
            points.tofile(self._path(part))

    def _take(self, part: Part) -> AnyArray:
        return self._whole(part, self._rows.pop(part, []) or [np.empty(0, ROW_DTYPE)])

    def _on_ground(self, under: AnyArray, static: AnyArray) -> AnyArray:
        """Return the rows of a tile that are not clearly above the lowest static ones of their
        columns.
        """
        wide = max(round(_COLUMN_M / self.cell_m), 1)
        lowest = np.full(_SIDE**2, np.inf)

        def columns(rows: AnyArray) -> tuple[IntArray, FloatArray]:
            x, y, z = _indices((STATIC, 0, 0), rows["key"] >> _LABEL_BITS).T
            return x // wide * _SIDE + y // wide, z + rows["z"] / rows["points"] / _STEPS

        np.minimum.at(lowest, *columns(static))
        column, height = columns(under)
        return under[height <= lowest[column] + _ABOVE_M / self.cell_m]

    def _elect(self, part: Part, rows: AnyArray) -> AnyArray:
        """Return one point per cell: the mean of its points, with the class with most votes, the
        lowest of several.
        """
        cells = rows["key"] >> _LABEL_BITS
        begins = run_starts(cells)
        best = np.lexsort((rows["key"], -rows["votes"], cells))
        best = best[run_starts(cells[best])]
        points = np.zeros(len(begins), POINT_DTYPE)
        count = np.add.reduceat(rows["points"].astype(np.int64), begins)
        for name, index in zip("xyz", _indices(part, cells[begins]).T, strict=True):
            inside = (np.add.reduceat(rows[name], begins) / count + 0.5) / _STEPS
            points[name] = (index + np.clip(inside, _EDGE, 1 - _EDGE)) * self.cell_m
        points["seen"] = np.add.reduceat(rows["seen"], begins)
        points["label"] = rows["key"][best] & ((1 << _LABEL_BITS) - 1)
        points["confidence"] = rows["votes"][best] / _VOTE / (points["seen"] + 1.0)
        return points

    def points(self, group: int = STATIC) -> Iterator[AnyArray]:
        """Yield the points of a group, tile by tile, after `finish`."""
        for part in self.counts:
            if part[0] == group:
                yield np.fromfile(self._path(part), POINT_DTYPE)


def _indices(part: Part, cells: IntArray) -> IntArray:
    """Return the (N, 3) indices of cells of a part, from keys without their class."""
    column = cells >> _HEIGHT_BITS
    x = column >> _SIDE_BITS
    y = column & (_SIDE - 1)
    z = (cells & (2 * _MIDDLE - 1)) - _MIDDLE
    return np.stack([x + part[1] * _SIDE, y + part[2] * _SIDE, z], axis=1)


def cells_of(points: AnyArray, cell_m: float) -> IntArray:
    """Return (N, 3) indices of the cells of points of a map, (N,) `POINT_DTYPE`."""
    return np.stack(
        [np.floor(points[axis].astype(np.float64) / cell_m) for axis in "xyz"], axis=1
    ).astype(np.int64)
