"""Recordings of NCore, NVIDIA's exchange format, version 4: see the page `docs/sets/ncore.md`."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from carlasc.converting import Cloud, Converter, FrameHandle, Recording, Sensor, Trajectory
from carlasc.core import CameraModel
from carlasc.core.arrays import AnyArray, FloatArray, IntArray
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import Transform, check_rigid, invert, multiply, quaternions_of
from carlasc.errors import FormatError, MissingDataError, count
from carlasc_converters.files import no_data, opening, sequence_name
from carlasc_converters.kitti_boxes import BoxRows
from carlasc_converters.ncore_cameras import NcoreCamera
from carlasc_converters.ncore_classes import NCORE, NCORE_TO_CARLA, OTHER_OBJECT, class_of_name
from carlasc_converters.ncore_store import SUFFIXES, NcoreStore, open_store
from carlasc_converters.transforms import FrameTree, PlacedFrame

_VERSION = "v4"
_COMPONENT = "v1"
_KINDS = ("lidars", "poses", "cuboids", "cameras", "intrinsics")
_RIG = "rig"
_WORLD = "world"
_NS = 1000  # nanoseconds in a microsecond
_ALONE_US = 50_000.0  # greatest distance in time from a single frame to the data that belong to it


class Ncore(Converter):
    """Reads recordings of NCore: files .zarr.itar or folders .zarr, one or several for each
    sequence.
    """

    title: ClassVar[str] = "NCore, NVIDIA's exchange format, version 4"
    classes = NCORE
    to_carla = NCORE_TO_CARLA

    def sequences(self) -> list[Recording]:
        """Return the sequences that have a LiDAR, by name.

        Raises:
            MissingDataError: no sequence exists.
            FormatError: a store has another version.
        """
        # those of one sequence lie in one folder
        stores = defaultdict[tuple[Path, str], list[NcoreStore]](list)
        for path in self._paths():
            store = open_store(str(path))
            about = store.attributes()
            if about.get("version") != _VERSION:
                raise FormatError(
                    path,
                    expected=f"NCore {_VERSION}",
                    found=about.get("version", "no version"),
                )
            stores[path.parent, str(about["sequence_id"])].append(store)
        recordings = [NcoreRecording(name, parts) for (_, name), parts in sorted(stores.items())]
        if not recordings:
            raise no_data(
                self.source,
                f"stores of NCore: {' or '.join(f'*{suffix}' for suffix in SUFFIXES)}",
                "check the path, or unpack the archives",
            )
        return list(recordings)

    def _paths(self) -> list[Path]:
        if self.source.name.endswith(SUFFIXES):
            return [self.source]
        return sorted(
            path for path in self.source.rglob("*ncore4*") if path.name.endswith(SUFFIXES)
        )


class NcoreRecording(Recording):
    """A sequence.

    Its frames are those of its first LiDAR; a frame's time is its end, as in NCore.
    """

    split = "Train"

    def __init__(self, name: str, stores: Sequence[NcoreStore]) -> None:
        self.name = sequence_name(name)
        self.location = str(stores[0].path)
        self._stores = stores
        if not self._lidars:
            raise MissingDataError(
                self.location,
                expected="a LiDAR with frames",
                found="none",
                advice="give all stores of the sequence",
            )

    @cached_property
    def _components(self) -> dict[str, dict[str, tuple[NcoreStore, str]]]:
        """Store and group of each component that is read, by its kind and its name."""
        by_kind: dict[str, dict[str, tuple[NcoreStore, str]]] = {kind: {} for kind in _KINDS}
        for store in self._stores:
            for kind, components in by_kind.items():
                for name in store.groups(kind):
                    group = f"{kind}/{name}"
                    version = store.attributes(group).get("component_version")
                    if version != _COMPONENT:
                        raise FormatError(
                            f"{store.path}: {group}",
                            expected=f"version {_COMPONENT}",
                            found=version,
                        )
                    components[name] = (store, group)
        return by_kind

    def _component(self, kind: str) -> tuple[NcoreStore, str] | None:
        """Return the component of a kind with the name default, as in NCore, otherwise the first;
        None without one.
        """
        groups = self._components[kind]
        return groups.get("default") or next(iter(groups.values()), None)

    @cached_property
    def _spans(self) -> dict[str, IntArray]:
        """(F, 2) microseconds of the start and the end of each frame, by LiDAR that has frames."""
        spans = {}
        for name, (store, group) in self._components["lidars"].items():
            with opening(f"{store.path}: {group}/frames", "the times of frames"):
                own = np.array(
                    store.attributes(f"{group}/frames")["frames_timestamps_us"], np.int64
                ).reshape(-1, 2)
            if len(own):
                spans[name] = own
        return spans

    @cached_property
    def _lidars(self) -> dict[str, tuple[NcoreStore, str]]:
        """Store and group of each LiDAR that has frames, the first being the origin."""
        return {name: self._components["lidars"][name] for name in self._spans}

    @cached_property
    def _first(self) -> IntArray:
        """(F, 2) microseconds of the frames of the first LiDAR."""
        return next(iter(self._spans.values()))

    @property
    def about(self) -> dict[str, Any]:
        """Name, interval of time and version of the sequence, as each of its stores has them."""
        return self._stores[0].attributes()

    @property
    def ends_us(self) -> IntArray:
        """(F,) microseconds: the time of each frame."""
        return self._first[:, 1]

    @cached_property
    def _slack_us(self) -> float:
        """Half of the time between frames: data farther from a frame do not belong to it."""
        ends = self.ends_us
        return float(np.median(np.diff(ends))) / 2 if len(ends) > 1 else _ALONE_US

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The frames of the first LiDAR, each with the frames of the other ones that are nearest to
        it in time.
        """
        ends = self.ends_us
        parts: list[list[tuple[int, str, str]]] = [[] for _ in ends]
        for index, (name, (store, group)) in enumerate(self._lidars.items()):
            own = self._spans[name][:, 1]
            apart = np.abs(own[:, None] - ends[None])
            for number in range(len(ends)):
                row = int(np.argmin(apart[:, number]))
                if apart[row, number] <= self._slack_us and int(np.argmin(apart[row])) == number:
                    parts[number].append((index, str(store.path), f"{group}/frames/{own[row]}"))
        return [
            NcoreFrame(number, end, tuple(parts[number]))
            for number, end in enumerate(ends.tolist())
        ]

    @cached_property
    def _tree(self) -> FrameTree:
        """The frames of coordinates, as a tree below the world."""
        edges: dict[str, list[tuple[str, IntArray, FloatArray]]] = defaultdict(list)
        if (component := self._component("poses")) is not None:
            store, group = component
            with opening(f"{store.path}: {group}", "poses between frames"):
                given = {
                    **store.attributes(f"{group}/static_poses"),
                    **store.attributes(f"{group}/dynamic_poses"),
                }
                for key, entry in given.items():
                    source, target = ast.literal_eval(key)
                    poses = np.array(entry.get("poses", [entry.get("pose")]), np.float64)
                    stamps = np.array(entry.get("timestamps_us", [0]), np.int64)
                    check_rigid(poses, f"{store.path}: {group}: {key}")
                    edges[target].append((source, stamps, poses))
                    edges[source].append(
                        (target, stamps, np.array([invert(pose) for pose in poses]))
                    )
        tree = FrameTree(self.location)
        reached = list[str]()
        waiting = [_WORLD if _WORLD in edges else _RIG]
        while waiting:
            parent = waiting.pop()
            reached.append(parent)
            for child, stamps, poses in edges[parent]:
                if child in reached or child in waiting:
                    continue
                waiting.append(child)
                rows = np.concatenate(
                    [poses[:, :3, 3], quaternions_of(poses[:, :3, :3])], axis=1
                ).tolist()
                for stamp, row in zip(stamps.tolist(), rows, strict=True):
                    tree.add(PlacedFrame(stamp * _NS, parent, child, tuple(row)))
        return tree

    @cached_property
    def vehicle(self) -> str:
        """Name of the frame of the vehicle: the rig, or the first LiDAR."""
        first = next(iter(self._lidars))
        return _RIG if self._tree.connected(first, _RIG) else first

    @cached_property
    def sensors(self) -> Sequence[Sensor]:  # type: ignore[override]
        """The LiDARs, where the poses say that they are on the rig.

        Raises:
            MissingDataError: there are several, and no poses between them.
        """
        at = self.ends_us[:1] * _NS
        sensors = []
        for name in self._lidars:
            self._check_connected(name)
            sensors.append(
                Sensor(name, self._tree.lookup(self.vehicle, name, at)[0], deskewed=False)
            )
        return sensors

    def times(self) -> FloatArray:
        """Return seconds after the first frame."""
        return self._seconds(self.ends_us)

    def _seconds(self, stamps_us: AnyArray) -> FloatArray:
        return (stamps_us - self._first[0, 1]) / 1e6

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return the poses of the rig in the world; None if there are none."""
        if not self._tree.connected(self.vehicle, _WORLD) or self.vehicle == _WORLD:
            return None
        tracks = [
            track.values[0] for track in self._tree.edges(self.vehicle, _WORLD) if len(track) > 1
        ]
        if not tracks:
            return None
        stamps = max(tracks, key=len)
        return Trajectory(
            self._tree.lookup(_WORLD, self.vehicle, stamps),
            self._seconds(stamps // _NS),
            self.location,
        )

    @cached_property
    def _observations(self) -> list[tuple[int, dict[str, Any]]]:
        """The observations of tracks, each with the number of its frame; -1 without one near."""
        if (component := self._component("cuboids")) is None:
            return []
        store, group = component
        with opening(f"{store.path}: {group}", "observations of tracks"):
            given = store.attributes(f"{group}/cuboids").get("cuboid_track_observations", [])
            return [(self._frame_at(int(entry["timestamp_us"])), entry) for entry in given]

    def boxes(self) -> Mapping[int, Boxes] | None:
        """Return the cuboids of each frame with observations, in the frame of the rig at its time;
        None without any.
        """
        if not self._observations:
            return None
        annotated = sorted({frame for frame, _ in self._observations} - {-1})
        numbers: dict[str, int] = {}
        where = f"{self.location}: cuboids"
        rows = BoxRows(where, annotated)
        seen = set[tuple[int, int]]()
        with opening(where, "observations of tracks"):
            for frame, entry in self._observations:
                track = numbers.setdefault(entry["track_id"], len(numbers) + 1)
                if frame < 0 or (frame, track) in seen:  # or it was seen by several sensors
                    continue
                seen.add((frame, track))
                stamps = (
                    np.array(
                        [self._first[frame, 1], entry["reference_frame_timestamp_us"]], np.int64
                    )
                    * _NS
                )
                vehicle_T_reference = self._between(entry["reference_frame_id"], stamps)
                box = entry["bbox3"]
                label = class_of_name(entry["class_id"])
                pose = multiply(vehicle_T_reference, _pose_of(box["centroid"], box["rot"]))
                size = np.array(box["dim"], np.float64)
                rows.add(frame, track, OTHER_OBJECT if label is None else label, pose, size)
        return rows.boxes()

    @cached_property
    def _cameras(self) -> list[NcoreCamera]:
        """The cameras with a calibration, by name."""
        if (component := self._component("intrinsics")) is None:
            return []
        store, group = component
        images = self._components["cameras"]
        cameras = []
        for name in store.groups(f"{group}/cameras"):
            own, place = images.get(name, (store, f"cameras/{name}"))
            cameras.append(
                NcoreCamera(name, own, place, store.attributes(f"{group}/cameras/{name}"))
            )
        return cameras

    @cached_property
    def _images(self) -> dict[str, list[int | None]]:
        """The row of the image of each frame, by camera."""
        return {
            camera.name: camera.nearest(self.ends_us, self._slack_us) for camera in self._cameras
        }

    def cameras(self) -> Sequence[CameraModel]:
        """Return the cameras with a model of the layout and with poses that lead to the vehicle."""
        models = []
        at = self.ends_us[:1] * _NS
        for camera in self._cameras:
            if camera.unknown is None and self._tree.connected(camera.name, self.vehicle):
                middles = self._seconds(camera.spans.mean(axis=1))
                taken = [
                    np.nan if row is None else float(middles[row])
                    for row in self._images[camera.name]
                ]
                place = self._tree.lookup(self.vehicle, camera.name, at)[0]
                models.append(camera.model(place, np.array(taken) if len(middles) else None))
        return models

    def image(self, camera: CameraModel, frame: int) -> tuple[str, bytes] | None:
        """Return the image of a camera that is nearest to a frame."""
        row = self._images[camera.name][frame]
        return (
            None
            if row is None
            else next(own for own in self._cameras if own.name == camera.name).read(row)
        )

    def notes(self) -> list[str]:
        """Return notes on what was left out of the recording, and on unknown classes of objects."""
        notes = [
            f"the camera {camera.name} was left out: "
            f"{camera.unknown or f'no poses lead to {self.vehicle}'}"
            for camera in self._cameras
            if camera.unknown or not self._tree.connected(camera.name, self.vehicle)
        ]
        for kind in ("poses", "cuboids", "intrinsics"):
            chosen = self._component(kind)
            groups = self._components[kind]
            if others := [name for name, component in groups.items() if component != chosen]:
                notes.append(f"several {kind}: only one was read, not {', '.join(others)}")
        if idle := sorted(self._components["lidars"].keys() - self._lidars.keys()):
            notes.append(f"LiDARs without frames were left out: {', '.join(idle)}")
        if far := sum(frame < 0 for frame, _ in self._observations):
            notes.append(f"{count(far, 'observation')} of boxes left out, not near any frame")
        unknown = {
            str(entry["class_id"])
            for _, entry in self._observations
            if class_of_name(entry["class_id"]) is None
        }
        if unknown:
            notes.append(
                f"objects of unknown classes became Other object: {', '.join(sorted(unknown))}"
            )
        return notes

    def _frame_at(self, stamp_us: int) -> int:
        """Return the frame that contains a time, or the nearest one; -1 if none is near."""
        away = np.maximum(self._first[:, 0] - stamp_us, 0) + np.maximum(stamp_us - self.ends_us, 0)
        frame = int(np.argmin(away))
        return frame if away[frame] <= self._slack_us else -1

    def _check_connected(self, frame: str) -> None:
        if not self._tree.connected(frame, self.vehicle):
            expected = f"poses from {frame} to {self.vehicle}"
            raise MissingDataError(self.location, expected=expected, found=self._tree)

    def _between(self, reference: str, stamps: IntArray) -> Transform:
        """Return (4, 4) from a frame at the second time to the rig at the first time."""
        self._check_connected(reference)
        root = self._tree.ancestors(self.vehicle)[-1]
        now = self._tree.lookup(root, self.vehicle, stamps[:1])[0]
        then = self._tree.lookup(root, reference, stamps[1:])[0]
        return multiply(invert(now), then)


@dataclass(frozen=True)
class NcoreFrame(FrameHandle):
    """A frame: the place of each LiDAR's data.

    Attributes:
        number: its number.
        end_us: the end of the first LiDAR's frame, microseconds.
        parts: for each LiDAR its index, the store and the group.
    """

    number: int
    end_us: int
    parts: tuple[tuple[int, str, str], ...]

    @property
    def location(self) -> str:  # type: ignore[override]
        """The store and the group of the first LiDAR."""
        return f"{self.parts[0][1]}: {self.parts[0][2]}"

    def read(self) -> Sequence[Cloud]:
        """Read all returns of all rays."""
        return [self._read(*part) for part in self.parts]

    def _read(self, index: int, path: str, group: str) -> Cloud:
        store = open_store(path)
        rays = {
            name: store.array(f"{group}/ray_bundle/{name}")
            for name in ("direction", "timestamp_us")
        }
        returns = {
            name: store.array(f"{group}/ray_bundle_returns/{name}")
            for name in ("distance_m", "intensity")
        }
        distance = returns["distance_m"]
        if distance.shape[1:] != rays["direction"].shape[:1]:
            raise FormatError(
                f"{path}: {group}",
                expected=f"returns of {len(rays['direction'])} rays",
                found=distance.shape,
            )
        which, ray = np.nonzero(np.isfinite(distance))
        points = np.empty((len(ray), 4), np.float32)
        points[:, :3] = rays["direction"][ray] * distance[which, ray, None]
        points[:, 3] = np.nan_to_num(returns["intensity"][which, ray])
        seconds: AnyArray = (rays["timestamp_us"][ray].astype(np.int64) - self.end_us) / 1e6
        return Cloud(points, seconds=seconds, sensor=index)


def _pose_of(centroid: Sequence[float], angles_rad: Sequence[float]) -> Transform:
    """Return (4, 4) of a box: turned about the fixed axes x, y and z, in this order."""
    pose = np.eye(4)
    turn = np.eye(3)
    for axis, angle in enumerate(angles_rad):
        one, (a, b) = np.eye(3), [k for k in range(3) if k != axis]
        sign = -1 if axis == 1 else 1
        one[a, a] = one[b, b] = np.cos(angle)
        one[a, b] = -sign * np.sin(angle)
        one[b, a] = sign * np.sin(angle)
        turn = one @ turn
    pose[:3, :3] = turn
    pose[:3, 3] = centroid
    return pose
