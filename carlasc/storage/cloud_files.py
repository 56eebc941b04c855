"""Files of classified points for other programs, written in pieces: .ply, .pcd, .las and .npz.

PLY: https://paulbourke.net/dataformats/ply/. PCD: https://pointclouds.org/documentation/tutorials/pcd_file_format.html (version 0.7).
"""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.errors import import_extra
from carlasc.storage.files import write_output

POINT_DTYPE = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("label", "<u2"), ("seen", "<u4"), ("confidence", "<f4")]
)
"""A point: metres, class, number of scans that saw its cell, confidence in the class."""

_ROW_DTYPE = np.dtype([*POINT_DTYPE.descr[:3], ("rgb", "<u4"), *POINT_DTYPE.descr[3:]])  # 0xAARRGGBB: bytes b, g, r, a
_PLY_NAMES = {"f4": "float", "u2": "ushort", "u4": "uint"}
_LAS_SCALE_M = 0.0001
_LAS_CLASSES = 256  # a classification has 8 bits; `label` holds every class


@dataclass(frozen=True)
class PointPieces:
    """Points that need not fit into memory.

    Attributes:
        count: number of points.
        pieces: yields arrays of `POINT_DTYPE`, `count` points in all; called once for each pass over them.
        classes: class table of the labels.
        about: what the points are, a line.
    """

    count: int
    pieces: Callable[[], Iterator[NDArray[Any]]]
    classes: ClassTable
    about: str

    def colored(self) -> Iterator[NDArray[Any]]:
        """Yield the pieces with the colours of their classes."""
        for piece in self.pieces():
            rows = np.zeros(len(piece), _ROW_DTYPE)
            for name in POINT_DTYPE.names or ():
                rows[name] = piece[name]
            red, green, blue = self.classes.palette[piece["label"]].astype(np.uint32).T
            rows["rgb"] = red << 16 | green << 8 | blue | np.uint32(255 << 24)
            yield rows


def write_points(path: str | os.PathLike[str], points: PointPieces) -> None:
    """Write points; the ending of the file, one of `POINT_ENDINGS`, says its format.

    Raises:
        DependencyError: laspy is needed, and not installed.
        StorageError: the file cannot be written; an earlier one stays.
    """
    write = _WRITERS[Path(path).suffix.lower()]
    write_output(Path(path), lambda file: write(file, points))


def _write_ply(file: BinaryIO, points: PointPieces) -> None:
    rows = [f"property {_PLY_NAMES[kind[1:]]} {name}" for name, kind, *_ in _ROW_DTYPE.descr]
    rows[3:4] = [f"property uchar {name}" for name in ("blue", "green", "red", "alpha")]
    names = [f"comment class {label} {name}" for label, name in points.classes.names.items()]
    head = ["ply", "format binary_little_endian 1.0", f"comment {points.about}", *names]
    _write_rows(file, points, [*head, f"element vertex {points.count}", *rows, "end_header"])


def _write_pcd(file: BinaryIO, points: PointPieces) -> None:
    kinds = list(zip(*((name, kind[2:], kind[1].upper()) for name, kind, *_ in _ROW_DTYPE.descr), strict=True))
    described = [" ".join([word, *values]) for word, values in zip(("FIELDS", "SIZE", "TYPE"), kinds, strict=True)]
    head = [f"# .PCD v0.7: {points.about}", "VERSION 0.7", *described, "COUNT" + " 1" * len(_ROW_DTYPE.descr)]
    size = [f"WIDTH {points.count}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {points.count}", "DATA binary"]
    _write_rows(file, points, [*head, *size])


def _write_rows(file: BinaryIO, points: PointPieces, head: list[str]) -> None:
    file.write("".join(f"{' '.join(line.split())}\n" for line in head).encode("ascii", "replace"))
    for piece in points.colored():
        file.write(piece.tobytes())


def _write_las(file: BinaryIO, points: PointPieces) -> None:
    laspy = import_extra("laspy", "scans")
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales, header.offsets = np.full(3, _LAS_SCALE_M), np.zeros(3)
    extra = {"label": np.uint16, "seen": np.uint32, "confidence": np.float32}
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind) for name, kind in extra.items()])
    with laspy.open(file, mode="w", header=header, closefd=False) as writer:
        for piece in points.colored():
            record = laspy.ScaleAwarePointRecord.zeros(len(piece), header=header)
            record.x, record.y, record.z = (piece[axis].astype(np.float64) for axis in "xyz")
            record.classification = np.where(piece["label"] < _LAS_CLASSES, piece["label"], 0).astype(np.uint8)
            for name, shift in (("red", 16), ("green", 8), ("blue", 0)):
                record[name] = (piece["rgb"] >> shift & 255).astype(np.uint16) * 257
            for name in extra:
                record[name] = piece[name]
            writer.write_points(record)


def _write_npz(file: BinaryIO, points: PointPieces) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        for name in ("points", "label", "seen", "confidence"):
            is_place = name == "points"
            dtype, columns = POINT_DTYPE["x" if is_place else name], ["x", "y", "z"] if is_place else [name]
            header = {"descr": dtype.str, "fortran_order": False, "shape": (points.count, 3)[: 1 + is_place]}
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as entry:
                np.lib.format.write_array_header_2_0(entry, header)
                for piece in points.pieces():
                    entry.write(structured_to_unstructured(piece[columns], dtype).tobytes())
        table, names = sorted(points.classes.names.items()), io.BytesIO()
        np.save(names, np.array(table, [("label", "<u2"), ("name", "<U64")]))
        archive.writestr(zipfile.ZipInfo("classes.npy"), names.getvalue())


_WRITERS: dict[str, Callable[[BinaryIO, PointPieces], None]] = {
    ".ply": _write_ply,
    ".pcd": _write_pcd,
    ".las": _write_las,
    ".npz": _write_npz,
}
POINT_ENDINGS = tuple(_WRITERS)
"""The endings of the files that are written."""
