"""Map files for other programs: points with classes, written in pieces (.ply, .pcd, .las and .npz),
and OctoMap binary trees (.bt).

PLY: https://paulbourke.net/dataformats/ply/. PCD:
https://pointclouds.org/documentation/tutorials/pcd_file_format.html (version 0.7).

A binary tree stores which cells are occupied and which are free; all others are unknown. After a
text header, each inner node has two bits for each of its eight children, 01 free, 10 occupied, 11
an inner node, 00 unknown, in the order x + 2 y + 4 z; the inner nodes follow each other in
depth-first order. A tree has 16 levels, and its middle is at the origin. See A. Hornung et al.,
"OctoMap", Autonomous Robots 2013, section 5, and https://octomap.github.io.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from carlasc.core.arrays import AnyArray, AnyIntArray, BoolArray
from carlasc.core.classes import ClassTable
from carlasc.errors import ArgumentError, import_extra
from carlasc.storage.files import AnyPath, write_output

POINT_DTYPE = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("label", "<u2"),
        ("seen", "<u4"),
        ("confidence", "<f4"),
    ]
)
"""A point: position in metres, class, number of scans that saw its cell, confidence of the class.
"""

# 0xAARRGGBB: bytes b, g, r, a
_ROW_DTYPE = np.dtype([*POINT_DTYPE.descr[:3], ("rgb", "<u4"), *POINT_DTYPE.descr[3:]])
_PLY_NAMES = {"f4": "float", "u2": "ushort", "u4": "uint"}
_LAS_SCALE_M = 0.0001
_LAS_CLASSES = 256  # a classification has 8 bits; `label` holds every class


@dataclass(frozen=True)
class PointPieces:
    """Points with classes, in pieces, because all of them may not fit into memory.

    Attributes:
        count: number of points.
        pieces: yields arrays of `POINT_DTYPE`, `count` points in all; called once for each pass
            over them.
        classes: class table of the labels.
        about: one line about the points, for the headers of files.
    """

    count: int
    pieces: Callable[[], Iterator[AnyArray]]
    classes: ClassTable
    about: str

    def colored(self) -> Iterator[AnyArray]:
        """Yield the pieces with the colours of their classes."""
        for piece in self.pieces():
            rows = np.zeros(len(piece), _ROW_DTYPE)
            for name in POINT_DTYPE.names or ():
                rows[name] = piece[name]
            red, green, blue = self.classes.palette[piece["label"]].astype(np.uint32).T
            rows["rgb"] = red << 16 | green << 8 | blue | np.uint32(255 << 24)
            yield rows


def write_points(path: AnyPath, points: PointPieces) -> None:
    """Write points. The file suffix, one of `POINT_ENDINGS`, determines the format.

    Raises:
        DependencyError: laspy is needed, and not installed.
        StorageError: the file cannot be written. An existing file is unchanged.
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
    kinds = [(name, kind[2:], kind[1].upper()) for name, kind, *_ in _ROW_DTYPE.descr]
    described = map(" ".join, zip(("FIELDS", "SIZE", "TYPE"), *kinds, strict=True))
    head = [
        f"# .PCD v0.7: {points.about}",
        "VERSION 0.7",
        *described,
        "COUNT" + " 1" * len(_ROW_DTYPE.descr),
    ]
    size = [
        f"WIDTH {points.count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {points.count}",
        "DATA binary",
    ]
    _write_rows(file, points, [*head, *size])


def _write_rows(file: BinaryIO, points: PointPieces, head: list[str]) -> None:
    file.write("".join(f"{' '.join(line.split())}\n" for line in head).encode("ascii", "replace"))
    for piece in points.colored():
        file.write(piece.tobytes())


def _write_las(file: BinaryIO, points: PointPieces) -> None:
    laspy = import_extra("laspy", "scans")
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, _LAS_SCALE_M)
    header.offsets = np.zeros(3)
    extra = {"label": np.uint16, "seen": np.uint32, "confidence": np.float32}
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind) for name, kind in extra.items()])
    with laspy.open(file, mode="w", header=header, closefd=False) as writer:
        for piece in points.colored():
            record = laspy.ScaleAwarePointRecord.zeros(len(piece), header=header)
            record.x, record.y, record.z = (piece[axis].astype(np.float64) for axis in "xyz")
            record.classification = np.where(
                piece["label"] < _LAS_CLASSES, piece["label"], 0
            ).astype(np.uint8)
            for name, shift in (("red", 16), ("green", 8), ("blue", 0)):
                record[name] = (piece["rgb"] >> shift & 255).astype(np.uint16) * 257
            for name in extra:
                record[name] = piece[name]
            writer.write_points(record)


