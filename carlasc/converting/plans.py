"""The plan of a conversion: the requested recordings, their outputs, and their poses and times,
from their files or estimated from their scans.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from carlasc.converting.assembling import (
    AxesAndClasses,
    LayoutOptions,
    Rig,
    VehicleMotion,
    read_scan,
)
from carlasc.converting.chosen import ChosenFrames
from carlasc.converting.given_boxes import GivenBoxes
from carlasc.converting.plausibility import (
    POSE_S,
    Mount,
    are_posed,
    check_mount,
    check_scan,
    check_standing,
    find_mount,
)
from carlasc.converting.protocol import Converter, FrameHandle, Recording, Trajectory
from carlasc.core.arrays import Float32Array, FloatArray
from carlasc.core.boxes import Boxes
from carlasc.core.choices import SplitName as SplitName  # noqa: PLC0414 (part of this module)
from carlasc.core.frames import FrameRange, check_seconds
from carlasc.core.geometry import invert, mirror_poses, relative_to
from carlasc.core.grids import GridSpec, mirror_spec
from carlasc.core.scans import ScanCentres
from carlasc.errors import (
    ArgumentError,
    CarlascError,
    ConflictError,
    FormatError,
    MissingDataError,
    first_runs,
)
from carlasc.inspection.alignment import PoseDiagnosis, diagnose_poses, structure_of
from carlasc.inspection.findings import Finding
from carlasc.inspection.pose_quality import describe_jumps, describe_mounting
from carlasc.motion.options import PoseOptions
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.inputs import PROVISIONAL, MadeFrom
from carlasc.storage.layout import Metadata
from carlasc.storage.protocol import SequenceWriter, Sink
from carlasc.storage.resuming import agree_lines, agree_metadata, check_grid, read_metadata

if TYPE_CHECKING:
    from carlasc.motion.odometry import UsableScan

FILE = "file"
KISS_ICP = "kiss-icp"
CONVERSION = "conversion"
"""Name of the record of what the scans of an output were converted from."""
_ESTIMATE = 'estimate poses from the scans with `poses="kiss-icp"`'
_ACCEPT = "accept them as they are with `force=True`"
# fourth differences, which are nearly 0 for a vehicle
_SMOOTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
_JITTER_M = 0.05
_SCANS = 5  # scans that say how the sensor is mounted
_AROUND_S = 1.0  # part of the trajectory that a frame needs: longer than a sweep


@dataclass
class Examined:
    """What is known of a recording before it is converted.

    Attributes:
        recording: the recording, with the frames that are converted, and upright.
        times: (F,) seconds by frame number, by the recording's clock.
        has_times: whether the recording has times.
        trajectory: poses of the vehicle by the same clock; None until they are estimated.
        poses: (F, 4, 4) first_T_scan by frame number, right-handed; None until they are estimated.
        mount: how the sensor is mounted; None if no ground was found, or not looked for.
        notes: notes for the user on poses and times, one line each.
        findings: what is probably wrong ("warning"), and what stops a conversion ("error").
    """

    recording: Recording
    times: FloatArray
    has_times: bool
    trajectory: Trajectory | None
    poses: FloatArray | None
    mount: Mount | None
    notes: list[str]
    findings: list[Finding]


@dataclass
class RecordingPlan(Examined):
    """One recording and its output.

    Attributes:
        writer: the output.
        pose_source: where poses come from.
        boxes: the annotated boxes by frame number, with class ids of the output, right-handed, in
            the frame of the scan; None if there are none.
        flow: whether flow is written.
        voxels: geometry of the recording's own voxel grids, right-handed, if they are written.
        force: whether estimated poses are accepted without a check.
        voxel_m: size of the voxels of the odometry; None: by the distances of points.
        max_range_m: farther points are not used by the odometry; None: as the converter says.
        missing: numbers of the frames whose scan is not written yet.
        unfinished: numbers of the frames without a scan, or without the fields from the motion of
            actors.
        again: whether all frames are made again and compared with those in the output, because the
            data set changed.
        is_same: whether it is the same data set nevertheless: some of its files are as they were.
        given: the table of boxes that was given, which become `boxes` when poses are known.
    """

    writer: SequenceWriter
    pose_source: str
    boxes: dict[int, Boxes] | None
    flow: bool
    voxels: GridSpec | None = None
    force: bool = False
    voxel_m: float | None = None
    max_range_m: float | None = None
    missing: set[int] = field(default_factory=set)
    unfinished: set[int] = field(default_factory=set)
    again: bool = False
    is_same: bool = False
    given: GivenBoxes | None = None

    def make_again(self, *, is_same: bool) -> None:
        """Make all frames again, because the data set changed."""
        numbers = set(self.recording.frame_numbers)
        self.is_same = is_same
        self.again = True
        self.missing = numbers
        self.unfinished = set(numbers)

    def take_estimate(self, first_T_scan: FloatArray) -> None:
        """Take estimated poses, (F, 4, 4) by frame number."""
        self.poses = first_T_scan
        self.trajectory = at_frames(
            first_T_scan @ invert(self.recording.vehicle_T_scan), self.times
        )
        self.place_boxes()

    def place_boxes(self) -> None:
        """Take the boxes of the given table, if there is one.

        Raises:
            FormatError: they are those of another drive.
        """
        if self.given is not None:
            self.boxes = placed_boxes(self.given, self, force=self.force)

    @property
    def rig(self) -> Rig:
        """The sensors."""
        return Rig.of(self.recording)

    @property
    def added(self) -> tuple[str, ...]:
        """Names of the fields from the motion of actors."""
        flow = ("flow",) if self.flow else ()
        return flow if self.boxes is None else ("labels", "instances", "boxes", *flow)

    def motion(self, handle: FrameHandle) -> VehicleMotion | None:
        """Return the motion of the vehicle around a frame; None if it is not known when the frame
        is read.

        Poses that are estimated from the scans are not known then, even if an earlier run estimated
        them.
        """
        estimated = self.pose_source == KISS_ICP and not self.rig.needs_motion
        if estimated or self.trajectory is None or self.trajectory.seconds is None:
            return None
        now = float(self.times[handle.number])
        first, last = np.searchsorted(self.trajectory.seconds, [now - _AROUND_S, now + _AROUND_S])
        near = slice(max(int(first) - 1, 0), int(last) + 1)
        if len(self.trajectory.world_T_vehicle[near]) < 2:
            near = slice(max(int(first) - 2, 0), int(last) + 2)
        return VehicleMotion(
            Trajectory(self.trajectory.world_T_vehicle[near], self.trajectory.seconds[near]), now
        )


def placed_boxes(given: GivenBoxes, seen: Examined, *, force: bool) -> dict[int, Boxes]:
    """Return the given boxes of each scan that has any, by frame number, in the frame of the scan;
    none until poses are known. Remarks become notes.

    Args:
        given: the boxes.
        seen: the recording, with its times, if it has any, and its poses, if they are known.
        force: whether boxes without points are accepted.

    Raises:
        FormatError: they are those of another drive, by their times, places or points.
    """
    if seen.poses is None and not seen.has_times:
        return {}
    scans = seen.recording.frames
    numbers = [handle.number for handle in scans]
    poses = None if seen.poses is None else seen.poses[numbers]
    seconds = (seen.times - seen.times[0])[numbers]
    boxes, _, notes = given.at_scans(numbers, seconds, poses, seen.recording.location)
    seen.notes += notes
    if boxes and not force:
        frames = [one for one in scans if one.number in boxes]
        given.check(boxes, _some_scans(seen.recording, frames))
    return boxes


def choose_recordings(
    recordings: list[Recording], source: Path, wanted: Collection[str] | None, split: SplitName
) -> list[Recording]:
    """Return the requested recordings, by their names or last parts of names, and by split.

    Args:
        recordings: those that exist.
        source: the data set, for errors.
        wanted: names or the last parts of them; None for all.
        split: the split in lower case, or "all".

    Raises:
        MissingDataError: a name does not exist, or no recording is left; the message lists those
            that exist.
        ConflictError: two recordings have the same name.
    """
    by_name: dict[str, Recording] = {}
    for recording in recordings:
        if recording.name in by_name:
            raise ConflictError(
                recording.location,
                expected="recordings with different names",
                found=f"{recording.name}, which {by_name[recording.name].location} has too",
                advice="convert them to different folders",
            )
        by_name[recording.name] = recording
    short = {name.rpartition("_")[2]: name for name in by_name}
    short = short if len(short) == len(by_name) else {name: name for name in by_name}
    if wanted is not None and (
        unknown := [name for name in wanted if name not in short and name not in by_name]
    ):
        raise MissingDataError(
            source,
            expected=f"the sequences {', '.join(unknown)}",
            found=f"only {', '.join(short) or 'none'}",
        )
    asked = None if wanted is None else {short.get(name, name) for name in wanted}
    chosen = [
        recording
        for name, recording in by_name.items()
        if (asked is None or name in asked) and split in ("all", recording.split.lower())
    ]
    chosen = [recording for recording in chosen if recording.frames or recording.problems()]
    if not chosen:
        found = ", ".join(
            f"{name} ({by_name[n].split}, {len(by_name[n].frames)} scans)"
            for name, n in short.items()
        )
        raise MissingDataError(
            source, expected=f"sequences with scans in the split {split}", found=found or "none"
        )
    if empty := [recording for recording in chosen if not recording.frames]:
        raise MissingDataError(
            empty[0].location, expected="scans", found="none", advice="copy them"
        )
    return chosen


def is_provisional(writer: SequenceWriter) -> bool:
    """Whether an output was written while its recording grew."""
    return MadeFrom.read(writer, CONVERSION).whole == PROVISIONAL


def sequence_path(recording: Recording) -> str:
    """Return the path of the output sequence of a recording."""
    return f"{recording.split}/{recording.name}/cartesian"


def examine(
    recording: Recording,
    converter: Converter,
    options: PoseOptions,
    *,
    frames: FrameRange,
    level: bool,
    known: bool,
) -> Examined:
    """Read the poses and times of a recording, choose its frames, and check what can be checked
    before they are read.

    Args:
        recording: the recording.
        converter: the converter.
        options: where poses come from.
        frames: the frames to convert.
        level: whether scans are turned upright.
        known: whether poses and mount are accepted without a check, for which scans are read.

    Raises:
        ArgumentError: `frames` holds no frame.
        FormatError: poses or times are not valid, or belong to other times than the scans.
        MissingDataError: the recording has no poses, although they were requested.
    """
    notes = list[str | None]()
    findings = list[Finding]()
    checked = recording.rays and (level or not known)
    mount = find_mount([*_some_scans(recording).values()]) if checked else None
    if not level:
        findings += check_mount(mount, recording.location, force=False)
    elif mount is not None:
        recording = _upright(recording, converter, mount, options)
        notes.append(f"scans were turned upright: they show {mount}")
    else:
        raise FormatError(
            recording.location, expected="ground in the scans, to turn them upright", found="none"
        )
    own_times = recording.times()
    times = frame_times(recording, own_times)
    trajectory = read_trajectory(recording, options)
    chosen = [handle for handle in recording.frames if handle.number in frames]
    if not chosen:
        raise ArgumentError(
            "frames",
            expected=f"frames of {recording.location}: {recording.frames[0].number} to "
            f"{recording.frames[-1].number}",
            found=frames,
        )
    if trajectory is not None and trajectory.seconds is not None:
        numbers = np.array([handle.number for handle in chosen])
        posed = are_posed(times[numbers], trajectory.seconds)
        if not posed.all():
            first, last = times[numbers[[0, -1]]]
            begin_s, end_s = trajectory.seconds[[0, -1]]
            if not posed.any():
                raise FormatError(
                    trajectory.where,
                    expected=f"poses over the time of the scans, {first:.3f} to {last:.3f} s",
                    found=f"poses over {begin_s:.3f} to {end_s:.3f} s",
                    advice=f"check that both use the same clock, or {_ESTIMATE}",
                )
            chosen = [handle for handle, there in zip(chosen, posed, strict=True) if there]
            notes.append(
                f"{np.count_nonzero(~posed)} of {len(posed)} scans have no pose at their time, and "
                f"are left out: {first_runs(numbers[~posed].tolist())}"
            )
    if len(chosen) < len(recording.frames):
        recording = ChosenFrames(recording, chosen)
    poses = None
    last = chosen[-1].number + 1
    if trajectory is not None:
        poses = scan_poses(trajectory, recording, times)[:last]
        if trajectory.seconds is None:
            trajectory = at_frames(trajectory.world_T_vehicle, times)
    times = times[:last]
    if not recording.rays:
        notes.append("the positions of the sensor are not known, so no grids are made from scans")
    elif poses is None:
        why = "as requested" if options.source == KISS_ICP else "because the recording has none"
        notes.append(f"poses are estimated from the scans, {why}")
    else:
        if not known:
            try:
                notes.append(check_poses(recording, converter, poses))
            except FormatError as error:
                try:
                    if trajectory is None or trajectory.other is None:
                        raise
                    swapped = replace(trajectory, world_T_vehicle=trajectory.other, other=None)
                    other = scan_poses(swapped, recording, times)[:last]
                    notes.append(check_poses(recording, converter, other))
                    notes.append(f"quaternions in {swapped.where} are w, x, y, z: scans overlap so")
                    trajectory = swapped
                    poses = other
                except FormatError:
                    findings.append(Finding.from_error("poses-on-scans", recording.location, error))
        numbers = np.array([handle.number for handle in chosen])
        if jump := describe_jumps(numbers, poses[numbers], times[numbers]):
            where = recording.location
            expected = "poses without jumps"
            advice = f"check whether the poses belong to these scans, or {_ESTIMATE}"
            findings.append(Finding("warning", "pose-jump", where, expected, jump, advice))
        notes.append(jitter_note(poses))
    if own_times is None and recording.rays:
        notes.append("there are no times: frames are taken to be 0.1 s apart")
    said = [note for note in notes if note]
    return Examined(
        recording, times, own_times is not None, trajectory, poses, mount, said, findings
    )


def _some_scans(
    recording: Recording, frames: Sequence[FrameHandle] = ()
) -> dict[int, Float32Array]:
    """Return the points of some scans of a recording that can be read, by frame number: of some
    frames only, if any are given.

    Raises:
        FormatError: none of them is a scan: the error of the first one.
    """
    rig = replace(Rig.of(recording), rays=False)
    frames = frames or recording.frames
    scans = dict[int, Float32Array]()
    problem: FormatError | None = None
    for row in sorted({*np.linspace(0, len(frames) - 1, _SCANS).astype(int).tolist()}):
        with suppress(CarlascError, OSError):  # the conversion of the frame reports the error
            scan = read_scan(frames[row], rig, None)
            try:
                check_scan(scan.points, scan.fields.get("seconds"), frames[row].location)
                scans[frames[row].number] = scan.points
            except FormatError as error:
                problem = problem or error
    if problem is not None and not scans:
        raise problem
    return scans


def _upright(
    recording: Recording, converter: Converter, mount: Mount, options: PoseOptions
) -> Recording:
    """Return a recording with its scans turned upright.

    Its poses are those of the tilted sensor, or of a vehicle that is level, whatever lets scans
    overlap more.
    """
    frames = recording.frames
    turn = mount.level_T_scan
    choices = [
        ChosenFrames(recording, frames, turn, vehicle_is_level=level) for level in (False, True)
    ]
    times = frame_times(recording, recording.times())
    shares = list[float]()
    for choice in choices:
        trajectory = read_trajectory(choice, options)
        if trajectory is None:
            return choice
        diagnosis = _diagnose(choice, converter, scan_poses(trajectory, choice, times))
        shares.append(diagnosis.share if diagnosis.pairs else 0.0)
    return choices[shares[1] > shares[0]]


def plan_recording(
    recording: Recording,
    converter: Converter,
    sink: Sink,
    output: LayoutOptions,
    options: PoseOptions,
    *,
    frames: FrameRange = FrameRange(),  # noqa: B008 (frozen)
    voxels: bool,
) -> RecordingPlan:
    """Read and check the poses, times and boxes of a recording, and find missing frames in the
    output. Nothing is written.

    Args:
        recording: the recording.
        converter: the converter.
        sink: the output.
        output: axes and classes, flow if it is available, and whether scans are turned upright.
        options: where poses come from.
        frames: the frames to convert.
        voxels: whether the recording's own voxel grids are written.

    Raises:
        FormatError: poses, times or boxes are not valid, scans do not overlap under the poses, or
            their sensor is not upright.
        MissingDataError: the recording has no poses or voxels, although they were requested.
        ConflictError: the output has another grid in the place of the voxels.
    """
    target = output.of(converter)
    given = None if output.boxes is None else GivenBoxes.read(output.boxes, target.classes)
    writer = sink.sequence(sequence_path(recording))
    grew = is_provisional(writer)
    known = options.force or (writer.read_document(layout.POSES) is not None and not grew)
    seen = examine(recording, converter, options, frames=frames, level=output.level, known=known)
    if problem := next((one for one in seen.findings if one.severity == "error"), None):
        raise FormatError(
            problem.location,
            expected=problem.expected,
            found=problem.found,
            advice=problem.advice,
        )
    recording = seen.recording
    boxes = _read_boxes(recording, target) if given is None else {}
    plan = RecordingPlan(
        **vars(seen),
        writer=writer,
        pose_source=KISS_ICP if seen.trajectory is None else FILE,
        boxes=boxes,
        flow=output.flow == "auto"
        and (boxes is not None or (recording.has_labels and recording.has_instances)),
        voxels=_check_voxels(recording, writer, target) if voxels else None,
        force=options.force,
        voxel_m=options.odometry_voxel_m,
        given=given,
    )
    plan.place_boxes()
    numbers = set(recording.frame_numbers)
    plan.missing = {number for number in numbers if not writer.has("points", number)}
    there = numbers - plan.missing
    plan.unfinished = plan.missing | {n for n in there if not _finished(plan, n)}
    return plan


def _finished(plan: RecordingPlan, number: int) -> bool:
    """Return whether a frame with a scan also has all fields from the motion of actors."""
    if plan.boxes is None and not plan.writer.has("instances", number):
        return True  # the frame has no numbers in the data set
    return all(plan.writer.has(name, number) for name in plan.added)


def _read_boxes(recording: Recording, target: AxesAndClasses) -> dict[int, Boxes] | None:
    """Return the boxes of the frames of a recording, in the frame of the scan and the classes of
    the output; None if the data set has none.
    """
    boxes = recording.boxes()
    if boxes is None:
        return None
    last = recording.frames[-1].number
    read = dict[int, Boxes]()
    scan_T_vehicle = invert(recording.vehicle_T_scan)
    moved = not np.array_equal(scan_T_vehicle, np.eye(4))
    for number, own in boxes.items():
        if number <= last:  # also of frames without a scan, because they show the motion of objects
            where = f"{recording.location}: frame {number}"
            try:
                placed = own.transform(scan_T_vehicle) if moved else own
            except FormatError as error:
                raise error.within(where) from error
            labels = target.map_labels(own.labels, f"boxes of {where}")
            read[number] = replace(placed, labels=labels)
    return read


def _check_voxels(recording: Recording, writer: SequenceWriter, target: AxesAndClasses) -> GridSpec:
    """Return the geometry of a recording's own voxels, after a check that they can be written.

    Raises:
        MissingDataError: the recording has no voxels.
        ConflictError: the output has another grid of that name.
    """
    if recording.voxels is None:
        raise MissingDataError(
            recording.location,
            expected="voxel grids",
            found="none",
            advice="copy them too, or take another value of `grids`",
        )
    params = _voxel_params(recording.voxels, target)
    check_grid(
        writer,
        layout.grid_folder(recording.voxels),
        params,
        recording.frame_numbers,
        overwrite=False,
    )
    return recording.voxels


def _announce(plan: RecordingPlan) -> None:
    """Declare the scans and their sizes, for stores that need this before anything is written."""
    if plan.writer.block == 1:
        return
    frames = plan.recording.frames
    points = list[int]()
    for handle in {frames[i].number: frames[i] for i in (0, len(frames) // 2, -1)}.values():
        with suppress(CarlascError):  # the error is reported when the frame is read again
            points.append(sum(len(cloud.points) for cloud in handle.read()))
    plan.writer.expect(
        {"points": plan.recording.frame_numbers},
        {"points": max(points)} if points else None,
    )


def begin(plan: RecordingPlan, target: AxesAndClasses, metadata: Metadata) -> None:
    """Write carlasc.json, times and the params.json of the voxel grid, and reuse poses that an
    earlier run estimated.

    A second estimate might differ in its last digits.

    Args:
        plan: the recording and its output.
        target: the axes and classes of the output.
        metadata: the entries of carlasc.json that all recordings share.

    Raises:
        ConflictError: the output has other poses, times or metadata.
    """
    writer = plan.writer
    extra: dict[str, object] = {
        **metadata.extra,
        "poses": plan.pose_source,
        "sensors": _sensors(plan, target),
    }
    if plan.findings:
        extra["findings"] = _recorded(plan.findings)
    if plan.boxes is not None and not plan.recording.has_labels:
        extra["labels"] = "boxes"
    if not plan.recording.rays:
        extra["rays"] = False
    where = f"{writer.location}/{layout.METADATA}"
    before = read_metadata(writer)
    if before is not None and before.extra.get("poses") != plan.pose_source:
        raise ConflictError(
            where,
            expected=f"poses from {plan.pose_source}",
            found=before.extra.get("poses", "others"),
            advice="write to another place",
        )
    if before is not None and _places(before.extra) not in ([], _places(extra)):
        raise ConflictError(
            where,
            expected="the sensors at the places, and as level, as in this run",
            found="others",
            advice="give the same `level`, or write to another place",
        )
    _announce(plan)
    described = replace(metadata, extra=extra)
    documents = {layout.METADATA: agree_metadata(writer, described)}
    if plan.again and before is not None:
        documents[layout.METADATA] = described.to_json()
    documents[layout.TIMES] = agree_lines(
        writer,
        layout.TIMES,
        plan.times - plan.times[0],
        is_whole=plan.again,
        may_change=lambda: plan.is_same,
    )
    if plan.voxels is not None:
        documents[layout.params_file(layout.grid_folder(plan.voxels))] = to_json(
            _voxel_params(plan.voxels, target)
        )
    _write(plan, documents)
    is_known = plan.poses is None and not plan.again
    estimated = writer.read_document(layout.POSES) if is_known else None
    if estimated is not None:
        stored = layout.decode_poses(estimated, f"{writer.location}/{layout.POSES}")
        plan.take_estimate(mirror_poses(stored) if target.mirrored else stored)
    if plan.poses is not None:
        write_poses(plan, target)


def write_poses(plan: RecordingPlan, target: AxesAndClasses) -> None:
    """Write poses.txt.

    Raises:
        ConflictError: the output has other poses.
    """
    assert plan.poses is not None
    poses = mirror_poses(plan.poses) if target.mirrored else plan.poses
    if plan.is_same or (plan.again and plan.pose_source == KISS_ICP):
        lines: bytes | None = layout.encode_poses(poses)
    else:
        lines = agree_lines(plan.writer, layout.POSES, poses, is_whole=plan.again)
    _write(plan, {layout.POSES: lines})


def _places(extra: Mapping[str, Any]) -> list[object]:
    return [
        np.round(sensor.get("scan_T_sensor", ()), 3).tolist() for sensor in extra.get("sensors", [])
    ]


def _recorded(findings: Iterable[Finding]) -> list[dict[str, str]]:
    """Return the record of findings in carlasc.json."""
    return [{"check": one.check, "verdict": one.severity, "message": str(one)} for one in findings]


def write_found(plan: RecordingPlan, height_m: float | None) -> None:
    """Add what was found while scans were read to carlasc.json: the height of the first sensor
    above the ground, if it is not known, and findings.
    """
    metadata = read_metadata(plan.writer)
    if metadata is None:
        return
    extra = dict(metadata.extra)
    if height_m is not None and extra.get("sensors") and metadata.height_m is None:
        first, *others = extra["sensors"]
        found = {"height_m": round(height_m, 2), "height_from": "ground"}
        extra["sensors"] = [{**first, **found}, *others]
    if plan.findings and "findings" not in extra:
        extra["findings"] = _recorded(plan.findings)
    if extra != metadata.extra:
        plan.writer.write_document(layout.METADATA, replace(metadata, extra=extra).to_json())


def _write(plan: RecordingPlan, documents: dict[str, bytes | None]) -> None:
    for document, data in documents.items():
        if data is not None:
            plan.writer.write_document(document, data)


def _sensors(plan: RecordingPlan, target: AxesAndClasses) -> list[dict[str, object]]:
    """Return the record of each sensor in carlasc.json: its name, 12 numbers of its pose in the
    frame of scans, and its height if known.
    """
    records = []
    for sensor in plan.recording.sensors:
        pose = invert(plan.recording.vehicle_T_scan) @ sensor.vehicle_T_sensor
        pose = mirror_poses(pose) if target.mirrored else pose
        record: dict[str, object] = {
            "name": sensor.name,
            "scan_T_sensor": pose[:3].reshape(-1).tolist(),
        }
        records.append(record | ({} if sensor.height_m is None else {"height_m": sensor.height_m}))
    return records


def _voxel_params(spec: GridSpec, target: AxesAndClasses) -> dict[str, object]:
    """Return the params.json of the data set's own voxel grid, whose right-handed geometry is
    `spec`.
    """
    record = {"version": version("carlasc"), "source": "voxels"}
    spec = mirror_spec(spec) if target.mirrored else spec
    return spec.to_params(target.classes.num_channels) | {"carlasc": record}


def frame_times(recording: Recording, times: FloatArray | None) -> FloatArray:
    """Return (F,) seconds by frame number, by the clock of the recording; without times, 10 Hz from
    0.

    Raises:
        FormatError: a frame has no time, or a time is not finite.
    """
    frames = recording.frames[-1].number + 1
    if times is None:
        return np.arange(frames, dtype=np.float64) * layout.FRAME_PERIOD_S
    if len(times) < frames:
        raise FormatError(
            recording.location,
            expected=f"a time for each frame up to {frames - 1}",
            found=f"{len(times)} times",
            advice="copy the file of times again",
        )
    return check_seconds(np.asarray(times[:frames], np.float64), recording.location)


def read_trajectory(recording: Recording, options: PoseOptions) -> Trajectory | None:
    """Return the poses of the vehicle at their own times, from the recording's files; None if they
    must be estimated.

    Poses without times belong to the frames, one by one.

    Args:
        recording: the recording.
        options: where poses come from.

    Raises:
        MissingDataError: the file of poses does not exist, and poses must not be estimated.
        FormatError: a frame has no pose, or all frames share one pose.
    """
    trajectory = None if options.source == KISS_ICP else recording.poses(force=options.force)
    if trajectory is None:
        if options.source == FILE:
            raise MissingDataError(
                recording.location,
                expected="a file of poses",
                found="none",
                advice=f"copy it, or {_ESTIMATE}",
            )
        return None
    last = recording.frames[-1].number
    if trajectory.seconds is None:
        if len(trajectory.world_T_vehicle) <= last:
            raise FormatError(
                recording.location,
                expected=f"a pose for each frame up to {last}",
                found=f"{len(trajectory.world_T_vehicle)} lines in the file of poses",
                advice=f"copy it again, or {_ESTIMATE}",
            )
        return replace(trajectory, world_T_vehicle=trajectory.world_T_vehicle[: last + 1])
    if len(trajectory.seconds) == 1 < len(recording.frames):
        raise FormatError(
            recording.location,
            expected=f"poses over the time of {len(recording.frames)} scans",
            found="one pose",
            advice=f"copy the file of poses again, or {_ESTIMATE}",
        )
    return trajectory


def at_frames(world_T_vehicle: FloatArray, times: FloatArray) -> Trajectory:
    """Return the trajectory of (F, 4, 4) poses of frames.

    If times do not increase, 0.1 s between frames is assumed.
    """
    if not (np.diff(times) > 0).all():
        times = np.arange(len(times), dtype=np.float64) * layout.FRAME_PERIOD_S
    return Trajectory(world_T_vehicle, times)


def scan_poses(trajectory: Trajectory, recording: Recording, times: FloatArray) -> FloatArray:
    """Return (F, 4, 4) first_T_scan by frame number.

    Poses of frames, or with their times, are not changed, others are interpolated.

    Args:
        trajectory: poses of the vehicle, with times.
        recording: the recording, for the pose of the scan on the vehicle.
        times: (F,) seconds by frame number, by the same clock.
    """
    given = trajectory.world_T_vehicle
    seconds = trajectory.seconds
    if seconds is not None and not np.array_equal(seconds, times):
        # frames beyond the poses are not converted
        given = trajectory.at(times.clip(seconds[0] - POSE_S, seconds[-1] + POSE_S))
    poses = given @ recording.vehicle_T_scan
    return relative_to(poses[0], poses)


def jitter(poses: FloatArray) -> float:
    """Return the noise of (F, 4, 4) poses of frames about a smooth path, metres: such as that of an
    unfiltered receiver.
    """
    places = poses[:, :3, 3]
    if len(places) < 2 * len(_SMOOTH):
        return 0.0
    jumps = np.stack(
        [np.convolve(places[:, axis], _SMOOTH, mode="valid") for axis in range(3)], axis=1
    )
    return float(np.median(np.linalg.norm(jumps, axis=1)) / np.linalg.norm(_SMOOTH))


def jitter_note(poses: FloatArray) -> str | None:
    """Return a note if poses jump; None if they do not."""
    if (error_m := jitter(poses)) < _JITTER_M:
        return None
    return (
        f"poses jump by about {100 * error_m:.0f} cm from one to the next, which blurs grids: "
        f"{_ESTIMATE}"
    )


def _read_usable(handle: FrameHandle, rig: Rig) -> UsableScan | CarlascError | OSError:
    """Read the points of a scan for odometry, in a worker, while poses of earlier scans are
    estimated.
    """
    from carlasc.motion.odometry import usable_points

    try:
        scan = read_scan(handle, rig, None)
    except (CarlascError, OSError) as error:
        return error
    used = usable_points(scan.points)
    seconds = scan.fields.get("seconds")
    return scan.points[used, :3], None if seconds is None else seconds[used]


def estimate_poses(
    plan: RecordingPlan, converter: Converter, step: Callable[[], object], run: Run
) -> FloatArray:
    """Estimate the pose of each scan with odometry.

    A frame without a scan gets the pose of the scan before it.

    Points of sensors that are not corrected for motion are corrected by the estimate, if their
    times are known. Scans that cannot be read are skipped: their conversion reports them. So are
    scans with too few points.

    Args:
        plan: its scans, and how their poses are estimated.
        converter: the converter, for the range of points to use.
        step: called for each frame.
        run: how the reading of scans is spread.

    Returns:
        (F, 4, 4) first_T_scan by frame number, right-handed.

    Raises:
        CarlascError: no scan can be read: the error of the first one.
        MissingDataError: no scan has enough points.
        DependencyError: kiss-icp is not installed.
    """
    recording = plan.recording
    errors: list[CarlascError | OSError] = []

    def scans() -> Iterator[tuple[int, UsableScan]]:
        with closing(run_all(partial(_read_usable, rig=plan.rig), recording.frames, run)) as read:
            for handle, scan in zip(recording.frames, read, strict=True):
                step()
                if isinstance(scan, Exception):
                    errors.append(scan)
                else:
                    yield handle.number, scan

    poses = dict(follow(scans(), converter, plan))
    if len(errors) == len(recording.frames):
        raise errors[0]
    return fill_gaps(poses, recording)


def follow(
    scans: Iterable[tuple[int, UsableScan]], converter: Converter, plan: RecordingPlan
) -> Iterator[tuple[int, FloatArray]]:
    """Yield the frame number and the (4, 4) first_T_scan of each scan with enough points, estimated
    with odometry.

    Args:
        scans: frame numbers and scans, in order.
        converter: the converter, for the range of points to use.
        plan: how poses are estimated; gets a note on what was chosen.

    Raises:
        DependencyError: kiss-icp is not installed.
        FormatError: the sensor stands, although its scans are taken from other and other places.
    """
    from carlasc.motion import odometry

    numbers: list[int] = []
    read_at: list[float] = []
    centres = ScanCentres()
    poses = list[FloatArray]()

    def usable() -> Iterator[UsableScan]:
        for number, scan in scans:
            if len(scan[0]) >= odometry.MIN_POINTS:
                numbers.append(number)
                read_at.append(float(plan.times[number]))
                centres.add(scan[0])
                yield scan

    for index, pose in enumerate(
        odometry.follow_scans(
            usable(),
            times=read_at,
            min_range_m=converter.min_range_m or 0.0,
            max_range_m=plan.max_range_m or converter.max_range_m or 100.0,
            voxel_m=plan.voxel_m,
            note=plan.notes.append,
        )
    ):
        poses.append(pose)
        yield numbers[index], pose
    if poses and not plan.force:
        check_standing(centres, np.stack(poses), plan.recording.location)


def fill_gaps(poses: Mapping[int, FloatArray], recording: Recording) -> FloatArray:
    """Return (F, 4, 4) poses by frame number from those of some frames: others have the pose of the
    frame before.

    Args:
        poses: (4, 4) pose of each, by increasing frame number.
        recording: its last frame is the last that gets a pose.

    Raises:
        MissingDataError: there is none.
    """
    if not poses:
        raise MissingDataError(
            recording.location,
            expected="scans to estimate poses from",
            found="none that can be read and has enough points",
            advice="copy the scans again",
        )
    every = np.arange(recording.frames[-1].number + 1)
    lines = np.searchsorted(list(poses), every, side="right") - 1
    return np.stack(list(poses.values()))[np.clip(lines, 0, None)]


def check_poses(recording: Recording, converter: Converter, poses: FloatArray) -> str | None:
    """Check that the scans overlap under their poses, which reads some scans.

    Poses of another point of the vehicle, or some frames late, are accepted with a note, which is
    returned.

    Args:
        recording: its scans.
        converter: the converter, for the classes that do not move.
        poses: (F, 4, 4) first_T_scan by frame number.

    Raises:
        FormatError: scans do not overlap; the message names the likely mistake, and what to do.
    """
    diagnosis = _diagnose(recording, converter, poses)
    expected = "poses under which the scans overlap"
    if diagnosis.correction is not None:
        raise FormatError(
            recording.location,
            expected=expected,
            found=f"{diagnosis.share_there:.0%} of a scan's structure overlaps that of an earlier "
            f"scan; the likely cause is {diagnosis.correction.name} (with that corrected: "
            f"{diagnosis.corrected_share:.0%})",
            advice=f"{diagnosis.correction.advice}, or {_ACCEPT}",
        )
    if diagnosis.offset_m is not None:
        x, y, z = diagnosis.offset_m
        raise FormatError(
            recording.location,
            expected=expected,
            found=f"scans that are about ({x:.1f}, {y:.1f}, {z:.1f}) m away from each other",
            advice=f"check that poses and calibration belong to this sequence, {_ESTIMATE}, or "
            f"{_ACCEPT}",
        )
    mounting = None if diagnosis.quality is None else diagnosis.quality.mounting
    described = None if mounting is None else describe_mounting(mounting)
    return None if described is None else f"{described[0]}: {described[1]}, or {_ESTIMATE}"


def _diagnose(recording: Recording, converter: Converter, poses: FloatArray) -> PoseDiagnosis:
    """Measure how well some scans overlap under their poses."""
    rig = Rig.of(recording)

    def structure(index: int) -> FloatArray:
        try:
            scan = read_scan(recording.frames[index], rig, None)
        except (CarlascError, OSError):
            return np.empty((0, 3))  # the conversion of the frame reports the error
        return structure_of(scan.points[:, :3], scan.labels, None, converter.classes)

    return diagnose_poses(structure, poses[recording.frame_numbers])
