"""Sequences of the layout as the files of OpenSceneFlow: one HDF5 file per log, with a group per
scan, and the indices of its loader.

The pickled indices are written because the loader of the other project needs them. This module
never reads a pickle.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from carlasc import storage
from carlasc.converting import Exported, Files, SequenceExporter, SequenceFile
from carlasc.core.arrays import AnyArray, Float32Array, FloatArray, LabelArray, Uint32Array
from carlasc.core.boxes import Boxes, mirror_boxes
from carlasc.core.geometry import (
    Transform,
    invert,
    mirror_points,
    mirror_poses,
    moved_back,
    rotate_vectors,
    transform_points,
)
from carlasc.core.tables import SEMANTICKITTI, lines_of
from carlasc.errors import FormatError, MissingDataError, import_extra
from carlasc.motion import ground_points
from carlasc.storage import layout
from carlasc_converters.argoverse2_classes import ARGOVERSE2
from carlasc_converters.exporters.classes import classes_of, lookup_of, mapping_of

_EVALUATED = 5  # every fifth scan with flow is evaluated, as in the project's own script
# points within this distance along x and y are evaluated, as in the challenge of Argoverse 2
_EVALUATED_M = 50.0
_SURFACE_M = 0.01  # points on the surface of a box count as inside, in spite of rounding
_FIRST_NS = (
    10**18
    # name of the first scan's group: the loader orders names as text, so all need the same number
    # of digits
)
_PROTOCOL = 4  # of the pickle: fixed, so that the bytes do not depend on the version of Python

# raw id, category of Argoverse 2; ids of moving classes are repeated
_KITTI = {
    int(raw): ARGOVERSE2.id_of(name)
    for raw, name in lines_of("""
    10 REGULAR_VEHICLE
    11 BICYCLE
    13 BUS
    15 MOTORCYCLE
    16 RAILED_VEHICLE
    18 TRUCK
    20 LARGE_VEHICLE
    30 PEDESTRIAN
    31 BICYCLIST
    32 MOTORCYCLIST
    252 REGULAR_VEHICLE
    253 BICYCLIST
    254 PEDESTRIAN
    255 MOTORCYCLIST
    256 RAILED_VEHICLE
    257 BUS
    258 TRUCK
    259 LARGE_VEHICLE