def _write_npz(file: BinaryIO, points: PointPieces) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        for name in ("points", "label", "seen", "confidence"):
            is_place = name == "points"
            dtype = POINT_DTYPE["x" if is_place else name]
            columns = ["x", "y", "z"] if is_place else [name]
            header = {
                "descr": dtype.str,
                "fortran_order": False,
                "shape": (points.count, 3)[: 1 + is_place],
            }
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as entry:
                np.lib.format.write_array_header_2_0(entry, header)
                for piece in points.pieces():
                    entry.write(structured_to_unstructured(piece[columns], dtype).tobytes())
        table = sorted(points.classes.names.items())
        names = io.BytesIO()
        np.save(names, np.array(table, [("label", "<u2"), ("name", "<U64")]))
        archive.writestr(zipfile.ZipInfo("classes.npy"), names.getvalue())


_WRITERS: dict[str, Callable[[BinaryIO, PointPieces], None]] = {
    ".ply": _write_ply,
    ".pcd": _write_pcd,
    ".las": _write_las,
    ".npz": _write_npz,
}
POINT_ENDINGS = tuple(_WRITERS)
"""The suffixes of the files that `write_points` writes."""


_LEVELS = 16
_MIDDLE = 1 << (_LEVELS - 1)
_FREE = 1
_OCCUPIED = 2
_INNER = 3
# eight equal children, which become one leaf
_ALL_FREE = 0x5555
_ALL_OCCUPIED = 0xAAAA


def write_octomap(
    path: AnyPath,
    cells: AnyIntArray,
    occupied: BoolArray,
    cell_m: float,
) -> None:
    """Write cells as an OctoMap binary tree.

    Args:
        path: the file.
        cells: (N, 3) unique indices of cells. Cell i begins at i times `cell_m`.
        occupied: (N,) whether each cell is occupied; the others are free.
        cell_m: size of a cell, metres.

    Raises:
        ArgumentError: a cell is outside the extent of the tree.
        StorageError: the file cannot be written. An existing file is unchanged.
    """
    farthest = int(np.abs(cells).max(initial=0))
    if farthest >= _MIDDLE:
        raise ArgumentError(
            "cell_m",
            expected=f"cells within {_MIDDLE * cell_m:g} m of the origin, the extent of an OctoMap "
            f"tree",
            found=f"{farthest * cell_m:.0f} m",
            advice="use larger cells, or fewer frames",
        )
    nodes, tree = _encode(cells, occupied)
    text = f"# Octomap OcTree binary file\nid OcTree\nsize {nodes}\nres {float(cell_m)!r}\ndata\n"
    write_output(Path(path), text.encode() + tree)


def _encode(cells: AnyIntArray, occupied: BoolArray) -> tuple[int, bytes]:
    """Return the number of nodes of a tree, and its encoded bytes."""
    code = _interleave((cells + _MIDDLE).astype(np.uint64))
    order = np.argsort(code)
    code = code[order]
    state = np.where(occupied[order], _OCCUPIED, _FREE).astype(np.uint16)
    nodes = 1
    first = [np.empty(0, np.uint64)]
    inner = [np.empty(0, np.uint16)]
    depths = [np.empty(0, np.int8)]
    for depth in range(_LEVELS - 1, -1, -1):  # of the parents of these nodes
        starts = np.flatnonzero(np.diff(code >> np.uint64(3), prepend=np.uint64(1 << 63)))
        places = (np.uint64(2) * (code & np.uint64(7))).astype(np.uint16)
        masks = np.bitwise_or.reduceat(state << places, starts) if len(starts) else state
        alike = (masks == _ALL_FREE) | (masks == _ALL_OCCUPIED)
        nodes += len(code) - 8 * int(alike.sum())
        code = code[starts] >> np.uint64(3)
        first.append(code[~alike] << np.uint64(3 * (_LEVELS - depth)))
        inner.append(masks[~alike])
        depths.append(np.full(len(first[-1]), depth, np.int8))
        state = np.where(alike, masks & 3, _INNER).astype(np.uint16)
    order = np.lexsort((np.concatenate(depths), np.concatenate(first)))
    return nodes if len(cells) else 0, np.concatenate(inner)[order].astype("<u2").tobytes()


def _interleave(keys: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return (N,) Morton codes of (N, 3) keys, with z in the most significant bits."""
    code = np.zeros(len(keys), np.uint64)
    for bit in range(_LEVELS):
        for axis in range(3):
            code |= ((keys[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code
