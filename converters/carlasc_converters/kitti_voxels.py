"""SemanticKITTI's voxel files: labels as uint16, masks of one bit a voxel, first voxel in the highest bit (FORMAT section 6)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from carlasc.converting import VoxelContent
from carlasc.core.grids import GridSpec
from carlasc.errors import FormatError

GRID = GridSpec("cartesian", (256, 256, 32), (0.0, -25.6, -2.0), (51.2, 25.6, 4.4))
MASKS = (".bin", ".invalid", ".occluded")
_SUFFIXES = (".label", *MASKS)


def pack_bits(mask: NDArray[np.bool_]) -> bytes:
    """Return a mask as bits, C order, most significant bit first."""
    return np.packbits(mask.reshape(-1)).tobytes()


def unpack_bits(data: bytes, size: tuple[int, int, int], where: str) -> NDArray[np.bool_]:
    """Read a mask.

    Raises:
        FormatError: the number of bytes does not fit the size.
    """
    voxels = int(np.prod(size))
    if len(data) != -(-voxels // 8):
        raise FormatError(
            where, expected=f"{-(-voxels // 8)} bytes of packed bits", found=f"{len(data)}", advice="cut short?"
        )
    return np.unpackbits(np.frombuffer(data, np.uint8), count=voxels).reshape(size).astype(np.bool_)


def read_voxel_files(folder: Path, frame: int) -> VoxelContent | None:
    """Read the voxels of a frame: labels, and what is known of them; None where there are no labels.

    A raw 0 is empty; an invalid voxel is not known.

    Raises:
        FormatError: a file has another size.
    """
    files = {
        f"{frame:06d}{suffix}": path.read_bytes()
        for suffix in _SUFFIXES
        if (path := folder / f"{frame:06d}{suffix}").is_file()
    }
    data = files.get(f"{frame:06d}.label")
    if data is None:
        return None
    voxels = int(np.prod(GRID.size))
    if len(data) != 2 * voxels:
        raise FormatError(
            f"{folder / f'{frame:06d}.label'}",
            expected=f"{2 * voxels} bytes (256 x 256 x 32 uint16)",
            found=f"{len(data)}",
            advice="cut short?",
        )
    labels = np.frombuffer(data, "<u2").reshape(GRID.size)
    known = np.ones(GRID.size, np.bool_)
    invalid = files.get(f"{frame:06d}.invalid")
    if invalid is not None:
        known = ~unpack_bits(invalid, GRID.size, str(folder / f"{frame:06d}.invalid"))
    return VoxelContent(labels, known, files)
