"""Which image of a camera belongs to each frame: the nearest in time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def nearest_images(
    paths: Mapping[int, Path], frames: NDArray[np.int64], within: int
) -> tuple[NDArray[np.int64], NDArray[np.bool_], tuple[str, ...]]:
    """Return the stamp of the image nearest to each frame, whether it is near enough, and its absolute path, "" where it is not.

    Args:
        paths: the images by stamp; one at least.
        frames: (F,) stamps of the frames, in the same unit.
        within: images that are farther away belong to no frame.
    """
    stamps = np.array(sorted(paths), np.int64)
    after = np.minimum(np.searchsorted(stamps, frames).clip(1), len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(stamps[after] - frames) < np.abs(frames - stamps[before]), stamps[after], stamps[before])
    near = np.abs(nearest - frames) < within
    found = (str(paths[at].absolute()) if ok else "" for at, ok in zip(nearest.tolist(), near, strict=True))
    return nearest, near, tuple(found)
