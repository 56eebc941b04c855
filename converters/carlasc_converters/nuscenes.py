"""nuScenes: see the page `docs/sets/nuscenes.md`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np

from carlasc.converting.protocol import Converter, FrameHandle, Recording, Sensor, Split, Trajectory
from carlasc.core import CameraModel
from carlasc.core.arrays import FloatArray, IntArray
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import Transform, invert
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc_converters.files import missing_scans, no_data
from carlasc_converters.image_files import nearest_images
from carlasc_converters.nuscenes_classes import MINI_VALIDATION, NUSCENES, TO_CARLA, VALIDATION
from carlasc_converters.nuscenes_frames import NuScenesFrame
from carlasc_converters.nuscenes_tables import CHANNEL, Annotations, SceneRow, Tables
from carlasc_converters.transforms import poses_of

_NEAR_US = 50_000  # greatest time between an image and its scan


@dataclass(eq=False)
class NuScenes(Converter):
    """Reads nuScenes with its point labels and instances (lidarseg and panoptic), if they are
    installed.
    """

    title: ClassVar[str] = "nuScenes, with lidarseg and panoptic labels where they are installed"
    license = "CC BY-NC-SA 4.0"
    citation = (
        "H. Caesar et al., nuScenes, CVPR 2020; W. K. Fong et al., Panoptic nuScenes, RA-L 2022"
    )
    classes = NUSCENES
    to_carla = TO_CARLA
    sensor = "Velodyne HDL-32E"
    min_range_m = 2.5
    max_range_m = 50.0

    source: Path
    _: KW_ONLY
    version: Annotated[
        str | None, "Folder of the tables, if there are several, such as v1.0-mini."
    ] = None
    sweeps: Annotated[
        bool, "Read all scans, 20 per second; without it, only key frames, 2 per second."
    ] = True

    def sequences(self) -> list[Recording]:
        """Return the scenes with files, by name. This reads the tables.

        Raises:
            ArgumentError: an option has a wrong value.
            MissingDataError: a table does not exist, or no scene has files.
            FormatError: a table does not have the format.
        """
        tables = Tables(self._version())
        tables.check_categories()
        root = tables.folder.parent
        # each folder is listed once, because it may hold hundreds of thousands of files
        names_in = cache(lambda folder: set(os.listdir(folder) if folder.is_dir() else ()))
        recordings: list[Recording] = []
        for scene in tables.scenes:
            present = {
                scan.file
                for scan in scene.scans
                if (file := root / scan.file).name in names_in(file.parent)
            }
            if present:
                recordings.append(NuScenesScene(tables, scene, present, all_scans=self.sweeps))
        if not recordings:
            raise MissingDataError(
                root,
                expected=f"the LiDAR scans that {tables.folder.name} lists, such as "
                f"samples/{CHANNEL}/*.pcd.bin",
                found="none of them",
                advice="unpack the archives of the sensor data beside the folder of the tables",
            )
        return recordings

    def _version(self) -> Path:
        """Return the folder of the tables."""
        root = self.source.resolve()
        asked = self.version
        if (root / "scene.json").is_file() and asked in (None, root.name):
            return root
        folders = sorted(path.parent for path in root.glob("v*/scene.json"))
        listed = ", ".join(folder.name for folder in folders)
        if not folders:
            raise no_data(
                self.source,
                "v1.0-mini/scene.json, or another version",
                "give the folder that holds v1.0-mini/, samples/ and sweeps/",
            )
        chosen = [folder for folder in folders if asked in (None, folder.name)]
        if len(chosen) != 1:
            raise ArgumentError(
                "version", expected=f"one of {listed}", found=repr(asked) if asked else "no choice"
            )
        return chosen[0]


class NuScenesScene(Recording):
    """One scene.

    Attributes:
        tables: the tables that hold it.
        scene: the scene.
    """

    def __init__(
        self, tables: Tables, scene: SceneRow, present: set[str], *, all_scans: bool
    ) -> None:
        """Choose the scans.

        Args:
            tables: the tables.
            scene: the scene.
            present: files of points that exist.
            all_scans: whether scans between key frames are frames, too.
        """
        self.tables = tables
        self.scene = scene
        self.name = f"NUSC_{scene.name}"
        self.location = f"{tables.folder}: {scene.name}"
        self.split = _split_of(scene.name, tables.folder.name)
        self._between = any(scan.sample < 0 and scan.file in present for scan in scene.scans)
        self._asked_for_all = all_scans
        chosen = [scan for scan in scene.scans if scan.sample >= 0 or (all_scans and self._between)]
        self._scans = chosen
        self._present = present
        self.has_labels = any(scan.labels or scan.instances for scan in chosen)
        self.has_instances = any(scan.instances for scan in chosen)

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The scans that exist."""
        root = self.tables.folder.parent
        boxes = self._boxes
        sensor_T_vehicle = invert(self.sensors[0].vehicle_T_sensor)
        return [
            NuScenesFrame(
                str(root / scan.file),
                number,
                None if scan.labels is None else str(root / scan.labels),
                None if scan.instances is None else str(root / scan.instances),
                boxes[number].transform(sensor_T_vehicle)
                if scan.instances and number in boxes
                else None,
            )
            for number, scan in enumerate(self._scans)
            if scan.file in self._present
        ]

    @cached_property
    def sensors(self) -> Sequence[Sensor]:  # type: ignore[override]
        """The LiDAR on the roof. The origin of the vehicle is on the ground."""
        mounts = [
            self.tables.mounts[token] for token in sorted({scan.mount for scan in self.scene.scans})
        ]
        if any(not np.allclose(mount, mounts[0]) for mount in mounts):
            raise FormatError(
                self.location,
                expected=f"one calibration of {CHANNEL} in a scene",
                found=len(mounts),
            )
        return (
            Sensor(
                CHANNEL,
                mounts[0],
                points_in="sensor",
                deskewed=True,
                height_m=float(mounts[0][2, 3]),
            ),
        )

    def poses(self, *, force: bool = False) -> Trajectory:
        """Return the poses of the vehicle at all LiDAR scans of the scene, at their own times."""
        rows = [scan.pose for scan in self.scene.scans]
        return Trajectory(
            self._global_T_vehicle(rows),
            self._seconds(self.tables.poses[0][rows]),
            f"{self.tables.path('ego_pose')}: {self.scene.name}",
        )

    def _global_T_vehicle(self, rows: Sequence[int]) -> FloatArray:
        """Return (N, 4, 4) poses of rows of the poses in the tables."""
        numbers = self.tables.poses[1][rows]
        return poses_of(
            numbers[:, 3:], numbers[:, :3], f"{self.tables.path('ego_pose')}: {self.scene.name}"
        )

    def times(self) -> FloatArray:
        """Return seconds after the first frame."""
        return self._seconds(np.array([scan.timestamp for scan in self._scans], np.int64))

    def _seconds(self, microseconds: IntArray) -> FloatArray:
        return np.asarray(microseconds - self._scans[0].timestamp, np.float64) * 1e-6

    def cameras(self) -> Sequence[CameraModel]:
        """Return the cameras of the scene, with the images nearest in time to each frame."""
        root = self.tables.folder.parent
        models = []
        frames = np.array([scan.timestamp for scan in self._scans], np.int64)
        for token in sorted(
            {image.mount for image in self.scene.images},
            key=lambda one: self.tables.cameras[one].channel,
        ):
            row = self.tables.cameras[token]
            own = [image for image in self.scene.images if image.mount == token]
            nearest, near, images = nearest_images(
                {image.timestamp: root / image.file for image in own}, frames, _NEAR_US
            )
            width, height = own[0].size
            camera = CameraModel(
                name=row.channel,
                width=width,
                height=height,
                matrix=row.matrix,
                sensor_T_camera=row.vehicle_T_camera,
                times=np.where(near, self._seconds(nearest), np.nan),
                images=images,
            )
            models.append(camera)
        return models

    def sample_tokens(self) -> dict[int, str]:
        """Return the token of the sample of each key frame, by its number."""
        tokens = self.tables.sample_tokens
        return {n: tokens[scan.sample] for n, scan in enumerate(self._scans) if scan.sample >= 0}

    def boxes(self) -> Mapping[int, Boxes] | None:
        """Return the boxes of the key frames.

        Tracks are numbered as the data set's panoptic labels are: by first appearance.
        """
        return None if self.tables.annotations is None else self._boxes

    @cached_property
    def _boxes(self) -> dict[int, Boxes]:
        """The boxes by frame."""
        annotations = self.tables.annotations
        if annotations is None:
            return {}
        keys = {number: scan for number, scan in enumerate(self._scans) if scan.sample >= 0}
        rows = {number: annotations.of(scan.sample) for number, scan in keys.items()}
        tracks = _tracks(
            [rows[number] for number in sorted(rows, key=lambda number: keys[number].sample)]
        )
        poses = self._global_T_vehicle([scan.pose for scan in keys.values()])
        kept = {}
        for (number, scan), global_T_vehicle in zip(keys.items(), poses, strict=True):
            try:
                kept[number] = _boxes_of(rows[number], tracks, global_T_vehicle)
            except FormatError as error:
                raise error.within(
                    f"{self.tables.path('sample_annotation')}: {scan.file}"
                ) from error
        return kept

    def problems(self) -> list[tuple[int, str]]:
        """Return the scans that the tables list and that have no file."""
        root = self.tables.folder.parent
        advice = "unpack the archives of the sensor data again"
        files = [
            (number, root / scan.file)
            for number, scan in enumerate(self._scans)
            if scan.file not in self._present
        ]
        return missing_scans(files, "a LiDAR scan that the tables list", advice)

    def notes(self) -> list[str]:
        """Return notes on what is missing in the scene."""
        if (
            self._asked_for_all
            and not self._between
            and any(scan.sample < 0 for scan in self.scene.scans)
        ):
            return [
                f"{self.location}: no scan between key frames exists in sweeps/: the frames are "
                f"the key frames, 2 a second"
            ]
        return []


def _boxes_of(rows: Annotations, tracks: Mapping[int, int], global_T_vehicle: Transform) -> Boxes:
    """Return the boxes of a sample in the frame of the vehicle."""
    global_T_box = poses_of(rows.numbers[:, 6:], rows.numbers[:, :3], "boxes")
    numbers = np.array([tracks[instance] for instance in rows.instances.tolist()], np.uint32)
    sizes = rows.numbers[:, [4, 3, 5]]  # the tables give width, length, height
    return Boxes.from_poses(numbers, rows.labels, invert(global_T_vehicle) @ global_T_box, sizes)


def _tracks(samples: Sequence[Annotations]) -> dict[int, int]:
    """Return the number of each object of a scene from 1: the order in which its samples first name
    it.
    """
    tracks: dict[int, int] = {}
    for sample in samples:
        for instance in sample.instances.tolist():
            tracks.setdefault(instance, len(tracks) + 1)
    return tracks


def _split_of(scene: str, version: str) -> Split:
    if "test" in version:
        return "Test"
    return "Val" if scene in (MINI_VALIDATION if "mini" in version else VALIDATION) else "Train"
