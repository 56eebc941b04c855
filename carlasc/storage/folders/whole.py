"""Whether a frame's file in a local folder is whole, as far as its size says: a power failure can leave empty and short files.

Files that are written durably (see `carlasc.storage.durability`) are whole as soon as they exist. Others, and those of older versions, are checked by
their sizes, which costs little more than to ask whether they exist.
"""

from __future__ import annotations

import math
import os

import numpy as np

from carlasc.core.grids import GridSpec
from carlasc.errors import FormatError
from carlasc.storage import layout
from carlasc.storage.files import parse_json

_ZIP_END, _ZIP_END_BYTES = b"PK\x05\x06", 22  # of the record that ends a zip without a comment, as NumPy writes them


class WholeFiles:
    """Answers for one `<coordinates>` folder; it can be pickled.

    Args:
        folder: the folder.
    """

    def __init__(self, folder: str) -> None:
        self._folder = folder
        self._cells: dict[str, int] = {}  # of grids whose params.json has been read

    def has(self, name: str, frame: int) -> bool:
        """Whether the file of a field exists, and is neither empty nor of a length that it cannot have.

        Files of a grid have a length that params.json tells. Files with a row per point must have as many rows as the points, which have as many as
        the labels. A table of votes must end as a zip does. An empty file is valid for boxes, of which there may be none, and for a scan whose points
        and labels are both empty.
        """
        entry = layout.field_named(name)
        size = self._size(entry, frame)
        if size is None:
            return False
        if entry.kind == "boxes":
            return True
        if entry.per == "voxel":
            cells = self._cells_of(entry.folder)
            return size > 0 if cells is None else size == cells * np.dtype(entry.dtype).itemsize
        if entry.kind == "votes":
            return self._ends_as_zip(entry.file(frame), size)
        if entry.per == "point":
            other = layout.SCAN_FIELDS["labels" if name == "points" else "points"]
            rows, beside = size / _row(entry), self._size(other, frame)
            return rows.is_integer() and (beside is None or beside / _row(other) == rows)
        return size > 0

    def forget(self, grid: str) -> None:
        """Forget the size of a grid that is replaced."""
        self._cells.pop(grid, None)

    def _size(self, entry: layout.Field, frame: int) -> int | None:
        try:
            return os.stat(f"{self._folder}/{entry.file(frame)}").st_size
        except (FileNotFoundError, NotADirectoryError):
            return None

    def _ends_as_zip(self, path: str, size: int) -> bool:
        with open(f"{self._folder}/{path}", "rb", buffering=0) as file:
            return os.pread(file.fileno(), len(_ZIP_END), max(0, size - _ZIP_END_BYTES)) == _ZIP_END

    def _cells_of(self, grid: str) -> int | None:
        """Return the number of voxels of a grid; None if nothing says it."""
        if grid not in self._cells:
            where = f"{self._folder}/{layout.params_file(grid)}"
            try:
                with open(where, "rb") as file:
                    spec = GridSpec.from_params(parse_json(file.read(), where), where)
            except (FileNotFoundError, FormatError):
                return None
            self._cells[grid] = math.prod(spec.size)
        return self._cells[grid]


def _row(entry: layout.Field) -> int:
    return np.dtype(entry.dtype).itemsize * (entry.columns or 1)
