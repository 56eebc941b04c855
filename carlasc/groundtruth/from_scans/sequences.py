"""Sequences whose grids are made from scans: each frame's grid from the scans around it in time."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import transform_points
from carlasc.core.grids import Grid
from carlasc.errors import CarlascError, MissingDataError
from carlasc.groundtruth.from_scans.actors import FIRST_MOVER, Actors
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import find_actors, key_of
from carlasc.groundtruth.from_scans.trajectory import check_trajectory, with_estimated_poses
from carlasc.groundtruth.heights import ground_of
from carlasc.groundtruth.inputs import (
    FrameData,
    FrameInput,
    Plan,
    SequenceInput,
    StoredSequence,
    choose_frames,
    parent_path,
    scan_fields,
)
from carlasc.groundtruth.options import FromScans
from carlasc.groundtruth.reporting.facts import Residual
from carlasc.motion import LONGEST_M
from carlasc.running.options import Run
from carlasc.storage import as_source, layout
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.resuming import RECORD
from carlasc.storage.sinks import SequenceWriter

TRACKS = "tracks.npz"
"""The document that keeps the actors of a sequence beside its grids. It may be deleted: the next run makes it again."""
_TENTH = 10
_LOOKED_AT = 3  # scans that are looked at for ground below the grid
_BELOW = 0.2  # share of ground points below the grid that is worth a note: on hills, some are


@dataclass(frozen=True)
class ScanWindow:
    """What a worker needs of a sequence for one frame: its scans, and the actors in the window of the frame."""

    feed: ScanFeed
    actors: Actors


@dataclass(frozen=True)
class ScanFrame(FrameInput):
    """One frame of a sequence, with the scans that vote on it, and the actors in them."""

    inputs: ScanSequence | ScanWindow
    number: int
    source_frame: int

    def __reduce__(self) -> tuple[type[Self], tuple[Any, ...]]:
        feed = self.inputs.feed
        first, last = feed.options.window
        near = self.inputs.actors.between(self.number + first, self.number + last)
        return type(self), (ScanWindow(feed, near), self.number, self.source_frame)

    def fields(self) -> tuple[str, ...]:
        """Return the names of the scan fields that the frame has."""
        return scan_fields(self.inputs.feed.sequence, self.number)

    def make(self, plan: Plan) -> FrameData:
        """Read the frame's own files, and count the votes of the scans in its window."""
        feed = self.inputs.feed
        fields = {name: feed.sequence.read(name, self.number) for name in self.fields()}
        merged = merge_frame(plan, feed, self.inputs.actors, self.number, feed.reaching(self.number, plan.spec))
        return FrameData(fields, merged.grid, merged.votes, merged.evidence)

    def thinned(self, plan: Plan) -> Grid:
        """Return the grid without every tenth of the scans of other frames."""
        feed = self.inputs.feed
        window = feed.reaching(self.number, plan.spec)
        others = [frame for frame in window if frame != self.number]
        left_out = set(others[_TENTH // 2 :: _TENTH])
        kept = [frame for frame in window if frame not in left_out]
        return merge_frame(plan, feed, self.inputs.actors, self.number, kept).grid

    def residuals(self) -> Mapping[int, Residual]:
        """Return how well the sightings of the moving actors in the frame overlay with the next ones, by number of the actor."""
        feed, frame, found = self.inputs.feed, self.number, {}
        last = frame + feed.options.window[1]
        for number, track in self.inputs.actors.tracks.items():
            later = min((other for other in track.members if frame < other <= last), default=None)
            here, there = track.pose(frame), None if later is None else track.pose(later)
            own, others = track.members.get(frame, ()), () if later is None else track.members[later]
            if later is None or here is None or there is None or not len(own) or not len(others):
                continue
            one, other = (
                transform_points(feed.pose(f), feed.read(f).points[list(members)].astype(np.float64))
                for f, members in ((frame, own), (later, others))
            )
            found[number] = Residual.between(one, other, here, there)
        return found


class ScanSequence(StoredSequence):
    """A sequence whose scans are merged over time."""

    def __init__(self, sequence: Sequence, plan: Plan, options: FromScans) -> None:
        super().__init__(sequence, plan)
        self.options = options
        self.actors = Actors()

    @cached_property
    def estimates_poses(self) -> bool:
        """Whether poses are estimated from the scans: if that is asked for, or if the sequence has none but those of an earlier run."""
        source, sequence, grid = self.options.poses.source, self.sequence, self.plan.grid
        if source != "auto" or layout.POSES not in sequence.documents():
            return source != "file"
        record = sequence.params(grid).get(RECORD) if grid in sequence.grids else None
        return isinstance(record, dict) and record.get("poses") == "kiss-icp"

    @cached_property
    def feed(self) -> ScanFeed:
        """The scans of the sequence, after its poses and times were checked.

        Raises:
            MissingDataError: there are no poses.
            FormatError: poses or times are not valid.
        """
        sequence = with_estimated_poses(self.sequence) if self.estimates_poses else self.sequence
        check_trajectory(sequence, self.options)
        return ScanFeed(sequence, self.options)

    def _find_frames(self) -> tuple[FrameInput, ...]:
        chosen = choose_frames(self.plan.frames, self.sequence.frames("points"), self.location)
        return tuple(ScanFrame(self, number, number) for number in chosen)

    def frame(self, number: int) -> FrameInput | None:
        """Return a frame of the sequence, chosen or not; None if it has no scan."""
        return ScanFrame(self, number, number) if number in self.feed.frames else None

    @property
    def steps_before(self) -> int:
        """Number of scans that the pass that finds the actors reads."""
        return self.feed.reads

    def prepare(self, writer: SequenceWriter, run: Run, steps: Callable[[int], None]) -> None:
        """Find the actors of the sequence, or read those that an earlier run found."""
        if not self.feed.needs_actors:
            return
        key = key_of(self.feed)
        kept = _read_actors(writer, key)
        if kept is None:
            self.actors = find_actors(self.feed, run, steps)
            writer.write_document(TRACKS, self.actors.to_bytes(key))
            return
        self.actors = kept
        steps(self.steps_before)

    def summaries(self) -> Series[Mapping[str, Any]] | None:
        """Return what was found of each actor, by number; None if no actor is tracked."""
        return self.actors.summary if self.feed.needs_actors else None

    def record(self) -> dict[str, Any]:
        """Return how scans are merged."""
        options = self.options
        record: dict[str, Any] = {"observe": "scans", "motion": "+".join(self.feed.motion) or "none"}
        record |= {"dynamic": options.dynamic}
        if options.dynamic == "align":
            record |= {"complete": options.complete}
        if not options.own_path:
            record |= {"own_path": False}
        record |= {"poses": "kiss-icp"} if self.estimates_poses else {}
        record |= {"window": f"{options.window[0]}:{options.window[1]}", "stride": options.stride}
        record |= {} if options.window_m is None else {"window_m": options.window_m}
        limits = {"min_range_m": self.feed.min_range_m, "max_range_m": self.feed.max_range_m}
        return record | {name: value for name, value in limits.items() if np.isfinite(value) and value > 0}

    def poses(self) -> NDArray[np.float64] | None:
        """Return the poses to write beside the grids; None if they were estimated and the sequence has its own."""
        has_own = layout.POSES in self.sequence.documents()
        return None if has_own and self.estimates_poses else self.feed.sequence.poses

    def notes(self) -> list[str]:
        """Return what the scans lack, and what was found in spite of it."""
        where, dynamic, notes = self.location, self.options.dynamic, []
        if self.estimates_poses and self.options.poses.source == "auto":
            notes.append(f"{where}: there are no poses: they were estimated from the scans (kiss-icp)")
        if not self.feed.has_labels:
            notes.append(f"{where}: the scans have no labels: grids contain geometry only, in one class")
        elif not self.feed.motion and dynamic != "tube":
            notes.append(f"{where}: nothing shows what moves: everything was treated as static")
        found = sum(track.instance >= FIRST_MOVER for track in self.actors.tracks.values())
        left_out = sum(len(points) for points in self.actors.moving.values())
        if "evidence" in self.feed.motion and (found or left_out):
            shown = [f"{found} actors that move"] if found else []
            shown += [f"{left_out} {'more ' if found else ''}points that moved"] if left_out else []
            out = ": these points were left out of other frames" if left_out else ""
            notes.append(f"{where}: free space shows {' and '.join(shown)}, although nothing else says so{out}")
        wrong = sum(max(actor["size_m"]) >= LONGEST_M for actor in self.actors.summary)
        if wrong:
            notes.append(
                f"{where}: {wrong} actors are larger than any vehicle, so their numbers or boxes are wrong: their points were treated as static"
            )
        below = self._share_below()
        if below > _BELOW:
            notes.append(
                f"{where}: {below:.0%} of the points on the ground are below the grid, which begins at {self.plan.spec.lower[2]:g} m"
            )
        if len(self.feed.frames) == 1:
            notes.append(f"{where}: there is one scan only: nothing is merged, and what it did not see is unknown")
        return notes

    def _share_below(self) -> float:
        """Return the share of the ground points of some scans that are below the grid. Scans that cannot be read fail elsewhere."""
        feed, spec = self.feed, self.plan.spec
        chosen = feed.frames[np.unique(np.linspace(0, len(feed.frames) - 1, _LOOKED_AT).astype(int))]
        heights = [np.empty(0, np.float32)]
        for frame in chosen.tolist():
            try:
                scan = feed.sequence.scan(frame, () if feed.finds_ground else ("labels",))
            except CarlascError:
                continue
            ground = ground_of(scan.points, scan.labels, feed.classes.ground)
            heights.append(ground[np.hypot(ground[:, 0], ground[:, 1]) < abs(spec.upper[0]), 2])
        below = np.concatenate(heights) < spec.lower[2]
        return float(below.mean()) if len(below) else 0.0


def _read_actors(writer: SequenceWriter, key: str) -> Actors | None:
    """Return the actors that an earlier run kept; None if there are none, or they were made from something else."""
    data = writer.read_document(TRACKS)
    if data is None:
        return None
    try:
        actors, made_from = Actors.from_bytes(data, TRACKS)
    except CarlascError:  # of another version, or damaged: it is only a copy of what the scans say
        return None
    return actors if made_from == key else None


def scan_sequences(source: str | os.PathLike[str] | Source, plan: Plan, options: FromScans) -> list[SequenceInput]:
    """Find the sequences of a source that have scans.

    Raises:
        MissingDataError: there is none.
    """
    sequences: dict[str, Sequence] = {}
    for sequence in as_source(source).sequences().values():
        parent = parent_path(sequence)
        other = sequences.get(parent)  # scans may exist beside the grids of both coordinates: take the folder with more
        if other is None or len(sequence.frames("points")) > len(other.frames("points")):
            sequences[parent] = sequence
    chosen = [sequence for sequence in sequences.values() if "points" in sequence.fields()]
    if not chosen:
        raise MissingDataError(source, expected="sequences with scans (velodyne/)", found="none")
    return [ScanSequence(sequence, plan, options) for sequence in chosen]
