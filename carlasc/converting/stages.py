"""The stages of the conversion of one recording: its scans are read once and written, then labels,
boxes and flow from the motion of actors are added, and its cameras are written.

A worker converts several frames in one task.
"""

from __future__ import annotations

from bisect import bisect
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import groupby
from operator import attrgetter
from typing import Any

import numpy as np

from carlasc.converting.actors import (
    MAX_GAP,
    ActorMotion,
    ActorObservation,
    Fields,
    MotionJob,
    MotionStage,
    Velocity,
    find_actors,
)
from carlasc.converting.assembling import (
    AxesAndClasses,
    Images,
    Rig,
    VehicleMotion,
    make_fields,
    read_scan,
)
from carlasc.converting.plans import (
    RecordingPlan,
    begin,
    estimate_poses,
    fill_gaps,
    follow,
    write_found,
    write_poses,
)
from carlasc.converting.plausibility import check_mount, find_mount
from carlasc.converting.protocol import Converter, Failure, FrameHandle
from carlasc.core.arrays import AnyArray, Float32Array, FloatArray
from carlasc.core.boxes import Boxes
from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import invert
from carlasc.core.grids import GridSpec, mirror_grid
from carlasc.errors import CarlascError, StorageError
from carlasc.motion import Track, tracks_from_boxes
from carlasc.motion.ground import Ground, find_ground
from carlasc.motion.odometry import UsableScan, usable_points
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import layout
from carlasc.storage.camera_files import cameras_to_json
from carlasc.storage.inputs import digest_of
from carlasc.storage.layout import Metadata
from carlasc.storage.protocol import SequenceWriter

VOXEL_FILES = "voxels_kitti"
"""Folder of a sequence with the unchanged voxel files of the other data set, so that an export can
write them again.
"""

_NEARLY_ALL = 0.99  # share of the points within the reach of a recording
_GROUND_FRAMES = 5  # scans in which the ground is looked for
_NEAR_M = 250.0  # boxes farther away from the sensor hold no points
_FRAMES = 8  # frames per task if each has its own files, because a task costs more than a frame


@dataclass(frozen=True)
class ScanJob:
    """A frame to read.

    Attributes:
        handle: the frame.
        motion: the motion of the vehicle around it, if known.
        write: False if its scan exists already.
    """

    handle: FrameHandle
    motion: VehicleMotion | None = None
    write: bool = True


@dataclass
class ConvertedFrame:
    """The result of a stage for one frame: its fields were written, or are still to be written, or
    it failed.

    Attributes:
        number: frame number.
        fields: its fields, until they are written.
        failure: error message, if it failed.
        points: (N, 3) float32 points to estimate poses from, right-handed, if they were requested.
        actors: its numbered actors, if they were requested.
        unnumbered: number of its moving points that belong to no numbered actor.
        names: names of the fields that were made.
        changed: whether any of them was not in the output already.
    """

    number: int
    fields: Fields = field(default_factory=dict)
    failure: str | None = None
    points: Float32Array | None = None
    actors: tuple[ActorObservation, ...] = ()
    unnumbered: int = 0
    names: frozenset[str] = frozenset()
    changed: bool = False


