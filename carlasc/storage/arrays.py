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
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import FormatError, MissingDataError, reading
from carlasc.storage.files import damaged

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


def parse_npy(data: bytes | memoryview, expected: ArrayFormat, where: str) -> AnyArray:
    """Return the array of a .npy file.

    Args:
        data: the whole file.
        expected: what it must hold.
        where: the file, for errors.

    Returns:
        The array, in C order.

    Raises:
        FormatError: the file has another type, shape or size, or is no .npy file.
    """
    return _read_array(io.BytesIO(data), len(data), expected, where)


def read_npy(path: str | Path, expected: ArrayFormat) -> AnyArray:
    """Return the array of a .npy file on this machine.

    A file that is longer than its header says is not read.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: the file has another type, shape or size, cannot be read, or is no .npy file.
    """
    with _opened(path) as file:
        return _read_array(file, os.fstat(file.fileno()).st_size, expected, str(path))


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
        raise damaged(
            where,
            f"at most {_MOST_RATIO} times the {packed} packed bytes",
            f"{size} unpacked bytes",
            "the file was made to fill the memory: do not use it",
        )


def check_size(shape: tuple[int, ...], dtype: np.dtype[Any], what: str) -> None:
    """Check that an array is not larger than any real frame.

    For fields whose size the format does not limit.

    Raises:
        FormatError: the array is too large; the message begins with `what`.
    """
    if math.prod(shape) * dtype.itemsize > _MOST_BYTES:
        raise damaged(
            what,
            f"at most {_MOST_BYTES} bytes",
            f"{dtype.name} of shape {_text(shape)}",
            "the store is damaged, or was made to fill the memory",
        )


class NpzFile:
    """The arrays of an open .npz file.

    Attributes:
        names: names of the arrays.
    """

    def __init__(self, archive: zipfile.ZipFile, where: str) -> None:
        self._archive = archive
        self._where = where
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
            return _npy_header(stream)[1]

    def read(self, name: str, expected: ArrayFormat) -> AnyArray:
        """Return an array, in C order.

        Raises:
            FormatError: the array does not exist, has another type, shape or size, has a
                compression that NumPy does not use, or is damaged.
        """
        member = self._members.get(name)
        where = f"{self._where}: {name}"
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
            return _read_array(stream, member.file_size, expected, where, member.compress_size)


def npz_bytes(arrays: Mapping[str, tuple[AnyArray, int]]) -> bytes:
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
    name = where or str(source)
    with (
        io.BytesIO(source) if isinstance(source, bytes | memoryview) else _opened(source) as file,
        ExitStack() as stack,
    ):
        with reading(name, "an .npz file"):
            archive = stack.enter_context(zipfile.ZipFile(file))
            opened = NpzFile(archive, name)
        yield opened


@contextmanager
def _opened(path: str | Path) -> Iterator[IO[bytes]]:
    try:
        # closed below: only what opening raises is caught here
        file = Path(path).open("rb")  # noqa: SIM115
    except FileNotFoundError as error:
        raise MissingDataError(path, expected="a file", found="nothing") from error
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        raise FormatError(
            path, problem=f"cannot be read: {getattr(error, 'strerror', None) or error}"
        ) from error
    with file:
        yield file


def _npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and type from the header of a .npy file."""
    version = np.lib.format.read_magic(stream)
    if version not in _READERS:
        raise ValueError(f"version {version} of the .npy format")
    shape, _, dtype = _READERS[version](stream)
    return shape, dtype


def _read_array(
    stream: IO[bytes], length: int, expected: ArrayFormat, where: str, packed: int | None = None
) -> AnyArray:
    """Return the array of a .npy file of `length` bytes, which are `packed` bytes in a zip."""
    shape = _check_header(stream, length, expected, where)
    if packed is not None:
        check_ratio(length, packed, where)
    with reading(where, "a .npy array"):
        stream.seek(0)
        array = np.lib.format.read_array(stream, allow_pickle=False)
        stream.read(1)  # reaches the end of a member, where its checksum is compared
    return np.asarray(array.reshape(shape), order="C")


def _check_header(
    stream: IO[bytes], length: int, expected: ArrayFormat, where: str
) -> tuple[int, ...]:
    """Read the header of a .npy file, check it against the expected format and the length of the
    file, and return the shape.

    NumPy parses its text as a Python literal of at most 10,000 characters. No code is run.
    """
    with reading(where, "a .npy array"):
        shape, dtype = _npy_header(stream)
        start = stream.tell()
    wanted = expected.shape
    count = math.prod(shape)
    # An empty array of shape (0,) is accepted as (0, K): CarlaSC has such files for an empty list
    # of actors.
    if shape == (0,) and wanted is not None and len(wanted) == 2:
        shape = (0, wanted[1] or 0)
    if not expected.holds(dtype):
        names = list(dict.fromkeys(np.dtype(name).name for name in expected.dtypes))
        text = " or ".join(names) if len(names) < 4 else "numeric"
        raise FormatError(where, expected=f"{text} values", found=dtype.name)
    fits = wanted is None or (
        len(shape) == len(wanted)
        and all(size in (None, given) for size, given in zip(wanted, shape, strict=True))
    )
    if not fits or min(shape, default=0) < 0:
        raise FormatError(
            where, expected=f"an array of {_text(wanted or ())} values", found=_text(shape)
        )
    size = start + count * dtype.itemsize
    if size >= 2**63:
        raise FormatError(where, expected="an array that fits into memory", found=_text(shape))
    if expected.most is not None and count > expected.most:
        raise FormatError(where, expected=f"at most {expected.most} values", found=_text(shape))
    if length != size:
        raise damaged(
            where,
            f"{size} bytes ({_text(shape)} {dtype.name})",
            str(length),
            "the file is cut short, or something was added",
        )
    return shape


def _text(shape: tuple[int | None, ...]) -> str:
    return " x ".join("N" if length is None else str(length) for length in shape) or "one value"
