"""A crowded street, made of the simulated town's meshes, for `dense.py`.

Forty scooters and bicycles ride in a bunch and between the lanes, a truck drives beside a bus, and
people walk in groups, along walls, and across the road. Rows of motorcycles are parked on both
sidewalks, and from each row one starts. Nothing overlaps while it moves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from carlasc_recorders import TownActor
from carlasc_recorders.town.actors import STRIDE_M
from carlasc_recorders.town.meshes import Mesh, MeshBuilder
from carlasc_recorders.town.plan import KERB_M
from carlasc_recorders.town.shapes import (
    EGO_KIND,
    GAIT_PHASES,
    VEHICLE,
    VEHICLE_KINDS,
    bicycle_mesh,
    pedestrian_mesh,
    vehicle_mesh,
)
from numpy.typing import NDArray
from street import (
    BESIDE_Y_M,
    EGO_Y_M,
    END_M,
    HALF_ROAD_M,
    START_M,
    TOWARDS_Y_M,
    WALK_M,
    StreetDrive,
    StreetPopulation,
    build_street,
)

from carlasc.captures import Lidar
from carlasc.core.geometry import rotation_z, translation
from carlasc.core.tables import CARLA
from carlasc.storage.layout import FRAME_PERIOD_S

FRAMES = 41  # of a drive
_STREAM = 3000  # of random numbers
_KINDS = {kind.name: kind for kind in VEHICLE_KINDS}
_CARS = ("sedan", "hatchback", "suv", "van", "pickup")
# between the lanes, at their edges, and those of the bunch, which fills both lanes
_BETWEEN_M, _BUNCH_M = (3.1, 3.9, 7.1, -0.1, -3.5, -7.1), (0.6, 1.5, 2.4, 3.3, 4.2, 5.1, 6.0, 6.9)
_ROW, _ROW_M, _PARKED_Y_M = 10, 0.75, HALF_ROAD_M + 1.3  # motorcycles in a row, their spacing
_ACROSS = 12  # people cross the road
_GAP_M = 0.12  # least distance of two bodies


@dataclass(frozen=True)
class User:
    """A road user that keeps its speed and its direction once it has started.

    Attributes:
        kind: "car", "truck" (or bus), "rider", "person", "parked" or "starts" (motorcycles).
        x: where it is before it starts, metres.
        y: metres.
        yaw: its direction, radians.
        speed: m/s.
        shape: its mesh; the height in metres if it is a person.
        starts_s: when it starts.
    """

    kind: str
    x: float
    y: float
    yaw: float
    speed: float
    shape: Mesh | float
    starts_s: float = 0.0

    def way(self, frame: int) -> float:
        """Return how far it has come, metres."""
        return self.speed * max(frame * FRAME_PERIOD_S - self.starts_s, 0.0)

    def mesh(self, frame: int) -> Mesh:
        """Return its shape in a frame."""
        if isinstance(self.shape, Mesh):
            return self.shape
        steps = (self.x + self.y + self.way(frame)) / STRIDE_M
        phase = int(steps * GAIT_PHASES) % GAIT_PHASES if self.speed else -1
        return pedestrian_mesh(round(self.shape, 1), phase)

    def at(self, number: int, frame: int) -> TownActor:
        """Return it in a frame, as the actor of a number."""
        ahead = np.array([np.cos(self.yaw), np.sin(self.yaw), 0.0])
        place = np.array([self.x, self.y, 0.0]) + ahead * self.way(frame)
        place[2] = KERB_M if abs(place[1]) > HALF_ROAD_M else 0.0
        moves = frame * FRAME_PERIOD_S >= self.starts_s
        pose = translation(place) @ rotation_z(self.yaw)
        return TownActor(number, pose, ahead * self.speed * moves, self.mesh(frame))

    def bounds(self) -> NDArray[np.float64]:
        """Return the (F, 2, 2) lower and upper corners of its place in each frame, seen from
        above.
        """
        corners = self.mesh(0).vertices[:, :2]
        turn = rotation_z(self.yaw)[:2, :2]
        around = corners @ turn.T
        way = np.array([self.way(frame) for frame in range(FRAMES)])
        place = np.array([self.x, self.y]) + way[:, None] * turn[:, 0]
        return place[:, None] + np.stack([around.min(axis=0), around.max(axis=0)])


class Crowd(StreetPopulation):
    """Everything that moves or is parked on a crowded street: the vehicle that records first.

    Attributes:
        movers: all of it, by number from `EGO_ID` on: the vehicle that records first.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.movers: list[User] = []
        self._bounds: list[NDArray[np.float64]] = []
        speed = float(rng.uniform(2.5, 6.0))
        self._add(User("car", 0.0, EGO_Y_M, 0.0, speed, vehicle_mesh(EGO_KIND)))
        self._rows(rng)
        truck, bus = vehicle_mesh(_KINDS["truck"]), vehicle_mesh(_KINDS["bus"])
        ahead = float(rng.uniform(16.0, 22.0))
        beside = float(rng.uniform(-1.0, 1.0))
        self._add(User("truck", ahead, EGO_Y_M, 0.0, speed + 0.5, truck))
        self._add(User("truck", ahead + beside, BESIDE_Y_M, 0.0, speed + 1.0, bus))
        paces = [speed + 0.5, speed + 1.0, *rng.uniform(4.0, 9.0, 2)]
        for _ in range(90):
            lane = int(rng.integers(4))
            y = (EGO_Y_M, BESIDE_Y_M, *TOWARDS_Y_M)[lane]
            name = "truck" if rng.random() < 0.12 else _CARS[int(rng.integers(len(_CARS)))]
            x, way = float(rng.uniform(-45.0, 75.0)), (0.0 if lane < 2 else np.pi)
            if lane < 2 and -4.0 < x < 34.0:
                continue  # the place of the bunch
            kind = "truck" if name == "truck" else "car"
            one = User(kind, x, y, way, float(paces[lane]), vehicle_mesh(_KINDS[name]))
            self._add(one, gap_m=3.0)
        for _ in range(400):  # people across the road
            side, y = float(rng.choice((-1.0, 1.0))), float(rng.uniform(-5.0, 8.5))
            yaw = -side * np.pi / 2 + float(rng.normal(0.0, 0.2))
            x, pace = float(rng.uniform(-18.0, 40.0)), float(rng.uniform(1.0, 1.8))
            self._person(rng, x, side * y, yaw, pace)
            if sum(user.kind == "person" for user in self.movers) == _ACROSS:
                break
        self._riders(rng, speed)
        self._people(rng)

    def _rows(self, rng: np.random.Generator) -> None:
        """Add the rows of motorcycles, and those that start."""
        for side in (-1.0, 1.0):
            for begin in rng.uniform((-8.0, 14.0), (2.0, 22.0)):
                yaw = -side * float(rng.uniform(1.2, np.pi / 2))
                leaves = int(rng.integers(2, _ROW - 2))
                for k in range(_ROW):
                    x = float(begin) + _ROW_M * k
                    parked = User("parked", x, side * _PARKED_Y_M, yaw, 0.0, scooter_mesh(False))
                    if k == leaves:
                        pace, when = float(rng.uniform(1.2, 2.0)), float(rng.uniform(1.0, 2.5))
                        ridden = replace(parked, kind="starts", speed=pace, starts_s=when)
                        parked = replace(ridden, shape=scooter_mesh(True))
                    self._add(parked, gap_m=-1.0)

    def _riders(self, rng: np.random.Generator, speed: float) -> None:
        count = 0
        for _ in range(6000):
            bunch = count < 26
            ys = _BUNCH_M if bunch else _BETWEEN_M
            y = float(rng.choice(ys) + rng.uniform(-0.1, 0.1))
            x = float(rng.uniform(-8.0, 33.0) if bunch else rng.uniform(-35.0, 60.0))
            way = np.pi if y < 0 else 0.0
            pace = speed + float(rng.uniform(-0.5, 2.0)) if y > 0 else float(rng.uniform(4.0, 9.0))
            shape = scooter_mesh(True) if rng.random() < 0.7 else bicycle_mesh()
            turn = float(rng.normal(0.0, 0.015))
            count += self._add(User("rider", x, y, way + turn, pace, shape))
            if count == 40:
                return

    def _people(self, rng: np.random.Generator) -> None:
        for _ in range(30):  # groups of three to five, abreast and behind each other
            side, pace = float(rng.choice((-1.0, 1.0))), float(rng.uniform(0.9, 1.6))
            x, y = float(rng.uniform(-22.0, 45.0)), float(rng.uniform(2.4, 3.2))
            yaw = 0.0 if rng.random() < 0.5 else np.pi
            for k in range(int(rng.integers(3, 6))):
                at = x + 0.75 * (k // 2) + float(rng.uniform(-0.1, 0.1))
                self._person(rng, at, side * (HALF_ROAD_M + y + 0.65 * (k % 2)), yaw, pace)
        for _ in range(16):  # along the walls
            side, yaw = float(rng.choice((-1.0, 1.0))), np.pi * float(rng.integers(2))
            y = side * (HALF_ROAD_M + WALK_M - float(rng.uniform(0.05, 0.2)))
            self._person(rng, float(rng.uniform(-25.0, 45.0)), y, yaw, float(rng.uniform(0.6, 1.6)))
        for _ in range(10):  # they stand
            y = float(rng.choice((-1.0, 1.0))) * (HALF_ROAD_M + float(rng.uniform(2.3, 3.6)))
            self._person(rng, float(rng.uniform(-20, 40)), y, float(rng.uniform(0, 6)), 0.0)

    def _person(
        self, rng: np.random.Generator, x: float, y: float, yaw: float, speed: float
    ) -> bool:
        """Add a person."""
        return self._add(User("person", x, y, yaw, speed, float(rng.uniform(1.5, 1.9))))

    def _add(self, user: User, gap_m: float = _GAP_M) -> bool:
        """Add a road user unless it comes too near to another; return whether it was added. Along
        the street the distance is at least `gap_m`; those with a negative one are always added.
        """
        bounds = user.bounds()
        for other in self._bounds if gap_m > 0 else ():
            gaps = np.maximum(bounds[:, 0] - other[:, 1], other[:, 0] - bounds[:, 1])
            if (gaps < (gap_m, _GAP_M)).all(axis=1).any():
                return False
        self.movers.append(user)
        self._bounds.append(bounds)
        return True


class CrowdedDrive(StreetDrive):
    """A drive along such a street."""

    def __init__(self, seed: int, lidar: Lidar | None = None) -> None:
        """Build the street and its traffic; the arguments are those of `Drive`."""
        rng = np.random.default_rng([seed, _STREAM])
        self.seed, self.traffic = seed, "heavy"
        self.lidar = Lidar() if lidar is None else lidar
        street, walls = build_street(rng), MeshBuilder()
        walls.add_mesh(street.mesh, np.eye(4))
        for side in (-1.0, 1.0):
            x = START_M
            while x < END_M:
                length = float(rng.uniform(5.0, 20.0))
                place = (x + length / 2, side * (HALF_ROAD_M + WALK_M + 0.35), KERB_M)
                size = (length, 0.2, float(rng.uniform(1.2, 4.0)))
                walls.boxes(CARLA.id_of("Building"), place, size)
                x += length + float(rng.uniform(1.0, 5.0))
        self.town = replace(street, mesh=walls.build())
        self._population = self.crowd = Crowd(rng)
        self._snapshot = None


@cache
def scooter_mesh(ridden: bool) -> Mesh:
    """Return a scooter, with its rider or parked."""
    builder = MeshBuilder()
    for x in (-0.62, 0.62):
        builder.rod(VEHICLE, (x, -0.06, 0.27), (x, 0.06, 0.27), 0.27, sections=12)
    builder.boxes(VEHICLE, (-0.45, 0.0, 0.3), (0.75, 0.32, 0.5))  # engine and seat
    builder.boxes(VEHICLE, (0.1, 0.0, 0.22), (0.5, 0.34, 0.1))
    builder.boxes(VEHICLE, (0.48, 0.0, 0.3), (0.12, 0.4, 0.6))  # leg shield
    builder.rod(VEHICLE, (0.6, 0, 0.27), (0.42, 0, 1.02), 0.05)
    builder.rod(VEHICLE, (0.4, -0.34, 1.02), (0.4, 0.34, 1.02), 0.03)
    if ridden:
        for side in (-1.0, 1.0):
            builder.rod(VEHICLE, (-0.25, side * 0.13, 0.85), (0.15, side * 0.18, 0.75), 0.09)
            builder.rod(VEHICLE, (0.15, side * 0.18, 0.75), (0.2, side * 0.16, 0.32), 0.07)
            builder.rod(VEHICLE, (-0.15, side * 0.2, 1.3), (0.36, side * 0.3, 1.03), 0.05)
        builder.rod(VEHICLE, (-0.3, 0, 0.85), (-0.17, 0, 1.4), 0.2, sections=8)
        builder.boxes(VEHICLE, (-0.13, 0.0, 1.45), (0.26, 0.22, 0.28))
    return builder.build()
