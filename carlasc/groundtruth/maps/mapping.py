"""`carlasc.map`: a map of the static points of a drive, or of a grid, and the bodies of the actors
of a drive.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from carlasc.core.arrays import AnyArray, FloatArray, IntArray
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.geometry import invert, mirror_poses, transform_points
from carlasc.core.grids import GridSpec, mirror_voxels
from carlasc.errors import ArgumentError, MissingDataError, check_types
from carlasc.groundtruth.from_scans.feed import ScanFeed, WithoutScans
from carlasc.groundtruth.from_scans.merging import Merger
from carlasc.groundtruth.from_scans.sequences import ScanSequence, scan_sequences
from carlasc.groundtruth.inputs import GridPlan, choose_frames
from carlasc.groundtruth.maps.cloud_files import POINT_DTYPE, PointPieces, write_points
from carlasc.groundtruth.maps.growing_cells import (
    STATIC,
    GrowingCells,
    Part,
    cells_of,
    rows_of_scan,
    split,
)
from carlasc.groundtruth.maps.map_files import ACTORS, MapCells, MapFiles, write_distances
from carlasc.groundtruth.options import FromScans, Voting
from carlasc.motion import HORIZON_S, Track
from carlasc.motion.options import MotionOptions, PoseOptions
from carlasc.motion.tracks import MovingActors
from carlasc.running.processes import one_pool, run_all
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import as_source, layout
from carlasc.storage.derived_copies import check_complete
from carlasc.storage.files import AnyPath, to_json, write_atomic, writing
from carlasc.storage.folder import FolderWriter
from carlasc.storage.inputs import MadeFrom, combined, sequence_states
from carlasc.storage.protocol import Sequence, Source

_LEAST_CELL_M = 0.001  # smaller cells are finer than float32 positions


@dataclass(frozen=True)
class MapResult:
    """The result of `map`.

    Attributes:
        files: the files, and the folder of actors.
        points: number of points, or of occupied voxels.
        frames: number of scans; 1 for a grid.
        actors: number of actors whose bodies were written.
        notes: remarks on the results, one line each.
        elapsed_s: duration, in seconds.
    """

    files: tuple[str, ...]
    points: int
    frames: int
    actors: int
    notes: tuple[str, ...]
    elapsed_s: float


def map(
    source: AnyPath | Source,
    out: AnyPath | None = None,
    *,
    cell_m: float = 0.05,
    frames: Frames = None,
    grid: str | None = None,
    actors: bool = False,
    mesh: AnyPath | None = None,
    distance: AnyPath | None = None,
    motion: MotionOptions = MotionOptions(),  # noqa: B008 (frozen)
    poses: PoseOptions = PoseOptions(),  # noqa: B008 (frozen)
    overwrite: bool = False,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> MapResult:
    """Write a map of a drive: the static points of its scans in one frame, one point per cell,
    without moving points.

    The frame is that of the drive's poses, in right-handed axes: x ahead, y to the left, z up, at
    the first scan. Each point is the mean of the points in its cell. Its class has the most votes,
    one vote per scan; `seen` is the number of scans; `confidence` is the share of the votes for the
    class with one more vote against it: 0.5 for a cell that one scan saw. Moving points are found
    as in `regrid`. With `grid`, the map is a grid of one frame instead, in the frame of its sensor.

    Args:
        source: a data set with one sequence: anything that `carlasc.open` takes, or a source.
        out: the file of the map: .ply, .pcd, .las or .npz (points), or .bt (OctoMap). None: only
            the files `mesh` and `distance`.
        cell_m: size of a cell, in metres: one point is written per cell. A grid has its own cells.
        frames: range of frame numbers; None for all. Moving actors are searched for in a few more
            seconds. With `grid`, one frame.
        grid: make the map from this grid of one frame, instead of the scans.
        actors: also write the body of each moving actor, in its own frame, to the folder
            OUT_actors, and their poses to actors.json.
        mesh: file of the surface of the occupied cells, with classes as colours: .ply or .glb.
        distance: with `grid`: .npz file of the distance of each voxel from the surface.
        motion: how moving points are found.
        poses: where poses come from. Missing poses are estimated from the scans, unless
            `PoseOptions("file")` is given.
        overwrite: replace existing files.
        run: how the work is spread. Steps of progress are scans.

    Returns:
        The files that were written.

    Raises:
        ArgumentError: an ending that is not known, cells that OctoMap cannot hold, or an argument
            that does not fit.
        MissingDataError: there is no scan, no pose, no such grid, or nothing static.
        ConflictError: a file exists.
        CompleteError: the files of this call exist.
        FormatError: a scan, poses or times are not valid.
        DependencyError: a file needs a package that is not installed, or poses have to be
            estimated, and kiss-icp is not installed.
        StorageError: a file cannot be written.
    """
    check_types(map, locals())
    began = time.perf_counter()
    if not (math.isfinite(cell_m) and cell_m >= _LEAST_CELL_M):
        raise ArgumentError(
            "cell_m", expected=f"{_LEAST_CELL_M:g} metres or more", found=str(cell_m)
        )
    if run.part.count > 1:
        raise ArgumentError("part", expected="none, as a map is one file", found=str(run.part))
    files = MapFiles.of(out, mesh, distance, actors, grid)
    opened, wanted = as_source(source), FrameRange.of(frames)
    first, settings = files.all[0], (cell_m, str(wanted), grid, [str(path) for path in files.all])
    states = sequence_states(opened, *([f"{grid}/labels", f"{grid}/counts"] if grid else []))
    record = MadeFrom(combined(settings, motion, poses, sorted(states.items())))
    keeper, kept = FolderWriter(first.parent), f"map-{first.name}"
    if not overwrite and all(path.exists() for path in files.all):
        check_complete(first, MadeFrom.read(keeper, kept) == record)
    files.check(overwrite)
    count, bodies, notes = (
        1,
        0,
        tuple[str, ...](),
    )
    if grid is not None:
        points = write_grid(opened, grid, wanted, files)
    else:
        options = FromScans(window=(0, 0), motion=motion, poses=poses)
        with files.folder() as folder:
            drive = DriveMap.of(opened, wanted, options, GrowingCells(Path(folder), cell_m))
            drive.fill(run, actors)
            points, count, notes = drive.write(files), len(drive.frames), drive.notes()
            if files.actors is not None and files.out is not None:
                bodies = drive.write_actors(files.actors, files.out.suffix.lower())
    record.write(keeper, kept)
    return MapResult(
        tuple(str(path) for path in files.all),
        points,
        count,
        bodies,
        notes,
        time.perf_counter() - began,
    )


_BLOCK = 10  # number of scans that a worker sums


@dataclass
class DriveMap:
    """The map of a drive.

    Attributes:
        inputs: the scans, their poses, and the moving actors.
        frames: the frames whose scans are in the map.
        cells: the map.
    """

    inputs: ScanSequence
    frames: list[int]
    cells: GrowingCells

    @classmethod
    def of(
        cls, source: Source, frames: FrameRange, options: FromScans, cells: GrowingCells
    ) -> Self:
        """Find the one sequence of a source.

        Scans far from the chosen frames are hidden: their motion does not matter.
        """
        plan = GridPlan(GridSpec.published(), "map", options, Voting(), frames)
        sequence = only(
            [
                one.sequence
                for one in scan_sequences(source, plan, options)
                if isinstance(one, ScanSequence)
            ]
        )
        known = sequence.frames("points")
        chosen = choose_frames(frames, known, sequence.location)
        around = round(HORIZON_S / layout.FRAME_PERIOD_S)
        hidden = known[(known < chosen[0] - around) | (known > chosen[-1] + around)].tolist()
        view = WithoutScans(sequence, hidden) if hidden else sequence
        return cls(ScanSequence(view, plan, options), chosen, cells)

    def fill(self, run: Run, actors: bool) -> None:
        """Refine poses, find moving actors, and add the static points of each scan; with `actors`,
        add the points of actors too.
        """
        inputs = self.inputs
        progress = StepCounter(run.progress, inputs.steps_before + len(self.frames))
        progress(0)
        with one_pool(run) as pool:
            inputs.prepare(None, pool, progress)
            blocks = [
                tuple(self.frames[first : first + _BLOCK])
                for first in range(0, len(self.frames), _BLOCK)
            ]
            items = ((block, inputs.actors.between(block[0], block[-1])) for block in blocks)
            with closing(
                run_all(_AddScans(inputs.feed, self.cells.cell_m, actors), items, pool)
            ) as added:
                for block, pieces in zip(blocks, added, strict=True):
                    self.cells.add(pieces)
                    progress(len(block))
        self.cells.finish()

    def write(self, files: MapFiles) -> int:
        """Write the map, and return the number of its points.

        Raises:
            MissingDataError: there are none.
        """
        name = self.inputs.sequence.name or self.inputs.path or "a drive"
        points = self._pieces(STATIC, f"map of {name}, metres, x ahead, y left, z up")
        if not points.count:
            raise MissingDataError(
                self.inputs.location, expected="points of something static", found="none"
            )
        files.write(points, self._whole)
        return points.count

    def _whole(self) -> MapCells:
        whole = np.concatenate([np.empty(0, POINT_DTYPE), *self.cells.points()])
        size = np.full(3, self.cells.cell_m)
        return MapCells(cells_of(whole, self.cells.cell_m), whole["label"], np.zeros(3), size)

    def _pieces(self, group: int, about: str) -> PointPieces:
        count = sum(number for part, number in self.cells.counts.items() if part[0] == group)
        return PointPieces(
            count, lambda: self.cells.points(group), self.inputs.metadata.classes, about
        )

    def write_actors(self, folder: Path, ending: str) -> int:
        """Write the body of each actor, in its own frame, and its poses; return the number of
        actors.
        """
        table, made = list[dict[str, Any]](), self.cells.folder / folder.name
        made.mkdir()
        for number in sorted({part[0] for part in self.cells.counts} - {STATIC}):
            about = self._about(number, self.inputs.actors.tracks[number]) | {
                "file": f"{number:04}{ending}"
            }
            text = f"actor {number}, {about['class']}, metres, x forward, y left, z up"
            write_points(made / about["file"], self._pieces(number, text))
            table.append(about)
        write_atomic(made / ACTORS, to_json(table))
        with writing(folder):
            if folder.exists():
                shutil.rmtree(folder)
            made.rename(folder)
        return len(table)

    def _about(self, number: int, track: Track) -> dict[str, Any]:
        frames = [frame for frame in self.frames if track.pose(frame) is not None]
        poses = track.world_T_actor[np.array(frames) - track.first]
        poses = mirror_poses(poses) if self.inputs.metadata.axes == "left" else poses
        return {
            "number": number,
            "class": self.inputs.metadata.classes.names[track.label],
            "rigid": track.rigid,
            "confidence": track.confidence,
            "size_m": track.size.tolist(),
            "frames": frames,
            "map_T_actor": poses[:, :3].reshape(-1, 12).tolist(),
        }

    def notes(self) -> tuple[str, ...]:
        """Return remarks on the results, one line each."""
        where, notes, metadata = self.inputs.location, self.inputs.findings(), self.inputs.metadata
        if self.inputs.feed.has_labels:
            notes.append(f"{where}: classes {self.inputs.sequence.table_use()}")
        if not self.inputs.feed.has_labels:
            notes.append(
                f"{where}: the scans have no labels: the map contains geometry only, in one class"
            )
        elif metadata.predicted:
            notes.append(f"{where}: classes are those of labels that were {metadata.predicted}")
        return tuple(notes)


@dataclass(frozen=True)
class _AddScans:
    """Sums the scans of a block, in a worker."""

    feed: ScanFeed
    cell_m: float
    actors: bool

    def __call__(self, block: tuple[tuple[int, ...], MovingActors]) -> list[tuple[Part, AnyArray]]:
        frames, actors = block
        merger = Merger(self.feed.read, actors, self.feed.classes, "align")
        of_scans = [rows for frame in frames for rows in self._rows(merger, frame)]
        parts, rows = zip(*of_scans, strict=True)
        return split(np.concatenate(parts), np.concatenate(rows))

    def _rows(self, merger: Merger, frame: int) -> Iterator[tuple[IntArray, AnyArray]]:
        """Yield the cells of the static points of a scan, then, if `actors` is set, those of each
        actor.
        """
        feed, scan = self.feed, self.feed.read(frame)
        labels, static = merger.labels(frame), merger.static(frame)
        if feed.must_find_ground:  # ground that was found had a class for the votes only
            labels[np.isin(labels, sorted(feed.classes.ground))] = feed.classes.geometry_id
        world = transform_points(scan.world_T_sensor, scan.points.astype(np.float64))
        chosen: list[tuple[int, AnyArray, FloatArray]] = [
            (STATIC, np.flatnonzero(static), world[static])
        ]
        for number, track in merger.actors.tracks.items() if self.actors else ():
            members, pose = track.members.get(frame), track.pose(frame)
            if members is not None and pose is not None:
                chosen.append((number, members, transform_points(invert(pose), world[members])))
        for group, points, places in chosen:
            right = places * (1, -1, 1) if feed.sequence.metadata.axes == "left" else places
            sure = None if scan.sure is None else scan.sure[points]
            yield rows_of_scan(right, labels[points], sure, group, self.cell_m)


def write_grid(source: Source, name: str, frames: FrameRange, files: MapFiles) -> int:
    """Write the occupied voxels of a grid, in right-handed axes, and return their number.

    Raises:
        MissingDataError: there is no such grid, or nothing in it is occupied.
        ArgumentError: several sequences or frames have it, or it is not Cartesian.
    """
    having = [one for one in source.sequences().values() if name in one.grids]
    if not having:
        names = sorted({grid for one in source.sequences().values() for grid in one.grids})
        raise MissingDataError(
            source.location, expected=f"the grid {name}", found=", ".join(names) or "no grid"
        )
    sequence = only(having)
    where = f"{sequence.location}/{name}"
    chosen = choose_frames(frames, sequence.frames(f"{name}/labels"), where)
    if len(chosen) > 1:
        raise ArgumentError(
            "frames", expected="one frame of the grid", found=f"{len(chosen)}, from {chosen[0]}"
        )
    given = sequence.grid(name, chosen[0])
    if given.spec.coordinates != "cartesian":
        raise ArgumentError(
            "grid", expected="a Cartesian grid", found=f"{name}, a {given.spec.coordinates} one"
        )
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
    pieces = PointPieces(
        len(points), lambda: iter([points]), sequence.metadata.classes, f"voxels of {where}"
    )
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
