"""`carlasc.map`: maps of drives, and of grids."""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass
from pathlib import Path

from carlasc.core.frames import FrameRange, Frames
from carlasc.errors import ArgumentError
from carlasc.groundtruth.maps.drive_map import DriveMap
from carlasc.groundtruth.maps.grid_map import write_grid
from carlasc.groundtruth.maps.growing_cells import GrowingCells
from carlasc.groundtruth.maps.map_files import MapFiles
from carlasc.groundtruth.options import FromScans
from carlasc.motion.options import MotionOptions, PoseOptions
from carlasc.running.spreading import Run
from carlasc.storage import as_source
from carlasc.storage.protocol import Source

_LEAST_CELL_M = 0.001  # less is finer than float32 positions are


@dataclass(frozen=True)
class MapResult:
    """What `map` wrote.

    Attributes:
        files: the files, and the folder of actors.
        points: number of points, or of occupied voxels.
        frames: number of scans; 1 for a grid.
        actors: number of actors whose bodies were written.
        notes: remarks about what was found, one line each.
        elapsed_s: duration, in seconds.
    """

    files: tuple[str, ...]
    points: int
    frames: int
    actors: int
    notes: tuple[str, ...]
    elapsed_s: float


def map(
    source: str | os.PathLike[str] | Source,
    out: str | os.PathLike[str] | None = None,
    *,
    cell_m: float = 0.05,
    frames: Frames = None,
    grid: str | None = None,
    movers: bool = False,
    mesh: str | os.PathLike[str] | None = None,
    distance: str | os.PathLike[str] | None = None,
    motion: MotionOptions = MotionOptions(),  # noqa: B008 (frozen)
    poses: PoseOptions = PoseOptions(),  # noqa: B008 (frozen)
    overwrite: bool = False,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> MapResult:
    """Write a map of a drive: the static points of its scans in one frame, one point per cell, without what moves.

    The frame is that of the drive's poses, in right-handed axes: x ahead, y to the left, z up, at the first scan. Each point is the mean of
    the points in its cell. Its class is that for which most scans vote, one vote per scan; `seen` is their number; `confidence` is the
    share of the votes for the class where one more vote is against it: 0.5 for a cell that one scan saw. What moves is found as `regrid`
    finds it. With `grid`, the map is a grid of one frame instead, in the frame of its sensor.

    Args:
        source: what has one sequence: anything that `carlasc.open` takes, or a source.
        out: the file of the map: .ply, .pcd, .las or .npz (points), or .bt (OctoMap). None: only what `mesh` and `distance` ask for.
        cell_m: size of a cell, metres; a grid has its own cells.
        frames: range of frame numbers; None for all. What moves is looked for in a few seconds more. With `grid`, it must hold one frame.
        grid: name of the grid that is the map.
        movers: also write the body of each actor that moves, in its own frame, to the folder `<out>_movers`, with `actors.json`: its poses.
        mesh: file of the surface of the occupied cells, with the colours of classes: .ply or .glb.
        distance: .npz file of each voxel's distance from the surface, with `grid`: see `docs/commands/map.md`.
        motion: what tells which points move, and how.
        poses: where poses come from. Those of a sequence without any are estimated from its scans, unless `PoseOptions("file")` is given.
        overwrite: replace files that exist.
        run: how the work is spread. Steps of progress are scans.

    Returns:
        What was written.

    Raises:
        ArgumentError: an ending that is not known, cells that OctoMap cannot hold, or an argument that does not fit.
        MissingDataError: there is no scan, no pose, no such grid, or nothing static.
        ConflictError: a file exists.
        FormatError: a scan, poses or times are not valid.
        DependencyError: a file needs a package that is not installed, or poses have to be estimated, and kiss-icp is not installed.
        StorageError: a file cannot be written.
    """
    began = time.perf_counter()
    if not (math.isfinite(cell_m) and cell_m >= _LEAST_CELL_M):
        raise ArgumentError("cell_m", expected=f"{_LEAST_CELL_M:g} metres or more", found=str(cell_m))
    if run.part.count > 1:
        raise ArgumentError("part", expected="none, as a map is one file", found=str(run.part))
    files = MapFiles.of(out, mesh, distance, movers, grid)
    files.check(overwrite)
    opened, wanted, count, actors, notes = as_source(source), FrameRange.of(frames), 1, 0, tuple[str, ...]()
    if grid is not None:
        points = write_grid(opened, grid, wanted, files)
    else:
        options = FromScans(window=(0, 0), motion=motion, poses=poses)
        with files.folder() as folder:
            drive = DriveMap.of(opened, wanted, options, GrowingCells(Path(folder), cell_m))
            drive.fill(run, movers)
            points, count, notes = drive.write(files), len(drive.frames), drive.notes()
            if files.movers is not None and files.out is not None:
                actors = drive.write_actors(files.movers, files.out.suffix.lower())
    return MapResult(tuple(str(path) for path in files.all), points, count, actors, notes, time.perf_counter() - began)
