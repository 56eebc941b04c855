"""The image of a camera for each frame: the nearest in time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from carlasc.core.arrays import BoolArray, IntArray


def nearest_rows(stamps: IntArray, frames: IntArray) -> IntArray:
    """Return (F,) the row of the stamp nearest to each frame.

    Args:
        stamps: (N,) increasing; one at least.
        frames: (F,) stamps of the frames, in the same unit.
    """
    after = np.minimum(np.searchsorted(stamps, frames).clip(1), len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(stamps[after] - frames) < np.abs(frames - stamps[before]), after, before)


def nearest_within(stamps: IntArray, frames: IntArray, within: float) -> list[int | None]:
    """Return the row of the stamp nearest to each frame; None if it is farther away than `within`.

    Args:
        stamps: (N,) increasing.
        frames: (F,) stamps of the frames, in the same unit.
        within: the greatest distance.
    """
    if not len(stamps):
        return [None] * len(frames)
    rows = nearest_rows(stamps, frames)
    near = np.abs(stamps[rows] - frames) <= within
    return [row if ok else None for row, ok in zip(rows.tolist(), near.tolist(), strict=True)]


def nearest_images(
    paths: Mapping[int, Path], frames: IntArray, within: int
) -> tuple[IntArray, BoolArray, tuple[str, ...]]:
    """Return the stamp of the image nearest to each frame, whether it is near enough, and its
    absolute path, "" where it is not.

    Args:
        paths: the images by stamp; one at least.
        frames: (F,) stamps of the frames, in the same unit.
        within: images that are farther away belong to no frame.
    """
    stamps = np.array(sorted(paths), np.int64)
    nearest = stamps[nearest_rows(stamps, frames)]
    near = np.abs(nearest - frames) < within
    names = (
        str(paths[at].absolute()) if ok else ""
        for at, ok in zip(nearest.tolist(), near, strict=True)
    )
    return nearest, near, tuple(names)
