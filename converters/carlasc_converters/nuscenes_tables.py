"""The tables of nuScenes: the LiDAR scans, poses and boxes of its scenes.

Each table is read once, row by row.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from functools import cached_property, partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import FloatArray, Int32Array, IntArray, Uint32Array
from carlasc.core.geometry import Transform
from carlasc.errors import FormatError
from carlasc.storage.files import leads_outside
from carlasc_converters import json_rows
from carlasc_converters.nuscenes_classes import CLASS_IDS
from carlasc_converters.transforms import poses_of

CHANNEL = "LIDAR_TOP"
_POSE = ("translation", "rotation")
_KINDS: dict[str, type | int] = {
    "translation": 3,
    "rotation": 4,
    "size": 3,
    "timestamp": int,
    "index": int,
    "is_key_frame": bool,
    "width": int,
    "height": int,
    "camera_intrinsic": list,
}
read_rows = partial(json_rows.read_rows, kinds=_KINDS)


@dataclass(frozen=True, slots=True)
class LidarScan:
    """A LiDAR scan of a scene: a row of sample_data.

    Attributes:
        file: the points, relative to the root of the data set.
        timestamp: microseconds.
        sample: row of the sample that it belongs to, if it is the key frame of that sample;
            otherwise -1.
        mount: token of the calibrated sensor.
        pose: row of `Tables.poses`.
        labels: file of the point labels, or None.
        instances: file of the panoptic labels, or None.
    """

    file: str
    timestamp: int
    sample: int
    mount: str
    pose: int
    labels: str | None
    instances: str | None


@dataclass(frozen=True, slots=True)
class CameraRow:
    """A calibrated camera.

    Attributes:
        channel: such as "CAM_FRONT".
        vehicle_T_camera: (4, 4).
        matrix: (3, 3) intrinsic matrix, pixels.
    """

    channel: str
    vehicle_T_camera: Transform
    matrix: FloatArray


@dataclass(frozen=True, slots=True)
class ImageRow:
    """An image of a scene: a row of sample_data.

    Attributes:
        file: relative to the root of the data set.
        timestamp: microseconds.
        mount: token of the calibrated camera.
        size: columns and rows.
    """

    file: str
    timestamp: int
    mount: str
    size: tuple[int, int]


@dataclass(frozen=True)
class SceneRow:
    """A scene: about 20 s of driving.

    Attributes:
        name: such as "scene-0103".
        scans: its LiDAR scans by increasing time.
        images: the images of its cameras.
    """

    name: str
    scans: tuple[LidarScan, ...]
    images: tuple[ImageRow, ...] = ()


@dataclass(frozen=True)
class Annotations:
    """The boxes of all samples, as columns.

    Attributes:
        samples: (A,) row of the sample of each box, increasing.
        instances: (A,) row of the object in the table of instances.
        labels: (A,) class ids.
        numbers: (A, 10) x, y, z of the centre in the global frame, width, length, height, and the
            quaternion w, x, y, z.
    """

    samples: Int32Array
    instances: Int32Array
    labels: Uint32Array
    numbers: FloatArray

    def of(self, sample: int) -> Annotations:
        """Return the boxes of one sample."""
        rows = slice(*np.searchsorted(self.samples, (sample, sample + 1)))
        return Annotations(
            self.samples[rows], self.instances[rows], self.labels[rows], self.numbers[rows]
        )


class Tables:
    """The tables in one folder.

    Attributes:
        folder: the folder, such as v1.0-mini.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # row in `poses` by token; `scenes` collects the needed poses
        self._pose_rows: dict[str, int] = {}

    def path(self, table: str) -> Path:
        """Return the file of a table."""
        return self.folder / f"{table}.json"

    def check_categories(self) -> None:
        """Check that classes have the same names as in our table, and those of point labels the
        same numbers.

        Raises:
            FormatError: they differ, so that the tables belong to another version.
        """
        path = self.path("category")
        for (name,) in read_rows(path, ("name",)):
            if name not in CLASS_IDS:
                self._refuse_categories(repr(name))
        # these add numbers to the categories
        if self.path("lidarseg").is_file() or self.path("panoptic").is_file():
            for name, index in read_rows(path, ("name", "index")):
                if index != CLASS_IDS[name]:
                    self._refuse_categories(f"{index} for {name}, which is {CLASS_IDS[name]}")

    def _refuse_categories(self, found: str) -> None:
        expected = (
            f"the {len(CLASS_IDS)} categories of nuScenes v1.0, with the numbers of "
            f"nuScenes-lidarseg"
        )
        raise FormatError(
            self.path("category"),
            expected=expected,
            found=found,
            advice="use the tables of nuScenes v1.0",
        )

    @cached_property
    def _samples(self) -> dict[str, tuple[int, str]]:
        """Row, and token of the scene, of each sample."""
        rows = read_rows(self.path("sample"), ("token", "scene_token"))
        return {token: (row, scene) for row, (token, scene) in enumerate(rows)}

    @property
    def sample_tokens(self) -> list[str]:
        """The tokens of the samples, by row."""
        return list(self._samples)

    @cached_property
    def mounts(self) -> dict[str, Transform]:
        """(4, 4) pose of each calibrated LiDAR in the frame of its vehicle, by token."""
        sensors = {
            token
            for token, channel in read_rows(self.path("sensor"), ("token", "channel"))
            if channel == CHANNEL
        }
        path = self.path("calibrated_sensor")
        rows = [
            row for row in read_rows(path, ("token", "sensor_token", *_POSE)) if row[1] in sensors
        ]
        poses = poses_of(_columns(rows, 3, 4), _columns(rows, 2, 3), str(path))
        return {row[0]: pose for row, pose in zip(rows, poses, strict=True)}

    @cached_property
    def cameras(self) -> dict[str, CameraRow]:
        """The calibrated cameras, by token."""
        channels = dict(read_rows(self.path("sensor"), ("token", "channel")))
        path = self.path("calibrated_sensor")
        keys = ("token", "sensor_token", *_POSE, "camera_intrinsic")
        rows = [row for row in read_rows(path, keys) if row[4]]
        poses = poses_of(_columns(rows, 3, 4), _columns(rows, 2, 3), str(path))
        cameras = {}
        for (token, sensor, _, _, intrinsic), pose in zip(rows, poses, strict=True):
            try:
                matrix = np.array(intrinsic, np.float64).reshape(3, 3)
            except ValueError as error:
                raise FormatError(
                    path, expected="3 x 3 numbers in camera_intrinsic", found=intrinsic
                ) from error
            cameras[token] = CameraRow(str(channels.get(sensor)), pose, matrix)
        return cameras

    @cached_property
    def scenes(self) -> list[SceneRow]:
        """The scenes, by name."""
        scans: dict[str, list[LidarScan]] = {}
        images: dict[str, list[ImageRow]] = {}
        labels = self._label_files("lidarseg")
        instances = self._label_files("panoptic")
        samples = self._samples
        mounts = self.mounts
        cameras = self.cameras
        keys = (
            "token",
            "sample_token",
            "ego_pose_token",
            "calibrated_sensor_token",
            "filename",
            "timestamp",
            "is_key_frame",
            "width",
            "height",
        )
        for token, sample, pose, mount, file, timestamp, key, *size in read_rows(
            self.path("sample_data"), keys
        ):
            if mount in cameras and sample in samples and all(size):
                self._check_inside("sample_data", file)
                width, height = size
                images.setdefault(samples[sample][1], []).append(
                    ImageRow(file, timestamp, mount, (width, height))
                )
            if mount not in mounts:
                continue  # of a camera or a radar
            if sample not in samples:
                raise FormatError(
                    self.path("sample_data"),
                    expected="a sample_token of sample.json",
                    found=f"{sample} for {file}",
                )
            row, scene = samples[sample]
            place = self._pose_rows.setdefault(pose, len(self._pose_rows))
            self._check_inside("sample_data", file)
            files = labels.get(token), instances.get(token)
            scans.setdefault(scene, []).append(
                LidarScan(file, timestamp, row if key else -1, mount, place, *files)
            )
        rows = list(read_rows(self.path("scene"), ("token", "name")))
        for _, name in rows:
            self._check_inside("scene", name)
        scenes = [
            SceneRow(
                name,
                tuple(sorted(scans.get(token, ()), key=attrgetter("timestamp"))),
                tuple(images.get(token, ())),
            )
            for token, name in rows
        ]
        return sorted(scenes, key=attrgetter("name"))

    def _label_files(self, table: str) -> dict[str, str]:
        """Return the files of a table of labels by token of the scan; none if there is no such
        table.
        """
        path = self.path(table)
        files = dict(read_rows(path, ("sample_data_token", "filename"))) if path.is_file() else {}
        for file in files.values():
            self._check_inside(table, file)
        return files

    def _check_inside(self, table: str, name: str) -> None:
        if leads_outside(name):
            raise FormatError(
                self.path(table),
                expected="names of files of the data set",
                found=repr(name),
                advice="it leads elsewhere",
            )

    @cached_property
    def poses(self) -> tuple[IntArray, FloatArray]:
        """(P,) timestamps in microseconds, and (P, 7) x, y, z, qw, qx, qy, qz of the vehicle in the
        global frame, at LiDAR scans.
        """
        wanted = self._pose_rows if self.scenes else {}
        timestamps = np.zeros(len(wanted), np.int64)
        numbers = np.full((len(wanted), 7), np.nan)
        for token, timestamp, position, rotation in read_rows(
            self.path("ego_pose"), ("token", "timestamp", *_POSE)
        ):
            if (row := wanted.get(token)) is not None:
                timestamps[row] = timestamp
                numbers[row] = (*position, *rotation)
        if np.isnan(numbers).any():
            lacking = list(wanted)[int(np.argmax(np.isnan(numbers).any(axis=1)))]
            raise FormatError(
                self.path("ego_pose"),
                expected=f"the pose {lacking} of a LiDAR scan",
                found="no such row",
            )
        return timestamps, numbers

    @cached_property
    def annotations(self) -> Annotations | None:
        """All boxes; None if there are none, as in the test set."""
        if not self.path("sample_annotation").is_file():
            return None
        class_ids = {
            token: CLASS_IDS[name]
            for token, name in read_rows(self.path("category"), ("token", "name"))
        }
        objects: dict[str, tuple[int, int]] = {}
        for token, category in read_rows(self.path("instance"), ("token", "category_token")):
            if category not in class_ids:
                found = f"{category} for {token}"
                raise FormatError(
                    self.path("instance"), expected="a category_token of category.json", found=found
                )
            objects[token] = len(objects), class_ids[category]
        samples = array("i")
        instances = array("i")
        labels = array("I")
        numbers = array("d")
        path = self.path("sample_annotation")
        keys = ("sample_token", "instance_token", "translation", "size", "rotation")
        for sample, instance, position, size, rotation in read_rows(path, keys):
            if sample not in self._samples or instance not in objects:
                found = f"{sample} and {instance} in row {len(samples)}"
                raise FormatError(path, expected="a known sample and instance", found=found)
            samples.append(self._samples[sample][0])
            instances.append(objects[instance][0])
            labels.append(objects[instance][1])
            numbers.extend((*position, *size, *rotation))
        if not samples:
            return None
        rows = np.frombuffer(samples, np.int32)
        order = np.argsort(rows, kind="stable")
        return Annotations(
            rows[order],
            np.frombuffer(instances, np.int32)[order],
            np.frombuffer(labels, np.uint32)[order],
            np.frombuffer(numbers, np.float64).reshape(-1, 10)[order],
        )


def _columns(rows: list[tuple[Any, ...]], place: int, width: int) -> FloatArray:
    """Return one value of each row, which is a list of `width` numbers, as (N, width)."""
    return np.array([row[place] for row in rows], np.float64).reshape(-1, width)
