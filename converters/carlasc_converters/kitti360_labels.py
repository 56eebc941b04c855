"""Labels of KITTI-360's scans, from its accumulated point clouds, because scans have no labels.

A cloud covers a window of frames. `static/` holds static points; `dynamic/` holds moving points,
with the frame of each as its time stamp.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import (
    AnyIntArray,
    FloatArray,
    IntArray,
    RecordArray,
    Uint16Array,
    Uint32Array,
)
from carlasc.core.scans import check_finite
from carlasc.errors import import_extra
from carlasc_converters.files import Version, version_of
from carlasc_converters.ply import PlyVertices

MAX_DISTANCE_M = 0.2  # a point farther than this from every labelled one stays unlabelled
_WINDOW = re.compile(r"(\d{10})_(\d{10})\.ply")
_PER_CLASS = 1000  # instance = 1000 * class + number in the class, 0 for none
_MAX_CLASS = (
    65535  # values that do not fit into 16 bits are no classes, and are reported as this one
)
_COLUMNS = ("x", "y", "z", "semantic", "instance")


@dataclass(frozen=True)
class Labelled:
    """Points with labels, prepared for the search of nearest neighbours.

    Attributes:
        tree: a `scipy.spatial.cKDTree` of the points; None if there are none.
        labels: (N,) uint16 class ids.
        instances: (N,) uint32.
    """

    tree: Any
    labels: Uint16Array
    instances: Uint32Array

    @classmethod
    def of(cls, rows: RecordArray, where: str) -> Labelled:
        """Return the points of some vertices of a file, which is named in errors.

        Raises:
            FormatError: a coordinate is not finite.
        """
        spatial = import_extra("scipy.spatial", "kitti")
        points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
        check_finite(points, where)
        # An unbalanced tree is built several times faster, and searched as fast if points are on
        # surfaces.
        tree = (
            spatial.cKDTree(points, leafsize=32, compact_nodes=False, balanced_tree=False)
            if len(rows)
            else None
        )
        labels = np.clip(rows["semantic"], 0, _MAX_CLASS).astype(np.uint16)
        numbered = np.clip(rows["instance"], 0, None).astype(np.uint32)
        return cls(tree, labels, np.where(numbered % _PER_CLASS > 0, numbered, 0).astype(np.uint32))

    def nearest(self, points: FloatArray) -> tuple[FloatArray, IntArray]:
        """Return the distance and the index of the nearest point for each of (M, 3) points;
        infinite if none is near enough.
        """
        if self.tree is None:
            return np.full(len(points), np.inf), np.zeros(len(points), np.int64)
        finite = np.asarray(np.isfinite(points).all(axis=1))
        distances, indices = self.tree.query(
            np.where(finite[:, None], points, 0.0), distance_upper_bound=MAX_DISTANCE_M
        )
        distances[~finite] = np.inf
        return distances, np.where(np.isfinite(distances), indices, 0)


def windows_of(static: Path) -> dict[str, tuple[int, int]]:
    """Return the first and the last frame of each window, by the name of its file; empty if the
    folder does not exist.
    """
    names: Iterable[str] = (path.name for path in static.iterdir()) if static.is_dir() else ()
    matches = {name: match for name in sorted(names) if (match := _WINDOW.fullmatch(name))}
    return {name: (int(match[1]), int(match[2])) for name, match in matches.items()}


def window_at(windows: dict[str, tuple[int, int]], frame: int) -> str | None:
    """Return the window in which a frame is farthest from both ends, because windows overlap; None
    without a window.
    """
    depths = {name: min(frame - first, last - frame) for name, (first, last) in windows.items()}
    best = max(depths, key=lambda name: depths[name], default=None)
    return best if best is not None and depths[best] >= 0 else None


def label_points(
    folder: Path, window: str, frame: int, world: FloatArray
) -> tuple[Uint16Array, Uint32Array]:
    """Return the class and the instance of each point of a scan: those of the nearest labelled
    point within `MAX_DISTANCE_M`.

    Static points are used in all frames of the window, moving points only in their own frame.

    Args:
        folder: the folder that holds static/ and dynamic/.
        window: the name of the window's files.
        frame: number of the scan.
        world: (N, 3) the points, in the frame of the world.

    Raises:
        FormatError: a file is damaged, or its points have no labels.
        DependencyError: scipy is not installed.
    """
    labels = np.zeros(len(world), np.uint16)
    instances = np.zeros(len(world), np.uint32)
    nearest = np.full(len(world), np.inf)
    moving = (
        _moving(str(folder / "dynamic" / window), frame)
        if (folder / "dynamic" / window).is_file()
        else None
    )
    static = str(folder / "static" / window)
    for cloud in (_standing(static, version_of(static, "labelled points")), moving):
        if cloud is not None:
            distances, indices = cloud.nearest(world)
            nearer = distances < nearest
            labels[nearer] = cloud.labels[indices[nearer]]
            instances[nearer] = cloud.instances[indices[nearer]]
            nearest = np.minimum(nearest, distances)
    return labels, instances


@lru_cache(maxsize=1)  # one window per process, because frames are read in order
def _standing(path: str, version: Version) -> Labelled:
    return Labelled.of(PlyVertices.open(path, _COLUMNS).read(), path)


@lru_cache(maxsize=1)
def _by_time(path: str, version: Version) -> tuple[RecordArray, AnyIntArray]:
    """Return the vertices of a dynamic file by increasing time stamp, and their time stamps."""
    rows = np.array(PlyVertices.open(path, (*_COLUMNS, "timestamp")).read())
    rows = rows[np.argsort(rows["timestamp"], kind="stable")]
    return rows, np.ascontiguousarray(rows["timestamp"])


def _moving(path: str, frame: int) -> Labelled:
    rows, stamps = _by_time(path, version_of(path))
    first, last = np.searchsorted(stamps, [frame, frame + 1])
    return Labelled.of(rows[first:last], path)
