"""A small simulated drive with known ground truth.

Tests of converters write it in the format of another data set and compare.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np

from carlasc.converting.protocol import Sensor
from carlasc.core.arrays import Float32Array, FloatArray, IntArray, Uint8Array, Uint32Array
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import Transform, invert, rotation_z, transform_points

KINDS = ("none", "road", "building", "vegetation", "pole", "car", "van", "pedestrian", "cyclist")
"""Kinds of things; `DriveScan.kinds` are indices of this tuple. Index 0 is not used."""
MOVABLE = ("car", "van", "pedestrian", "cyclist")
"""Kinds of things with boxes and track numbers."""


_KEPT = 16  # number of cached scans of a drive


@dataclass(frozen=True)
class Thing:
    """An upright cuboid in the world.

    Attributes:
        kind: one of `KINDS`.
        center: (x, y, z) at time 0, metres.
        size: length, width, height, metres.
        heading: radians about z.
        speed: metres per second along the heading.
    """

    kind: str
    center: tuple[float, float, float]
    size: tuple[float, float, float]
    heading: float = 0.0
    speed: float = 0.0

    def place(self, seconds: FloatArray | float) -> FloatArray:
        """Return the (..., 3) position of the center at some times."""
        ahead = self.speed * np.array([np.cos(self.heading), np.sin(self.heading), 0.0])
        return np.array(self.center) + np.asarray(seconds)[..., None] * ahead

    def world_T_box(self, seconds: FloatArray | float) -> FloatArray:
        """Return the (..., 4, 4) pose of the box at some times."""
        poses = np.broadcast_to(rotation_z(self.heading), (*np.shape(seconds), 4, 4)).copy()
        poses[..., :3, 3] = self.place(seconds)
        return poses


def read_things(rows: Sequence[Sequence[Any]]) -> tuple[Thing, ...]:
    """Return things from rows of kind, center, size, heading and speed; the last two may lack."""
    return tuple(Thing(kind, tuple(row[:3]), tuple(row[3:6]), *row[6:]) for kind, *row in rows)


def _street() -> tuple[Thing, ...]:
    """Return a street with houses, poles, trees and traffic."""
    return read_things(json.loads(files(__package__).joinpath("street.json").read_text("utf-8")))


@dataclass(frozen=True)
class DriveScan:
    """The scan of one sensor for one frame.

    Attributes:
        points: (N, 4) float32, x, y, z in metres in the frame of the sensor at the time of each
            point, and remission 0 to 1.
        deskewed: (N, 4) float32, the same points in the frame of the sensor at the time of the
            frame.
        kinds: (N,) uint8 indices of `KINDS`.
        instances: (N,) uint32 track numbers, 0 for things without a box.
        seconds: (N,) float64 time of each point after the time of the frame.
        world_T_sensor: (N, 4, 4) pose of the sensor at the time of each point.
    """

    points: Float32Array
    deskewed: Float32Array
    kinds: Uint8Array
    instances: Uint32Array
    seconds: FloatArray
    world_T_sensor: FloatArray


@dataclass(frozen=True)
class SimulatedDrive:
    """A vehicle that drives along a street with traffic.

    Axes are right-handed: x forward, y left, z up. The drive is exact and deterministic.

    The frame of the vehicle is at its rear axle, `axle_m` above the ground. If `rolling`, each
    sensor makes one turn per frame, from half a period before the time of the frame to half a
    period after it. Otherwise, all points are taken at the time of the frame.

    Attributes:
        frames: number of frames.
        period_s: time between frames, seconds.
        sensors: LiDARs of the vehicle.
        rolling: whether the points of a scan are taken one after the other.
        clockwise: whether rolling sensors turn clockwise, seen from above.
        speed: speed of the vehicle, metres per second.
        axle_m: height of the origin of the vehicle frame above the ground, metres.
        things: the things in the street.
        channels: number of laser beams.
        columns: number of azimuths.
        elevation_deg: the lowest and the highest beam.
        range_m: farther hits give no point.
        noise_m: standard deviation of the measured distances.
        body: parts of the vehicle that its sensors see, in its frame.
        way: returns the (..., 4, 4) poses of the vehicle at (...) seconds; None is the street.
    """

    frames: int = 8
    period_s: float = 0.1
    sensors: tuple[Sensor, ...] = field(
        default_factory=lambda: (
            Sensor(
                "lidar", np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.73], [0, 0, 0, 1]])
            ),
        )
    )
    rolling: bool = False
    clockwise: bool = False
    speed: float = 6.0
    axle_m: float = 0.0
    things: tuple[Thing, ...] = field(default_factory=_street)
    channels: int = 20
    columns: int = 180
    elevation_deg: tuple[float, float] = (-24.0, 8.0)
    range_m: float = 60.0
    noise_m: float = 0.0
    body: tuple[Thing, ...] = ()
    way: Callable[[FloatArray], FloatArray] | None = None

    _kept: dict[tuple[int, int], DriveScan] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def times(self) -> FloatArray:
        """(F,) seconds."""
        return np.arange(self.frames, dtype=np.float64) * self.period_s

    def world_T_vehicle(self, seconds: FloatArray | float) -> FloatArray:
        """Return the (..., 4, 4) poses of the vehicle at some times.

        On the street, it moves slightly from side to side.
        """
        at = np.asarray(seconds, np.float64)
        if self.way is not None:
            return self.way(at)
        x = self.speed * at
        poses = np.zeros((*at.shape, 4, 4))
        poses[..., 2, 2] = poses[..., 3, 3] = 1.0
        slope = 0.06 * np.cos(0.1 * x)
        cos = 1 / np.hypot(1, slope)
        sin = slope / np.hypot(1, slope)
        poses[..., 0, 0] = cos
        poses[..., 0, 1] = -sin
        poses[..., 1, 0] = sin
        poses[..., 1, 1] = cos
        poses[..., 0, 3] = x
        poses[..., 1, 3] = 0.6 * np.sin(0.1 * x)
        poses[..., 2, 3] = self.axle_m
        return poses

    def boxes(self, frame: int, labels: dict[str, int] | None = None) -> Boxes:
        """Return the boxes of the movable things within 60 m at a frame, in the frame of the
        vehicle.

        Args:
            frame: frame number.
            labels: class id of each kind; None takes the indices of `KINDS`.
        """
        vehicle_T_world = invert(self.world_T_vehicle(frame * self.period_s))
        near = [
            (track, thing, vehicle_T_world @ thing.world_T_box(frame * self.period_s))
            for track, thing in enumerate(self._movable, 1)
        ]
        near = [row for row in near if np.linalg.norm(row[2][:3, 3]) < 60.0]
        ids = {kind: place for place, kind in enumerate(KINDS)} if labels is None else labels
        return Boxes.from_poses(
            np.array([track for track, _, _ in near], np.uint32),
            np.array([ids[thing.kind] for _, thing, _ in near], np.uint32),
            np.array([pose for _, _, pose in near]).reshape(-1, 4, 4),
            np.array([thing.size for _, thing, _ in near]).reshape(-1, 3),
        )

    def scan(self, frame: int, sensor: int = 0) -> DriveScan:
        """Return the scan of a sensor for a frame.

        The last scans are cached; do not write to them.
        """
        key = (frame, sensor)
        if key not in self._kept:
            while len(self._kept) >= _KEPT:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = self._look(frame, sensor)
        return self._kept[key]

    def __getstate__(self) -> dict[str, object]:
        """Leave out the cached scans, which can be simulated again."""
        return {**vars(self), "_kept": {}}

    def _look(self, frame: int, sensor: int) -> DriveScan:
        mount = self.sensors[sensor].vehicle_T_sensor
        elevation = np.deg2rad(np.linspace(*self.elevation_deg, self.channels))
        azimuth = np.arange(self.columns) * (2 * np.pi / self.columns) - np.pi
        sweep = (np.arange(self.columns) / self.columns - 0.5) * self.period_s
        turn = (-sweep if self.clockwise else sweep) * self.rolling
        azimuth = np.repeat(azimuth, self.channels)
        turn = np.repeat(turn, self.channels)
        elevation = np.tile(elevation, self.columns)
        rays = np.stack(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ],
            axis=1,
        )
        at = frame * self.period_s + turn
        poses = self.world_T_vehicle(at) @ mount
        origins = poses[:, :3, 3]
        directions = np.einsum("nij,nj->ni", poses[:, :3, :3], rays)
        own = np.broadcast_to(mount[:3, 3], origins.shape), rays @ mount[:3, :3].T
        reach, hit = self._nearest((origins, directions), own, at)
        seen = reach < self.range_m
        reach = reach[seen]
        hit = hit[seen]
        poses = poses[seen]
        turn = turn[seen]
        if self.noise_m:
            rng = np.random.default_rng([frame, sensor])
            reach = reach + rng.normal(0.0, self.noise_m, len(reach))
        points = (rays[seen] * reach[:, None]).astype(np.float32)
        world = (
            np.einsum("nij,nj->ni", poses[:, :3, :3], points.astype(np.float64)) + poses[:, :3, 3]
        )
        deskewed = transform_points(
            invert(self.world_T_vehicle(frame * self.period_s) @ mount), world
        ).astype(np.float32)
        remission = np.round(0.1 + 0.05 * hit % 0.8, 2).astype(np.float32)[:, None]
        kinds = np.array(
            [KINDS.index(kind) for kind in ("road", *(thing.kind for thing in self._all))], np.uint8
        )
        tracks = {thing: track for track, thing in enumerate(self._movable, 1)}
        instances = np.array([0, *(tracks.get(thing, 0) for thing in self._all)], np.uint32)
        return DriveScan(
            np.hstack([points, remission]),
            np.hstack([deskewed, remission]),
            kinds[hit],
            instances[hit],
            turn,
            poses,
        )

    @property
    def _movable(self) -> tuple[Thing, ...]:
        return tuple(thing for thing in self.things if thing.kind in MOVABLE)

    @property
    def _all(self) -> tuple[Thing, ...]:
        return self.things + self.body

    def _nearest(
        self,
        world: tuple[FloatArray, FloatArray],
        own: tuple[FloatArray, FloatArray],
        at: FloatArray,
    ) -> tuple[FloatArray, IntArray]:
        """Return the length of each ray, and what it hits: 0 for the ground, n for the n-th thing
        from 1. `world` and `own` are origins and directions in the frames of the world and of the
        vehicle.
        """
        origins, directions = world
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.where(directions[:, 2] < 0, -origins[:, 2] / directions[:, 2], np.inf)
            hit = np.zeros(len(at), np.int64)
            for number, thing in enumerate(self._all, 1):
                origins, directions = world if number <= len(self.things) else own
                turn = rotation_z(thing.heading)[:3, :3]
                start = (origins - thing.place(at)) @ turn
                ray = directions @ turn
                half = np.array(thing.size) / 2
                one = (-half - start) / ray
                other = (half - start) / ray
                enter = np.fmin(one, other).max(axis=1)
                leave = np.fmax(one, other).min(axis=1)
                nearer = (enter <= leave) & (enter > 0) & (enter < reach)
                reach[nearer] = enter[nearer]
                hit[nearer] = number
        return reach, hit


def world_T_sensor(drive: SimulatedDrive, frame: int, sensor: int = 0) -> Transform:
    """Return the (4, 4) pose of a sensor at the time of a frame."""
    return drive.world_T_vehicle(frame * drive.period_s) @ drive.sensors[sensor].vehicle_T_sensor
