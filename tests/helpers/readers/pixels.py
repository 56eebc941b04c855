"""Finding colours in pictures, and small grids to draw."""

from __future__ import annotations

import numpy as np

from carlasc.core.grids import Grid, GridSpec

RED, BLUE, WHITE = 4, 10, 0  # Pedestrian and Vehicle: the reddest and the bluest of CARLA's classes


def red_pixels(picture):
    """Return (H, W) bool: clearly red, in the sun or in the shade."""
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return (red > 70) & (red > 3 * green) & (red > 2 * blue)


def blue_pixels(picture):
    """Return (H, W) bool: clearly blue, in the sun or in the shade."""
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return (blue > 50) & (blue > 3 * red) & (blue > 3 * green)


def middle_of(mask):
    """Return the mean (column, row) of a mask's pixels."""
    assert mask.any(), "nothing of that colour in the picture"
    rows, columns = np.nonzero(mask)
    return columns.mean(), rows.mean()


def has_color(picture, color, tolerance=3):
    """Return whether a colour occurs in a picture."""
    return bool((np.abs(picture.astype(int) - color).max(-1) <= tolerance).any())


def grid_with(blocks, spec=None, size_m=1.2):
    """Return a free grid with cubes of given classes, {(x, y, z) in metres: class}."""
    spec = spec or GridSpec.published("cartesian")
    labels = np.zeros(spec.size, np.uint32)
    offsets = np.linspace(-size_m / 2, size_m / 2, 13)
    cube = np.stack(np.meshgrid(offsets, offsets, offsets, indexing="ij"), -1).reshape(-1, 3)
    for center, label in blocks.items():
        flat = spec.flat_index(np.asarray(center) + cube)
        labels.reshape(-1)[flat[flat >= 0]] = label
    return Grid(spec, labels, np.ones(spec.size, np.float32))
