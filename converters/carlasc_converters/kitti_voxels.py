"""SemanticKITTI's voxel files: uint16 labels, and masks of one bit per voxel.

See the format page, `docs/format.md#semantickitti`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from carlasc.converting import VoxelContent
from carlasc.core.arrays import BoolArray
from carlasc.core.grids import GridSpec
from carlasc.errors import FormatError
from carlasc_converters.files import read_bytes

GRID = GridSpec("cartesian", (256, 256, 32), (0.0, -25.6, -2.0), (51.2, 25.6, 4.4))
MASKS = (".bin", ".invalid", ".occluded")
_SUFFIXES = (".label", *MASKS)
_COPY = "the file is incomplete: copy it again"


def pack_bits(mask: BoolArray) -> bytes:
    """Return a mask as packed bits: C order, the first voxel in the most significant bit."""
    return np.packbits(mask.reshape(-1)).tobytes()


def unpack_bits(data: bytes, size: tuple[int, int, int], where: str) -> BoolArray:
    """Return the mask of `size` that packed bits hold.

    Raises:
        FormatError: the number of bytes does not fit the size; `where` is the file.
    """
    voxels = int(np.prod(size))
    if len(data) != -(-voxels // 8):
        raise FormatError(
            where,
            expected=f"{-(-voxels // 8)} bytes of packed bits",
            found=len(data),
            advice=_COPY,
        )
    return np.unpackbits(np.frombuffer(data, np.uint8), count=voxels).reshape(size).astype(np.bool_)


def _height_of(voxels: int) -> str:
    """Return the size of a grid with the columns of the benchmark in words; "" for another one."""
    return "" if voxels % (256 * 256) else f" (256 x 256 x {voxels // (256 * 256)} uint16)"


def read_voxel_files(folder: Path, frame: int) -> VoxelContent | None:
    """Read a frame's voxel files; None if the frame has no labels.

    A voxel of class 0 is free; an invalid voxel is unknown.

    Raises:
        FormatError: the size of a file does not fit the grid.
    """
    files = {
        f"{frame:06d}{suffix}": read_bytes(path)
        for suffix in _SUFFIXES
        if (path := folder / f"{frame:06d}{suffix}").is_file()
    }
    data = files.get(f"{frame:06d}.label")
    if data is None:
        return None
    voxels = int(np.prod(GRID.size))
    if len(data) != 2 * voxels:
        raise FormatError(
            folder / f"{frame:06d}.label",
            expected=f"{2 * voxels} bytes (256 x 256 x 32 uint16)",
            found=str(len(data)) + _height_of(len(data) // 2),
            advice=_COPY if len(data) % (2 * 256 * 256) else "export a grid of that size",
        )
    labels = np.frombuffer(data, "<u2").reshape(GRID.size)
    known = np.ones(GRID.size, np.bool_)
    invalid = files.get(f"{frame:06d}.invalid")
    if invalid is not None:
        known = ~unpack_bits(invalid, GRID.size, str(folder / f"{frame:06d}.invalid"))
    return VoxelContent(labels, known, files)
