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
from numpy.typing import NDArray

from carlasc.converting import Cloud, Converter, FrameHandle, Recording, Sensor, Trajectory
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import Transform, check_rigid, invert, multiply, quaternions_of
from carlasc.errors import FormatError, MissingDataError
from carlasc_converters.files import opening, sequence_name
from carlasc_converters.kitti_boxes import BoxRows
from carlasc_converters.ncore_classes import NCORE, NCORE_TO_CARLA, class_of_name
from carlasc_converters.ncore_store import SUFFIXES, NcoreStore, open_store
from carlasc_converters.transforms import FrameTree, PlacedFrame

_VERSION = "v4"
_COMPONENT = "v1"
_RIG, _WORLD = "rig", "world"
_NS = 1000  # nanoseconds in a microsecond


class Ncore(Converter):
    """Reads recordings of NCore: files .zarr.itar or folders .zarr, one or several for each sequence."""

    title: ClassVar[str] = "NCore, NVIDIA's exchange format, version 4"
    classes = NCORE
    to_carla = NCORE_TO_CARLA

    def sequences(self) -> list[Recording]:
        """Return the sequences that have a LiDAR, by name.

        Raises:
            MissingDataError: there is none.
            FormatError: a store has another version.
        """
        stores = defaultdict[str, list[NcoreStore]](list)
        for path in self._paths():
            store = open_store(str(path))
            about = store.attributes()
            if about.get("version") != _VERSION:
                raise FormatError(path, expected=f"NCore {_VERSION}", found=str(about.get("version", "no version")))
            stores[str(about["sequence_id"])].append(store)
        found = [NcoreRecording(name, parts) for name, parts in sorted(stores.items())]
        if not found:
            raise MissingDataError(
                self.source,
                expected=f"stores of NCore: {' or '.join(f'*{suffix}' for suffix in SUFFIXES)}",
                found="none",
            )
        return list(found)

    def _paths(self) -> list[Path]:
        if self.source.name.endswith(SUFFIXES):
            return [self.source]
        return sorted(path for path in self.source.rglob("*ncore4*") if path.name.endswith(SUFFIXES))


