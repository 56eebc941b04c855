"""A recording with some of its frames, and with its scans turned upright."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from carlasc.converting.protocol import FrameHandle, Recording, Trajectory
from carlasc.core.arrays import FloatArray
from carlasc.core.boxes import Boxes
from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import Transform, invert
from carlasc.errors import ArgumentError


class ChosenFrames(Recording):
    """A recording of which some frames are converted.

    Args:
        own: the recording.
        frames: the frames.
        level_T_scan: (4, 4) rotation of its scans; None if they are upright.
        vehicle_is_level: whether only the sensors are tilted. If not, the frame of the vehicle is
            that of the sensor, and its poses and boxes are turned, too.
    """

    def __init__(
        self,
        own: Recording,
        frames: Sequence[FrameHandle],
        level_T_scan: Transform | None = None,
        *,
        vehicle_is_level: bool = False,
    ) -> None:
        self._own = own
        self.frames = frames
        self._turn = None if vehicle_is_level else level_T_scan
        self.name = own.name
        self.split = own.split
        self.location = own.location
        self.has_labels = own.has_labels
        self.has_instances = own.has_instances
        self.voxels = own.voxels
        self.rays = own.rays
        self.sensors = own.sensors
        if level_T_scan is None:
            return
        if any(sensor.points_in != "sensor" for sensor in own.sensors):
            raise ArgumentError(
                "level",
                expected=f"False, because points of {own.location} are in the frame of the vehicle",
                found="True",
            )
        turn = level_T_scan
        if vehicle_is_level:  # about the first sensor
            turn = own.vehicle_T_scan @ turn @ invert(own.vehicle_T_scan)
        self.sensors = [
            replace(sensor, vehicle_T_sensor=turn @ sensor.vehicle_T_sensor)
            for sensor in own.sensors
        ]

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return the poses of the turned vehicle."""
        found = self._own.poses(force=force)
        if found is None or self._turn is None:
            return found
        turned = found.world_T_vehicle @ invert(self._turn)
        return replace(found, world_T_vehicle=turned, other=None)

    def times(self) -> FloatArray | None:
        """Return the times of all frames."""
        return self._own.times()

    def boxes(self) -> Mapping[int, Boxes] | None:
        """Return the boxes in the frame of the turned vehicle."""
        boxes = self._own.boxes()
        if boxes is None or self._turn is None:
            return boxes
        return {number: own.transform(self._turn) for number, own in boxes.items()}

    def cameras(self) -> Sequence[CameraModel]:
        """Return the cameras in the frame of the turned vehicle."""
        turn = self._turn
        cameras = self._own.cameras()
        if turn is None:
            return cameras
        return [
            camera.replaced(sensor_T_camera=turn @ camera.sensor_T_camera) for camera in cameras
        ]

    def image(self, camera: CameraModel, frame: int) -> tuple[str, bytes] | None:
        """Return an image of a camera."""
        return self._own.image(camera, frame)

    def problems(self) -> list[tuple[int, str]]:
        """Return the missing frames among the chosen ones."""
        first = self.frames[0].number
        last = self.frames[-1].number
        return [one for one in self._own.problems() if first <= one[0] <= last]

    def notes(self) -> list[str]:
        """Return the notes of the whole recording."""
        return self._own.notes()
