"""A frame as one scan: its clouds in the frame of the layout, at one instant, with the origin of
each ray; and the classes and axes in which its fields are written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from carlasc.converting.plausibility import check_scan
from carlasc.converting.protocol import (
    Cloud,
    Converter,
    FrameHandle,
    Recording,
    Sensor,
    Trajectory,
)
from carlasc.core.arrays import AnyArray, Float32Array, FloatArray, LabelArray, Uint32Array
from carlasc.core.choices import Axes, CompareInputs
from carlasc.core.choices import FlowSource as FlowSource  # noqa: PLC0414 (part of this module)
from carlasc.core.choices import Images as Images  # noqa: PLC0414 (part of this module)
from carlasc.core.classes import ClassTable, Remap, ids_in
from carlasc.core.geometry import Transform, invert, mirror_points, transform_points
from carlasc.errors import (
    ArgumentError,
    CarlascError,
    FormatError,
    check_choice,
    check_types,
    describe,
    first_names,
)
from carlasc.motion.odometry import move_each, ticks_of
from carlasc.storage import layout
from carlasc.storage.files import AnyPath

_APART_M = 0.25  # positions of a sensor within a sweep that are closer than this count as one
_IDS = np.iinfo(np.uint16).max + 1
_UNKNOWN = np.uint32(np.iinfo(np.uint32).max)


@dataclass(frozen=True)
class LayoutOptions:
    """How a conversion writes sequences.

    Attributes:
        classes: classes of the labels. "carla": CarlaSC's classes. The name of the data set's own
            class table, such as "semantickitti": its ids are kept. "auto": the ids of SemanticKITTI
            are kept, because its tools need them, and all others become "carla".
        axes: axes of the output. "left": y is mirrored, as in CarlaSC, which is left-handed.
            "right": right-handed, as in the data set.
        flow: scene flow. "auto": the velocity of each actor, from its tracked boxes, otherwise
            estimated from the points of numbered actors. "none": no flow.
        allow_unknown: treat class ids that the table does not have as unlabelled.
        images: images of cameras. "copy": copied into the output. "link": only their paths are
            written. "none": left out. The calibration of the cameras is always written.
        level: turn scans upright, so that the ground in them is level: for a LiDAR that is mounted
            upside down or at an angle, without a calibration that says so.
        allow_gaps: finish frames that take labels, motion or votes from a frame that failed.
            Otherwise they wait until it is repaired.
        compare_inputs: how it is found out whether the data set changed since an earlier run:
            "fast": by the names, sizes and times of its files; "content": all frames are made
            again and compared; "never": existing frames are kept.
        boxes: .csv, .json or .parquet file of the boxes of one recording, as `label_motion` writes
            it, in the frame of the first scan, right-handed; instead of those of the data set.

    Raises:
        ArgumentError: an unknown value of `axes`, `flow`, `images` or `compare_inputs`.
    """

    classes: str = "auto"
    axes: Axes = "left"
    flow: FlowSource = "auto"
    allow_unknown: bool = False
    images: Images = "none"
    level: bool = False
    allow_gaps: bool = False
    compare_inputs: CompareInputs = "fast"
    boxes: AnyPath | None = None

    def __post_init__(self) -> None:
        check_types(LayoutOptions, vars(self))
        check_choice("axes", self.axes, Axes)
        check_choice("images", self.images, Images)
        check_choice("flow", self.flow, FlowSource)
        check_choice("compare_inputs", self.compare_inputs, CompareInputs)

    def of(self, converter: Converter) -> AxesAndClasses:
        """Return the axes and the classes in which the data of a converter are written.

        Raises:
            ArgumentError: `classes` is neither "auto", "carla" nor the name of the converter's
                class table.
        """
        own = converter.classes.name
        check_choice("classes", self.classes, ("auto", "carla", own))
        usual = own if converter.keeps_classes else "carla"
        keeps = (usual if self.classes == "auto" else self.classes) == own
        if not keeps and converter.to_carla is None:
            raise ArgumentError(
                "classes",
                expected=f"{converter.classes.name}, because no map to CarlaSC's classes exists",
                found="carla",
            )
        remap = None if keeps else converter.to_carla
        return AxesAndClasses(converter.classes, remap, self.axes == "left", self.allow_unknown)


@dataclass(frozen=True)
class AxesAndClasses:
    """The axes and the classes in which frames of a data set are written.

    Attributes:
        source: class table of the ids that are read.
        remap: maps them to other ids; None keeps them.
        mirrored: whether y is mirrored, from right-handed axes to CarlaSC's left-handed ones.
        allow_unknown: whether ids that the table does not have become unlabelled.
    """

    source: ClassTable
    remap: Remap | None
    mirrored: bool
    allow_unknown: bool = False

    @property
    def classes(self) -> ClassTable:
        """Table of the ids that are written."""
        return self.source if self.remap is None else self.remap.target

    def map_labels(self, labels: LabelArray, where: str) -> Uint32Array:
        """Return the ids that are written for the ids that were read.

        Raises:
            FormatError: an id is unknown; the message names it and its frequency. `where` names the
                labels.
        """
        ids = self.source.names if self.remap is None else self.remap.mapping
        lookup = _lookup_table(
            tuple(ids), tuple(ids if self.remap is None else self.remap.mapping.values())
        )
        mapped = lookup[labels if labels.dtype.itemsize <= 2 else np.minimum(labels, _IDS - 1)]
        if mapped.size and int(mapped.max()) == _UNKNOWN:
            unknown = mapped == _UNKNOWN
            if not self.allow_unknown:
                counts = ids_in(labels[unknown]).items()
                raise FormatError(
                    where,
                    expected=f"class ids of {self.source.name}",
                    found=first_names(f"{label} ({times} times)" for label, times in counts),
                    advice="treat them as unlabelled with `allow_unknown=True`",
                )
            mapped[unknown] = 0
        return mapped


@lru_cache(maxsize=8)
def _lookup_table(ids: tuple[int, ...], targets: tuple[int, ...]) -> Uint32Array:
    """Return the target of every 16-bit id, `_UNKNOWN` where it has none."""
    lookup = np.full(_IDS, _UNKNOWN, np.uint32)
    lookup[list(ids)] = targets
    return lookup


@dataclass(frozen=True)
class Rig:
    """The sensors of a recording, and their poses.

    Attributes:
        sensors: the LiDARs.
        vehicle_T_scan: (4, 4), from the frame of the scans in the layout to that of the vehicle.
        rays: whether points are those that a sensor at the origin sees.
    """

    sensors: tuple[Sensor, ...]
    vehicle_T_scan: Transform
    rays: bool = True

    @classmethod
    def of(cls, recording: Recording) -> Rig:
        """Return the sensors of a recording."""
        return cls(tuple(recording.sensors), recording.vehicle_T_scan, recording.rays)

    @property
    def needs_motion(self) -> bool:
        """Whether the motion of the vehicle is needed to place points."""
        return any(not sensor.deskewed for sensor in self.sensors)


@dataclass(frozen=True)
class VehicleMotion:
    """The motion of the vehicle around a frame.

    Attributes:
        trajectory: poses with times.
        seconds: time of the frame, by the same clock.
    """

    trajectory: Trajectory
    seconds: float


@dataclass(frozen=True)
class Assembled:
    """One scan, right-handed, in the frame of the layout, with the class ids of the data set.

    Attributes:
        points: (N, 4) float32.
        labels: (N,) class ids; None if no cloud has labels. Those of clouds without labels are 0.
        instances: (N,) uint32, in the same way.
        fields: further fields of the layout by name.
    """

    points: Float32Array
    labels: LabelArray | None
    instances: Uint32Array | None
    fields: dict[str, AnyArray]


def read_scan(handle: FrameHandle, rig: Rig, motion: VehicleMotion | None) -> Assembled:
    """Read a frame, put its clouds together as `assemble` does, and check the scan.

    Args:
        handle: the frame.
        rig: the sensors.
        motion: the motion of the vehicle around the frame; None if it is not known.

    Raises:
        CarlascError: the frame cannot be read, or is no scan. Other exceptions of a converter
            become a FormatError.
    """
    try:
        clouds = handle.read()
    except (CarlascError, OSError, MemoryError):
        raise
    except Exception as error:
        problem = f"the converter failed: {describe(error)}"
        advice = "check the file, or report the error"
        raise FormatError(handle.location, problem=problem, advice=advice) from error
    scan = assemble(clouds, rig, motion, handle.location)
    if rig.rays:
        check_scan(scan.points, scan.fields.get("seconds"), handle.location)
    return scan


def assemble(
    clouds: Sequence[Cloud], rig: Rig, motion: VehicleMotion | None, where: str
) -> Assembled:
    """Put the clouds of a frame together, in their order. Every point is kept.

    Points are corrected for the motion of the vehicle, to the time of the frame, if their times and
    the motion are known.

    Args:
        clouds: at least one.
        rig: the sensors.
        motion: the motion of the vehicle; None if it is not known.
        where: the frame, for errors.

    Raises:
        FormatError: a cloud names a sensor that does not exist, or its fields do not fit its
            points.
    """
    if not clouds:
        raise FormatError(where, expected="points of at least one sensor", found="none")
    for cloud in clouds:
        _check(cloud, rig, where)
    placed = [_place(cloud, rig, motion) for cloud in clouds]
    points = np.concatenate([points for points, _ in placed]) if len(placed) > 1 else placed[0][0]
    fields: dict[str, AnyArray] = {}
    if len(rig.sensors) > 1:
        fields["sensor"] = np.concatenate(
            [np.full(len(cloud.points), cloud.sensor, np.uint8) for cloud in clouds]
        )
    seconds = _joined([cloud.seconds for cloud in clouds], clouds, np.float32)
    if seconds is not None:
        fields["seconds"] = seconds
    # Either all frames of a recording have origins or none, also frames in which the vehicle is at
    # rest.
    if any(origins.any() for _, origins in placed) or any(
        _follows_motion(cloud, rig, motion) for cloud in clouds
    ):
        fields["origins"] = np.concatenate([origins for _, origins in placed])
    for name in clouds[0].others:
        fields[name] = np.concatenate([_other(cloud, name, rig, where) for cloud in clouds])
    labels = _joined([cloud.labels for cloud in clouds], clouds, np.uint32)
    instances = _joined([cloud.instances for cloud in clouds], clouds, np.uint32)
    return Assembled(points, labels, instances, fields)


def _check(cloud: Cloud, rig: Rig, where: str) -> None:
    count = len(cloud.points)
    if cloud.points.ndim != 2 or cloud.points.shape[1] != 4 or cloud.points.dtype != np.float32:
        found = f"{cloud.points.shape} {cloud.points.dtype}"
        raise FormatError(f"{where}: points", expected="shape (N, 4) float32", found=found)
    if not 0 <= cloud.sensor < len(rig.sensors):
        raise FormatError(where, expected=f"a sensor 0..{len(rig.sensors) - 1}", found=cloud.sensor)
    fields = {
        "labels": cloud.labels,
        "instances": cloud.instances,
        "seconds": cloud.seconds,
        "origins": cloud.origins,
    }
    for name, values in (fields | dict(cloud.others)).items():
        if values is not None and len(values) != count:
            raise FormatError(
                f"{where}: {name}",
                expected=f"one for each of {count} points",
                found=len(values),
            )
    if cloud.seconds is not None and not np.isfinite(cloud.seconds).all():
        found = f"NaN or infinity at point {int(np.argmin(np.isfinite(cloud.seconds)))}"
        raise FormatError(f"{where}: times of points", expected="finite numbers", found=found)


def _follows_motion(cloud: Cloud, rig: Rig, motion: VehicleMotion | None) -> bool:
    """Return whether the position of the sensor is known for each point of a cloud."""
    sensor = rig.sensors[cloud.sensor]
    return (
        cloud.seconds is not None
        and motion is not None
        and (sensor.calibrated or not sensor.deskewed)
    )


def _place(
    cloud: Cloud, rig: Rig, motion: VehicleMotion | None
) -> tuple[Float32Array, Float32Array]:
    """Return the (N, 4) points and the (N, 3) origins of their rays, in the frame of the scan."""
    sensor = rig.sensors[cloud.sensor]
    scan_T_vehicle = invert(rig.vehicle_T_scan)
    scan_T_points = scan_T_vehicle @ sensor.vehicle_T_points
    if cloud.seconds is None or motion is None or not _follows_motion(cloud, rig, motion):
        points = _moved(scan_T_points, cloud.points)
        if cloud.origins is not None:
            return points, transform_points(scan_T_points, cloud.origins).astype(np.float32)
        return points, np.broadcast_to(_origin(sensor, scan_T_points), (len(points), 3))
    ticks, tick_of = ticks_of(cloud.seconds)
    now = motion.trajectory.at(np.array([motion.seconds]))[0]
    vehicle_T_then = invert(now) @ motion.trajectory.at(motion.seconds + ticks)
    scan_T_then = scan_T_vehicle @ vehicle_T_then @ sensor.vehicle_T_points
    if sensor.deskewed:
        points = _moved(scan_T_points, cloud.points)
    else:
        points = cloud.points.copy()
        points[:, :3] = move_each(cloud.points, scan_T_then, tick_of)
    if cloud.origins is not None and not sensor.deskewed:
        origins = move_each(cloud.origins, scan_T_then, tick_of).astype(np.float32)
    elif cloud.origins is not None:
        origins = transform_points(scan_T_points, cloud.origins).astype(np.float32)
    else:
        origins = _thinned(
            (scan_T_then[:, :3, :3] @ sensor.origin + scan_T_then[:, :3, 3]), sensor, scan_T_points
        )[tick_of]
    return points, origins


def _origin(sensor: Sensor, scan_T_points: Transform) -> Float32Array:
    """Return the position of a sensor in the frame of the scan; exactly the origin if it differs by
    rounding only.
    """
    origin = transform_points(scan_T_points, sensor.origin)
    origin[np.abs(origin) < 1e-9] = 0
    return origin.astype(np.float32)


def _thinned(path: FloatArray, sensor: Sensor, scan_T_points: Transform) -> Float32Array:
    """Return (T, 3) positions of a sensor over a sweep; neighbours within `_APART_M` are equal."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    if length[-1] < _APART_M:
        return np.tile(_origin(sensor, scan_T_points), (len(path), 1))
    parts = np.ceil(length[-1] / _APART_M)
    _, part = np.unique(
        np.minimum(np.floor(length / length[-1] * parts), parts - 1), return_inverse=True
    )
    counts = np.bincount(part)
    middle = np.stack([np.bincount(part, path[:, axis]) / counts for axis in range(3)], axis=1)
    return middle[part].astype(np.float32)