""")
}
_CARLA = {4: ARGOVERSE2.id_of("PEDESTRIAN"), 10: ARGOVERSE2.id_of("REGULAR_VEHICLE")}
CATEGORIES: Mapping[str, Mapping[int, int]] = {
    "carla": {label: _CARLA.get(label, 0) for label in range(25)},
    "carlasc11": {label: _CARLA.get(label, 0) for label in range(11)},
    SEMANTICKITTI.name: {label: _KITTI.get(label, 0) for label in SEMANTICKITTI.names},
    # its converter numbers them so
    "argoverse2": {label: label if label <= 30 else 0 for label in range(33)},
}
"""Name of a class table -> id -> category of Argoverse 2."""


class OpenSceneFlowExporter(SequenceExporter):
    """Writes scans, poses and scene flow.

    Points have right-handed axes and their origin at the sensor.
    """

    title = "OpenSceneFlow: SPLIT/LOG.h5 and SPLIT/index_total.pkl, index_flow.pkl, index_eval.pkl"

    def folders(self, names: Sequence[str]) -> dict[str, str]:
        """Return the root for each name: the split is in the name of the file."""
        return dict.fromkeys(names, ".")

    def file(self, sequence: storage.Sequence) -> str:
        """Return SPLIT/LOG.h5.

        The loader takes the name up to the first dot as the name of the log.
        """
        split = "" if sequence.split is None else f"{sequence.split.lower()}/"
        return f"{split}{sequence.name.replace('.', '_') or 'log'}.h5"

    def check(self, sequence: storage.Sequence) -> list[str]:
        """Check that scans, poses, and flow or boxes exist."""
        import_extra("h5py", "hdf5")
        fields = sequence.fields()
        wanted = {
            "scans": "points" in fields,
            layout.POSES: layout.POSES in sequence.documents(),
            "flow or boxes, for the motion of objects": bool(fields & {"flow", "boxes"}),
        }
        for expected, found in wanted.items():
            if not found:
                raise MissingDataError(sequence.location, expected=expected, found="none")
        notes = []
        if "labels" not in fields:
            notes.append(
                f"{sequence.location} has no labels: the ground is found by the shape of each scan"
            )
        else:
            mapping_of(CATEGORIES, "category", sequence.metadata.classes, sequence.location)
        if layout.TIMES not in sequence.documents():
            notes.append(
                f"{sequence.location} has no times: {layout.FRAME_PERIOD_S} s between frames is "
                f"assumed"
            )
        self._timestamps(sequence)
        return notes

    def open(self, path: Path, sequence: storage.Sequence) -> SequenceFile:
        """Open a new HDF5 file."""
        return _LogFile(path, self._timestamps(sequence))

    def frames_in(self, path: Path, sequence: storage.Sequence) -> list[int]:
        """Return the frames that a file has a group for."""
        groups = set(_scans_in(path))
        return [
            frame for frame, timestamp in self._timestamps(sequence).items() if timestamp in groups
        ]

    def index(self, root: Path, exported: Sequence[Exported]) -> Files:
        """Return the indices of each folder that was written to, with the logs that were in it
        already.

        They list all scans, those with flow, and those that are evaluated.
        """
        folders = {(root / self.file(part.sequence)).parent for part in exported}
        made: dict[str, bytes] = {}
        for folder in sorted(folders):
            logs = {path.stem: _scans_in(path) for path in sorted(folder.glob("*.h5"))}
            flows = {
                log: [time for time, has_flow in scans.items() if has_flow]
                for log, scans in logs.items()
            }
            total = {log: list(scans) for log, scans in logs.items()}
            evaluated = {log: times[::_EVALUATED] for log, times in flows.items()}
            for name, chosen in (("total", total), ("flow", flows), ("eval", evaluated)):
                entries = [[log, time] for log, times in chosen.items() for time in times]
                place = (folder / f"index_{name}.pkl").relative_to(root).as_posix()
                made[place] = pickle.dumps(entries, _PROTOCOL)
        return made

    def make_frame(self, sequence: storage.Sequence, frame: int) -> dict[str, AnyArray]:
        """Return the arrays of a scan; those of flow only if another scan follows."""
        left = sequence.metadata.axes == "left"
        fields = [
            name
            for name in ("labels", "instances", "flow", "seconds", "sensor")
            if _has(sequence, name, frame)
        ]
        read = {name: sequence.read(name, frame) for name in fields}
        points = np.asarray(sequence.read("points", frame)[:, :3], np.float32)
        for name, array in read.items():
            if len(array) != len(points):
                where = f"{sequence.location}: {name} of frame {frame}"
                raise FormatError(
                    where, expected=f"{len(points)} rows, as points", found=len(array)
                )
        points = mirror_points(points) if left else points
        pose = _pose(sequence, frame)
        made: dict[str, AnyArray] = {
            "lidar": points,
            "lidar_id": read["sensor"].astype(np.uint8)
            if "sensor" in read
            else np.zeros(len(points), np.uint8),
            "pose": pose,
        }
        if "seconds" in read:
            made["lidar_dt"] = read["seconds"].astype(np.float32)
        table = sequence.metadata.classes
        if "labels" in read:
            where = f"{sequence.location}: labels of frame {frame}"
            lookup = lookup_of(mapping_of(CATEGORIES, "category", table, where))
            made["flow_category_indices"] = classes_of(read["labels"], lookup, table, where).astype(
                np.uint8
            )
            made["ground_mask"] = np.isin(read["labels"], sorted(table.ground))
        else:
            made["ground_mask"] = ground_points(points)
        if "instances" in read:
            made["flow_instance_id"] = read["instances"]
        following = _next(sequence, frame)
        if following is not None:
            flow = read.get("flow")
            velocity = None if flow is None else mirror_points(flow) if left else flow
            now, later = (_boxes(sequence, number) for number in (frame, following))
            (elapsed_s,) = np.diff(sequence.times_of([frame, following])).tolist()
            step = _Step(invert(_pose(sequence, following)) @ pose, elapsed_s)
            seconds = read.get("seconds")
            instances = read.get("instances")
            made |= step.flow(points, seconds, velocity, instances, now, later)
            near = (np.abs(points[:, :2]) <= _EVALUATED_M).all(axis=1)
            made["eval_mask"] = near & ~made["ground_mask"] & made["flow_is_valid"]
        return made

    def _timestamps(self, sequence: storage.Sequence) -> dict[int, str]:
        """Return the name of each frame's group: its time in nanoseconds, after that of the first
        scan, which is always the same.

        Raises:
            FormatError: times do not increase.
        """
        frames = self.frames(sequence)
        times = [round(seconds * 1e9) for seconds in sequence.times_of(frames).tolist()]
        for before, after, frame in zip(times, times[1:], frames[1:], strict=False):
            if after <= before:
                where = f"{sequence.location}/{layout.TIMES}"
                raise FormatError(
                    where,
                    expected="times that increase",
                    found=f"{after / 1e9:g} s at frame {frame}",
                )
        return {frame: str(_FIRST_NS + time) for frame, time in zip(frames, times, strict=True)}


class _Step(NamedTuple):
    """From a scan to the next one."""

    next_T_now: Transform
    seconds: float

    def flow(
        self,
        points: Float32Array,
        seconds: AnyArray | None,
        velocity: Float32Array | None,
        instances: LabelArray | None,
        now: Boxes | None,
        later: Boxes | None,
    ) -> dict[str, AnyArray]:
        """Return the displacement of points to the next scan, in its frame, and the points for
        which it is known.

        An object with boxes in both scans moves with its box; without a box in the next scan, its
        points are not valid. A point that was seen some seconds after the time of its scan was seen
        on the box of that moment, and so it is in the next scan. Other points move by their
        velocity, which is that at their own time. Without velocities, points outside of boxes are
        static, and scans without annotation have no valid points.
        """
        moved = (
            points.astype(np.float64)
            if velocity is None
            else points + velocity.astype(np.float64) * self.seconds
        )
        there = transform_points(self.next_T_now, moved)
        valid = np.full(
            len(points), velocity is not None or (now is not None and later is not None)
        )
        if now is not None and later is not None:
            _, rows, next_rows = np.intersect1d(now.tracks, later.tracks, return_indices=True)
            speeds = np.zeros((len(now), 3))
            centers = later.centers[next_rows]
            here = transform_points(invert(self.next_T_now), centers)
            speeds[rows] = (here - now.centers[rows]) / self.seconds
            owners = _owners(now, points, seconds, speeds) if instances is None else instances
            valid[np.isin(owners, np.setdiff1d(now.tracks, later.tracks))] = False
            changes = later.sensor_T_box[next_rows] @ invert(now.sensor_T_box[rows])
            for row, change in zip(rows.tolist(), changes, strict=True):
                of_it = owners == now.tracks[row]
                if of_it.any():
                    late = None if seconds is None else seconds[of_it]
                    own = moved_back(points[of_it].astype(np.float64), late, speeds[row])
                    ahead = -rotate_vectors(change, speeds[row])
                    there[of_it] = moved_back(transform_points(change, own), late, ahead)
        return {
            "flow": (there - points).astype(np.float32),
            "flow_is_valid": valid,
            "ego_motion": self.next_T_now,
        }


class _LogFile(SequenceFile):
    """An HDF5 file that is being written.

    Objects are numbered from 1 in the order in which they appear, because numbers have 16 bits.
    """

    def __init__(self, path: Path, timestamps: Mapping[int, str]) -> None:
        self._file = import_extra("h5py", "hdf5").File(path, "w")
        self._path = path
        self._timestamps = timestamps
        self._numbers = {0: 0}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def add(self, frame: int, content: Mapping[str, AnyArray]) -> None:
        """Write the group of a scan."""
        arrays = dict(content)
        if "flow_instance_id" in arrays:
            arrays["flow_instance_id"] = self._number(arrays["flow_instance_id"])
        group = self._file.create_group(self._timestamps[frame])
        for name, array in arrays.items():
            group.create_dataset(name, data=array)

    def _number(self, instances: LabelArray) -> NDArray[np.int16]:
        actors = np.unique(instances)
        for instance in actors.tolist():
            self._numbers.setdefault(instance, len(self._numbers))
        if len(self._numbers) > np.iinfo(np.int16).max + 1:
            raise FormatError(
                self._path, expected="at most 32767 objects", found=len(self._numbers) - 1
            )
        return np.array([self._numbers[instance] for instance in actors.tolist()], np.int16)[
            np.searchsorted(actors, instances)
        ]


def _owners(
    boxes: Boxes, points: Float32Array, seconds: AnyArray | None, speeds: FloatArray
) -> Uint32Array:
    """Return (N,) the track of the box that each point was in when it was seen, 0 for none: of
    several, the smallest.

    Args:
        boxes: the boxes of the scan.
        points: (N, 3).
        seconds: (N,) seconds after the time of the scan; None for 0.
        speeds: (B, 3) velocity of each box, m/s, frame of the scan.
    """
    owners = np.zeros(len(points), np.uint32)
    for row in np.argsort(-np.prod(boxes.sizes, axis=1), kind="stable").tolist():
        own = boxes.select(np.array([row]))
        inside = own.contains(moved_back(points, seconds, speeds[row]), _SURFACE_M)[0]
        owners[inside] = boxes.tracks[row]
    return owners


def _scans_in(path: Path) -> dict[str, bool]:
    """Return the names of the scans of a log in their order, and whether each has flow."""
    try:
        with import_extra("h5py", "hdf5").File(path, "r") as file:
            return {name: "flow" in file[name] for name in sorted(file, key=int)}
    except (OSError, ValueError) as error:
        advice = "remove the file, or export again with `overwrite=True`"
        raise FormatError(
            path, expected="an HDF5 file of scans", found="something else", advice=advice
        ) from error


def _has(sequence: storage.Sequence, field: str, frame: int) -> bool:
    return field in sequence.fields() and bool(np.isin(frame, sequence.frames(field)))


def _next(sequence: storage.Sequence, frame: int) -> int | None:
    frames = sequence.frames("points")
    place = int(np.searchsorted(frames, frame, "right"))
    return int(frames[place]) if place < len(frames) else None


def _pose(sequence: storage.Sequence, frame: int) -> Transform:
    """Return first_T_scan of a frame, right-handed."""
    pose = sequence.read_pose(frame)
    return pose if sequence.metadata.axes == "right" else mirror_poses(pose)


def _boxes(sequence: storage.Sequence, frame: int) -> Boxes | None:
    """Return a frame's boxes, right-handed; None if it was not annotated."""
    if "boxes" not in sequence.fields():
        return None
    boxes = sequence.boxes(frame)
    return boxes if boxes is None or sequence.metadata.axes == "right" else mirror_boxes(boxes)
