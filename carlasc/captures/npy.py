"""Reading a .npy file of a known type and shape."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError

_LONGEST_HEADER = 1 << 14  # bytes; NumPy refuses headers of more than 10,000


@dataclass(frozen=True)
class ArrayFormat:
    """What a .npy file must hold.

    Attributes:
        dtype: NumPy's name of the type.
        shape: length of each axis; None allows any length.
    """

    dtype: str
    shape: tuple[int | None, ...]


def parse_npy(data: bytes | memoryview, expected: ArrayFormat, where: str) -> NDArray[Any]:
    """Return the array of a .npy file. Its type, shape and size are checked before the values are read.

    An empty file of shape (0,) is read as (0, K) where the format has K columns: the authors write an empty list of actors so.

    Args:
        data: the whole file.
        expected: what it must hold.
        where: the file, for errors.

    Returns:
        The array, in C order. It may be read-only.

    Raises:
        FormatError: the file has another type, shape or size, or is no .npy file.
    """
    shape, fortran_order, dtype, start = _parse_header(data, where)
    if len(shape) == 1 and shape[0] == 0 and len(expected.shape) == 2:
        shape = (0, expected.shape[1] or 0)
    if dtype != np.dtype(expected.dtype):
        raise FormatError(where, expected=f"{np.dtype(expected.dtype).name} values", found=dtype.name)
    if len(shape) != len(expected.shape) or any(
        length not in (None, found) for length, found in zip(expected.shape, shape, strict=True)
    ):
        raise FormatError(where, expected=f"an array of {_text(expected.shape)} values", found=_text(shape))
    count = int(np.prod(shape, dtype=np.int64))
    if len(data) - start != count * dtype.itemsize:
        raise FormatError(
            where,
            expected=f"{start + count * dtype.itemsize} bytes ({_text(shape)} {dtype.name})",
            found=str(len(data)),
            advice="the file is cut short, or something was added",
        )
    array = np.frombuffer(data, dtype, count, start)
    return np.ascontiguousarray(array.reshape(shape, order="F" if fortran_order else "C"))


def _parse_header(data: bytes | memoryview, where: str) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Return the shape, whether the order is Fortran's, and the type that the header of a .npy file names; and where it ends."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    stream = io.BytesIO(data[:_LONGEST_HEADER])
    try:
        version = np.lib.format.read_magic(stream)
        if version not in readers:
            raise ValueError(f"version {version} of the .npy format")
        shape, fortran_order, dtype = readers[version](stream)
    except ValueError as error:
        raise FormatError(where, expected="a .npy array", found="something else", advice=str(error)) from error
    return shape, fortran_order, dtype, stream.tell()


def _text(shape: tuple[int | None, ...]) -> str:
    return " x ".join("N" if length is None else str(length) for length in shape)
