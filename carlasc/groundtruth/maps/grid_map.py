"""A grid of one frame as a map."""

from __future__ import annotations

import numpy as np

from carlasc.core.axes import mirror_voxels
from carlasc.core.frames import FrameRange
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.groundtruth.inputs import choose_frames
from carlasc.groundtruth.maps.map_files import MapCells, MapFiles
from carlasc.groundtruth.maps.surfaces import write_distances
from carlasc.storage.cloud_files import POINT_DTYPE, PointPieces
from carlasc.storage.protocol import Sequence, Source


def write_grid(source: Source, name: str, frames: FrameRange, files: MapFiles) -> int:
    """Write the occupied voxels of a grid, in right-handed axes, and return their number.

    Raises:
        MissingDataError: there is no such grid, or nothing in it is occupied.
        ArgumentError: several sequences or frames have it, or it is not Cartesian.
    """
    having = [one for one in source.sequences().values() if name in one.grids]
    if not having:
        names = sorted({grid for one in source.sequences().values() for grid in one.grids})
        raise MissingDataError(source.location, expected=f"the grid {name}", found=", ".join(names) or "no grid")
    sequence = only(having)
    where = f"{sequence.location}/{name}"
    chosen = choose_frames(frames, sequence.frames(f"{name}/labels"), where)
    if len(chosen) > 1:
        raise ArgumentError("frames", expected="one frame of the grid", found=f"{len(chosen)}, from {chosen[0]}")
    given = sequence.grid(name, chosen[0])
    if given.spec.coordinates != "cartesian":
        raise ArgumentError("grid", expected="a Cartesian grid", found=f"{name}, a {given.spec.coordinates} one")
    grid = mirror_voxels(given) if sequence.metadata.axes == "left" else given
    lower, size = np.array(grid.spec.lower), grid.spec.voxel_size.astype(np.float64)
    index, labels = np.argwhere(grid.known), grid.labels[grid.known]
    occupied = grid.known & (grid.labels > 0)
    if not occupied.any():
        raise MissingDataError(where, expected="occupied voxels", found="none")
    points = np.zeros(int(occupied.sum()), POINT_DTYPE)
    for axis, middles in zip("xyz", (lower + (np.argwhere(occupied) + 0.5) * size).T, strict=True):
        points[axis] = middles
    points["label"] = grid.labels[occupied]
    points["seen"] = 1 if grid.counts is None else grid.counts[occupied]
    points["confidence"] = points["seen"] / (points["seen"] + 1.0)
    pieces = PointPieces(len(points), lambda: iter([points]), sequence.metadata.classes, f"voxels of {where}")
    files.write(pieces, lambda: MapCells(index, labels, lower, size))
    if files.distance is not None:
        write_distances(files.distance, given)
    return len(points)


def only(sequences: list[Sequence]) -> Sequence:
    """Return the one sequence.

    Raises:
        ArgumentError: there are several.
    """
    if len(sequences) != 1:
        few = ", ".join(one.path or one.location for one in sequences[:3])
        raise ArgumentError(
            "source",
            expected="one sequence, as a map has one frame",
            found=f"{len(sequences)} ({few}{', ...' if len(sequences) > 3 else ''})",
            advice="give the folder of one",
        )
    return sequences[0]
