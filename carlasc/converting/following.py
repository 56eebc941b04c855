"""`follow`: a drive that is still being recorded. Its scans are converted as they appear, and grids
are made as soon as their windows are complete. Both are provisional: `convert` makes the final ones
when the drive has ended.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, cast
from uuid import uuid4

import numpy as np

from carlasc.converting.assembling import (
    Assembled,
    LayoutOptions,
    VehicleMotion,
    make_fields,
    read_scan,
)
from carlasc.converting.chosen import ChosenFrames
from carlasc.converting.plans import (
    CONVERSION,
    begin,
    plan_recording,
    sequence_path,
)
from carlasc.converting.plans import follow as estimate
from carlasc.converting.protocol import Converter, FrameHandle, Trajectory
from carlasc.converting.registry import find_recordings, open_converter
from carlasc.converting.run import check_arguments, describe, plan_grids
from carlasc.converting.stages import Conversion
from carlasc.core.arrays import FloatArray
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import Transform, invert, mirror_poses
from carlasc.errors import (
    ArgumentError,
    CarlascError,
    ConflictError,
    FormatError,
    MissingDataError,
    check_types,
    count,
    only,
)
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.options import FromScans, GridOptions, Voting
from carlasc.groundtruth.provisional import make_provisional
from carlasc.inspection.pose_quality import describe_jumps
from carlasc.motion import odometry
from carlasc.motion.options import PoseOptions
from carlasc.running.processes import own_processes
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import layout as files
from carlasc.storage.files import AnyPath
from carlasc.storage.folder import FolderSink
from carlasc.storage.inputs import PROVISIONAL, MadeFrom
from carlasc.storage.layout import Metadata
from carlasc.storage.opening import as_sink
from carlasc.storage.protocol import Sink, Source

_LOOK_S = 0.5  # between two looks at the folder
_BATCH = 5  # scans that are written together, at most
_PAUSE_S = 3.0  # a pause of the sensor that is noted
_SAID_S = 10.0  # between two lines on the progress
_CALLS = 2  # of a maker that wait for its result
_AROUND = 20  # poses that give the motion during a scan


def follow(
    name: str | type[Converter],
    source: AnyPath,
    out: AnyPath,
    *,
    idle_s: float | None = None,
    layout: LayoutOptions = LayoutOptions(),  # noqa: B008 (frozen)
    poses: PoseOptions = PoseOptions(),  # noqa: B008 (frozen)
    grids: GridOptions | None = GridOptions(),  # noqa: B008 (frozen)
    options: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = lambda line: None,
    wait: Callable[[float], None] = time.sleep,
) -> None:
    """Convert the scans of a growing folder as they appear, until no scan comes any more or Ctrl-C.

    A scan is taken when its size did not change between two looks. Its pose is estimated from the
    scans before it, whatever poses the recording has. This process takes scans, and another one
    makes grids of frames whose windows are complete: of as many as it has time for. All of this is
    marked as provisional, and `convert` with the same arguments replaces it: its result does not
    depend on what was made here.

    Args:
        name: the converter, of a data set with one recording: "scans".
        source: the folder.
        out: folder to write to.
        idle_s: seconds without a new scan after which the drive has ended; None: it ends by Ctrl-C.
        layout: how sequences are written.
        poses: how poses are estimated.
        grids: the grids; None makes none.
        options: options of the converter, by name.
        say: called with what happens, one line each.
        wait: waits for some seconds, between two looks at the folder.

    Raises:
        ArgumentError: an argument has a wrong value, or does not fit a growing folder.
        ConflictError: `out` lies inside `source`, or holds other data.
        MissingDataError: there is no such folder.
        FormatError: the first scan shows that axes or options are wrong.
        DependencyError: kiss-icp is not installed.
    """
    check_types(follow, locals())
    root, sink = Path(source), as_sink(out)
    check_arguments(root, sink, "all", grids)
    if layout.level:
        raise ArgumentError("level", expected="False while the drive grows", found="True")
    if not isinstance(sink, FolderSink):
        raise ArgumentError("out", expected="a folder, while the drive grows", found=out)
    poses = replace(poses, source="kiss-icp")
    layout = replace(layout, boxes=None)
    converter = open_converter(name, root, options)
    look = _Folder(converter, idle_s, say, wait)
    with own_processes(1) as maker:
        documents = describe(converter, name, layout)
        drive = _Drive(look, converter, sink, layout, documents, poses, grids, maker)
        try:
            drive.run()
        except KeyboardInterrupt:
            say("the drive was ended")
        drive.finish()


@dataclass
class _Folder:
    """A folder that grows, and the converter that reads it."""

    converter: Converter
    idle_s: float | None
    say: Callable[[str], None]
    wait: Callable[[float], None]

    def scans(self) -> Iterator[tuple[FrameHandle, float | None] | None]:
        """Yield each scan when it is whole, and its time; None after each look."""
        problem, waited, before = "", 0.0, dict[str, tuple[int, int]]()
        last, taken = "", set[str]()  # scans may be moved away, so that the last one is gone
        while self.idle_s is None or waited < self.idle_s:
            fresh, times = list[FrameHandle](), None
            try:
                found = {one.location: one for one in find_recordings(self.converter)}
                recording = only("source", found, "one growing recording")
                places = [handle.location for handle in recording.frames]
                start = places.index(last) + 1 if last in places else 0
                fresh = [one for one in recording.frames[start:] if one.location not in taken]
                times = recording.times() if fresh else None
            except (MissingDataError, FormatError, OSError) as error:
                if str(error) != problem:
                    self.say(f"waiting for scans: {error}")
                problem, fresh = str(error), []
            now = {handle.location: _state(handle.location) for handle in fresh}
            for handle in fresh:
                if before.get(handle.location) != now[handle.location]:
                    break  # it is new, or still being written
                last = handle.location
                taken.add(last)
                yield handle, None if times is None else float(times[handle.number])
            if now and now != before:
                if waited >= _PAUSE_S and last:
                    self.say(f"scans come again after {waited:g} s")
                waited = 0.0
            before = now
            yield None
            self.wait(_LOOK_S)
            waited += _LOOK_S
            if waited - _LOOK_S < _PAUSE_S <= waited and last:
                self.say(f"no scan for {_PAUSE_S:g} s: waiting")


def _state(location: str) -> tuple[int, int]:
    """Return the size and the time of a file; zeros if it is gone."""
    try:
        about = os.stat(location)
    except OSError:
        return 0, 0
    return about.st_size, about.st_mtime_ns


@dataclass
class _Drive:
    """What is known of the drive so far, and the grids that are being made.

    Attributes:
        folder: the growing folder.
        converter: what reads it.
        sink: the output.
        layout: how sequences are written.
        metadata: the entries of carlasc.json that do not depend on scans.
        poses: how poses are estimated.
        grids: the grids; None makes none.
        maker: a process that makes grids.
        arrived: time of the file of each scan, or of the start after it, by frame number.
        lines: pose of each scan, first_T_scan, as far as they are estimated.
    """

    folder: _Folder
    converter: Converter
    sink: Sink
    layout: LayoutOptions
    metadata: Metadata
    poses: PoseOptions
    grids: GridOptions | None
    maker: Executor
    arrived: list[float] = field(default_factory=list)
    lines: list[Transform] = field(default_factory=list)
    _waiting: dict[int, tuple[FrameHandle, Assembled]] = field(default_factory=dict)
    _written: int = 0
    _poses: bytes = b""
    _grid: GridPlan | None = None
    _making: list[Future[tuple[list[int], list[str]]]] = field(default_factory=list)
    _made: list[int] = field(default_factory=list)
    _told: int = 0
    _begun_s: float = field(default_factory=time.time)
    _key: str = field(default_factory=lambda: uuid4().hex)
    _said: float = 0.0

    def run(self) -> None:
        """Take scans, estimate their poses, and write them, until the drive ends."""
        self.target = self.layout.of(self.converter)
        scans = self._usable()
        if (first := next(scans, None)) is None:
            return
        for number, pose in estimate(chain([first], scans), self.converter, self.plan):
            while len(self.lines) < number:  # a scan without a pose is where the last one was
                self.lines.append(self.lines[-1] if self.lines else pose)
            self.lines.append(pose)
            if len(self.lines) >= self._written + _BATCH:
                self.write()
        self.write()

    def _usable(self) -> Iterator[tuple[int, odometry.UsableScan]]:
        """Yield the number and the points of each scan that can be read."""
        for found in self.folder.scans():
            if found is None:
                self.write()
                continue
            (handle, seconds), number = found, len(self.arrived)
            if not number:
                self._begin()
            at_s = number * files.FRAME_PERIOD_S if seconds is None else seconds
            self.plan.times = np.append(self.plan.times, at_s)
            self.arrived.append(max(_state(handle.location)[1] / 1e9, self._begun_s))
            try:
                scan = read_scan(handle, self.plan.rig, None)
            except (CarlascError, OSError) as error:
                self.folder.say(f"left out: {error}")
                continue
            self._waiting[number] = handle, scan
            used = odometry.usable_points(scan.points)
            since = scan.fields.get("seconds") if self.plan.rig.needs_motion else None
            yield number, (scan.points[used, :3], None if since is None else since[used])

    def _begin(self) -> None:
        """Check the first scans, and begin the output.

        Raises:
            ConflictError: it holds other data.
        """
        (recording,) = find_recordings(self.converter)
        self.plan = plan = plan_recording(
            recording, self.converter, self.sink, self.layout, self.poses, voxels=False
        )
        before = MadeFrom.read(plan.writer, CONVERSION)
        observe = self.grids and self.grids.observe
        if before == MadeFrom() and plan.writer.read_document(files.METADATA) is not None:
            raise ConflictError(
                plan.writer.location,
                expected="nothing, or what `convert` wrote",
                found="other data",
                advice="write to another place",
            )
        plan.max_range_m = observe.max_range_m if isinstance(observe, FromScans) else None
        self._mark(before.frames)
        plan.writer.remove_document(files.METADATA)
        plan.again = plan.is_same = True
        begin(plan, self.target, self.metadata)
        plan.times = plan.times[:0]

    def _mark(self, frames: Mapping[str, str]) -> None:
        """Note that the output is provisional."""
        MadeFrom(PROVISIONAL, {}, dict(frames)).write(self.plan.writer, CONVERSION)

    def write(self) -> None:
        """Write the scans whose poses are known, poses and times first; and look after grids."""
        if (known := len(self.lines)) > self._written:
            plan, times = self.plan, self.plan.times[:known]
            poses = np.stack(self.lines)
            fresh = poses[self._written :]
            stored = mirror_poses(fresh) if self.target.mirrored else fresh
            self._poses += files.encode_poses(stored)
            new = slice(max(self._written - 1, 0), known)
            if jump := describe_jumps(np.arange(known)[new], poses[new], times[new]):
                self.folder.say(f"the sensor jumped: {jump}")
            earlier = MadeFrom.read(plan.writer, CONVERSION).frames
            self._mark(earlier | dict.fromkeys(map(str, range(self._written, known)), "done"))
            plan.writer.write_document(files.POSES, self._poses)
            plan.writer.write_document(files.TIMES, files.encode_times(times - times[0]))
            for number in sorted(n for n in self._waiting if n < known):
                handle, scan = self._waiting.pop(number)
                try:
                    if plan.rig.needs_motion:
                        scan = read_scan(handle, plan.rig, self._motion(poses, number))
                    fields = make_fields(scan, self.target, handle.location)
                except (CarlascError, OSError) as error:
                    self.folder.say(f"left out: {error}")
                    continue
                plan.writer.write_frames({number: fields})
            self._written = known
        if self.grids is not None and self._written:
            self._make_grids(self.grids)

    def _motion(self, poses: FloatArray, number: int) -> VehicleMotion | None:
        """Return the motion of the vehicle around a frame; None if it is not known."""
        near = slice(max(number - _AROUND, 0), number + _AROUND)
        times = self.plan.times[: len(poses)][near]
        if len(times) < 2 or not (np.diff(times) > 0).all():
            return None
        vehicle = poses[near] @ invert(self.plan.recording.vehicle_T_scan)
        return VehicleMotion(Trajectory(vehicle, times), float(self.plan.times[number]))

    def _make_grids(self, grids: GridOptions) -> None:
        """Take grids that are made, and tell the maker of new scans: it has one call to work on,
        and one more to go on with.
        """
        if self._grid is None:
            self._grid = self._plan(grids, self.sink.source())
        while self._making and self._making[0].done():
            self._take(self._making.pop(0).result())
        if self._written > self._told and len(self._making) < _CALLS:
            self._told, path = self._written, sequence_path(self.plan.recording)
            about = self._key, self.sink, path, self.plan.writer, self._grid
            self._making.append(self.maker.submit(make_provisional, *about))

    def _take(self, made: tuple[list[int], list[str]]) -> None:
        """Note what the maker made."""
        numbers, problems = made
        for problem in problems:
            self.folder.say(problem)
        self._made += numbers
        if numbers and self._grid is not None:
            observe = cast(FromScans, self._grid.observe)
            self._report(numbers[-1] + observe.window[1])

    def _plan(self, grids: GridOptions, source: Source) -> GridPlan:
        """Return the plan of the grids, by the ground and the reach of the scans so far."""
        (recording,) = find_recordings(self.converter)
        self.plan.recording = ChosenFrames(recording, recording.frames[: self._written])
        one = Conversion(
            self.plan, self.converter, self.target, "none", Run(workers=1), StepCounter(None)
        )
        one.find_ground()
        spec, observe, notes = plan_grids(grids, [one], source, self.poses)
        for note in notes:
            self.folder.say(note)
        voting = grids.voting or Voting()
        return GridPlan(spec, files.grid_folder(spec), observe, voting, FrameRange())

    def _report(self, last: int) -> None:
        """Say how far scans and grids are behind the sensor, from time to time.

        Args:
            last: the last scan in the window of the grid that was made.
        """
        now, made = time.time(), self._made
        if now - self._said < _SAID_S:
            return
        self._said = now
        behind_s = now - self.arrived[self._written - 1]
        grids_s = now - self.arrived[last]
        every = (made[-1] - made[0]) / max(len(made) - 1, 1)
        self.folder.say(
            f"{count(self._written, 'scan')}, {behind_s:.1f} s behind the sensor; "
            f"{count(len(made), 'provisional grid')}, the last {grids_s:.1f} s after its window "
            f"was complete, of every {max(every, 1):.0f}th scan"
        )

    def finish(self) -> None:
        """Wait for the grids that are being made, then for those of the last scans; say what there
        is.
        """
        for _ in range(2):
            while self._making:
                self._take(self._making.pop(0).result())
            self.write()
        made = len(self._made)
        self.folder.say(
            f"the drive has {count(len(self.arrived), 'scan')}; "
            f"{count(made, 'provisional grid')} were made"
        )
