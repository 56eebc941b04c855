"""Reading arrays from untrusted .npy and .npz files, and writing .npz files.

The header of an array holds its type, shape and size. They are checked before any value is read,
and only the header is unpacked for that. A small file that claims a huge array, or unpacks to one,
therefore takes neither memory nor time. Pickles are never read. The format is that of
`numpy.lib.format`; .npz files are zips of such files (PKWARE's APPNOTE).
"""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError, MissingDataError, reading

_LONGEST_HEADER = 1 << 14  # bytes; NumPy refuses headers of more than 10,000
_PIECE = 1 << 18  # bytes that are unpacked at a time
# bytes: smaller arrays are unpacked at any compression ratio: zeros compress very well
_SMALL = 1 << 26  # fact: small-array
_MOST_RATIO = 100  # largest compression ratio of larger arrays; Deflate reaches 1032
# largest frame of any field but a grid: 20 million points, more than any sensor records
_MOST_BYTES = 1 << 28  # fact: largest-frame
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # the methods that NumPy writes
_ENCRYPTED = 1  # flag
_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}

_ORDERS = ("<", ">")
WHOLE_NUMBERS = (
    "?",
    "i1",
    "u1",
    *(f"{order}{kind}{size}" for order in _ORDERS for kind in "iu" for size in (2, 4, 8)),
)
"""All integer types, for files of other programs, whose type is not fixed."""
NUMBERS = (*WHOLE_NUMBERS, *(f"{order}f{size}" for order in _ORDERS for size in (2, 4, 8)))
"""All integer and floating-point types, for files of other programs."""


@dataclass(frozen=True)
class ArrayFormat:
    """The type and shape that an array in a file must have.

    Attributes:
        dtypes: NumPy names of the allowed types, with the byte order.
        shape: length of each axis; None allows any length. A shape of None allows every shape.
        most: largest number of elements; None if it is not limited.
        records: whether elements may also be records, whose fields have these types.
    """

    dtypes: tuple[str, ...]
    shape: tuple[int | None, ...] | None
    most: int | None = None
    records: bool = False

    def holds(self, dtype: np.dtype[Any]) -> bool:
        """Return whether elements may have a type."""
        kinds = [dtype[name] for name in dtype.names] if self.records and dtype.names else [dtype]
        return all(kind in tuple(map(np.dtype, self.dtypes)) for kind in kinds)


