"""The common part of the exporters of tracked boxes, which write one file per sequence: the boxes
of its field `boxes`, or those of a table.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, NamedTuple, Self

import numpy as np

from carlasc import storage
from carlasc.converting import Converter, GivenBoxes, Recording, WholeFileExporter
from carlasc.core.arrays import FloatArray
from carlasc.core.boxes import Boxes
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, mirror_poses
from carlasc.core.tables import lines_of
from carlasc.errors import FormatError, MissingDataError
from carlasc.motion import sequence_boxes, tracks_from_boxes, velocities_of

_LATE_S = 0.005  # a scan that is farther away in time is another one
TableFile = Annotated[
    str | None,
    "Table of the boxes of one sequence (.csv, .json or .parquet), as `--boxes-out` writes it. "
    "Default: the annotated boxes of each sequence.",
]

# type of KITTI, class of nuScenes' tracking ("-" for none), names in the class tables of data sets
_NAMES = {
    name: (kitti, nuscenes)
    for kitti, nuscenes, *names in lines_of("""
    Car car vehicle car moving-car regular_vehicle vehicle.car
    Car - vehicle.emergency.ambulance vehicle.emergency.police
    Van car van
    Truck truck truck moving-truck box_truck truck_cab large_vehicle vehicle.truck
    Truck - vehicle.construction
    Misc bus bus moving-bus school_bus articulated_bus vehicle.bus.bendy vehicle.bus.rigid
    Misc trailer trailer caravan vehicular_trailer vehicle.trailer
    Tram - tram train on-rails moving-on-rails railed_vehicle
    Cyclist bicycle bicycle bicyclist moving-bicyclist cyclist rider wheeled_rider vehicle.bicycle
    Cyclist bicycle two-wheeler
    Cyclist motorcycle motorcycle motorcyclist moving-motorcyclist vehicle.motorcycle
    Pedestrian pedestrian pedestrian person moving-person official_signaler
    Pedestrian pedestrian human.pedestrian.adult human.pedestrian.child
    Pedestrian pedestrian human.pedestrian.construction_worker human.pedestrian.police_officer
    Person_sitting pedestrian person_sitting
    """)
    for name in names
}


def names_of(table: ClassTable, label: int) -> tuple[str, str]:
    """Return the type of KITTI and the class of nuScenes' tracking of a class of objects: Misc and
    "-" if they have none.
    """
    return _NAMES.get(table.names[label].lower(), ("Misc", "-"))


@lru_cache(maxsize=1)
def _recordings(kind: type[Converter], place: str) -> dict[str, Recording]:
    return {one.name: one for one in kind(Path(place)).sequences()}


class Origin(NamedTuple):
    """The recording that a sequence was converted from.

    Attributes:
        recording: the recording.
        numbers: the number of each frame of the sequence in it.
        vehicle_T_scan: (4, 4) pose of the scans of the sequence, right-handed.
    """

    recording: Recording
    numbers: dict[int, int]
    vehicle_T_scan: Transform

    @classmethod
    def of(cls, sequence: storage.Sequence, kind: type[Converter], place: str) -> Self:
        """Find the recording, by its name and the times of its frames.

        Raises:
            MissingDataError: the data set has no such recording, or carlasc.json does not say where
                the sensors are.
            FormatError: it has no frame at the time of one of the sequence.
        """
        found = _recordings(kind, place)
        frames = sequence.scan_frames().tolist()
        sensors = sequence.metadata.extra.get("sensors")
        if sequence.name not in found or not sensors:
            raise MissingDataError(
                place,
                expected=f"the recording from which {sequence.location} was converted",
                found=", ".join(found),
            )
        recording = found[sequence.name]
        own = sequence.times_of(frames)
        late = np.abs(np.asarray(recording.times()) - own[:, None])
        if late.min(axis=1).max() > _LATE_S:
            raise FormatError(
                place,
                expected=f"scans at the times of {sequence.location}",
                found=f"scans that are up to {late.min(axis=1).max():g} s apart",
            )
        scan_T_sensor = np.vstack([np.reshape(sensors[0]["scan_T_sensor"], (3, 4)), np.eye(4)[3]])
        if sequence.metadata.axes == "left":
            scan_T_sensor = mirror_poses(scan_T_sensor)
        numbers = dict(zip(frames, late.argmin(axis=1).tolist(), strict=True))
        vehicle_T_scan = recording.sensors[0].vehicle_T_sensor @ invert(scan_T_sensor)
        return cls(recording, numbers, vehicle_T_scan)


class FrameBoxes(NamedTuple):
    """The boxes of one frame, right-handed.

    Attributes:
        number: its number.
        first_T_scan: (4, 4) pose.
        boxes: the N boxes in the frame of the scan.
        values: (N, 4) velocity in the frame of the first scan, m/s, and confidence, 0 to 1.
    """

    number: int
    first_T_scan: Transform
    boxes: Boxes
    values: FloatArray


@dataclass(eq=False)
class BoxExporter(WholeFileExporter):
    """Writes the tracked boxes of each sequence to one file."""

    boxes: TableFile = None

    @property
    def of_one(self) -> str | None:
        """A table is that of one sequence."""
        return None if self.boxes is None else "boxes"

    def read(self, sequence: storage.Sequence) -> tuple[list[FrameBoxes], list[str]]:
        """Return the annotated boxes of each frame that has any, and remarks, one line each.

        Raises:
            MissingDataError: there are no boxes or poses.
            FormatError: boxes are not valid, or are those of another drive.
        """
        if self.boxes is None and "boxes" not in sequence.fields():
            advice = "give a table of boxes with `boxes`"
            raise MissingDataError(sequence.location, expected="boxes", found="none", advice=advice)
        numbers = self.frames(sequence)
        notes = list[str]()
        times, poses, boxes = sequence_boxes(sequence, numbers)
        given = dict[int, FloatArray]()
        if self.boxes is not None:
            table = GivenBoxes.read(self.boxes, sequence.metadata.classes)
            boxes, rows, notes = table.at_scans(numbers, times, poses, sequence.location)
            given = {n: table.table.values[own, 7:11] for n, own in zip(boxes, rows, strict=True)}
        pose_of = dict(zip(numbers, poses, strict=True))
        tracks = tracks_from_boxes(boxes, pose_of, dict(zip(numbers, times.tolist(), strict=True)))
        frames = []
        for number, own in boxes.items():
            found = np.insert(velocities_of(tracks, number, own), 3, 1.0, axis=1)
            known = given.get(number, found)
            values = np.where(np.isnan(known), found, known)
            kept = np.flatnonzero(own.annotated)
            frames.append(FrameBoxes(number, pose_of[number], own.select(kept), values[kept]))
        return frames, notes