@dataclass(frozen=True)
class ScanStage:
    """Reads frames, in a worker.

    Attributes:
        target: the axes and classes of the output.
        writer: the output.
        rig: the sensors.
        voxels: geometry of the frames' own voxel grids, right-handed, if they are written.
        for_odometry: whether their points are returned, from which poses are estimated.
        for_actors: whether their actors are returned, whose motion is estimated.
        again: whether voxels that are written already are read again.
    """

    target: AxesAndClasses
    writer: SequenceWriter
    rig: Rig
    voxels: GridSpec | None = None
    for_odometry: bool = False
    for_actors: bool = False
    again: bool = False

    def make(self, job: ScanJob, frame: ConvertedFrame) -> Fields:
        """Read a frame; return the fields of its scan and of its own voxel grid, and add other
        requested data to the result.
        """
        fields: dict[str, AnyArray] = {}
        if job.write or self.for_odometry or self.for_actors:
            scan = read_scan(job.handle, self.rig, job.motion)
            classes = self.target.source
            if self.for_odometry:
                frame.points = scan.points[usable_points(scan.points), :3]
            if self.for_actors and scan.labels is not None and scan.instances is not None:
                frame.actors = find_actors(scan.points, scan.labels, scan.instances, classes)
                moving = np.isin(scan.labels, sorted(classes.moving))
                frame.unnumbered = int(np.count_nonzero(moving & (scan.instances == 0)))
            if job.write:
                fields = make_fields(scan, self.target, job.handle.location)
        if self.voxels is not None:
            fields |= self._voxel_fields(job.handle, self.voxels)
        return fields

    def _voxel_fields(self, handle: FrameHandle, spec: GridSpec) -> dict[str, AnyArray]:
        """Return the fields of the frame's own voxel grid, and keep its files; empty if it has
        none, or if it is written already.
        """
        grid = layout.grid_folder(spec)
        written = not self.again and self.writer.has(f"{grid}/counts", handle.number)
        voxels = None if written else handle.read_voxels()
        if voxels is None:
            return {}
        labels = self.target.map_labels(voxels.labels, f"voxels of {handle.location}")
        # occupied, but its class has no target
        known = voxels.known & ~((labels == 0) & (voxels.labels > 0))
        labels[~known] = 0
        for name, data in voxels.files.items():
            self.writer.write_document(f"{VOXEL_FILES}/{name}", data)
        counts = known.astype(np.float32)
        if self.target.mirrored:
            labels = mirror_grid(labels)
            counts = mirror_grid(counts)
        return {f"{grid}/labels": labels, f"{grid}/counts": counts}


@dataclass(frozen=True)
class Block:
    """Several frames that a worker converts in one task.

    Attributes:
        stage: makes the fields of each frame.
        jobs: the frames: a `ScanJob` or a `MotionJob` each, as the stage takes them.
        again: whether only fields that differ from those in the output are written.
    """

    stage: ScanStage | MotionStage
    jobs: tuple[Any, ...]
    again: bool = False

    def convert(self) -> list[ConvertedFrame]:
        """Convert the frames, and write them if the writer can be used in workers.

        A frame that cannot be read has failed.

        Raises:
            StorageError: the output cannot be written, so that all other frames would fail, too.
        """
        frames = [ConvertedFrame(job.handle.number) for job in self.jobs]
        for job, frame in zip(self.jobs, frames, strict=True):
            try:
                frame.fields = self.stage.make(job, frame)
                frame.names = frozenset(frame.fields)
                if self.again:
                    frame.fields = _different(self.stage.writer, frame.number, frame.fields)
                frame.changed = bool(frame.fields)
            except StorageError:
                raise
            except (CarlascError, OSError) as error:
                frame.failure = str(error)
        if self.stage.writer.concurrent:
            write_frames(self.stage.writer, frames)
        return frames

    def fail(self, message: str) -> list[ConvertedFrame]:
        """Return the frames of a block whose worker failed."""
        return [ConvertedFrame(job.handle.number, failure=message) for job in self.jobs]


def _different(writer: SequenceWriter, number: int, fields: Fields) -> Fields:
    """Return the fields that differ from those in the output."""
    return {
        name: array
        for name, array in fields.items()
        if not writer.has(name, number)
        or (there := writer.read(name, number)) is None
        or digest_of(name, there) != digest_of(name, array)
    }


def write_frames(writer: SequenceWriter, frames: Iterable[ConvertedFrame]) -> None:
    """Write the fields of some frames, in the order of each frame, and drop them from memory."""
    frames = list(frames)
    if fields := {frame.number: frame.fields for frame in frames if frame.fields}:
        writer.write_frames(fields)
    for frame in frames:
        frame.fields = {}


def waits_for(failed: int) -> str:
    """Return why a frame is not finished: another one failed."""
    return f"frame {failed}, which failed: repair that one, or finish with `allow_gaps=True`"


