"""Grids of a drive that still grows: from the poses and the scans known so far.

One process makes them. It keeps what it knows of the drive, so each scan is read and searched for
motion once, and each of its rays is followed once. Every N-th scan is merged, and its frame gets a
grid: N is what the process has time for. Poses are not refined.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

from carlasc.errors import CarlascError
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import follower_of, track_of
from carlasc.groundtruth.from_scans.sequences import ScanFrame, ScanSequence, ScanWindow
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.options import FromScans
from carlasc.groundtruth.run import FrameTask, settings_of
from carlasc.motion import Track, complete_bodies
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
# A track is estimated again after so much of the drive: of so many actors with each scan, at most.
_AGAIN_S, _TOGETHER = 2.0, 2
_OWN = 20  # the recording vehicle is looked for again after so many frames
_KEPT = 80  # frames whose observations of actors are kept, at least
_MOST, _EACH = 120, 6  # scans that may wait; N grows by one with so many of them


def make_provisional(
    key: str, sink: Sink, path: str, writer: SequenceWriter, plan: GridPlan
) -> tuple[list[int], list[str]]:
    """Take the scans that were written since the last call, and make grids, marked as provisional.

    Args:
        key: of the drive: other calls with it in the same process continue each other.
        sink: the output.
        path: path of the sequence.
        writer: writes beside it.
        plan: the plan of the final grids.

    Returns:
        The frames that got a grid; and why scans or frames failed.

    Raises:
        StorageError: a grid cannot be written.
    """
    sequence = sink.source().sequences_in([place_of(path)])[path]
    if key not in _DRIVES:
        _DRIVES.clear()
        _DRIVES[key] = _GrowingDrive(sequence, plan, writer)
    drive, made, problems = _DRIVES[key], list[int](), list[str]()
    for frame in drive.choose(sequence):
        try:
            drive.take(frame)
            made += drive.make_grid()
        except (CarlascError, OSError, MemoryError) as error:
            problems.append(f"no grid of frame {frame} yet: {error}")
    return made, problems


class _GrowingDrive:
    """What is known of a drive: what moved in the last scans, and their free space."""

    def __init__(self, sequence: Sequence, plan: GridPlan, writer: SequenceWriter) -> None:
        observe = cast(FromScans, plan.observe)
        self.plan = plan
        self.writer = writer
        self.first, self.last = observe.window
        if observe.motion.source != "none":
            observe = replace(observe, motion=replace(observe.motion, source="evidence"))
        self.feed = feed = ScanFeed(sequence, observe)
        feed.use(sequence, [])
        self._next, self._every, self._unmade = 0, 1, 0
        self._judged = list[int]()  # the frames whose moving points are known
        movable = feed.classes.movable if feed.trusts_ground_labels else ()
        self._evidence = EvidenceWindow(movable, after_s=_AFTER_S)
        self._follower = follower_of(feed)
        self._tracks = dict[int, Track]()

    def choose(self, sequence: Sequence) -> list[int]:
        """Return the scans to take: every N-th one."""
        self.feed.use(sequence, self._judged)
        frames, known = sequence.frames("points").tolist(), len(sequence.poses)
        new = [frame for frame in frames if self._next <= frame < known][-_MOST:]
        self._every = 1 + len(new) // _EACH
        return new[:: self._every]

    def take(self, frame: int) -> None:
        """Take a scan, and find what moved in the scans before it.

        Raises:
            FormatError: it is not valid.
        """
        self._next = frame + self._every
        if frame % _OWN < self._every:
            self._follower.find_own()
        if not self.feed.needs_actors:
            self._judge(frame)
            return
        for found in self._evidence.add(self.feed.evidence_scan(frame, ())):
            self._judge(found.frame)
            self._track(self._follower.add(found.thinned()))
            self._track(self._follower.again(found.seconds - _AGAIN_S, _TOGETHER))

    def _judge(self, frame: int) -> None:
        """Merge a frame from now on, and forget old ones."""
        oldest = frame - max(self.last - self.first, _KEPT)
        self._judged = [one for one in [*self._judged, frame] if one >= oldest]
        self.feed.use(self.feed.sequence, self._judged)
        self._follower.forget_before(oldest)

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
        if not self._unmade:
            self._begin_grid(number)
        self._unmade = number + 1
        follower, numbers = self._follower, {n: n - FIRST_FOUND + 1 for n in self._tracks}
        actors = MovingActors(
            self._tracks, follower.moved, own=tuple(follower.own), numbers=numbers
        )
        frame = ScanFrame(ScanWindow(self.feed, actors), number, number)
        task = FrameTask(number, frame, self.plan, self.feed.classes, False)
        fields, _ = task.outputs_of(replace(frame.make(self.plan), fields={}), frame)
        self.writer.write_frames({number: fields})
        return [number]

    def _begin_grid(self, number: int) -> None:
        """Note that grids are provisional; remove frames with other settings.

        Raises:
            ConflictError: the grid is not one of carlasc's.
        """
        plan = self.plan
        writer = self.writer
        document = layout.params_file(plan.grid)
        inputs = ScanSequence(self.feed.sequence, plan, cast(FromScans, plan.observe))
        params = settings_of(inputs, plan)
        check_grid(writer, plan.grid, params, [number], overwrite=True)
        MadeFrom(PROVISIONAL).write(writer, f"made-{plan.grid}")
        if (existing := writer.read_document(document)) != to_json(params):
            if existing is not None:
                writer.remove_grid(plan.grid)
            writer.write_document(document, to_json(params))

    def _track(self, actors: list[FoundActor]) -> None:
        """Estimate the tracks of actors, instead of earlier ones of the same actors. The others
        stay, with what is kept of them.
        """
        times, deformable = self.feed.times, self.feed.classes.deformable
        tracks = [track_of(actor, times, deformable) for actor in actors]
        gone = self._follower.replaced | self._follower.riders
        self._tracks = {
            number: track
            for number, track in self._tracks.items()
            if number not in gone and max(track.members) >= self._judged[0]
        }
        self._follower.replaced.clear()
        whole = complete_bodies(tracks, self._tracks.values())
        self._tracks |= {track.instance: track for track in whole if track.moves}


_DRIVES: dict[str, _GrowingDrive] = {}  # the drive of this process, by its key
