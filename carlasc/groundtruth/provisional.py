"""Grids of a drive that still grows: from the poses and the scans known so far."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from carlasc.errors import CarlascError
from carlasc.groundtruth.from_scans.actor_voxels import with_numbers
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import track_of, untracked
from carlasc.groundtruth.from_scans.sequences import ScanFrame, ScanSequence, ScanWindow
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.options import FromScans
from carlasc.groundtruth.run import FrameTask, settings_of
from carlasc.motion import ActorFollower, Track, complete_bodies
from carlasc.motion.evidence import EvidenceWindow
from carlasc.motion.found_actors import FoundActor
from carlasc.motion.tracks import FIRST_FOUND, MovingActors
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.inputs import PROVISIONAL, MadeFrom
from carlasc.storage.layout import place_of
from carlasc.storage.protocol import Sequence, SequenceWriter, Sink
from carlasc.storage.resuming import check_grid

_AFTER_S = 0.8  # scans up to so much later show what moves in a scan
_AGAIN_S = 2.0  # tracks are estimated again after so much of the drive
_KEPT_S = 8.0  # how long observations of actors are kept
_EVERY, _BEHIND = 3, 15  # N before the first grid; N grows by one with so many scans that wait
_BEFORE = 40  # scans before a window, if the pass begins in the middle of a drive
_MEAN_OF = 10  # about so many of the last scans and grids show how much time there is


@dataclass
class MadeGrids:
    """What a call of `NewScans.make` made.

    Attributes:
        numbers: the frames that got a grid.
        problems: scans and frames that failed, and why.
    """

    numbers: list[int] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class NewScans:
    """Scans that were written since the last call, for the process that makes provisional grids.

    The process keeps what it knows of the drive from call to call, so each scan is read and
    searched for motion once, and each ray is followed once. Poses are not refined. Every N-th scan
    is merged, and its frame gets a grid: N is what the process has time for.

    Attributes:
        key: of the drive.
        sink: the output.
        path: path of the sequence.
        writer: writes beside it.
        plan: the plan of the final grids.
        known: number of frames whose poses are written.
    """

    key: str
    sink: Sink
    path: str
    writer: SequenceWriter
    plan: GridPlan
    known: int

    def make(self) -> MadeGrids:
        """Take the scans, and make the grids of frames whose windows are complete, marked as
        provisional.

        Raises:
            StorageError: a grid cannot be written.
        """
        done = MadeGrids()
        sequence = self.sink.source().sequences_in([place_of(self.path)])[self.path]
        frames = [one for one in sequence.frames("points").tolist() if one < self.known]
        if not frames:
            return done
        if self.key not in _DRIVES:
            _DRIVES.clear()
            _DRIVES[self.key] = _GrowingDrive(sequence, self.plan, self.writer, frames)
        drive = _DRIVES[self.key]
        for frame in drive.choose(sequence, frames):
            begun_s = time.monotonic()
            try:
                drive.take(frame)
                drive.make_grid(done)
            except (CarlascError, OSError) as error:
                done.problems.append(f"frame {frame}: {error}")
            drive.note_time(time.monotonic() - begun_s)
        return done


class _GrowingDrive:
    """What is known of a drive: what moved in the last scans, and their free space."""

    def __init__(
        self, sequence: Sequence, plan: GridPlan, writer: SequenceWriter, frames: list[int]
    ) -> None:
        observe = cast(FromScans, plan.observe)
        self.plan, self.writer, self.window = plan, writer, observe.window
        if observe.motion.source != "none":
            observe = replace(observe, motion=replace(observe.motion, source="evidence"))
        self.feed = feed = ScanFeed(sequence, observe, is_growing=True)
        # if it is begun in the middle of a drive, with a whole window
        first, last = self.window
        self._next = max(frames[0], frames[-1] - (last - first) - _BEFORE)
        self._first = self._next - (min(first, 0) if self._next > frames[0] else 0)
        self._judged = list[int]()  # the frames whose moving points are known
        self._evidence = EvidenceWindow(after_s=_AFTER_S)
        self._follower = ActorFollower(
            deformable=feed.classes.deformable,
            first_instance=FIRST_FOUND,
            default_label=0 if feed.has_labels else feed.classes.geometry_id,
        )
        self._tracks, self._actors = list[Track](), MovingActors()
        self._tracked_s, self._numbered, self._is_begun = -np.inf, 0, False
        self._every = _EVERY
        self._spent_s: float | None = None  # time for a scan and its grid, a mean of the last ones

    def choose(self, sequence: Sequence, frames: list[int]) -> list[int]:
        """Return the scans to take: every N-th one, more of them the faster they are taken."""
        self.feed.sequence = sequence
        new, last = [frame for frame in frames if frame >= self._next], frames[-_MEAN_OF:]
        every = _EVERY
        if self._spent_s is not None and len(last) > 1:
            period_s = (self.feed.time(last[-1]) - self.feed.time(last[0])) / (len(last) - 1)
            every = max(math.ceil(self._spent_s / max(period_s, 1e-3)), 1)
        self._every = every + len(new) // _BEHIND
        return new[:: self._every]

    def note_time(self, spent_s: float) -> None:
        """Note how long a scan and its grid took, after the first grid."""
        if self._spent_s is not None:
            spent_s = self._spent_s + (spent_s - self._spent_s) / _MEAN_OF
        if self._is_begun:
            self._spent_s = spent_s

    def take(self, frame: int) -> None:
        """Take a scan, and find what moved in the scans before it.

        Raises:
            FormatError: it is not valid.
        """
        self._next = frame + self._every
        if not self.feed.needs_actors:
            self._judge(frame)
            return
        scan = self.feed.evidence_scan(frame, ())
        self.feed.read(frame)  # now, as it is at hand
        for found in self._evidence.add(scan):
            self._judge(found.frame)
            self._tracks += map(self._track, self._follower.add(found.thinned()))

    def _judge(self, frame: int) -> None:
        """Add a frame to those that are merged."""
        first, last = self.window
        feed, now_s = self.feed, self.feed.time(frame)
        self._judged.append(frame)
        oldest = frame + first - last
        self._judged = [f for f in self._judged if f >= oldest or now_s - feed.time(f) < _KEPT_S]
        feed.use(self._judged)
        self._follower.forget_before(self._judged[0])
        self._tracks = [
            track
            for track in self._tracks
            if track.first + len(track.world_T_actor) > self._judged[0]
        ]

    def make_grid(self, done: MadeGrids) -> None:
        """Make and write the grid of the newest frame whose window is complete, unless it is
        made.
        """
        last = self._judged[-1] - self.window[1] if self._judged else -1
        ready = [frame for frame in self._judged if self._first <= frame <= last]
        if not ready:
            return
        number = ready[-1]
        if not self._is_begun:
            self._begin_grid(number)
        self._first = number + 1
        near = self._actors_now().between(number + self.window[0], number + self.window[1])
        frame, grid = ScanFrame(ScanWindow(self.feed, near), number, number), f"{self.plan.grid}/"
        made = FrameTask(number, frame, self.plan, self.feed.classes, False).run()
        fields = {name: data for name, data in made.outputs.items() if name.startswith(grid)}
        if fields:
            self.writer.write_frames({number: fields})
            done.numbers.append(number)
        if made.error:
            done.problems.append(f"no grid of frame {number} yet: {made.error}")

    def _begin_grid(self, number: int) -> None:
        """Note that grids are provisional; remove frames with other settings.

        Raises:
            ConflictError: the grid is not one of carlasc's.
        """
        plan, writer = self.plan, self.writer
        inputs = ScanSequence(self.feed.sequence, plan, cast(FromScans, plan.observe))
        params = settings_of(inputs, plan)
        check_grid(writer, plan.grid, params, [number], overwrite=True)
        document = layout.params_file(plan.grid)
        MadeFrom(PROVISIONAL).write(writer, f"made-{plan.grid}")
        if (existing := writer.read_document(document)) != to_json(params):
            if existing is not None:
                writer.remove_grid(plan.grid)
            writer.write_document(document, to_json(params))
        self._is_begun = True

    def _track(self, actor: FoundActor) -> Track:
        return track_of(actor, self.feed.times, self.feed.classes.deformable)

    def _actors_now(self) -> MovingActors:
        """Return the moving actors, with the tracks of the last second at least."""
        now_s = self.feed.time(self._judged[-1])
        if now_s - self._tracked_s >= _AGAIN_S and self.feed.needs_actors:
            self._tracked_s = now_s
            follower, living = self._follower.ended_now()
            every = [*self._tracks, *map(self._track, living)]
            every = [track for track in every if track.instance not in follower.riders]
            moving = untracked(follower.moved, [track for track in every if track.is_possible])
            actors = MovingActors.of(complete_bodies(every), moving, follower.own)
            # what was kept of an actor is not of this track of it: each gets a new number
            numbered = {self._numbered + n: track for n, track in actors.tracks.items()}
            self._numbered += len(every)
            self._actors = replace(actors, tracks=numbered)
            if self.plan.voting.keep_actors:
                self._actors = with_numbers(self._actors, self.feed)
        return replace(self._actors, moving={**self._follower.moved, **self._actors.moving})


_DRIVES: dict[str, _GrowingDrive] = {}  # the drive of this process, by its key
