"""Grids from raw captures: all sensors of the capture vote for the instant of each frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from carlasc.captures.raw import Capture, CaptureFiles, SensorRecording, find_captures
from carlasc.captures.settings import LidarEffects
from carlasc.captures.simulation import Simulator
from carlasc.core.arrays import AnyArray, FloatArray
from carlasc.core.geometry import relative_to
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.groundtruth.inputs import FrameData, FrameInput, GridPlan, SequenceInput, choose_frames
from carlasc.groundtruth.voting.ballot import Observation, count_votes
from carlasc.groundtruth.voxel_actors import ActorPoints
from carlasc.storage import layout
from carlasc.storage.camera_files import cameras_to_json
from carlasc.storage.files import AnyPath
from carlasc.storage.inputs import FrameFiles, combined
from carlasc.storage.layout import Metadata
from carlasc.storage.protocol import Source

if TYPE_CHECKING:
    from carlasc.groundtruth.seen import Views

_TURN_FRAMES = 3  # frames before and after
_TURNING_M_S = 1.0  # the velocity of slower actors does not show their heading


@dataclass(frozen=True)
class CaptureFrame(FrameInput):
    """One frame of a capture: each sensor is a voter, and the grid is in the frame of the ego
    sensor.
    """

    capture: Capture
    sensors: tuple[int, ...]
    number: int
    source_frame: int
    # a frame before and one after: the turn rates of actors are measured between them
    around: tuple[int, int]

    def fields(self) -> tuple[str, ...]:
        """Return points, labels, flow and instances, and the pictures that the frame has."""
        capture = self.capture
        frame = self.source_frame
        bev = ("bev",) if capture.has_bev(frame) else ()
        images = capture.image_fields(frame) if capture.cameras else ()
        return ("points", "labels", "flow", "instances", *capture.effects.fields, *bev, *images)

    def views(self) -> Views:
        """Return the cameras of the capture: their images are taken at the instant of the frame."""
        return [(camera, camera.sensor_T_camera) for camera in self.capture.cameras.values()]

    def make(self, plan: GridPlan) -> FrameData:
        """Read the scan of the ego sensor, and count the votes of all sensors.

        The other recordings are read one at a time, so memory does not grow with the number of
        sensors.
        """
        seen = self.capture.read_scan(self.source_frame)
        fields: dict[str, AnyArray] = {
            "points": np.column_stack([seen.scan.points, np.zeros(len(seen.scan), np.float32)]),
            "labels": _present(seen.scan.labels),
            "flow": seen.flow(),
            "instances": _present(seen.scan.instances),
            **{name: seen.scan.others[name] for name in self.capture.effects.fields},
        }
        picture = self.capture.read_bev(self.source_frame)
        if picture is not None:
            fields["bev"] = np.frombuffer(picture, np.uint8)
        if self.capture.cameras:
            fields |= self.capture.read_images(self.source_frame)
        step = plan.voting.free_step_m
        classes = self.capture.classes
        who = (
            ActorPoints(plan.spec, self._turns(), classes.deformable)
            if plan.voting.keep_actors
            else None
        )
        # votes are of ideal scans
        plain = self.capture.effects == LidarEffects()
        ego = seen if plain else self.capture.read(0, self.source_frame)
        observations = self._observations(ego, who)
        boxes = plan.voting.keep_seen
        votes = count_votes(
            observations, plan.spec, classes, rule=plan.rule, free_step_m=step, keep_boxes=boxes
        )
        grid = votes.to_grid()
        actors = None if who is None else who.of(grid.labels)
        return FrameData(fields, grid, votes, actors=actors, boxes=votes.boxes)

    def _observations(self, ego: SensorRecording, who: ActorPoints | None) -> Iterator[Observation]:
        for sensor in self.sensors:
            recording = (
                ego if sensor == self.sensors[0] else self.capture.read(sensor, self.source_frame)
            )
            ego_T_sensor = relative_to(ego.world_T_sensor, recording.world_T_sensor)
            if who is not None:
                who.add(recording, ego_T_sensor)
            yield Observation(recording.scan.points, _present(recording.scan.labels), ego_T_sensor)

    def _turns(self) -> dict[int, float]:
        """Return the turn rates of actors about the vertical, rad/s: the change of the direction of
        their velocity.
        """
        before, after = (self.capture.read_velocities(frame) for frame in self.around)
        seconds = (self.around[1] - self.around[0]) * layout.FRAME_PERIOD_S
        turns = dict[int, float]()
        for actor in before.keys() & after.keys() if seconds else ():
            first = before[actor]
            last = after[actor]
            if min(np.hypot(*first[:2]), np.hypot(*last[:2])) > _TURNING_M_S:
                angle = np.arctan2(
                    first[0] * last[1] - first[1] * last[0], first[0] * last[0] + first[1] * last[1]
                )
                turns[actor] = float(angle) / seconds
        return turns


@dataclass
class _SettingsFiles(FrameFiles):
    """The settings of a simulation, in the place of the files of its frames."""

    settings: bytes
    kind: str = "simulation"
    tree: None = None

    def paths(self, frame: int) -> list[str]:
        """Return none."""
        return []

    def contents(self, frame: int) -> Iterator[tuple[str, bytes]]:
        """Yield the settings."""
        yield "settings", self.settings


class CaptureSequence(SequenceInput):
    """A capture as a sequence: its frames are renumbered from 0."""

    def __init__(self, capture: Capture, path: str, plan: GridPlan) -> None:
        self.path = path
        self.location = capture.location
        self.metadata = Metadata(
            classes=capture.classes,
            extra={"simulated": True} if capture.is_simulated else {},
        )
        self.capture = capture
        self.plan = plan

    def _find_frames(self) -> tuple[FrameInput, ...]:
        capture = self.capture
        numbers = choose_frames(self.plan.frames, np.array(capture.frames), capture.location)
        # Frames hold a copy of the capture without its cached listing, which would be pickled with
        # each frame.
        light = capture.light()
        known = capture.frames
        place = np.searchsorted(known, numbers)
        around = [
            known[np.clip(place + step, 0, len(known) - 1)].tolist()
            for step in (-_TURN_FRAMES, _TURN_FRAMES)
        ]
        frames = enumerate(zip(numbers, *around, strict=True))
        return tuple(
            CaptureFrame(light, capture.sensors, i, n, (before, after))
            for i, (n, before, after) in frames
        )

    def _count_points(self, source_frame: int) -> int:
        return len(self.capture.read_scan(source_frame).scan)

    def poses(self) -> FloatArray:
        """Return inv(pose0[first]) @ pose0[f] for each frame f.

        Raises:
            FormatError: the first frame's pose, which is the origin, is not valid.
            MissingDataError: the first frame's pose does not exist.
        """
        first = self.frames[0].source_frame
        try:
            world_T_first = self.capture.read_pose(0, first)
        except (FormatError, MissingDataError) as error:
            error.advice = (
                "the first frame's pose is the origin of poses.txt: fix it, or start with a later "
                "frame"
            )
            raise
        # NaN where a pose cannot be read: reading that frame raises the same error, and that one is
        # reported
        poses = self.capture.read_poses(0, [frame.source_frame for frame in self.frames])
        return relative_to(world_T_first, poses)

    def times(self) -> FloatArray:
        """Return (f - first) * 0.1 for each frame f: see `docs/format.md#votes`."""
        numbers = np.array([frame.source_frame for frame in self.frames])
        return (numbers - numbers[0]) * layout.FRAME_PERIOD_S

    def cameras(self) -> bytes | None:
        """Return cameras.json; None if the capture has no cameras."""
        return cameras_to_json(self.capture.cameras.values()) if self.capture.cameras else None

    def files(self) -> FrameFiles | None:
        """Return the files of the recordings, or the settings of a simulation; None if neither is
        known.
        """
        capture = self.capture
        if isinstance(capture, Simulator):
            return _SettingsFiles(repr(capture.settings).encode())
        return CaptureFiles(capture.light()) if type(capture) is Capture else None

    def depended(self) -> list[int]:
        """Return the frames of the capture, and those in which the motion of actors is read."""
        return sorted({one for number in range(len(self.frames)) for one in self._used(number)})

    def _used(self, number: int) -> tuple[int, ...]:
        """Return the frames of the capture that a frame of the output is made from."""
        frame = cast(CaptureFrame, self.frames[number])
        return frame.source_frame, *(frame.around if self.plan.voting.keep_actors else ())

    def made_from(self, number: int, own: Mapping[str, str], whole: str) -> str:
        """Return a digest of the recordings of a frame."""
        return combined([own[str(one)] for one in self._used(number)], self.shared())

    def record(self) -> dict[str, Any]:
        """Return the frames and the number of sensors.

        An open end of the range stays open, so that a later run continues after the capture has
        grown.
        """
        asked = self.plan.frames
        first = self.frames[0].source_frame
        frames = str(asked)
        if asked.stop is None:
            frames = f"{first}:"
        elif asked.only is None:
            frames = f"{first}:{self.frames[-1].source_frame + 1}"
        return {"observe": "capture", "frames": frames, "sensors": len(self.capture.sensors)}


def capture_sequences(
    source: AnyPath | Source | Capture, plan: GridPlan, places: Series[str] = ("",)
) -> list[SequenceInput]:
    """Find the captures in or below some places of a folder.

    Raises:
        ArgumentError: the source is not a path.
        MissingDataError: there is no capture.
    """
    if isinstance(source, Capture):
        return [CaptureSequence(source, "", plan)]
    if isinstance(source, Source):
        raise ArgumentError("source", expected="a folder with a capture", found=repr(source))
    found = find_captures(source, places).items()
    return [CaptureSequence(capture, path, plan) for path, capture in found]


def _present(array: AnyArray | None) -> AnyArray:
    if array is None:  # never: Capture.read refuses recordings without labels or instances
        raise FormatError("recording", expected="labels and instances", found="none")
    return array
