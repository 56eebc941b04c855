"""The static points of a drive as a map, and the bodies of its actors."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from carlasc.core.axes import mirror_poses
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import invert, transform_points
from carlasc.core.grids import GridSpec
from carlasc.errors import MissingDataError
from carlasc.groundtruth.from_scans.feed import ScanFeed, WithoutScans
from carlasc.groundtruth.from_scans.merging import Merger
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.groundtruth.from_scans.sequences import ScanSequence, scan_sequences
from carlasc.groundtruth.inputs import GridPlan, RunProgress, choose_frames
from carlasc.groundtruth.maps.grid_map import only
from carlasc.groundtruth.maps.growing_cells import STATIC, GrowingCells, Part, cells_of, rows_of_scan, split
from carlasc.groundtruth.maps.map_files import ACTORS, MapCells, MapFiles
from carlasc.groundtruth.options import FromScans, Voting
from carlasc.motion import HORIZON_S, Track
from carlasc.motion.tracks import MovingActors
from carlasc.running.processes import one_pool, run_all
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.cloud_files import POINT_DTYPE, PointPieces, write_points
from carlasc.storage.files import to_json, write_atomic, writing
from carlasc.storage.protocol import Source

_BLOCK = 10  # scans that a worker adds up


@dataclass
class DriveMap:
    """The map of a drive.

    Attributes:
        inputs: the scans, their poses, and what moves.
        frames: the frames whose scans are in the map.
        cells: the map.
    """

    inputs: ScanSequence
    frames: list[int]
    cells: GrowingCells

    @classmethod
    def of(cls, source: Source, frames: FrameRange, options: FromScans, cells: GrowingCells) -> Self:
        """Find the one sequence of a source. Scans that are far from the chosen frames are hidden: what moves there does not matter."""
        plan = GridPlan(GridSpec.published(), "map", options, Voting(), frames)
        sequence = only(
            [one.sequence for one in scan_sequences(source, plan, options) if isinstance(one, ScanSequence)]
        )
        known = sequence.frames("points")
        chosen = choose_frames(frames, known, sequence.location)
        around = round(HORIZON_S / layout.FRAME_PERIOD_S)
        hidden = known[(known < chosen[0] - around) | (known > chosen[-1] + around)].tolist()
        view = WithoutScans(sequence, hidden) if hidden else sequence
        return cls(ScanSequence(view, plan, options), chosen, cells)

    def fill(self, run: Run, movers: bool) -> None:
        """Refine poses, find what moves, and add every scan without it; with `movers`, add their bodies too."""
        inputs = self.inputs
        progress = RunProgress(run.progress, 0, inputs.steps_before + len(self.frames))
        with one_pool(run) as pool:
            inputs.refine(None, pool, progress)
            if inputs.feed.needs_actors:
                inputs.actors = find_actors(inputs.feed, pool, progress)
            blocks = [tuple(self.frames[first : first + _BLOCK]) for first in range(0, len(self.frames), _BLOCK)]
            items = ((block, inputs.actors.between(block[0], block[-1])) for block in blocks)
            with closing(run_all(_AddScans(inputs.feed, self.cells.cell_m, movers), items, pool)) as added:
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
            raise MissingDataError(self.inputs.location, expected="points of something static", found="none")
        files.write(points, self._whole)
        return points.count

    def _whole(self) -> MapCells:
        whole = np.concatenate([np.empty(0, POINT_DTYPE), *self.cells.points()])
        size = np.full(3, self.cells.cell_m)
        return MapCells(cells_of(whole, self.cells.cell_m), whole["label"], np.zeros(3), size)

    def _pieces(self, group: int, about: str) -> PointPieces:
        count = sum(number for part, number in self.cells.counts.items() if part[0] == group)
        return PointPieces(count, lambda: self.cells.points(group), self.inputs.metadata.classes, about)

    def write_actors(self, folder: Path, ending: str) -> int:
        """Write the body of each actor, in its own frame, and where it was; return their number."""
        table, made = list[dict[str, Any]](), self.cells.folder / folder.name
        made.mkdir()
        for number in sorted({part[0] for part in self.cells.counts} - {STATIC}):
            about = self._about(number, self.inputs.actors.tracks[number]) | {"file": f"{number:04}{ending}"}
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
        """Return what was found, one line each."""
        where, notes, metadata = self.inputs.location, self.inputs.findings(), self.inputs.metadata
        if not self.inputs.feed.has_labels:
            notes.append(f"{where}: the scans have no labels: the map contains geometry only, in one class")
        elif metadata.predicted:
            notes.append(f"{where}: classes are those of labels that were {metadata.predicted}")
        return tuple(notes)


@dataclass(frozen=True)
class _AddScans:
    """Adds up the scans of a block, in a worker."""

    feed: ScanFeed
    cell_m: float
    movers: bool

    def __call__(self, block: tuple[tuple[int, ...], MovingActors]) -> list[tuple[Part, NDArray[Any]]]:
        frames, actors = block
        merger = Merger(self.feed.read, actors, self.feed.classes, "align")
        found = [rows for frame in frames for rows in self._rows(merger, frame)]
        parts, rows = zip(*found, strict=True)
        return split(np.concatenate(parts), np.concatenate(rows))

    def _rows(self, merger: Merger, frame: int) -> Iterator[tuple[NDArray[np.int64], NDArray[Any]]]:
        """Yield the cells of the static points of a scan, then, if they are wanted, those of each actor."""
        feed, scan = self.feed, self.feed.read(frame)
        labels, static = merger.labels(frame), merger.static(frame)
        if feed.finds_ground:  # ground that was found had a class for the votes only
            labels[np.isin(labels, sorted(feed.classes.ground))] = feed.classes.geometry_id
        world = transform_points(scan.world_T_sensor, scan.points.astype(np.float64))
        chosen: list[tuple[int, NDArray[Any], NDArray[np.float64]]] = [(STATIC, np.flatnonzero(static), world[static])]
        for number, track in merger.actors.tracks.items() if self.movers else ():
            members, pose = track.members.get(frame), track.pose(frame)
            if members is not None and pose is not None:
                chosen.append((number, members, transform_points(invert(pose), world[members])))
        for group, points, places in chosen:
            right = places * (1, -1, 1) if feed.sequence.metadata.axes == "left" else places
            sure = None if scan.sure is None else scan.sure[points]
            yield rows_of_scan(right, labels[points], sure, np.full(len(points), group), self.cell_m)
