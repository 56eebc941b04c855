"""A drive through the town: the state of the town in any frame, and the scans of any LiDAR.

All randomness comes from the seed. A recording depends only on the seed, the frame and the sensor,
so any frame can be made separately, in any process, with the same bytes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from carlasc.captures.raw import SensorRecording
from carlasc.captures.settings import (
    EGO_SENSOR_M,
    HEIGHTS_M,
    Lidar,
    LidarEffects,
    TrafficLevel,
    check_at_least,
    sensor_offsets,
)
from carlasc.core.arrays import FloatArray, Uint32Array
from carlasc.core.geometry import (
    Transform,
    invert,
    rotate_vectors,
    slerp,
    transform_points,
    translation,
)
from carlasc.core.scans import Scan
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc_recorders.town.actors import EGO_ID, Population, TownActor
from carlasc_recorders.town.meshes import Mesh, RayScene, concatenate
from carlasc_recorders.town.returns import NO_SURFACE, Luck, cast
from carlasc_recorders.town.town import Town, build_town

REFERENCE_OFFSET_M = (
    25.6  # maximum offset of a reference sensor in x and y: half the width of the published grid
)
SENSOR_MARGIN_M = 37.0  # maximum distance of a sensor from the ego vehicle
LONGEST_HALF_M = 6.0  # half the length of the longest vehicle, rounded up

# Streams of random numbers: the second word of the seed.
_TOWN, _POPULATION, _SENSORS, _NOISE, _REFERENCE = range(5)


@dataclass(frozen=True)
class Snapshot:
    """The town around the ego vehicle at one instant.

    Attributes:
        frame: frame number.
        world_T_ego: (4, 4) pose of the ego vehicle.
        actors: all actors of the town by id.
        mesh: everything within the range of the sensors, including actors, world frame.
        instances: (F,) uint32 id of the actor of each triangle, 0 for none.
        scene: the same mesh, for ray casting.
    """

    frame: int
    world_T_ego: Transform
    actors: dict[int, TownActor]
    mesh: Mesh
    instances: Uint32Array
    scene: RayScene


class TownDrive:
    """A simulated drive: a town with traffic, and an ego vehicle with LiDARs that drives through
    it.

    Attributes:
        seed: seed of the town, its traffic, the offsets of the sensors, and the noise.
        traffic: "light", "medium" or "heavy".
        lidar: model of the LiDARs.
        town: the town.
    """

    def __init__(
        self, seed: int = 0, traffic: TrafficLevel = "medium", lidar: Lidar | None = None
    ) -> None:
        """Build the town.

        Args:
            seed: 0 or more.
            traffic: "light", "medium" or "heavy": 25, 50 or 100 moving vehicles, and as many
                pedestrians.
            lidar: model of the LiDARs; None takes the model of the data set.

        Raises:
            ArgumentError: the seed is negative, or the level of traffic is unknown.
            DependencyError: a package of the extra `simulate` is missing.
        """
        check_at_least(0, seed=seed)
        self.seed = seed
        self.traffic = traffic
        self.lidar = lidar if lidar is not None else Lidar()
        self.town: Town = build_town(self._random(_TOWN))
        self._population = Population(self._random(_POPULATION), self.town, traffic)
        self._snapshot: Snapshot | None = None

    def ego_pose(self, frame: int) -> Transform:
        """Return (4, 4) world_T_ego.

        The origin of the ego frame is on the ground below the centre of the vehicle.

        Raises:
            ArgumentError: the frame is negative.
        """
        check_at_least(0, frame=frame)
        return self._population.ego_pose(frame)

    def actors(self, frame: int) -> list[TownActor]:
        """Return all actors of the town in a frame, the ego vehicle first.

        Raises:
            ArgumentError: the frame is negative.
        """
        check_at_least(0, frame=frame)
        return self._population.at(frame)

    def sensor_offsets(self, sensors: int) -> FloatArray:
        """Return the (S, 3) offsets of the sensors in the vehicle frame, metres, the ego sensor
        first.

        A drive with more sensors has the same offsets for the first ones.

        Raises:
            ArgumentError: the number of sensors is less than 1.
        """
        check_at_least(1, sensors=sensors)
        return sensor_offsets(sensors, self._random(_SENSORS))

    def sensor_poses(self, frame: int, sensors: int) -> FloatArray:
        """Return world_T_sensor of each sensor, shape (S, 4, 4).

        The sensors have the orientation of the vehicle.

        Raises:
            ArgumentError: the frame is negative, or the number of sensors is less than 1.
        """
        ego = self.ego_pose(frame)
        return np.stack([ego @ translation(offset) for offset in self.sensor_offsets(sensors)])

    def record(self, frame: int, sensor: int = 0) -> SensorRecording:
        """Return the recording of a sensor of the vehicle in a frame. Sensor 0 is the ego sensor.

        Points are in the sensor frame. Velocities are over ground (without ego motion), on the axes
        of the sensor frame.

        Raises:
            ArgumentError: the frame or the sensor is negative.
        """
        check_at_least(0, sensor=sensor)
        pose = self.sensor_poses(frame, sensor + 1)[sensor]
        return scan_snapshot(
            self.snapshot(frame), pose, self.lidar, self._random(_NOISE, frame, sensor)
        )

    def scan(self, frame: int, sensor: int = 0) -> Scan:
        """Return the scan of a sensor with labels, flow and instances.

        Raises:
            ArgumentError: the frame or the sensor is negative.
        """
        recording = self.record(frame, sensor)
        return replace(recording.scan, flow=recording.flow())

    def sweep(
        self,
        frame: int,
        sensor: int = 0,
        *,
        parts: int = 20,
        phase: float = 0.0,
        effects: LidarEffects = LidarEffects(),  # noqa: B008 (frozen)
    ) -> SensorRecording:
        """Return the recording of a sensor that turns once while everything moves.

        The turn begins half a period before the time of the frame and ends half a period after it.
        Points are corrected for the motion of the vehicle, as converters do: they are in the frame
        of the sensor at the time of the frame. The scan has the fields `seconds` and `origins`.
        Velocities are those at the time of the frame.

        Args:
            frame: frame number.
            sensor: number of the sensor.
            parts: number of parts of the turn; the rays of a part are cast at one instant.
            phase: part of a turn by which its begin is after azimuth -pi, from 0 to 1.
            effects: what makes the scan differ from that of an ideal LiDAR; `turning` has no
                meaning here.

        Raises:
            ArgumentError: the frame or the sensor is negative, or there is no part.
        """
        check_at_least(0, sensor=sensor)
        check_at_least(1, parts=parts)
        now = self.snapshot(frame)
        offset = translation(self.sensor_offsets(sensor + 1)[sensor])
        directions = self.lidar.directions_of(frame)
        part_of = ((self.lidar.phases - phase) % 1.0 * parts).astype(np.int64)
        seconds = ((np.arange(parts) + 0.5) / parts - 0.5) * FRAME_PERIOD_S
        luck = Luck.draw(self.lidar, effects, self._random(_NOISE, frame, sensor))
        paths = self._paths(frame, seconds)
        static = [actor for id, actor in now.actors.items() if id not in paths]
        world = self._place(frame, now.world_T_ego, static)
        pose = now.world_T_ego @ offset
        scans = list[Scan]()
        for part, after_s in enumerate(seconds.tolist()):
            moved = [
                replace(now.actors[id], world_T_actor=path[part]) for id, path in paths.items()
            ]
            moving = self._place(frame, paths[EGO_ID][part], moved, with_town=False)
            then = moving.world_T_ego @ offset
            rays = np.flatnonzero(part_of == part)
            scan = _scan(
                (world, moving), then, self.lidar, directions[rays], luck.take(rays), effects
            )
            pose_T_then = invert(pose) @ then
            points = transform_points(pose_T_then, scan.points).astype(np.float32)
            origins = np.tile(pose_T_then[:3, 3].astype(np.float32), (len(scan), 1))
            others = {"seconds": np.full(len(scan), after_s, np.float32), "origins": origins}
            scans.append(replace(scan, points=points, others=others))
        whole = concatenate_scans(scans)
        return SensorRecording(whole, pose, _velocities(now, pose, whole))

    def _paths(self, frame: int, seconds: FloatArray) -> dict[int, FloatArray]:
        """Return the (T, 4, 4) poses of what moves at (T,) times after a frame, by its number; the
        ego vehicle is the first.
        """
        frames = np.arange(max(frame - 1, 0), frame + 2)
        poses = defaultdict[int, list[Transform]](list)
        moving = set[int]()
        for actor in (actor for near in frames.tolist() for actor in self._population.at(near)):
            poses[actor.id].append(actor.world_T_actor)
            if actor.id == EGO_ID or actor.velocity.any():
                moving.add(actor.id)
        times = (frames - frame) * FRAME_PERIOD_S
        return {id: slerp(np.stack(poses[id]), times, seconds) for id in sorted(moving)}

    def reference_observations(
        self, frame: int, sensors: int = 60, seed: int = 0
    ) -> list[SensorRecording]:
        """Return recordings of additional sensors at the time of a frame, as a reference for ground
        truth.

        These sensors are at random positions in free space within the area of the published grid, 1
        to 5 m high; one in ten is near the ground and one in ten is high above it. They are not
        sensors of the vehicle.

        Args:
            frame: frame number.
            sensors: number of reference sensors.
            seed: seed of their positions.

        Raises:
            ArgumentError: the frame is negative, or the number of sensors is less than 1.
        """
        check_at_least(1, sensors=sensors)
        rng = self._random(_REFERENCE, frame, seed)
        ego = self.ego_pose(frame) @ translation((*EGO_SENSOR_M[:2], 0.0))
        recordings: list[SensorRecording] = []
        while len(recordings) < sensors:
            kind = len(recordings) % 10
            heights = (0.4, 1.0) if kind == 4 else (7.0, 14.0) if kind == 9 else HEIGHTS_M
            offset = np.append(
                rng.uniform(-REFERENCE_OFFSET_M, REFERENCE_OFFSET_M, 2), rng.uniform(*heights)
            )
            pose = ego @ translation(offset)
            if self.is_free(frame, pose[:3, 3]):
                recordings.append(scan_snapshot(self.snapshot(frame), pose, self.lidar, rng))
        return recordings

    def is_free(self, frame: int, point: FloatArray) -> bool:
        """Whether a point (3,) of the world is outside all buildings and actors, with a margin."""
        for footprint, height in self.town.buildings:
            # the roof is within these 4 m
            if point[2] < height + 4.0 and footprint.contains(point[:2], 0.8):
                return False
        for actor in self.snapshot(frame).actors.values():
            local = transform_points(invert(actor.world_T_actor), point)
            low = actor.mesh.vertices.min(axis=0) - 0.5
            high = actor.mesh.vertices.max(axis=0) + 0.5
            if ((low < local) & (local < high)).all():
                return False
        return True

    def snapshot(self, frame: int) -> Snapshot:
        """Return the town around the ego vehicle in a frame. The last snapshot is cached.

        Raises:
            ArgumentError: the frame is negative.
        """
        if self._snapshot is None or self._snapshot.frame != frame:
            self._snapshot = self._take_snapshot(frame)
        return self._snapshot

    def _take_snapshot(self, frame: int) -> Snapshot:
        return self._place(frame, self.ego_pose(frame), self._population.at(frame))

    def _place(
        self, frame: int, ego: Transform, actors: list[TownActor], *, with_town: bool = True
    ) -> Snapshot:
        """Return actors, and the town unless it is left out, around the ego vehicle."""
        reach = self.lidar.range_m + SENSOR_MARGIN_M
        near = [
            actor
            for actor in actors
            if np.hypot(*(actor.world_T_actor[:2, 3] - ego[:2, 3])) < reach + LONGEST_HALF_M
        ]
        meshes = [actor.mesh.transformed(actor.world_T_actor) for actor in near]
        owners = [actor.id for actor in near]
        if with_town:
            low, high = self._extents
            nearest = np.clip(ego[:2, 3], low, high) - ego[:2, 3]
            keep = (nearest**2).sum(axis=1) < reach**2
            meshes = [self.town.mesh.select(keep), *meshes]
            owners = [0, *owners]
        counts = [len(mesh.faces) for mesh in meshes]
        instances = np.repeat(np.array(owners, np.uint32), counts)
        mesh = concatenate(meshes)
        by_id = {actor.id: actor for actor in actors}
        return Snapshot(frame, ego, by_id, mesh, instances, RayScene(mesh, ego[:3, 3]))

    @cached_property
    def _extents(self) -> tuple[FloatArray, FloatArray]:
        """Minimum and maximum x and y of each triangle of the static town, (F, 2) each."""
        corners = self.town.mesh.triangles[..., :2]
        return corners.min(axis=1), corners.max(axis=1)

    def _random(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *stream])


def concatenate_scans(scans: Sequence[Scan]) -> Scan:
    """Return the points of several scans with the same fields as one scan."""
    fields: dict[str, Any] = {
        name: np.concatenate([vars(scan).get(name, scan.others.get(name)) for scan in scans])
        for name in ("points", *scans[0].fields())
    }
    others = {name: fields.pop(name) for name in scans[0].others}
    return Scan(**fields, others=others)


def scan_snapshot(
    snapshot: Snapshot, world_T_sensor: Transform, lidar: Lidar, rng: np.random.Generator
) -> SensorRecording:
    """Return the recording of a LiDAR at a pose in a snapshot.

    Points on the ego vehicle and unlabelled points are not recorded. Noise is drawn for every ray,
    so that it does not depend on which rays hit a surface.

    Args:
        snapshot: the town at one instant.
        world_T_sensor: (4, 4) pose of the sensor.
        lidar: model of the LiDAR.
        rng: source of the noise.
    """
    luck = Luck.draw(lidar, LidarEffects(), rng)
    directions = lidar.directions_of(snapshot.frame)
    scan = _scan((snapshot,), world_T_sensor, lidar, directions, luck)
    return SensorRecording(scan, world_T_sensor, _velocities(snapshot, world_T_sensor, scan))


def _scan(
    snapshots: Sequence[Snapshot],
    world_T_sensor: Transform,
    lidar: Lidar,
    directions: FloatArray,
    luck: Luck,
    effects: LidarEffects = LidarEffects(),  # noqa: B008 (frozen)
) -> Scan:
    """Return the scan of (R, 3) rays, without points on the ego vehicle, and without unlabelled
    ones, unless they are of no surface.
    """
    found = cast(snapshots, world_T_sensor, directions, lidar, effects, luck)
    found = found.take((found.instances != EGO_ID) & (found.labels != 0))
    distances = found.distances * luck.scale[found.rays]
    rays = found.rays
    points = (directions[rays] * distances[:, None] + luck.noise[rays]).astype(np.float32)
    labels = np.where(found.labels == NO_SURFACE, 0, found.labels).astype(np.uint32)
    return Scan(points, labels, None, found.instances)


def _velocities(snapshot: Snapshot, world_T_sensor: Transform, scan: Scan) -> FloatArray:
    """Return (K, 4) id and velocity over ground, m/s, sensor frame, of every actor that was hit."""
    assert scan.instances is not None
    hit = np.unique(scan.instances[scan.instances != 0])
    velocities = np.array([snapshot.actors[int(id)].velocity for id in hit]).reshape(-1, 3)
    return np.column_stack(
        [hit.astype(np.float64), rotate_vectors(invert(world_T_sensor), velocities)]
    )