@dataclass(frozen=True)
class _Header:
    """The checked header of a .npy file."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    fortran_order: bool
    start: int  # first byte of the values

    @property
    def size(self) -> int:
        """Number of bytes of the values."""
        return math.prod(self.shape) * self.dtype.itemsize

    def array(self, values: bytes | memoryview) -> NDArray[Any]:
        """Return these bytes as an array in C order.

        Copies only if the file is in Fortran order.
        """
        flat = np.frombuffer(values, self.dtype, math.prod(self.shape))
        return np.asarray(
            flat.reshape(self.shape, order="F" if self.fortran_order else "C"), order="C"
        )


def parse_npy(data: bytes | memoryview, expected: ArrayFormat, where: str) -> NDArray[Any]:
    """Return the array of a .npy file.

    Args:
        data: the whole file.
        expected: what it must hold.
        where: the file, for errors.

    Returns:
        The array, in C order. It may be read-only.

    Raises:
        FormatError: the file has another type, shape or size, or is no .npy file.
    """
    header = _read_header(io.BytesIO(data[:_LONGEST_HEADER]), expected, where)
    if len(data) - header.start != header.size:
        raise FormatError(
            where,
            expected=f"{header.start + header.size} bytes ({_text(header.shape)} "
            f"{header.dtype.name})",
            found=str(len(data)),
            advice="the file is cut short, or something was added",
        )
    return header.array(memoryview(data)[header.start :])


def read_npy(path: str | Path, expected: ArrayFormat) -> NDArray[Any]:
    """Return the array of a .npy file on this machine.

    A file that is longer than its header says is not read.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: the file has another type, shape or size, cannot be read, or is no .npy file.
    """
    with _opened(path) as file:
        header = _read_header(file, expected, str(path))
        found = os.fstat(file.fileno()).st_size
        if found != header.start + header.size:
            raise FormatError(
                path,
                expected=f"{header.start + header.size} bytes ({_text(header.shape)} "
                f"{header.dtype.name})",
                found=str(found),
                advice="the file is cut short, or something was added",
            )
        file.seek(header.start)
        return header.array(file.read(header.size))


def check_ratio(size: int, packed: int, where: str) -> None:
    """Check the compression ratio of an array whose size is not known otherwise.

    Args:
        size: bytes of the unpacked array.
        packed: bytes of the packed array.
        where: the file, for errors.

    Raises:
        FormatError: the array is large, and its ratio is higher than that of any real array.
    """
    if size > max(_SMALL, _MOST_RATIO * packed):
        raise FormatError(
            where,
            expected=f"at most {_MOST_RATIO} times the {packed} packed bytes",
            found=f"{size} unpacked bytes",
            advice="the file was made to fill the memory: do not use it",
        )


def check_size(shape: tuple[int, ...], dtype: np.dtype[Any], what: str) -> None:
    """Check that an array is not larger than any real frame.

    For fields whose size the format does not limit.

    Raises:
        FormatError: the array is too large; the message begins with `what`.
    """
    if math.prod(shape) * dtype.itemsize > _MOST_BYTES:
        raise FormatError(
            what,
            expected=f"at most {_MOST_BYTES} bytes",
            found=f"{dtype.name} of shape {_text(shape)}",
            advice="the store is damaged, or was made to fill the memory",
        )


class NpzFile:
    """The arrays of an open .npz file.

    Attributes:
        names: names of the arrays.
    """

    def __init__(self, archive: zipfile.ZipFile, where: str) -> None:
        self._archive, self._where = archive, where
        self._members = {
            member.filename.removesuffix(".npy"): member for member in archive.infolist()
        }
        self.names = tuple(self._members)

    def dtype(self, name: str) -> np.dtype[Any]:
        """Return the type of an array, from its header alone."""
        where = f"{self._where}: {name}"
        with (
            reading(where, "a .npy array in a whole zip"),
            self._archive.open(self._members[name]) as stream,
        ):
            return _npy_header(stream)[2]

    def read(self, name: str, expected: ArrayFormat) -> NDArray[Any]:
        """Return an array, in C order.

        Raises:
            FormatError: the array does not exist, has another type, shape or size, has a
                compression that NumPy does not use, or is damaged.
        """
        member, where = self._members.get(name), f"{self._where}: {name}"
        if member is None:
            raise FormatError(
                self._where,
                expected=f"an array {name}",
                found=", ".join(self.names) or "an archive without arrays",
            )
        if member.flag_bits & _ENCRYPTED or member.compress_type not in _METHODS:
            found = (
                "an encrypted one"
                if member.flag_bits & _ENCRYPTED
                else f"compression {member.compress_type}"
            )
            raise FormatError(where, expected="a stored or deflated array", found=found)
        with reading(where, "a .npy array in a whole zip"), self._archive.open(member) as stream:
            header = _read_header(stream, expected, where)
            self._check_size(header, member, where)
            return header.array(self._unpack(stream, header, where))

    def _check_size(self, header: _Header, member: zipfile.ZipInfo, where: str) -> None:
        if member.file_size != header.start + header.size:
            raise FormatError(
                where,
                expected=f"{header.start + header.size} bytes ({_text(header.shape)} "
                f"{header.dtype.name})",
                found=str(member.file_size),
                advice="the file is damaged",
            )
        check_ratio(header.size, member.compress_size, where)

    @staticmethod
    def _unpack(stream: IO[bytes], header: _Header, where: str) -> memoryview:
        values = np.empty(header.size, np.uint8)
        view, place = values.data, 0
        while place < header.size and (part := stream.read(min(_PIECE, header.size - place))):
            view[place : place + len(part)] = part
            place += len(part)
        stream.read(1)  # reaches the end, where the checksum is compared
        if place != header.size:
            raise FormatError(
                where,
                expected=f"{header.size} bytes of values",
                found=str(place),
                advice="the file is damaged",
            )
        return view


def npz_bytes(arrays: Mapping[str, tuple[NDArray[Any], int]]) -> bytes:
    """Return a compressed .npz file like that of `numpy.savez_compressed`, but with one Deflate
    level per array.

    Args:
        arrays: array and Deflate level by name. Levels go from 1 (fast) to 9 (small); NumPy uses 6.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, (array, level) in arrays.items():
            archive.compresslevel = level
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    return buffer.getvalue()