def _moved(scan_T_points: Transform, points: Float32Array) -> Float32Array:
    """Return (N, 4) points in the frame of the scan; the same numbers where the frames are the
    same.
    """
    if np.array_equal(scan_T_points, np.eye(4)):
        return points
    moved = points.copy()
    moved[:, :3] = transform_points(scan_T_points, points[:, :3])
    return moved


def _joined(
    parts: Sequence[AnyArray | None], clouds: Sequence[Cloud], dtype: type
) -> AnyArray | None:
    """Return the values of all clouds; 0 for those of clouds that have none; None if no cloud has
    any.
    """
    if all(part is None for part in parts):
        return None
    if len(parts) == 1:
        return parts[0] if dtype is np.uint32 else np.asarray(parts[0], dtype)
    filled: list[AnyArray] = [
        np.zeros(len(cloud.points), dtype) if part is None else part.astype(dtype)
        for part, cloud in zip(parts, clouds, strict=True)
    ]
    return np.concatenate(filled)


def _other(cloud: Cloud, name: str, rig: Rig, where: str) -> AnyArray:
    if name not in cloud.others:
        sensor = rig.sensors[cloud.sensor].name
        raise FormatError(
            where, expected=f"the field {name} from all sensors", found=f"none from {sensor}"
        )
    values = cloud.others[name]
    if layout.field_named(name).kind != "vector":
        return values
    rotation = (invert(rig.vehicle_T_scan) @ rig.sensors[cloud.sensor].vehicle_T_points)[:3, :3]
    return (values @ rotation.T).astype(values.dtype)


def make_fields(scan: Assembled, target: AxesAndClasses, where: str) -> dict[str, AnyArray]:
    """Return the fields of a scan in the axes and classes of the target, points last: a frame that
    has points is complete.

    Args:
        scan: the scan, right-handed, with class ids of the data set.
        target: the axes and classes in which it is written.
        where: the frame, for errors.

    Raises:
        FormatError: a class id is unknown.
    """
    fields: dict[str, AnyArray] = {}
    if scan.labels is not None:
        fields["labels"] = target.map_labels(scan.labels, f"labels of {where}")
    if scan.instances is not None:
        fields["instances"] = scan.instances
    for name, array in scan.fields.items():
        mirrored = target.mirrored and layout.field_named(name).kind == "vector"
        fields[name] = mirror_points(array) if mirrored else array
    fields["points"] = mirror_points(scan.points) if target.mirrored else scan.points
    return fields
