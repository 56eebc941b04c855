"""A drive through a town: where everything is at any frame, and what any LiDAR sees of it.

All randomness comes from the seed, and what a sensor sees in a frame depends on the seed, the frame and the sensor alone: any
frame can be made by itself, in any process, with the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.raw import EGO_SENSOR_M, HEIGHTS_M, Recording, sensor_offsets
from carlasc.captures.town.actors import EGO_ID, Actor, Population
from carlasc.captures.town.lidar import Lidar, RayScene, turned
from carlasc.captures.town.meshes import Mesh
from carlasc.captures.town.town import Town, build_town
from carlasc.core.geometry import Transform, invert, rotate_vectors, transform_points, translation
from carlasc.core.scans import Scan
from carlasc.errors import ArgumentError

REFERENCE_SPREAD_M = 25.6  # half the width of the published grid
CROP_MARGIN_M = 37.0  # sensors may be this far from the ego vehicle

# What each stream of random numbers is for: the seed's second word.
_TOWN, _POPULATION, _SENSORS, _NOISE, _REFERENCE = range(5)


@dataclass(frozen=True)
class Snapshot:
    """The town at one instant, around the ego vehicle.

    Attributes:
        frame: frame number.
        world_T_ego: (4, 4) pose of the ego vehicle.
        actors: everybody in the town, by id.
        mesh: what is near, standing or moving.
        instances: (F,) uint32 actor of each triangle, 0 is none.
        scene: the same, for rays.
    """

    frame: int
    world_T_ego: Transform
    actors: dict[int, Actor]
    mesh: Mesh
    instances: NDArray[np.uint32]
    scene: RayScene


class Drive:
    """A town with its traffic, an ego vehicle that drives through it, and the sensors it carries.

    Attributes:
        seed: what everything is drawn from.
        traffic: "light", "medium" or "heavy".
        lidar: the sensors' model.
    """

    def __init__(self, seed: int = 0, traffic: str = "medium", lidar: Lidar | None = None) -> None:
        """Build the town.

        Args:
            seed: any number from 0.
            traffic: "light", "medium" or "heavy": 25, 50 or 100 vehicles and as many pedestrians.
            lidar: the sensors' model; the data set's if None.

        Raises:
            ArgumentError: the seed is negative, or the traffic unknown.
        """
        if seed < 0:
            raise ArgumentError("seed", expected="0 or more", found=f"{seed}")
        self.seed, self.traffic = seed, traffic
        self.lidar = lidar if lidar is not None else Lidar()
        self.town: Town = build_town(self._random(_TOWN))
        self._population = Population(self._random(_POPULATION), self.town, traffic)
        self._snapshot: Snapshot | None = None

    def ego_pose(self, frame: int) -> Transform:
        """Return (4, 4) world_T_ego: the ego vehicle's middle, on the ground."""
        return self._population.ego_pose(_checked(frame))

    def actors(self, frame: int) -> list[Actor]:
        """Return everybody in the town at a frame, the ego vehicle first."""
        return self._population.at(_checked(frame))

    def sensor_offsets(self, count: int) -> NDArray[np.float64]:
        """Return where the sensors are on the vehicle: (count, 3) metres, vehicle frame, the ego sensor first.

        The first k are the same for any count.

        Raises:
            ArgumentError: no sensor.
        """
        if count < 1:
            raise ArgumentError("sensors", expected="at least 1", found=f"{count}")
        return sensor_offsets(count, self._random(_SENSORS))

    def sensor_poses(self, frame: int, count: int) -> NDArray[np.float64]:
        """Return (count, 4, 4) world_T_sensor: offsets as above, orientation the vehicle's."""
        ego = self.ego_pose(frame)
        return np.stack([ego @ translation(offset) for offset in self.sensor_offsets(count)])

    def record(self, frame: int, sensor: int = 0) -> Recording:
        """Return what a sensor of the vehicle records in a frame: sensor 0 is the ego one, any number may follow.

        Points are in the sensor's frame; velocities are over ground (ego motion removed), in the sensor's frame.

        Raises:
            ArgumentError: the frame or the sensor is negative.
        """
        if sensor < 0:
            raise ArgumentError("sensor", expected="0 or more", found=f"{sensor}")
        pose = self.sensor_poses(frame, sensor + 1)[sensor]
        return self._observe(frame, pose, self._random(_NOISE, frame, sensor))

    def scan(self, frame: int, sensor: int = 0) -> Scan:
        """Return a sensor's scan with all that is known of its points: labels, flow, instances."""
        recording = self.record(frame, sensor)
        return replace(recording.scan, flow=recording.flow())

    def reference_observations(self, frame: int, sensors: int = 60, seed: int = 0) -> list[Recording]:
        """Return what many other sensors see at the very instant of a frame: the judge of any ground truth.

        They stand in free space all over the published grid's area, 1 to 5 m high, every tenth near the ground and every tenth
        high above; none of them is one of the vehicle's own.

        Args:
            frame: frame number.
            sensors: how many.
            seed: another draw.

        Raises:
            ArgumentError: no sensor.
        """
        if sensors < 1:
            raise ArgumentError("sensors", expected="at least 1", found=f"{sensors}")
        rng = self._random(_REFERENCE, frame, seed)
        ego = self.ego_pose(frame) @ translation(EGO_SENSOR_M[:2] + (0.0,))
        recordings: list[Recording] = []
        while len(recordings) < sensors:
            kind = len(recordings) % 10
            heights = (0.4, 1.0) if kind == 4 else (7.0, 14.0) if kind == 9 else HEIGHTS_M
            offset = np.append(rng.uniform(-REFERENCE_SPREAD_M, REFERENCE_SPREAD_M, 2), rng.uniform(*heights))
            pose = ego @ translation(offset)
            if self.is_free(frame, pose[:3, 3]):
                recordings.append(self._observe(frame, pose, rng))
        return recordings

    def is_free(self, frame: int, point: NDArray[np.float64]) -> bool:
        """Whether a point (3,) of the world is in no building and in nobody, with half a metre to spare."""
        for footprint, height in self.town.solids:
            if point[2] < height + 4.0 and footprint.contains(point[:2], 0.8):
                return False
        for actor in self.snapshot(frame).actors.values():
            local = transform_points(invert(actor.world_T_actor), point)
            low, high = actor.mesh.vertices.min(axis=0) - 0.5, actor.mesh.vertices.max(axis=0) + 0.5
            if ((low < local) & (local < high)).all():
                return False
        return True

    def snapshot(self, frame: int) -> Snapshot:
        """Return the town around the ego vehicle at a frame; the last one is kept."""
        if self._snapshot is None or self._snapshot.frame != frame:
            self._snapshot = self._take_snapshot(_checked(frame))
        return self._snapshot

    def _take_snapshot(self, frame: int) -> Snapshot:
        ego = self.ego_pose(frame)
        reach = self.lidar.range_m + CROP_MARGIN_M
        actors = {actor.id: actor for actor in self._population.at(frame)}
        near = [
            actor for actor in actors.values() if np.hypot(*(actor.world_T_actor[:2, 3] - ego[:2, 3])) < reach + 6.0
        ]
        low, high = self._extents
        nearest = np.clip(ego[:2, 3], low, high) - ego[:2, 3]
        keep = (nearest**2).sum(axis=1) < reach**2
        meshes = [self.town.mesh.select(keep)]
        meshes += [actor.mesh.moved(actor.world_T_actor) for actor in near]
        counts = [len(mesh.faces) for mesh in meshes]
        instances = np.repeat(np.array([0, *(actor.id for actor in near)], np.uint32), counts)
        mesh = _join(meshes)
        return Snapshot(frame, ego, actors, mesh, instances, RayScene(mesh, ego[:3, 3]))

    @cached_property
    def _extents(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest x and y of each triangle that stands still: (F, 2) each."""
        corners = self.town.mesh.triangles[..., :2]
        return corners.min(axis=1), corners.max(axis=1)

    def _observe(self, frame: int, world_T_sensor: Transform, rng: np.random.Generator) -> Recording:
        """Scan from a pose. Noise is drawn for every ray, so that what one ray hits changes no other's point."""
        snapshot, lidar = self.snapshot(frame), self.lidar
        world_rays = turned(world_T_sensor, lidar.directions)
        rays, triangles, distances = snapshot.scene.cast(world_T_sensor[:3, 3], world_rays, lidar.range_m)
        noise = rng.uniform(-lidar.noise_m, lidar.noise_m, lidar.directions.shape)
        labels, instances = snapshot.mesh.labels[triangles], snapshot.instances[triangles]
        keep = (instances != EGO_ID) & (labels != 0)  # the ego vehicle is dropped, and so would unlabelled points be
        rays, distances, labels, instances = rays[keep], distances[keep], labels[keep], instances[keep]
        points = (lidar.directions[rays] * distances[:, None] + noise[rays]).astype(np.float32)
        scan = Scan(points, labels.astype(np.uint32), None, instances)
        return Recording(scan, world_T_sensor, self._velocities(snapshot, world_T_sensor, instances))

    def _velocities(
        self, snapshot: Snapshot, world_T_sensor: Transform, instances: NDArray[np.uint32]
    ) -> NDArray[np.float64]:
        """Return (K, 4): id and velocity over ground, in the sensor's frame, of everybody that was hit."""
        seen = np.unique(instances[instances != 0])
        velocities = np.array([snapshot.actors[int(id)].velocity for id in seen]).reshape(-1, 3)
        return np.column_stack([seen.astype(np.float64), rotate_vectors(invert(world_T_sensor), velocities)])

    def _random(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *stream])


def _join(meshes: list[Mesh]) -> Mesh:
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + np.int32(offset) for mesh, offset in zip(meshes, offsets[:-1], strict=True)]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(faces),
        np.concatenate([mesh.labels for mesh in meshes]),
    )


def _checked(frame: int) -> int:
    if frame < 0:
        raise ArgumentError("frame", expected="0 or more", found=f"{frame}")
    return frame
