"""The map of the static points of a drive, or of a grid, and the bodies of actors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from carlasc.core.arrays import AnyArray, FloatArray, IntArray
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import invert, mirror_poses, quaternions_of, transform_points
from carlasc.core.grids import GridSpec, mirror_voxels
from carlasc.errors import ArgumentError, MissingDataError, count, only
from carlasc.groundtruth.from_scans.feed import ScanFeed, WithoutScans
from carlasc.groundtruth.from_scans.merging import Merger
from carlasc.groundtruth.from_scans.sequences import ScanSequence, scan_sequences
from carlasc.groundtruth.inputs import GridPlan, choose_frames
from carlasc.groundtruth.maps.cloud_files import POINT_DTYPE, PointPieces, write_points
from carlasc.groundtruth.maps.growing_cells import (
    STATIC,
    UNDER,
    GrowingCells,
    Part,
    cells_of,
    rows_of_scan,
    split,
)
from carlasc.groundtruth.maps.map_files import ACTORS, MapCells, MapFiles, write_distances
from carlasc.groundtruth.options import FromScans, Voting
from carlasc.motion import HORIZON_S, Track
from carlasc.motion.evidence import views_of
from carlasc.motion.options import MotionOptions, PoseOptions
from carlasc.motion.parked import (
    Compared,
    View,
    compare_passes,
    find_gone,
    keys_of,
    other_passes,
    summed,
)
from carlasc.motion.tracks import MovingActors
from carlasc.running.processes import one_pool, run_all
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import layout
from carlasc.storage.files import temporary_folder, to_json, write_atomic, writing_folder
from carlasc.storage.protocol import Sequence, SequenceWriter, Source


class MapContent(NamedTuple):
    """What was written of a map.

    Attributes:
        points: number of points, or of occupied voxels.
        frames: number of scans; 1 for a grid.
        actors: number of actors whose bodies were written.
        parked: number of parked actors that were left out, as they are gone in another pass.
        notes: remarks on the results, one line each.
    """

    points: int
    frames: int
    actors: int
    parked: int
    notes: tuple[str, ...]


def write_map(
    source: Source,
    files: MapFiles,
    frames: FrameRange,
    cell_m: float,
    motion: MotionOptions,
    poses: PoseOptions,
    keep_parked: bool,
    writer: SequenceWriter,
    run: Run,
) -> MapContent:
    """Write the map of the one drive of a source; `writer` keeps refined poses and actors. For the
    other arguments and errors, see `carlasc.map`.
    """
    options = FromScans(window=(0, 0), motion=motion, poses=poses)
    with temporary_folder(files.all[0]) as folder:  # of cells that do not fit into memory
        drive = DriveMap.of(source, frames, options, GrowingCells(folder, cell_m))
        drive.fill(writer, run, files.actors is not None, keep_parked)
        points = drive.write(files)
        bodies = 0
        if files.trajectory is not None:
            drive.write_trajectory(files.trajectory)
        if files.boxes is not None:
            drive.inputs.box_table(drive.frames, refined=True).write(files.boxes)
        if files.actors is not None:
            bodies = drive.write_actors(files.actors, files.ending)
    return MapContent(points, len(drive.frames), bodies, drive.parked, drive.notes())


_BLOCK = 10  # number of scans that a worker sums


@dataclass
class DriveMap:
    """The map of a drive.

    Attributes:
        inputs: the scans, their poses, and the moving actors.
        frames: the frames whose scans are in the map.
        cells: the map.
        parked: number of parked actors that were left out, as they are gone in another pass.
    """

    inputs: ScanSequence
    frames: list[int]
    cells: GrowingCells
    parked: int = 0

    @classmethod
    def of(
        cls, source: Source, frames: FrameRange, options: FromScans, cells: GrowingCells
    ) -> Self:
        """Find the one sequence of a source.

        Scans far from the chosen frames are hidden: their motion does not matter.
        """
        plan = GridPlan(GridSpec.published(), "map", options, Voting(), frames)
        found = scan_sequences(source, plan, options)
        having = [one.sequence for one in found if isinstance(one, ScanSequence)]
        sequence = _only(having)
        known = sequence.frames("points")
        chosen = choose_frames(frames, known, sequence.location)
        near = with_neighbours(FrameRange(chosen[0], chosen[-1] + 1))
        hidden = [int(frame) for frame in known if frame not in near]
        view = WithoutScans(sequence, hidden) if hidden else sequence
        return cls(ScanSequence(view, plan, options), chosen, cells)

    def fill(
        self, writer: SequenceWriter, run: Run, actors: bool, keep_parked: bool = False
    ) -> None:
        """Refine poses, find moving actors and, unless they are kept, parked ones that leave, and
        add the static points of each scan; with `actors`, add the points of actors too. `writer`
        keeps poses and actors.
        """
        inputs = self.inputs
        progress = StepCounter(run.progress, inputs.steps_before + len(self.frames))
        progress(0)
        with one_pool(run) as pool:
            inputs.prepare(writer, pool, progress)
            gone = np.empty(0, np.int64)
            if inputs.feed.motion and not keep_parked:
                gone, self.parked = self._find_gone(pool, progress)
            blocks = _blocks(self.frames)
            items = ((block, inputs.actors.between(block[0], block[-1])) for block in blocks)
            with closing(
                run_all(_AddScans(inputs.feed, self.cells.cell_m, actors, gone), items, pool)
            ) as added:
                for block, pieces in zip(blocks, added, strict=True):
                    self.cells.add(pieces)
                    progress(len(block))
        self.cells.finish()

    def _find_gone(self, pool: Run, progress: StepCounter) -> tuple[IntArray, int]:
        """Return the cells of parked actors that are gone in another pass, and their number."""
        feed = self.inputs.feed
        frames = np.array(self.frames)
        positions = np.stack([feed.pose(frame)[:3, 3] for frame in self.frames])
        seconds = np.array([feed.time(frame) for frame in self.frames])
        passes = {
            self.frames[row]: [frames[rows].tolist() for rows in others]
            for row, others in other_passes(positions, seconds).items()
        }
        blocks = _blocks(list(passes))
        near = self.inputs.actors.between
        progress.expect(len(passes))
        items = (({one: passes[one] for one in own}, near(own[0], own[-1])) for own in blocks)
        found = np.empty(0, np.int64), np.empty((0, 3), np.int32)
        with closing(run_all(partial(_compare_passes, feed=feed), items, pool)) as compared:
            for block, new in zip(blocks, compared, strict=True):
                found = summed([found, new])
                progress(len(block))
        return find_gone(*found)

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
        points = sum(number for part, number in self.cells.counts.items() if part[0] == group)
        return PointPieces(
            points, lambda: self.cells.points(group), self.inputs.metadata.classes, about
        )

    def write_trajectory(self, path: Path) -> None:
        """Write the pose of the sensor at each scan, in the format of TUM."""
        sequence = self.inputs.feed.sequence
        poses = np.stack([sequence.read_pose(frame) for frame in self.frames])
        poses = mirror_poses(poses) if self.inputs.metadata.axes == "left" else poses
        turns = quaternions_of(poses[:, :3, :3])[:, [1, 2, 3, 0]]
        table = np.column_stack([sequence.times_of(self.frames), poses[:, :3, 3], turns])
        lines = (" ".join(f"{value:.9g}" for value in row) for row in table.tolist())
        write_atomic(path, "".join(f"{line}\n" for line in lines).encode())

    def write_actors(self, folder: Path, ending: str) -> int:
        """Write the body of each actor, in its own frame, and its poses; return the number of
        actors.
        """
        table = list[dict[str, Any]]()
        with writing_folder(folder) as made:
            for number in sorted({part[0] for part in self.cells.counts} - {STATIC}):
                about = self._about(number, self.inputs.actors.tracks[number])
                about["file"] = f"{number:04}{ending}"
                text = f"actor {number}, {about['class']}, metres, x forward, y left, z up"
                write_points(made / about["file"], self._pieces(number, text))
                table.append(about)
            write_atomic(made / ACTORS, to_json(table))
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
        where = self.inputs.location
        notes = self.inputs.findings()
        metadata = self.inputs.metadata
        if self.inputs.feed.has_labels:
            notes.append(f"{where}: classes {self.inputs.sequence.table_use()}")
            if metadata.predicted:
                notes.append(f"{where}: classes are those of labels that were {metadata.predicted}")
        else:
            notes.append(
                f"{where}: the scans have no labels: the map contains geometry only, in one class"
            )
        if self.parked:
            notes.append(
                f"{where}: {count(self.parked, 'parked actor')} that stood there in one pass and "
                "not in another one: left out (`keep_parked=True` keeps such)"
            )
        return tuple(notes)


def _blocks(frames: list[int]) -> list[tuple[int, ...]]:
    return [tuple(frames[first : first + _BLOCK]) for first in range(0, len(frames), _BLOCK)]


def _compare_passes(
    block: tuple[dict[int, list[list[int]]], MovingActors], feed: ScanFeed
) -> Compared:
    """Compare the scans of a block with other passes of their places, in a worker."""
    passes, actors = block
    merger = Merger(feed.read, actors, feed.classes, "align")

    @cache
    def view(frame: int) -> View:
        return feed.pose(frame), views_of(feed.evidence_scan(frame, ()))

    found = []
    for frame, others in passes.items():
        scan = feed.read(frame)
        views = [[view(other) for other in one] for one in others]
        compared = merger.static(frame) & ~feed.ground(scan)
        found.append(compare_passes(scan.points, compared, scan.world_T_sensor, views))
    return summed(found)


@dataclass(frozen=True)
class _AddScans:
    """Sums the scans of a block, in a worker; without the cells, in order, of what is gone."""

    feed: ScanFeed
    cell_m: float
    actors: bool
    gone: IntArray

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
        feed = self.feed
        scan = self.feed.read(frame)
        labels = merger.labels(frame)
        static = merger.static(frame)
        under = merger.under(frame)
        if feed.must_find_ground:  # ground that was found had a class for the votes only
            labels[feed.classes.have_role(labels, "ground")] = feed.classes.geometry_id
        world = transform_points(scan.world_T_sensor, scan.points.astype(np.float64))
        if len(self.gone):
            inside = np.isin(keys_of(world), self.gone)
            if inside.any():
                static = static & (feed.ground(scan) | ~inside)
                under = under | inside
        settled = merger.settled(frame).points if self.actors else scan.points
        chosen: list[tuple[int, AnyArray, FloatArray]] = [
            (group, np.flatnonzero(own), world[own])
            for group, own in ((STATIC, static & ~under), (UNDER, static & under))
        ]
        for number, track in merger.actors.tracks.items() if self.actors else ():
            members = track.members.get(frame)
            pose = track.pose(frame)
            if members is not None and pose is not None:
                own = settled[members].astype(np.float64)
                actor_T_sensor = invert(pose) @ scan.world_T_sensor
                chosen.append((number, members, transform_points(actor_T_sensor, own)))
        for group, points, places in chosen:
            right = places * (1, -1, 1) if feed.sequence.metadata.axes == "left" else places
            sure = None if scan.sure is None else scan.sure[points]
            yield rows_of_scan(right, labels[points], sure, group, self.cell_m)


def write_grid(source: Source, name: str, frames: FrameRange, files: MapFiles) -> MapContent:
    """Write the occupied voxels of a grid of one frame, in right-handed axes.

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
    sequence = _only(having)
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
    lower = np.array(grid.spec.lower)
    size = grid.spec.voxel_size.astype(np.float64)
    index = np.argwhere(grid.known)
    labels = grid.labels[grid.known]
    occupied = labels > 0
    if not occupied.any():
        raise MissingDataError(where, expected="occupied voxels", found="none")
    points = np.zeros(int(occupied.sum()), POINT_DTYPE)
    for axis, middles in zip("xyz", (lower + (index[occupied] + 0.5) * size).T, strict=True):
        points[axis] = middles
    points["label"] = labels[occupied]
    points["seen"] = 1 if grid.counts is None else grid.counts[grid.known][occupied]
    points["confidence"] = points["seen"] / (points["seen"] + 1.0)
    pieces = PointPieces(
        len(points), lambda: iter([points]), sequence.metadata.classes, f"voxels of {where}"
    )
    files.write(pieces, lambda: MapCells(index, labels, lower, size))
    if files.distance is not None:
        write_distances(files.distance, given)
    return MapContent(len(points), 1, 0, 0, ())


def with_neighbours(frames: FrameRange) -> FrameRange:
    """Return a range with the frames around it that tell what moves in it."""
    around = round(HORIZON_S / layout.FRAME_PERIOD_S)
    start = frames.start
    stop = frames.stop
    return FrameRange(
        None if start is None else max(start - around, 0), None if stop is None else stop + around
    )


def _only(having: list[Sequence]) -> Sequence:
    return only(
        "source",
        {one.path or one.location: one for one in having},
        "one sequence, as a map has one frame",
    )