class NcoreRecording(Recording):
    """A sequence. Its frames are those of its first LiDAR; a frame's time is its end, as in NCore."""

    split = "Train"

    def __init__(self, name: str, stores: Sequence[NcoreStore]) -> None:
        self.name, self.location, self._stores = sequence_name(name), str(stores[0].path), stores
        if not self._lidars:
            raise MissingDataError(
                self.location, expected="a component lidars", found="none", advice="give all stores of the sequence"
            )

    def _components(self, kind: str) -> dict[str, tuple[NcoreStore, str]]:
        """Return the store and the group of each component of a kind, by its name."""
        found = {}
        for store in self._stores:
            for name in store.groups(kind):
                group = f"{kind}/{name}"
                version = store.attributes(group).get("component_version")
                if version != _COMPONENT:
                    raise FormatError(f"{store.path}: {group}", expected=f"version {_COMPONENT}", found=str(version))
                found[name] = (store, group)
        return found

    @cached_property
    def _lidars(self) -> dict[str, tuple[NcoreStore, str]]:
        return self._components("lidars")

    @cached_property
    def _spans(self) -> list[NDArray[np.int64]]:
        """(F, 2) microseconds of the start and the end of each frame of each LiDAR."""
        spans = []
        for store, group in self._lidars.values():
            with opening(f"{store.path}: {group}/frames", "the times of frames"):
                spans.append(
                    np.array(store.attributes(f"{group}/frames")["frames_timestamps_us"], np.int64).reshape(-1, 2)
                )
        return spans

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The frames of the first LiDAR, each with the frame of every other one that ends nearest in time."""
        first = self._spans[0][:, 1]
        frames = []
        for number, end in enumerate(first.tolist()):
            parts = []
            for index, (spans, (store, group)) in enumerate(zip(self._spans, self._lidars.values(), strict=True)):
                if len(spans):
                    own = int(spans[np.argmin(np.abs(spans[:, 1] - end)), 1])
                    parts.append((index, str(store.path), f"{group}/frames/{own}"))
            frames.append(NcoreFrame(number, end, tuple(parts)))
        return frames

    @cached_property
    def _tree(self) -> FrameTree:
        """The frames of coordinates, as a tree below the world."""
        edges: dict[str, list[tuple[str, NDArray[np.int64], NDArray[np.float64]]]] = defaultdict(list)
        for store, group in self._components("poses").values():
            with opening(f"{store.path}: {group}", "poses between frames"):
                given = {**store.attributes(f"{group}/static_poses"), **store.attributes(f"{group}/dynamic_poses")}
                for key, entry in given.items():
                    source, target = ast.literal_eval(key)
                    poses = np.array(entry.get("poses", [entry.get("pose")]), np.float64)
                    stamps = np.array(entry.get("timestamps_us", [0]), np.int64)
                    check_rigid(poses, f"{store.path}: {group}: {key}")
                    edges[target].append((source, stamps, poses))
                    edges[source].append((target, stamps, np.array([invert(pose) for pose in poses])))
        tree, reached = FrameTree(self.location), list[str]()
        waiting = [_WORLD if _WORLD in edges else _RIG]
        while waiting:
            parent = waiting.pop()
            reached.append(parent)
            for child, stamps, poses in edges[parent]:
                if child in reached or child in waiting:
                    continue
                waiting.append(child)
                rows = np.concatenate([poses[:, :3, 3], quaternions_of(poses[:, :3, :3])], axis=1).tolist()
                for stamp, row in zip(stamps.tolist(), rows, strict=True):
                    tree.add(PlacedFrame(stamp * _NS, parent, child, tuple(row)))
        return tree

    @cached_property
    def _vehicle(self) -> str:
        first = next(iter(self._lidars))
        return _RIG if self._tree.connected(first, _RIG) else first

    @cached_property
    def sensors(self) -> Sequence[Sensor]:  # type: ignore[override]
        """The LiDARs, where the poses say that they are on the rig.

        Raises:
            MissingDataError: there are several, and no poses between them.
        """
        at, sensors = self._spans[0][:1, 1] * _NS, []
        for name in self._lidars:
            if not self._tree.connected(name, self._vehicle):
                raise MissingDataError(
                    self.location, expected=f"poses from {name} to {self._vehicle}", found=str(self._tree)
                )
            sensors.append(Sensor(name, self._tree.lookup(self._vehicle, name, at)[0], deskewed=False))
        return sensors

    def times(self) -> NDArray[np.float64]:
        """Return seconds after the first frame."""
        return self._seconds(self._spans[0][:, 1])

    def _seconds(self, stamps_us: NDArray[np.int64]) -> NDArray[np.float64]:
        return (stamps_us - self._spans[0][0, 1]) / 1e6

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return the poses of the rig in the world; None if there are none."""
        if not self._tree.connected(self._vehicle, _WORLD) or self._vehicle == _WORLD:
            return None
        tracks = [track.values[0] for track in self._tree.edges(self._vehicle, _WORLD) if len(track) > 1]
        if not tracks:
            return None
        stamps = max(tracks, key=len)
        return Trajectory(self._tree.lookup(_WORLD, self._vehicle, stamps), self._seconds(stamps // _NS), self.location)

    def boxes(self) -> Mapping[int, Boxes] | None:
        """Return the cuboids of each frame in the frame of the rig at the time of the frame; None if there are none."""
        observations = [
            entry
            for store, group in self._components("cuboids").values()
            for entry in store.attributes(f"{group}/cuboids").get("cuboid_track_observations", ())
        ]
        if not observations:
            return None
        ends = self._spans[0][:, 1]
        numbers: dict[str, int] = {}
        rows, seen = BoxRows(f"{self.location}: cuboids", list(range(len(ends)))), set[tuple[int, int]]()
        with opening(f"{self.location}: cuboids", "observations of tracks"):
            for entry in observations:
                frame, track = (
                    self._frame_at(int(entry["timestamp_us"])),
                    numbers.setdefault(entry["track_id"], len(numbers) + 1),
                )
                if (frame, track) in seen:
                    continue  # seen by several sensors
                seen.add((frame, track))
                stamps = np.array([ends[frame], entry["reference_frame_timestamp_us"]], np.int64) * _NS
                vehicle_T_reference = self._between(entry["reference_frame_id"], stamps)
                box = entry["bbox3"]
                pose = multiply(vehicle_T_reference, _pose_of(box["centroid"], box["rot"]))
                rows.add(frame, track, class_of_name(entry["class_id"]), pose, np.array(box["dim"], np.float64))
        return rows.boxes()

    def _frame_at(self, stamp_us: int) -> int:
        """Return the frame within which a time is, or which is nearest to it."""
        spans = self._spans[0]
        return int(np.argmin(np.maximum(spans[:, 0] - stamp_us, 0) + np.maximum(stamp_us - spans[:, 1], 0)))

    def _between(self, reference: str, stamps: NDArray[np.int64]) -> Transform:
        """Return (4, 4) from a frame at the second time to the rig at the first time."""
        if not self._tree.connected(reference, self._vehicle):
            raise MissingDataError(
                self.location, expected=f"poses from {reference} to {self._vehicle}", found=str(self._tree)
            )
        root = self._tree.ancestors(self._vehicle)[-1]
        now, then = (
            self._tree.lookup(root, self._vehicle, stamps[:1])[0],
            self._tree.lookup(root, reference, stamps[1:])[0],
        )
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
        rays = {name: store.array(f"{group}/ray_bundle/{name}") for name in ("direction", "timestamp_us")}
        returns = {name: store.array(f"{group}/ray_bundle_returns/{name}") for name in ("distance_m", "intensity")}
        distance = returns["distance_m"]
        if distance.shape[1:] != rays["direction"].shape[:1]:
            raise FormatError(
                f"{path}: {group}", expected=f"returns of {len(rays['direction'])} rays", found=str(distance.shape)
            )
        which, ray = np.nonzero(np.isfinite(distance))
        points = np.empty((len(ray), 4), np.float32)
        points[:, :3] = rays["direction"][ray] * distance[which, ray, None]
        points[:, 3] = np.nan_to_num(returns["intensity"][which, ray])
        seconds: NDArray[Any] = (rays["timestamp_us"][ray].astype(np.int64) - self.end_us) / 1e6
        return Cloud(points, seconds=seconds, sensor=index)


def _pose_of(centroid: Sequence[float], angles_rad: Sequence[float]) -> Transform:
    """Return (4, 4) of a box: turned about the fixed axes x, y and z, in this order."""
    pose, turn = np.eye(4), np.eye(3)
    for axis, angle in enumerate(angles_rad):
        one, (a, b) = np.eye(3), [k for k in range(3) if k != axis]
        sign = -1 if axis == 1 else 1
        one[a, a] = one[b, b] = np.cos(angle)
        one[a, b], one[b, a] = -sign * np.sin(angle), sign * np.sin(angle)
        turn = one @ turn
    pose[:3, :3], pose[:3, 3] = turn, centroid
    return pose
