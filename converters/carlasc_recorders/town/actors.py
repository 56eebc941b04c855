"""The actors of the town in any frame: moving and parked vehicles, and pedestrians, each with its
pose, velocity and shape.

Pedestrians walk around blocks, or stand on the sidewalk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from carlasc.captures.settings import TRAFFIC, TrafficLevel
from carlasc.core.arrays import FloatArray
from carlasc.core.geometry import Transform, rotation_z, translation
from carlasc.errors import check_choice
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc_recorders.town.meshes import Mesh, close_loop
from carlasc_recorders.town.plan import KERB_M
from carlasc_recorders.town.shapes import (
    EGO_KIND,
    GAIT_PHASES,
    VEHICLE_KINDS,
    VehicleKind,
    bicycle_mesh,
    pedestrian_mesh,
    vehicle_mesh,
)
from carlasc_recorders.town.streets import HALF_ROAD_M, CityBlock
from carlasc_recorders.town.town import Town
from carlasc_recorders.town.traffic import Traffic, place_vehicles

_OFFSETS_M = (1.1, 1.75, 2.3)
"""Distance from the kerb of pedestrians who walk along the loop, against it, and who stand."""


@dataclass(frozen=True)
class Walk:
    """The walk of a pedestrian around a block.

    Attributes:
        loop: (P, 2) closed path, metres. The first point is repeated at the end.
        start_m: distance along the loop at time 0.
        speed_mps: speed along the loop; negative against it, 0 for a standing pedestrian.
        heading_rad: heading of a pedestrian who stands.
    """

    loop: FloatArray
    start_m: float
    speed_mps: float
    heading_rad: float = 0.0

    def pose(self, elapsed_s: float, height_m: float) -> Transform:
        """Return (4, 4) world_T_pedestrian at a time. The feet are at `height_m`."""
        stations = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(self.loop, axis=0), axis=1))]
        )
        along = (self.start_m + self.speed_mps * elapsed_s) % stations[-1]
        point = [np.interp(along, stations, self.loop[:, axis]) for axis in (0, 1)]
        heading = self.heading_rad
        if self.speed_mps:
            step = min(int(np.searchsorted(stations, along, side="right")), len(stations) - 1)
            ahead = (self.loop[step] - self.loop[step - 1]) * np.sign(self.speed_mps)
            heading = float(np.arctan2(ahead[1], ahead[0]))
        return translation((*point, height_m)) @ rotation_z(heading)


def draw_walks(rng: np.random.Generator, blocks: tuple[CityBlock, ...], count: int) -> list[Walk]:
    """Draw random pedestrians: a third walk around a block in each direction, and a third stand.

    Pedestrians of one block and direction have the same speed and distance from the kerb, so they
    do not meet.
    """
    speeds = rng.uniform(1.0, 1.8, (len(blocks), 2))
    walks: list[Walk] = []
    occupied: dict[tuple[int, int], list[float]] = {}
    while len(walks) < count:
        number = int(rng.integers(len(blocks)))
        direction = int(rng.integers(3))
        loop = close_loop(blocks[number].outline.at(HALF_ROAD_M + _OFFSETS_M[direction]))
        length = float(np.linalg.norm(np.diff(loop, axis=0), axis=1).sum())
        start = rng.uniform(0, length)
        if any(
            min(abs(start - other), length - abs(start - other)) < 1.0
            for other in occupied.get((number, direction), [])
        ):
            continue
        occupied.setdefault((number, direction), []).append(start)
        speed = float(speeds[number, direction]) * (1, -1)[direction] if direction < 2 else 0.0
        walks.append(Walk(loop, start, speed, rng.uniform(-np.pi, np.pi)))
    return walks


EGO_ID = 1
OCCUPIED_SHARE = 0.4  # share of the parking spaces that hold a vehicle
BICYCLE_SHARE = 0.1  # share of the moving vehicles that are bicycles
BICYCLE_LENGTH_M = 1.9
LONGEST_PARKED_M = 5.5
STRIDE_M = 1.4  # length of two steps
WHEELBASE = 0.7  # relative to the length of the vehicle


@dataclass(frozen=True)
class TownActor:
    """A vehicle or a pedestrian at one instant.

    Attributes:
        id: number of the actor, the same in every frame of a drive. The ego vehicle is 1.
        world_T_actor: (4, 4) pose. The x axis of the actor's frame is forward, its origin is on the
            ground.
        velocity: (3,) velocity over ground, m/s, world frame.
        mesh: its shape, actor frame.
    """

    id: int
    world_T_actor: Transform
    velocity: FloatArray
    mesh: Mesh


class Population:
    """All actors of a town, in any frame."""

    def __init__(self, rng: np.random.Generator, town: Town, traffic: TrafficLevel) -> None:
        """Draw random actors.

        Args:
            rng: source of the random numbers.
            town: the town.
            traffic: "light", "medium" or "heavy".

        Raises:
            ArgumentError: the level of traffic is unknown.
        """
        check_choice("traffic", traffic, TrafficLevel)
        count = TRAFFIC[traffic]
        self._shapes, lengths = _draw_vehicles(rng, count)
        lane, along = _draw_ego_start(rng, town)
        vehicles = place_vehicles(rng, town.streets, lengths, lane, along)
        self._shapes = self._shapes[: len(vehicles)]
        self._traffic = Traffic(town.streets, vehicles)
        self._wheelbases = [WHEELBASE * vehicle.length_m for vehicle in vehicles]
        self._walks = draw_walks(rng, town.streets.blocks, count)
        self._heights = rng.uniform(1.55, 1.9, count)
        self._parked = _draw_parked_vehicles(rng, town, first_id=EGO_ID + len(vehicles) + count)

    def ego_pose(self, frame: int) -> Transform:
        """Return (4, 4) world_T_ego of a frame."""
        along, _ = self._traffic.at(frame)
        return self._traffic.pose(0, float(along[0]), self._wheelbases[0])

    def at(self, frame: int) -> list[TownActor]:
        """Return all actors in a frame, the ego vehicle first."""
        return [*self._vehicles(frame), *self._pedestrians(frame), *self._parked]

    def _vehicles(self, frame: int) -> list[TownActor]:
        along, speed = self._traffic.at(frame)
        actors = []
        for index, mesh in enumerate(self._shapes):
            pose = self._traffic.pose(index, float(along[index]), self._wheelbases[index])
            # the velocity of the centre of the vehicle is a finite difference along its route
            step_m = 0.01
            ahead = self._traffic.pose(index, float(along[index]) + step_m, self._wheelbases[index])
            velocity = (ahead[:3, 3] - pose[:3, 3]) / step_m * speed[index]
            actors.append(TownActor(EGO_ID + index, pose, velocity, mesh))
        return actors

    def _pedestrians(self, frame: int) -> list[TownActor]:
        elapsed_s = frame * FRAME_PERIOD_S
        actors = []
        for id, (walk, height) in enumerate(
            zip(self._walks, self._heights, strict=True), EGO_ID + len(self._shapes)
        ):
            pose = walk.pose(elapsed_s, KERB_M)
            speed = abs(walk.speed_mps)
            cycle = (walk.start_m + speed * elapsed_s) / STRIDE_M
            phase = int(cycle * GAIT_PHASES) % GAIT_PHASES if speed else -1
            actors.append(
                TownActor(
                    id, pose, speed * pose[:3, 0], pedestrian_mesh(round(float(height), 1), phase)
                )
            )
        return actors


def _draw_vehicles(rng: np.random.Generator, count: int) -> tuple[list[Mesh], list[float]]:
    """Draw random moving vehicles, and return their meshes and lengths, the ego vehicle first."""
    shapes = [vehicle_mesh(EGO_KIND)]
    lengths = [EGO_KIND.length_m]
    for _ in range(count):
        kind = _draw_kind(rng, VEHICLE_KINDS)
        if rng.random() < BICYCLE_SHARE:
            shapes.append(bicycle_mesh())
            lengths.append(BICYCLE_LENGTH_M)
        else:
            shapes.append(vehicle_mesh(kind))
            lengths.append(kind.length_m)
    return shapes, lengths


def _draw_kind(rng: np.random.Generator, kinds: tuple[VehicleKind, ...]) -> VehicleKind:
    shares = np.cumsum([kind.share for kind in kinds])
    return kinds[int(np.searchsorted(shares, rng.random() * shares[-1], side="right"))]


def _draw_ego_start(rng: np.random.Generator, town: Town) -> tuple[int, float]:
    """Draw a random start of the ego vehicle: index of a lane near the centre of the town, and
    distance along it, metres.
    """
    lanes = [(i, lane) for i, lane in enumerate(town.streets.lanes) if not lane.turn]
    lanes.sort(key=lambda item: float(np.linalg.norm(item[1].point(item[1].length_m / 2))))
    index, lane = lanes[rng.integers(8)]
    return index, lane.length_m * rng.uniform(0.15, 0.35)


def _draw_parked_vehicles(rng: np.random.Generator, town: Town, first_id: int) -> list[TownActor]:
    short = tuple(kind for kind in VEHICLE_KINDS if kind.length_m < LONGEST_PARKED_M)
    parked: list[TownActor] = []
    for world_T_space in town.parking:
        if rng.random() < OCCUPIED_SHARE:
            mesh = vehicle_mesh(_draw_kind(rng, short))
            parked.append(TownActor(first_id + len(parked), world_T_space, np.zeros(3), mesh))
    return parked
