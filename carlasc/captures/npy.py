"""Reading a .npy file of a known type and shape."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError, MissingDataError


@dataclass(frozen=True)
class ArrayFormat:
    """What a .npy file must hold.

    Attributes:
        dtype: NumPy's name of the type.
        shape: length of each axis; None allows any length.
    """

    dtype: str
    shape: tuple[int | None, ...]


def read_npy(path: Path, expected: ArrayFormat) -> NDArray[Any]:
    """Read a .npy file. Its type, shape and size are checked before the values are read.

    An empty file of shape (0,) is read as (0, K) where the format has K columns: the authors write an empty list of actors so.

    Returns:
        The array, in C order.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it has another type, shape or size, or cannot be read.
    """
    try:
        with path.open("rb") as stream:
            shape, fortran_order, dtype = _read_header(stream, path)
            size, start = os.fstat(stream.fileno()).st_size, stream.tell()
            if len(shape) == 1 and shape[0] == 0 and len(expected.shape) == 2:
                shape = (0, expected.shape[1] or 0)
            if dtype != np.dtype(expected.dtype):
                raise FormatError(path, expected=f"{np.dtype(expected.dtype).name} values", found=dtype.name)
            if len(shape) != len(expected.shape) or any(
                length not in (None, found) for length, found in zip(expected.shape, shape, strict=True)
            ):
                raise FormatError(path, expected=f"an array of {_text(expected.shape)} values", found=_text(shape))
            count = int(np.prod(shape, dtype=np.int64))
            if size - start != count * dtype.itemsize:
                raise FormatError(
                    path,
                    expected=f"{start + count * dtype.itemsize} bytes ({_text(shape)} {dtype.name})",
                    found=str(size),
                    advice="the file is cut short, or something was added",
                )
            array = np.fromfile(stream, dtype, count)
    except FileNotFoundError as error:
        raise MissingDataError(path, expected="a file", found="nothing") from error
    except OSError as error:
        raise FormatError(path, problem=f"cannot be read: {error.strerror or error}") from error
    return np.ascontiguousarray(array.reshape(shape, order="F" if fortran_order else "C"))


def _read_header(stream: BinaryIO, path: Path) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return the shape, whether the order is Fortran's, and the type that the header of a .npy file names."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        version = np.lib.format.read_magic(stream)
        if version not in readers:
            raise ValueError(f"version {version} of the .npy format")
        shape, fortran_order, dtype = readers[version](stream)
    except ValueError as error:
        raise FormatError(path, expected="a .npy array", found="something else", advice=str(error)) from error
    return shape, fortran_order, dtype


def _text(shape: tuple[int | None, ...]) -> str:
    return " x ".join("N" if length is None else str(length) for length in shape)
