"""Draws the points of a map, seen from above at an angle: `python docs/studies/map_picture.py MAP.npz OUT.png`. `carlasc map` makes MAP.npz."""

from __future__ import annotations

import sys

import numpy as np
from PIL import Image

from carlasc.core.tables import CARLA

WIDTH, HEIGHT = 1200, 560
AZIMUTH, ELEVATION = np.radians(-35), np.radians(38)
PIXELS_PER_M = 15.0


def draw(path: str, out: str) -> None:
    """Draw the points near the middle of a map, the nearer ones over the others, with a little shade by height."""
    with np.load(path) as made:
        points, labels = made["points"].astype(np.float64), made["label"]
    points = points - np.median(points, axis=0)
    turn = np.array([[np.cos(AZIMUTH), -np.sin(AZIMUTH)], [np.sin(AZIMUTH), np.cos(AZIMUTH)]])
    away, left = turn @ points[:, :2].T
    up = points[:, 2] * np.cos(ELEVATION) + away * np.sin(ELEVATION)
    depth = away * np.cos(ELEVATION) - points[:, 2] * np.sin(ELEVATION)
    columns = np.rint(WIDTH / 2 - left * PIXELS_PER_M).astype(int)
    rows = np.rint(HEIGHT / 2 - up * PIXELS_PER_M).astype(int)
    order = np.argsort(-depth)
    table = np.full((256, 3), 150.0)
    for label, color in CARLA.colors.items():
        table[label] = color
    shade = np.clip(0.75 + 0.05 * points[:, 2], 0.6, 1.0)[:, None]
    picture = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    for down in (0, 1):
        for right in (0, 1):
            row, column = rows[order] + down, columns[order] + right
            seen = (row >= 0) & (row < HEIGHT) & (column >= 0) & (column < WIDTH)
            picture[row[seen], column[seen]] = (table[labels] * shade)[order][seen]
    Image.fromarray(picture).quantize(256).save(out)


if __name__ == "__main__":
    draw(*sys.argv[1:3])
