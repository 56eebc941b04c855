"""Points of PCD files, version 0.7, by field: text, binary, and binary compressed.

The format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from carlasc.core.arrays import AnyArray, RecordArray, Uint8Array
from carlasc.core.compiling import cached
from carlasc.errors import FormatError
from carlasc_converters.files import COPY, check_size, opening

_MAX_LINE = 4096
_LONGEST_LITERAL = 32  # LZF: after a control byte n below this value, n + 1 literal bytes follow
_KINDS = {"F": "f", "I": "i", "U": "u"}


@dataclass(frozen=True)
class PcdHeader:
    """The header of a PCD file.

    Attributes:
        row: structured type of a point; fields without a meaning (`_` in the file) have another
            name here.
        points: number of points.
        encoding: "ascii", "binary" or "binary_compressed".
        viewpoint: x, y, z, and the quaternion w, x, y, z of the sensor, in the frame of the points.
    """

    row: np.dtype[np.void]
    points: int
    encoding: str
    viewpoint: tuple[float, ...] = (0, 0, 0, 1, 0, 0, 0)


def read_header(path: str | Path) -> PcdHeader:
    """Return the header of a PCD file.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it is not a PCD file.
    """
    with opening(path, "a PCD file"), Path(path).open("rb") as file:
        return _read_header(file, str(path))


def read_pcd(path: str | Path) -> dict[str, AnyArray]:
    """Return the fields of the points of a PCD file, each (N,), or (N, count) for a field of
    several values.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it is not a PCD file, or is cut short.
    """
    with opening(path, "a PCD file"), Path(path).open("rb") as file:
        header = _read_header(file, str(path))
        body = file.read()
    where = str(path)
    row = header.row
    count = header.points
    if header.encoding == "ascii":
        try:
            rows = _rows_of_text(body, row) if body.strip() else np.empty(0, row)
        except ValueError as error:
            raise FormatError(
                where, expected=f"{count} rows of numbers", found=f"others ({error})", advice=COPY
            ) from error
    else:
        if header.encoding == "binary_compressed":
            body = _unpacked(body, row, count, where)
        if len(body) < count * row.itemsize:
            raise FormatError(
                where, expected=f"{count} points", found=len(body) // row.itemsize, advice=COPY
            )
        rows = np.frombuffer(body, row, count)
    if len(rows) != count:
        raise FormatError(where, expected=f"{count} points", found=len(rows), advice=COPY)
    return {name: rows[name] for name in row.names or () if not name.startswith("_")}


def _read_header(file: BinaryIO, where: str) -> PcdHeader:
    entries: dict[str, list[str]] = {}
    while "DATA" not in entries:
        line = file.readline(_MAX_LINE)
        words = line.decode("latin-1").split()
        if not line or (words and not words[0].startswith("#") and not words[0].isupper()):
            raise FormatError(
                where,
                expected="the header of a PCD file, which ends with DATA",
                found=repr(line[:20]),
            )
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
    try:
        names = entries["FIELDS"]
        sizes = list(map(int, entries["SIZE"]))
        kinds = entries["TYPE"]
        counts = list(map(int, entries.get("COUNT", ["1"] * len(names))))
        points = (
            int(entries["POINTS"][0])
            if "POINTS" in entries
            else math.prod(int(entries[k][0]) for k in ("WIDTH", "HEIGHT"))
        )
        fields = [
            (
                f"_{place}" if name == "_" else name,
                f"<{_KINDS[kind]}{size}",
                *(() if count == 1 else ((count,),)),
            )
            for place, (name, size, kind, count) in enumerate(
                zip(names, sizes, kinds, counts, strict=True)
            )
        ]
        (encoding,) = entries["DATA"]
        if encoding not in ("ascii", "binary", "binary_compressed") or points < 0:
            raise ValueError(f"DATA {encoding}, {points} points")
        viewpoint = tuple(map(float, entries.get("VIEWPOINT", ())))
        return PcdHeader(np.dtype(fields), points, encoding, viewpoint or PcdHeader.viewpoint)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise FormatError(
            where,
            expected="FIELDS, SIZE, TYPE, COUNT, POINTS and DATA of a PCD file",
            found=f"others ({error})",
        ) from error


def _rows_of_text(body: bytes, row: np.dtype[np.void]) -> RecordArray:
    """Return the rows of a text body."""
    try:
        return np.loadtxt(io.BytesIO(body), row, comments=None, ndmin=1)
    except ValueError:  # whole numbers may be written as in 1.5e+03
        return np.loadtxt(io.BytesIO(body), row, comments=None, ndmin=1, converters=float)


def _unpacked(body: bytes, row: np.dtype[np.void], count: int, where: str) -> bytes:
    """Return the rows of a compressed body: two sizes, then all values of the first field, of the
    second, and so on.
    """
    packed, size = (int(n) for n in np.frombuffer(body[:8].ljust(8, b"\0"), "<u4"))
    if size != count * row.itemsize or len(body) < 8 + packed:
        expected = f"{packed} bytes of {count} compressed points"
        raise FormatError(
            where, expected=expected, found=f"{len(body) - 8} bytes of {size}", advice=COPY
        )
    check_size(size, where)
    columns = np.empty(size, np.uint8)
    if _lzf(np.frombuffer(body, np.uint8, packed, 8), columns) != size:
        raise FormatError(
            where, expected=f"{size} bytes in LZF compression", found="damaged ones", advice=COPY
        )
    rows = np.empty(count, row)
    start = 0
    for name in row.names or ():
        width = row[name].itemsize * count
        kind, shape = row[name].subdtype or (row[name], ())
        rows[name] = columns[start : start + width].view(kind).reshape(count, *shape)
        start += width
    return rows.tobytes()


@cached
def _lzf(packed: Uint8Array, out: Uint8Array) -> int:
    """Decompress LZF data into `out`, and return the number of bytes; -1 if the data are damaged.

    The format: http://oldhome.schmorp.de/marc/liblzf.html.
    """
    at = 0
    filled = 0
    while at < len(packed):
        control = int(packed[at])
        at += 1
        if control < _LONGEST_LITERAL:
            length = control + 1
            if at + length > len(packed) or filled + length > len(out):
                return -1
            out[filled : filled + length] = packed[at : at + length]
            at += length
        else:
            length = control >> 5
            if at + 1 + (length == 7) > len(packed):
                return -1
            if length == 7:
                length += int(packed[at])
                at += 1
            length += 2
            start = filled - ((control & 31) << 8) - int(packed[at]) - 1
            at += 1
            if start < 0 or filled + length > len(out):
                return -1
            # the two may overlap: bytes that were just written are repeated
            for k in range(length):
                out[filled + k] = out[start + k]
        filled += length
    return filled
