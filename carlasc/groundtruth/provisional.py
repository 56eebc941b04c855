"""Grids of a drive that still grows: from the poses and the scans known so far.

One process makes them. It keeps what it knows of the drive, so each scan is read and searched for
motion once, and each of its rays is followed once. Every N-th scan is merged, and its frame gets a
grid: N is what the process has time for. Poses are not refined.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import cast

import numpy as np

from carlasc.errors import CarlascError
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import follower_of, track_of, untracked
from carlasc.groundtruth.from_scans.sequences import ScanFrame, ScanSequence, ScanWindow
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.options import FromScans
from carlasc.groundtruth.run import FrameTask, settings_of
from carlasc.motion import Track, complete_bodies
from carlasc.motion.evidence import EvidenceWindow
from carlasc.motion.found_actors import FoundActor
from carlasc.motion.tracks import MovingActors
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.inputs import PROVISIONAL, MadeFrom
from carlasc.storage.layout import place_of
from carlasc.storage.protocol import Sequence, SequenceWriter, Sink
from carlasc.storage.resuming import check_grid

_AFTER_S = 0.8  # scans up to so much later show what moves in a scan
_AGAIN_S = 2.0  # tracks are estimated again after so much of the drive
_KEPT = 80  # frames whose observations of actors are kept, at least
_BEFORE = 40  # frames before a window, if the first call is in the middle of a drive
# time for a scan and its grid: the first guess, and how many of the last ones are averaged
_SPENT_S, _MEAN_OF = 0.3, 10
_BEHIND = 15  # N grows by one with so many scans that wait


def make_provisional(
    key: str, sink: Sink, path: str, writer: SequenceWriter, plan: GridPlan, known: int
) -> tuple[list[int], list[str]]:
    """Take the scans that were written since the last call, and make grids, marked as provisional.

    Args:
        key: of the drive: other calls with it in the same process continue each other.
        sink: the output.
        path: path of the sequence.
        writer: writes beside it.
        plan: the plan of the final grids.
        known: number of frames whose poses are written.

    Returns:
        The frames that got a grid; and why scans or frames failed.

    Raises:
        StorageError: a grid cannot be written.
    """
    sequence = sink.source().sequences_in([place_of(path)])[path]
    frames = [frame for frame in sequence.frames("points").tolist() if frame < known]
    made, problems = list[int](), list[str]()
    if len(frames) < 2:
        return made, problems
    if key not in _DRIVES:
        _DRIVES.clear()
        _DRIVES[key] = _GrowingDrive(sequence, plan, writer, frames)
    drive = _DRIVES[key]
    for frame in drive.choose(sequence, frames):
        begun_s, is_first = time.monotonic(), not drive.is_begun
        try:
            drive.take(frame)
            made += drive.make_grid()
        except (CarlascError, OSError) as error:
            problems.append(f"no grid of frame {frame} yet: {error}")
        if not is_first:  # a whole window
            drive.spent_s += (time.monotonic() - begun_s - drive.spent_s) / _MEAN_OF
    return made, problems


class _GrowingDrive:
    """What is known of a drive: what moved in the last scans, and their free space."""

    def __init__(
        self, sequence: Sequence, plan: GridPlan, writer: SequenceWriter, frames: list[int]
    ) -> None:
        observe = cast(FromScans, plan.observe)
        self.plan, self.writer, (self.first, self.last) = plan, writer, observe.window
        if observe.motion.source != "none":
            observe = replace(observe, motion=replace(observe.motion, source="evidence"))
        self.feed = feed = ScanFeed(sequence, observe)
        feed.use(sequence, [])
        # in the middle of a drive, the first grid has a whole window
        self._next = max(frames[0], frames[-1] - self.last + self.first - _BEFORE)
        self._unmade = self._next - min(self.first, 0) * (self._next > frames[0])
        self._judged = list[int]()  # the frames whose moving points are known
        movable = feed.classes.movable if feed.trusts_ground_labels else ()
        self._evidence = EvidenceWindow(movable, after_s=_AFTER_S)
        self._follower = follower_of(feed)
        self._tracks, self._actors = list[Track](), MovingActors()
        self._tracked_s, self._numbered = -np.inf, 1
        self.is_begun, self.spent_s, self._every = False, _SPENT_S, 1

    def choose(self, sequence: Sequence, frames: list[int]) -> list[int]:
        """Return the scans to take: every N-th one."""
        self.feed.use(sequence, self._judged)
        new = [frame for frame in frames if frame >= self._next]
        period_s = float(np.median(np.diff(sequence.times_of(frames[-_MEAN_OF:]))))
        self._every = max(math.ceil(self.spent_s / max(period_s, 1e-3)), 1) + len(new) // _BEHIND
        return new[:: self._every]

    def take(self, frame: int) -> None:
        """Take a scan, and find what moved in the scans before it.

        Raises:
            FormatError: it is not valid.
        """
        self._next = frame + self._every
        if not self.feed.needs_actors:
            self._judge(frame)
            return
        for found in self._evidence.add(self.feed.evidence_scan(frame, ())):
            self._judge(found.frame)
            self._tracks += map(self._track, self._follower.add(found.thinned()))

    def _judge(self, frame: int) -> None:
        """Merge a frame from now on, and forget old ones."""
        oldest = frame - max(self.last - self.first, _KEPT)
        self._judged = [one for one in [*self._judged, frame] if one >= oldest]
        self.feed.use(self.feed.sequence, self._judged)
        self._follower.forget_before(oldest)
        self._tracks = [track for track in self._tracks if max(track.members) >= oldest]

    def make_grid(self) -> list[int]:
        """Make and write the grid of the newest frame whose window is complete, unless it is
        made; return its number, if it has one.

        Raises:
            CarlascError: it cannot be made.
        """
        ready = [f for f in self._judged if self._unmade <= f <= self._judged[-1] - self.last]
        if not ready:
            return []
        number = ready[-1]
        if not self.is_begun:
            self._begin_grid(number)
        self._unmade = number + 1
        near = self._actors_now().between(number + self.first, number + self.last)
        frame = ScanFrame(ScanWindow(self.feed, near), number, number)
        made = FrameTask(number, frame, self.plan, self.feed.classes, False).run()
        if made.error:
            raise CarlascError(self.feed.sequence.location, problem=made.error)
        fields = {n: data for n, data in made.outputs.items() if n.startswith(f"{self.plan.grid}/")}
        self.writer.write_frames({number: fields})
        return [number]

    def _begin_grid(self, number: int) -> None:
        """Note that grids are provisional; remove frames with other settings.

        Raises:
            ConflictError: the grid is not one of carlasc's.
        """
        plan, writer, document = self.plan, self.writer, layout.params_file(self.plan.grid)
        inputs = ScanSequence(self.feed.sequence, plan, cast(FromScans, plan.observe))
        params = settings_of(inputs, plan)
        check_grid(writer, plan.grid, params, [number], overwrite=True)
        MadeFrom(PROVISIONAL).write(writer, f"made-{plan.grid}")
        if (existing := writer.read_document(document)) != to_json(params):
            if existing is not None:
                writer.remove_grid(plan.grid)
            writer.write_document(document, to_json(params))
        self.is_begun = True

    def _track(self, actor: FoundActor) -> Track:
        return track_of(actor, self.feed.times, self.feed.classes.deformable)

    def _actors_now(self) -> MovingActors:
        """Return the moving actors; their tracks are at most `_AGAIN_S` old."""
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
            self._actors = replace(actors, tracks=numbered, numbers={n: n for n in numbered})
        return replace(self._actors, moving={**self._follower.moved, **self._actors.moving})


_DRIVES: dict[str, _GrowingDrive] = {}  # the drive of this process, by its key
