"""Who is in the town at a frame: vehicles under way and parked, pedestrians, each with pose, velocity and shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.raw import TRAFFIC
from carlasc.captures.town.meshes import Mesh
from carlasc.captures.town.plan import KERB_M
from carlasc.captures.town.shapes import (
    EGO_KIND,
    GAIT_PHASES,
    KINDS,
    VehicleKind,
    pedestrian_mesh,
    two_wheeler_mesh,
    vehicle_mesh,
)
from carlasc.captures.town.town import Town
from carlasc.captures.town.traffic import Traffic, Walk, draw_walks, place_vehicles
from carlasc.core.geometry import Transform
from carlasc.errors import ArgumentError
from carlasc.storage.layout import FRAME_PERIOD_S

EGO_ID = 1
PARKED_SHARE = 0.4  # of the town's parking spaces
TWO_WHEELERS = 0.1  # of the vehicles
STRIDE_M = 1.4  # two steps
WHEELBASE = 0.7  # of the length


@dataclass(frozen=True)
class Actor:
    """A vehicle or a pedestrian at one instant.

    Attributes:
        id: the same in every frame of a drive, from 1; 1 is the ego vehicle.
        world_T_actor: (4, 4) pose; the actor's x is forward, its origin on the ground.
        velocity: (3,) m/s over ground, world frame.
        mesh: its shape, in its own frame.
    """

    id: int
    world_T_actor: Transform
    velocity: NDArray[np.float64]
    mesh: Mesh


class Population:
    """Everybody in a town, at any frame."""

    def __init__(self, rng: np.random.Generator, town: Town, traffic: str) -> None:
        """Draw who is there.

        Raises:
            ArgumentError: `traffic` is not one of TRAFFIC.
        """
        if traffic not in TRAFFIC:
            raise ArgumentError("traffic", expected=f"one of {', '.join(TRAFFIC)}", found=f"{traffic!r}")
        count = TRAFFIC[traffic]
        self._shapes, lengths = _draw_vehicles(rng, count)
        lane, along = _start_of_ego(rng, town)
        vehicles = place_vehicles(rng, town.streets, lengths, lane, along)
        self._shapes = self._shapes[: len(vehicles)]
        self._traffic = Traffic(town.streets, vehicles)
        self._wheelbases = [WHEELBASE * vehicle.length_m for vehicle in vehicles]
        self._walks = draw_walks(rng, town.streets.blocks, count)
        self._heights = rng.uniform(1.55, 1.9, count)
        self._parked = _park(rng, town, first_id=EGO_ID + len(vehicles) + count)

    def ego_pose(self, frame: int) -> Transform:
        """Return world_T_ego of a frame."""
        along, _ = self._traffic.at(frame)
        return self._traffic.pose(0, float(along[0]), self._wheelbases[0])

    def at(self, frame: int) -> list[Actor]:
        """Return everybody at a frame, the ego vehicle first."""
        return [*self._driving(frame), *self._walking(frame), *self._parked]

    def _driving(self, frame: int) -> list[Actor]:
        along, speed = self._traffic.at(frame)
        actors = []
        for index, mesh in enumerate(self._shapes):
            pose = self._traffic.pose(index, float(along[index]), self._wheelbases[index])
            nearby = 0.01  # metres: the velocity is that of its middle, along the path
            ahead = self._traffic.pose(index, float(along[index]) + nearby, self._wheelbases[index])
            velocity = (ahead[:3, 3] - pose[:3, 3]) / nearby * speed[index]
            actors.append(Actor(EGO_ID + index, pose, velocity, mesh))
        return actors

    def _walking(self, frame: int) -> list[Actor]:
        time = frame * FRAME_PERIOD_S
        first = EGO_ID + len(self._shapes)
        return [
            _pedestrian(first + index, walk, time, float(height))
            for index, (walk, height) in enumerate(zip(self._walks, self._heights, strict=True))
        ]


def _pedestrian(id: int, walk: Walk, time_s: float, height_m: float) -> Actor:
    pose = walk.pose(time_s, KERB_M)
    cycle = (walk.start_m + abs(walk.speed_mps) * time_s) / STRIDE_M
    phase = int(cycle * GAIT_PHASES) % GAIT_PHASES if walk.speed_mps else -1
    return Actor(id, pose, abs(walk.speed_mps) * pose[:3, 0], pedestrian_mesh(round(height_m, 1), phase))


def _draw_vehicles(rng: np.random.Generator, count: int) -> tuple[list[Mesh], list[float]]:
    """Return shapes and lengths: the ego vehicle first."""
    shapes, lengths = [vehicle_mesh(EGO_KIND)], [EGO_KIND.length_m]
    for _ in range(count):
        kind = _draw_kind(rng, KINDS)
        if rng.random() < TWO_WHEELERS:
            shapes.append(two_wheeler_mesh(rider=True))
            lengths.append(1.9)
        else:
            shapes.append(vehicle_mesh(kind))
            lengths.append(kind.length_m)
    return shapes, lengths


def _draw_kind(rng: np.random.Generator, kinds: tuple[VehicleKind, ...]) -> VehicleKind:
    shares = np.cumsum([kind.share for kind in kinds])
    return kinds[int(np.searchsorted(shares, rng.random() * shares[-1], side="right"))]


def _start_of_ego(rng: np.random.Generator, town: Town) -> tuple[int, float]:
    """Return a lane near the middle of the town and a place on its first third."""
    lanes = [(i, lane) for i, lane in enumerate(town.streets.lanes) if not lane.turn]
    lanes.sort(key=lambda item: float(np.linalg.norm(item[1].point(item[1].length_m / 2))))
    index, lane = lanes[int(rng.integers(8))]
    return index, lane.length_m * float(rng.uniform(0.15, 0.35))


def _park(rng: np.random.Generator, town: Town, first_id: int) -> list[Actor]:
    short = tuple(kind for kind in KINDS if kind.length_m < 5.5)
    parked: list[Actor] = []
    for space in town.parking:
        if rng.random() < PARKED_SHARE:
            mesh = vehicle_mesh(_draw_kind(rng, short))
            parked.append(Actor(first_id + len(parked), space.pose, np.zeros(3), mesh))
    return parked
