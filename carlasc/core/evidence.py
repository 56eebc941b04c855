"""What is known of a voxel besides its class: how certain it is, and where the knowledge comes from.

See the format page, `docs/format.md#evidence`.
"""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray


class VoxelFlag(IntFlag):
    """The bits of the field `<grid>/flags`: uint8 per voxel.

    `(flags & VoxelFlag.INFERRED) != 0` is true for inferred voxels.

    Attributes:
        INFERRED: no scan saw the voxel; it was completed from what was seen of the same object.
        CONTESTED: traffic passes through the voxel at other times of the window.
        SEEN_NOW: the frame's own scan saw the voxel.
        IN_ACTOR: the voxel is in the body of an actor.
    """

    INFERRED = 1
    CONTESTED = 2
    SEEN_NOW = 4
    IN_ACTOR = 8


def is_confident(occupied: NDArray[np.floating], min_confidence: float) -> NDArray[np.bool_]:
    """Return which voxels are free or occupied with at least some probability.

    Args:
        occupied: probability that each voxel is occupied, of any shape. It is compared as float16, as in the file, so that a grid
            and its file give the same result.
        min_confidence: least value of max(p, 1 - p); 0 to 0.5 accepts every voxel.

    Returns:
        bool array of the same shape; False where the probability is NaN.
    """
    p = np.asarray(occupied, np.float16)
    confident: NDArray[np.bool_] = np.maximum(p, 1 - p) >= np.float16(min_confidence)
    return confident