def in_blocks(
    handles: Sequence[FrameHandle], writer: SequenceWriter
) -> Iterator[Sequence[FrameHandle]]:
    """Yield frames, by increasing number, in blocks, one per task: those that the writer stores
    together, otherwise a few successive ones.
    """
    if writer.block == 1:
        yield from (handles[i : i + _FRAMES] for i in range(0, len(handles), _FRAMES))
    else:
        yield from (
            list(block) for _, block in groupby(handles, lambda one: one.number // writer.block)
        )


@dataclass
class Conversion:
    """The conversion of one recording.

    Attributes:
        plan: what is read, and where it is written.
        converter: what reads the data set.
        target: how frames are written.
        images: "copy", "link" or "none": the images of cameras.
        run_options: how the work is spread.
        steps: called after each frame of each stage.
        failures: frames that failed.
        notes: remarks about the result, one line each.
        failed: numbers of the frames that failed.
        changed: numbers of the frames that were not in the output already.
        allow_gaps: whether frames are finished that take labels or motion from a frame that failed.
        ground: the ground in some of its scans; None if none was found, or scans cannot be read
            back.
        reach_m: nearly all points of these scans are nearer, metres, seen from above.
    """

    plan: RecordingPlan
    converter: Converter
    target: AxesAndClasses
    images: Images
    run_options: Run
    steps: StepCounter
    allow_gaps: bool = False
    failures: list[Failure] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    ground: Ground | None = None
    reach_m: float = np.inf
    failed: set[int] = field(default_factory=set)
    _held: set[int] = field(default_factory=set)
    changed: set[int] = field(default_factory=set)
    _names: dict[int, frozenset[str]] = field(default_factory=dict)
    _unnumbered: int = 0

    def run(self, metadata: Metadata) -> None:
        """Convert the recording, or the frames that an earlier run did not convert."""
        plan = self.plan
        begin(plan, self.target, metadata)
        # the poses correct the scans: each scan is read twice
        if plan.poses is None and plan.rig.needs_motion:
            self.steps.expect(len(plan.recording.frames))
            plan.take_estimate(estimate_poses(plan, self.converter, self.steps, self.run_options))
            write_poses(plan, self.target)
        velocities = self._read_scans()
        if plan.poses is not None:
            write_poses(plan, self.target)
        self._finish(velocities)
        self.find_ground()
        self.failures += [
            Failure(plan.recording.location, *problem) for problem in plan.recording.problems()
        ]
        self.notes += self._remarks()
        self.notes += _write_cameras(plan, self.target, self.images)

    def remove_others(self, earlier: Iterable[int]) -> None:
        """Remove fields, and frames of an earlier run, that the data set has no longer.

        Raises:
            ConflictError: the store cannot remove frames.
        """
        plan = self.plan
        gone = set(earlier) - set(plan.recording.frame_numbers)
        if gone:
            grid = [] if plan.voxels is None else [layout.grid_folder(plan.voxels)]
            own = [f"{name}/{part}" for name in grid for part in ("labels", "counts")]
            images = [
                f"images.{camera.name}.{suffix}"
                for camera in plan.recording.cameras()
                for suffix in layout.IMAGE_SUFFIXES
            ]
            plan.writer.remove_frames([*layout.SCAN_FIELDS, *own, *images], gone)
        for number, made in self._names.items():
            others = [
                name
                for name in layout.SCAN_FIELDS
                if name not in made and plan.writer.has(name, number)
            ]
            if others and number not in self.failed:
                plan.writer.remove_frames(others, [number])
                self.changed.add(number)

    @property
    def waits(self) -> bool:
        """Whether any frame waits for one that failed. The grids of the recording then wait too."""
        return bool(self._held)

    @property
    def made(self) -> int:
        """Number of frames that were converted."""
        made = self.changed if self.plan.again else self.plan.unfinished
        return len(made - self.failed - self._held)

    @property
    def skipped(self) -> int:
        """Number of frames that were kept."""
        kept = set(self.plan.recording.frame_numbers) - self.failed - self._held
        return len(kept) - self.made

    @property
    def has_scans(self) -> bool:
        """Whether the scan of any frame exists."""
        has = self.plan.writer.has
        return any(has("points", number) for number in self.plan.recording.frame_numbers)

    def _read_scans(self) -> Mapping[int, Mapping[int, Velocity]]:
        """Read each frame once, and write its scan; return the velocities of numbered actors by
        frame.

        Missing poses are estimated meanwhile, and actors are tracked if their motion must be
        estimated.
        """
        plan = self.plan
        follow = plan.flow and plan.boxes is None and bool(plan.unfinished)
        estimate = plan.poses is None
        chosen = [
            handle
            for handle in plan.recording.frames
            if follow or estimate or handle.number in plan.missing or plan.voxels
        ]
        self.steps(len(plan.recording.frames) - len(chosen))
        stage = ScanStage(
            self.target, plan.writer, plan.rig, plan.voxels, estimate, follow, plan.again
        )
        blocks = [
            Block(
                stage,
                tuple(
                    ScanJob(handle, plan.motion(handle), handle.number in plan.missing)
                    for handle in part
                ),
                plan.again,
            )
            for part in in_blocks(chosen, plan.writer)
        ]
        actors = ActorMotion(self.converter.classes, self.run_options) if follow else None
        poses: dict[int, FloatArray] = {}
        for result, pose in self._placed(self._work(blocks)):
            if estimate:
                poses[result.number] = pose
            if actors is not None:
                actors.add(result.number, float(plan.times[result.number]), pose, result.actors)
                self._unnumbered += result.unnumbered
        # otherwise, the failures are reported
        if estimate and len(self.failed) < len(plan.recording.frames):
            plan.take_estimate(fill_gaps(poses, plan.recording))
        return {} if actors is None else actors.finish()

    def _placed(
        self, results: Iterator[ConvertedFrame]
    ) -> Iterator[tuple[ConvertedFrame, FloatArray]]:
        """Yield the frames that were read with their poses, which are estimated if they are not
        known.
        """
        usable = filter(lambda result: result.failure is None, results)
        if self.plan.poses is not None:
            for result in usable:
                yield result, self.plan.poses[result.number]
            return
        waiting: dict[int, ConvertedFrame] = {}

        def scans() -> Iterator[tuple[int, UsableScan]]:
            for result in usable:
                if result.points is not None:
                    points = result.points
                    result.points = None
                    waiting[result.number] = result
                    yield result.number, (points, None)

        for number, pose in follow(scans(), self.converter, self.plan):
            yield waiting.pop(number), pose

    def _work(self, blocks: Sequence[Block]) -> Iterator[ConvertedFrame]:
        """Yield the frames of blocks after their conversion; if workers cannot write them, they are
        written here.
        """
        run = partial(run_all, Block.convert, run=self.run_options)

        def one_by_one(block: Block, message: str) -> list[ConvertedFrame]:
            """Convert the frames of a lost block again, one by one, because one of them may have
            killed the workers.
            """
            if len(block.jobs) == 1 or self.plan.writer.block > 1:
                return block.fail(message)
            singles = [replace(block, jobs=(job,)) for job in block.jobs]
            return [frame for frames in run(singles, lost=Block.fail) for frame in frames]

        with closing(run(blocks, lost=one_by_one)) as results:
            for frames in results:
                write_frames(self.plan.writer, frames)
                for frame in frames:
                    self._names[frame.number] = frame.names | self._names.get(
                        frame.number, frozenset()
                    )
                    if frame.changed:
                        self.changed.add(frame.number)
                    if frame.failure is not None:
                        self.failed.add(frame.number)
                        self.failures.append(
                            Failure(self.plan.recording.location, frame.number, frame.failure)
                        )
                    yield frame
                self.steps(len(frames))

    def _finish(self, velocities: Mapping[int, Mapping[int, Velocity]]) -> None:
        """Add labels, instances, boxes and flow from the motion of actors."""
        plan = self.plan
        todo = plan.unfinished - self.failed if plan.added else set[int]()
        waiting = {} if self.allow_gaps else self._waiting(velocities)
        self.failures += [
            Failure(
                plan.recording.location,
                number,
                f"{plan.recording.location}: frame {number} waits for {waits_for(failed)}",
                waits=True,
            )
            for number, failed in sorted(waiting.items())
            if number in todo
        ]
        self._held |= waiting.keys() & todo
        wanted = [
            handle for handle in plan.recording.frames if handle.number in todo - waiting.keys()
        ]
        if not wanted or plan.poses is None:
            return
        self.steps.expect(len(wanted))
        tracks, boxes = self._box_tracks()
        blocks = []
        stage = MotionStage(self.target, plan.writer, plan.rig, plan.flow)
        for part in in_blocks(wanted, plan.writer):
            near = None if tracks is None else _near(tracks, part, plan.poses)
            jobs = [
                MotionJob(
                    handle,
                    plan.motion(handle),
                    plan.poses[handle.number],
                    velocities.get(handle.number, {}),
                    near,
                    boxes.get(handle.number),
                    self._labelled_around(handle),
                    plan.recording.has_labels and handle.labelled,
                    self._names.get(handle.number),
                )
                for handle in part
            ]
            blocks.append(Block(stage, tuple(jobs), plan.again))
        deque(self._work(blocks), maxlen=0)  # frames are written; nothing is kept

    def _waiting(self, velocities: Mapping[int, Mapping[int, Velocity]]) -> dict[int, int]:
        """Return the frames that take labels or motion from a frame that failed, each with the
        number of that frame.
        """
        waiting = dict[int, int]()
        frames: dict[int, list[int]] = {}
        for number, actors in velocities.items():
            for actor in actors:
                frames.setdefault(actor, []).append(number)
        for own in frames.values():
            reach = range(min(own) - MAX_GAP, max(own) + MAX_GAP + 1)
            failed = [number for number in sorted(self.failed) if number in reach]
            waiting |= dict.fromkeys(own, failed[0]) if failed else {}
        for handle in self.plan.recording.frames if self.plan.recording.has_labels else ():
            near = [] if handle.labelled else self._neighbours(handle)
            failed = [other.number for other in near if other.number in self.failed]
            waiting |= {handle.number: failed[0]} if failed else {}
        return waiting

    def _neighbours(self, handle: FrameHandle) -> list[FrameHandle]:
        """Return the frames with labels of their own before and after a frame."""
        place = bisect(self._labelled, handle.number, key=attrgetter("number"))
        return self._labelled[max(place - 1, 0) : place + 1]

    def _labelled_around(self, handle: FrameHandle) -> tuple[MotionJob, ...]:
        """Return the labelled frames before and after an unlabelled frame of a recording with
        labels.
        """
        plan = self.plan
        if handle.labelled or not plan.recording.has_labels or plan.poses is None:
            return ()
        return tuple(
            MotionJob(
                other,
                plan.motion(other),
                plan.poses[other.number],
                own=self._names.get(other.number),
            )
            for other in self._neighbours(handle)
        )

    @cached_property
    def _labelled(self) -> list[FrameHandle]:
        """The frames with labels of their own; without `allow_gaps`, also those that failed."""
        return [
            handle
            for handle in self.plan.recording.frames
            if handle.labelled and not (self.allow_gaps and handle.number in self.failed)
        ]

    def _box_tracks(self) -> tuple[list[Track] | None, dict[int, Boxes]]:
        """Return the tracks of the recording's boxes, and the boxes of each annotated frame."""
        plan = self.plan
        if plan.boxes is None or plan.poses is None:
            return None, {}
        poses = {number: plan.poses[number] for number in plan.boxes}
        numbers = sorted({*poses, *plan.recording.frame_numbers})
        times = {number: float(plan.times[number]) for number in numbers}
        return tracks_from_boxes(plan.boxes, poses, times), plan.boxes

    def find_ground(self) -> None:
        """Find the ground in some of the scans; write the height of the sensor if the data set
        does not say it, and what was found.
        """
        plan = self.plan
        frames = self.plan.recording.frame_numbers
        chosen = {frames[i] for i in np.linspace(0, len(frames) - 1, _GROUND_FRAMES).astype(int)}
        scans = [
            points
            for number in sorted(chosen - self.failed)
            if plan.writer.has("points", number)
            and (points := plan.writer.read("points", number)) is not None
        ]
        self.ground = find_ground(scans)
        away = np.concatenate([np.empty(0), *(np.hypot(*points[:, :2].T) for points in scans)])
        if len(away):
            self.reach_m = float(np.quantile(away, _NEARLY_ALL))
        if plan.recording.rays and not plan.findings:
            plan.findings += check_mount(find_mount(scans), plan.recording.location, force=True)
        write_found(plan, None if self.ground is None else self.ground.below_m)

    def _remarks(self) -> list[str]:
        plan = self.plan
        notes = [*plan.recording.notes(), *plan.notes]
        every = len(plan.recording.frames)
        if 0 < (existing := every - len(plan.unfinished)) < every:
            notes.append(f"an earlier run was continued: {existing} of {every} frames existed")
        if self.waits:
            notes.append("its grids wait, too, until all frames are converted")
        unlabelled = sum(not handle.labelled for handle in plan.recording.frames)
        if plan.boxes is not None and not plan.recording.has_labels:
            notes.append(
                "points have no labels: points in boxes got the class of the box, others are "
                "ground or have no class"
            )
        elif plan.boxes is not None and unlabelled:
            notes.append(
                f"{unlabelled} scans have no labels: their points got the class of the box that "
                f"they are in, or of labelled points nearby"
            )
        elif plan.boxes is None and not plan.recording.has_labels:
            notes.append(
                "scans have no labels, so neither labels nor instances nor flow were written"
            )
        if self._unnumbered:
            notes.append(
                f"{self._unnumbered} moving points belong to no numbered actor; their flow is "
                f"unknown and set to 0"
            )
        first = plan.recording.frames[0].number
        last = plan.recording.frames[-1].number
        every = last - first + 1
        if gaps := every - len(plan.recording.frames):
            notes.append(f"{gaps} of the {every} frames from {first} to {last} have no scan")
        return [f"{plan.writer.location}: {note}" for note in notes]


def _near(
    tracks: list[Track], handles: Sequence[FrameHandle], poses: FloatArray
) -> tuple[Track, ...]:
    """Return the tracks near the sensor in some frames, cut to these frames, so that little is sent
    to a worker.
    """
    here = poses[handles[0].number, :2, 3]
    near = []
    for track in tracks:
        part = track.between(handles[0].number, handles[-1].number)
        places = part.world_T_actor[:, :2, 3]
        if len(places) and float(np.square(places - here).sum(axis=1).min()) < _NEAR_M**2:
            near.append(part)
    return tuple(near)


def _write_cameras(plan: RecordingPlan, target: AxesAndClasses, images: Images) -> list[str]:
    """Write the cameras of a recording, and their images if they are copied; return notes."""
    cameras = plan.recording.cameras()
    if not cameras:
        if plan.again:
            plan.writer.remove_document(layout.CAMERAS)
        return []
    target_T_scan = np.diag([1.0, -1.0 if target.mirrored else 1.0, 1.0, 1.0])
    scan_T_vehicle = target_T_scan @ invert(plan.rig.vehicle_T_scan)
    written = [
        camera.replaced(
            sensor_T_camera=scan_T_vehicle @ camera.sensor_T_camera,
            times=None if camera.times is None else camera.times - plan.times[0],
            images=camera.images if images == "link" else None,
        )
        for camera in cameras
    ]
    content = cameras_to_json(written)
    if plan.writer.read_document(layout.CAMERAS) != content:
        plan.writer.write_document(layout.CAMERAS, content)
    if images == "link" and not any(camera.images for camera in cameras):
        return [
            "no camera has images in separate files to link to: --images copy writes the images"
        ]
    return _copy_images(plan, cameras) if images == "copy" else []


def _copy_images(plan: RecordingPlan, cameras: Sequence[CameraModel]) -> list[str]:
    """Copy the images of all frames, those that are stored together at once; return the number of
    missing images.
    """
    missing = 0
    blocks = dict[int, list[int]]()
    for handle in plan.recording.frames:
        blocks.setdefault(handle.number // plan.writer.block, []).append(handle.number)
    for numbers in blocks.values():
        by_frame: dict[int, dict[str, AnyArray]] = {}
        for number in numbers:
            for camera in cameras:
                if not plan.again and any(
                    plan.writer.has(f"images.{camera.name}.{suffix}", number)
                    for suffix in layout.IMAGE_SUFFIXES
                ):
                    continue
                if (image := plan.recording.image(camera, number)) is None:
                    missing += 1
                    continue
                made = {f"images.{camera.name}.{image[0]}": np.frombuffer(image[1], np.uint8)}
                if new := _different(plan.writer, number, made):
                    by_frame.setdefault(number, {}).update(new)
        if by_frame:
            plan.writer.write_frames(by_frame)
    note = f"{missing} images of cameras do not exist, or are neither .jpg nor .png"
    return [note] if missing else []
