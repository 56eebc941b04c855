"""Files of points, one scan each, as columns by name: .bin, .npy, .npz, .csv, .txt, .xyz, .pts,
.ply, .pcd, .las and .laz.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from itertools import chain
from pathlib import Path

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import ArgumentError, FormatError, import_extra
from carlasc.storage.arrays import NUMBERS, ArrayFormat, open_npz, read_npy
from carlasc_converters.files import COPY, is_number, opening, read_bytes
from carlasc_converters.pcd import read_pcd
from carlasc_converters.ply import PlyVertices

_FIRST = ("x", "y", "z", "intensity")  # the columns of an array without names
_MOST_COLUMNS = 12
_FLOAT = 4
_FEW = 2000  # values, from which the number of columns is not found
_ALIKE = 0.5  # rows of the right width are more alike than others by this
_VALUES = 27720  # of a file are compared; each number of columns up to 12 divides it
_ARRAY = ArrayFormat(NUMBERS, None, records=True)


def read_columns(path: Path, columns: tuple[str, ...] | None = None) -> dict[str, AnyArray]:
    """Return the values of the points of a file, (N,) each, by their names in the file or in
    `columns`.

    Args:
        path: the file; its suffix says its format.
        columns: names of the columns of a file that names none: of .bin and .npy. None: x, y, z and
            intensity, as far as a file without names has so many.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: the file does not have its format, or has no points, or other columns.
        ArgumentError: `columns` is needed.
        DependencyError: laspy is needed, and not installed.
    """
    columns_read = _READERS[path.suffix.lower()](path, columns)
    if not next(iter(columns_read.values()), np.empty(0)).size:
        raise FormatError(
            path, expected="points", found="none", advice="remove the file, or record it again"
        )
    return columns_read


def _read_bin(path: Path, columns: tuple[str, ...] | None) -> dict[str, AnyArray]:
    data = read_bytes(path)
    count, left = divmod(len(data), _FLOAT)
    if left:
        raise FormatError(path, expected="float32 values", found=f"{len(data)} bytes", advice=COPY)
    values = np.frombuffer(data, "<f4")
    if columns is None:
        fits = [number for number in range(3, _MOST_COLUMNS + 1) if count % number == 0]
        raise ArgumentError(
            "columns",
            expected="the names of the columns, such as x,y,z,intensity",
            found="none",
            advice=f"the {len(data)} bytes of {path} are points of "
            f"{' or '.join(map(str, fits)) or 'no number of'} float32 columns",
        )
    if count % len(columns):
        raise FormatError(
            path,
            expected=f"a multiple of {_FLOAT * len(columns)} bytes ({len(columns)} float32 per "
            f"point)",
            found=len(data),
            advice=f"check `columns` ({','.join(columns)})",
        )
    width = len(columns)
    sample = values[:_VALUES]
    unlike = {
        number: _unlikeness(sample.reshape(-1, number))
        for number in {width, *range(3, _MOST_COLUMNS + 1)}
        if count % number == 0 and len(sample) % number == 0
    }
    best = min(unlike, key=unlike.__getitem__, default=width)
    if best % width and count > _FEW and unlike[best] < _ALIKE * unlike[width]:
        raise FormatError(
            path,
            expected=f"points of {width} columns",
            found=f"values that fit points of {best}",
            advice=f"name all {best} columns with `columns`",
        )
    return dict(zip(columns, values.reshape(-1, width).T, strict=True))


def _unlikeness(rows: AnyArray) -> float:
    """Return how much the first three columns of successive rows differ, compared with rows that
    are far apart.
    """
    table = np.nan_to_num(np.asarray(rows[:, :3], np.float64))
    near = np.abs(np.diff(table, axis=0)).mean(axis=0)
    far = np.abs(table - np.roll(table, len(table) // 3, axis=0)).mean(axis=0)
    return float((near / np.maximum(far, 1e-9)).max())


def _read_npy(path: Path, columns: tuple[str, ...] | None) -> dict[str, AnyArray]:
    return _named(read_npy(path, _ARRAY), path, columns)


def _read_npz(path: Path, columns: tuple[str, ...] | None) -> dict[str, AnyArray]:
    with open_npz(path) as archive:
        arrays = {
            name: archive.read(name, _ARRAY)
            for name in archive.names
            if _ARRAY.holds(archive.dtype(name))
        }
    tables = {name: array for name, array in arrays.items() if array.ndim == 2 or array.dtype.names}
    if len(tables) != 1:
        if "x" in arrays:
            return arrays
        raise FormatError(
            path,
            expected="one table of points, or x, y and z",
            found=", ".join(arrays) or "nothing",
        )
    ((name, table),) = tables.items()
    rest = {key: array for key, array in arrays.items() if key != name and len(array) == len(table)}
    return _named(table, path, columns) | rest


def _named(array: AnyArray, path: Path, columns: tuple[str, ...] | None) -> dict[str, AnyArray]:
    """Return the columns of a structured array, or of a table (N, C)."""
    if array.dtype.names:
        return {name: array[name].reshape(-1) for name in array.dtype.names}
    if array.ndim != 2 or array.dtype.kind not in "fiu":
        raise FormatError(
            path,
            expected="a table (N, 3) of numbers, or wider",
            found=f"{array.shape} {array.dtype}",
        )
    names = columns or _FIRST[: array.shape[1]]
    if array.shape[1] != len(names):
        raise FormatError(
            path,
            expected=f"{len(names)} columns ({','.join(names)})",
            found=array.shape[1],
            advice="name all columns with `columns`",
        )
    return dict(zip(names, array.T, strict=True))


def _read_csv(path: Path, columns: tuple[str, ...] | None) -> dict[str, AnyArray]:
    with opening(path, "a table of numbers"), path.open(encoding="utf-8-sig") as file:
        first = file.readline()
        if path.suffix.lower() == ".pts" and first.strip().isdecimal():
            first = file.readline()  # after the number of points
        separator = next((mark for mark in ";," if mark in first), None)
        words = [word.strip(' \t\r\n"') for word in first.lstrip("#/ ").split(separator)]
        lines: Iterable[str] = file
        if separator == ";":
            lines = (line.replace(",", ".") for line in file)
        if named := any(not is_number(word.replace(",", ".")) for word in words):
            columns = tuple(words)
        elif first:
            lines = chain([first.replace(",", ".") if separator == ";" else first], lines)
        with warnings.catch_warnings(action="ignore"):  # a file without points is an error later
            table = np.loadtxt(lines, np.float64, delimiter=separator, ndmin=2, quotechar='"')
    if named and not table.size:
        table = np.empty((0, len(words)))
    return _named(table, path, columns)


def _read_ply(path: Path, columns: tuple[str, ...] | None) -> dict[str, AnyArray]:
    rows = PlyVertices.open(path).read()
    return {name: rows[name] for name in rows.dtype.names or ()}


def _read_pcd(path: Path, columns: tuple[str, ...] | None) -> dict[str, AnyArray]:
    return {name: values for name, values in read_pcd(path).items() if values.ndim == 1}


def _read_las(path: Path, columns: tuple[str, ...] | None) -> dict[str, AnyArray]:
    laspy = import_extra("laspy", "scans")
    with opening(path, "a LAS file"):
        cloud = laspy.read(path)
        names = [
            name
            for name in cloud.point_format.dimension_names
            if name.lower() not in ("x", "y", "z")
        ]
        scaled = {axis: np.asarray(getattr(cloud, axis)) for axis in ("x", "y", "z")}
        # in seconds by the format
        return scaled | {
            "gps_time_s" if name == "gps_time" else name: np.asarray(cloud[name]) for name in names
        }


_READERS: dict[str, Callable[[Path, tuple[str, ...] | None], dict[str, AnyArray]]] = {
    ".bin": _read_bin,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".csv": _read_csv,
    ".txt": _read_csv,
    ".xyz": _read_csv,
    ".pts": _read_csv,
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".las": _read_las,
    ".laz": _read_las,
}
FORMATS = tuple(_READERS)
"""The suffixes of the files that are read."""