@contextmanager
def open_npz(source: str | Path | bytes | memoryview, where: str = "") -> Iterator[NpzFile]:
    """Open an .npz file, given by its path or its bytes.

    Args:
        source: the path or the bytes.
        where: name of the file in errors, if `source` is bytes.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: the file is not a zip, is damaged, or cannot be read.
    """
    if isinstance(source, bytes | memoryview):
        with _archive(io.BytesIO(source), where) as archive:
            yield archive
    else:
        with _opened(source) as file, _archive(file, where or str(source)) as archive:
            yield archive


@contextmanager
def _archive(file: IO[bytes], where: str) -> Iterator[NpzFile]:
    with reading(where, "an .npz file"):
        archive = zipfile.ZipFile(file)
        opened = NpzFile(archive, where)
    with archive:
        yield opened


@contextmanager
def _opened(path: str | Path) -> Iterator[IO[bytes]]:
    try:
        file = Path(path).open("rb")  # noqa: SIM115 (closed below: only what opening raises is caught here)
    except FileNotFoundError as error:
        raise MissingDataError(path, expected="a file", found="nothing") from error
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        raise FormatError(
            path, problem=f"cannot be read: {getattr(error, 'strerror', None) or error}"
        ) from error
    with file:
        yield file


def _npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, whether the order is Fortran, and type from the header of a .npy file."""
    version = np.lib.format.read_magic(stream)
    if version not in _READERS:
        raise ValueError(f"version {version} of the .npy format")
    header: tuple[tuple[int, ...], bool, np.dtype[Any]] = _READERS[version](stream)
    return header


def _read_header(stream: IO[bytes], expected: ArrayFormat, where: str) -> _Header:
    """Read the header of a .npy file, and check it against the expected format.

    NumPy parses its text as a Python literal of at most 10,000 characters. No code is run.
    """
    with reading(where, "a .npy array"):
        shape, fortran_order, dtype = _npy_header(stream)
        start = stream.tell()
    # An empty array of shape (0,) is accepted as (0, K): CarlaSC has such files for an empty list
    # of actors.
    if (
        len(shape) == 1
        and shape[0] == 0
        and expected.shape is not None
        and len(expected.shape) == 2
    ):
        shape = (0, expected.shape[1] or 0)
    if not expected.holds(dtype):
        names = list(dict.fromkeys(np.dtype(name).name for name in expected.dtypes))
        wanted = " or ".join(names) if len(names) < 4 else "numeric"
        raise FormatError(where, expected=f"{wanted} values", found=dtype.name)
    fits = expected.shape is None or (
        len(shape) == len(expected.shape)
        and all(
            length in (None, found) for length, found in zip(expected.shape, shape, strict=True)
        )
    )
    if not fits or min(shape, default=0) < 0:
        raise FormatError(
            where, expected=f"an array of {_text(expected.shape or ())} values", found=_text(shape)
        )
    if math.prod(shape) * dtype.itemsize >= 2**63:
        raise FormatError(where, expected="an array that fits into memory", found=_text(shape))
    if expected.most is not None and math.prod(shape) > expected.most:
        raise FormatError(where, expected=f"at most {expected.most} values", found=_text(shape))
    return _Header(dtype, shape, fortran_order, start)


def _text(shape: tuple[int | None, ...]) -> str:
    return " x ".join("N" if length is None else str(length) for length in shape) or "one value"
