"""A converter of simulated drives in memory: what the toolkit does itself, without any files."""

from typing import ClassVar

import numpy as np

from carlasc.converting import Cloud, Converter, FrameHandle, Recording, Trajectory
from carlasc.core import CARLA, ClassTable, Remap
from carlasc.testing import KINDS, SimulatedDrive

NAMES = dict(enumerate(KINDS)) | {9: "ground", 10: "geometry"}
IDS = {kind: index for index, kind in enumerate(KINDS)}
TABLE = ClassTable(
    "drive",
    NAMES,
    {index: (20 * index, 100, 50) for index in NAMES},
    movable=frozenset({5, 6, 7, 8}),
    deformable=frozenset({7}),
    ground=frozenset({1, 9}),
    geometry_only=10,
    ground_only=9,
)
TO_CARLA = Remap(
    "drive_to_carla",
    TABLE,
    CARLA,
    {0: 0, 1: 7, 2: 1, 3: 9, 4: 5, 5: 10, 6: 10, 7: 4, 8: 10, 9: 14, 10: 3},
)


class DriveFrame(FrameHandle):
    """A frame of a drive; it counts how often it is read."""

    reads: ClassVar[list[int]] = []

    def __init__(self, drive, number, gives):
        self.drive, self.number, self.gives, self.location = drive, number, gives, f"frame {number}"

    def read(self):
        self.reads.append(self.number)
        return [self._cloud(sensor) for sensor in range(len(self.drive.sensors))]

    def _cloud(self, sensor):
        scan = self.drive.scan(self.number, sensor)
        return Cloud(
            scan.points,
            scan.kinds if "labels" in self.gives else None,
            scan.instances if "instances" in self.gives else None,
            scan.seconds if self.drive.rolling else None,
            sensor=sensor,
        )


class DriveRecording(Recording):
    """A drive as a recording."""

    name, split, location = "DRIVE_0", "Train", "memory"

    def __init__(self, drive, gives, annotated):
        self.drive, self.gives, self.annotated, self.sensors = (
            drive,
            gives,
            annotated,
            drive.sensors,
        )
        self.frames = [DriveFrame(drive, number, gives) for number in range(drive.frames)]
        self.has_labels, self.has_instances = "labels" in gives, "instances" in gives

    def poses(self, *, force=False):
        seconds = np.arange(-0.03, self.drive.times[-1] + 0.1, 0.02)  # not those of the frames
        return (
            Trajectory(self.drive.world_T_vehicle(seconds), seconds)
            if "poses" in self.gives
            else None
        )

    def times(self):
        return self.drive.times if "times" in self.gives else None

    def boxes(self):
        if "boxes" not in self.gives:
            return None
        return {
            number: self.drive.boxes(number)
            for number in range(0, self.drive.frames, self.annotated)
        }


class DriveConverter(Converter):
    """Gives a drive: subclasses say which, what of it, and which frames are annotated with boxes."""

    title, classes, to_carla = "simulated drives", TABLE, TO_CARLA
    min_range_m, max_range_m = 1.0, 70.0
    drive: ClassVar[SimulatedDrive] = SimulatedDrive()
    gives: ClassVar[frozenset[str]] = frozenset({"labels", "instances", "poses", "times"})
    annotated: ClassVar[int] = 1

    def sequences(self):
        return [DriveRecording(self.drive, self.gives, self.annotated)]
