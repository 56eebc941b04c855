"""A square beside a street in which vehicles manoeuvre, for `manoeuvres.py`.

A lorry with a trailer turns, an articulated bus stops at the kerb and starts again, a car turns in
three moves, another one drives in a tight circle, one leaves a parking space in reverse, and a
queue of cars stops and goes. Vehicles move as their axles allow: the rear axle moves along the
vehicle, and the axle of a trailer towards its joint.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from carlasc_recorders import TownActor
from carlasc_recorders.town.furniture import add_building
from carlasc_recorders.town.meshes import MeshBuilder
from carlasc_recorders.town.plan import PlantCatalogue, Rectangle, TownPlan
from carlasc_recorders.town.shapes import EGO_KIND, VEHICLE_KINDS, VehicleKind, vehicle_mesh
from carlasc_recorders.town.town import ROAD
from numpy.typing import NDArray
from street import HALF_ROAD_M, StreetDrive, StreetPopulation, build_street, lay_strip

from carlasc.captures import Lidar
from carlasc.core.geometry import Transform, rotation_z, translation
from carlasc.storage.layout import FRAME_PERIOD_S

FRAMES = 91  # of a drive
_STREAM = 4000  # of random numbers
_SQUARE_M = 48.0  # the far side of the square; y is to the right
_STEPS = 10  # of the motion between two frames
_ACCELERATION_M_S2, _STEERING = 2.0, 0.3  # greatest change per second of speed and of curvature
_KINDS = {kind.name: kind for kind in VEHICLE_KINDS}
_CARS = ("sedan", "hatchback", "suv", "van")
_AXLES = ((0.16, 0.5), (0.8, 0.5))
_TRACTOR = VehicleKind(
    "tractor",
    5.9,
    2.5,
    ((0.0, 0.6), (1.0, 0.6), (1.0, 1.0), (0.0, 1.0)),
    ((0.62, 0.98), (1.0, 0.98), (0.99, 2.6), (0.95, 3.6), (0.62, 3.7)),
    _AXLES,
    0,
    0.0,
)
_TRAILER = VehicleKind(
    "trailer",
    13.6,
    2.5,
    ((0.0, 1.1), (1.0, 1.1), (1.0, 1.3), (0.0, 1.3)),
    ((0.0, 1.28), (1.0, 1.28), (1.0, 3.95), (0.0, 3.95)),
    ((0.21, 0.5), (0.12, 0.5), (0.3, 0.5)),
    0,
    0.0,
)
_BUS = _KINDS["bus"]
_BUS_FRONT = replace(_BUS, name="bus, front", length_m=10.4, wheels=((0.27, 0.48), (0.78, 0.48)))
_BUS_REAR = replace(_BUS, name="bus, rear", length_m=7.2, wheels=((0.35, 0.48),))


@dataclass(frozen=True)
class Leg:
    """What the driver wants for some time.

    Attributes:
        seconds: how long.
        speed: m/s; negative in reverse.
        curvature: of the path of the rear axle, 1/m; positive to the right, in either direction.
    """

    seconds: float
    speed: float
    curvature: float = 0.0


@dataclass(frozen=True)
class Vehicle:
    """A vehicle that follows legs, or is drawn by another one.

    Attributes:
        name: what it does, for the table; empty if it is drawn.
        kind: its shape.
        start: x, y, metres, and heading, radians, of its rear axle in frame 0.
        legs: what it does; afterwards it stands.
        drawn_by: the vehicle that draws it; it begins in one line with it.
        joint_m: how far the joint is ahead of the rear axle of that vehicle.
        reach_m: how far the joint is ahead of its own axle.
    """

    name: str
    kind: VehicleKind
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    legs: Sequence[Leg] = ()
    drawn_by: Vehicle | None = None
    joint_m: float = 0.0
    reach_m: float = 0.0

    @cached_property
    def states(self) -> NDArray[np.float64]:
        """(T, 3) x, y and heading of its rear axle at each step."""
        step_s, count = FRAME_PERIOD_S / _STEPS, (FRAMES + 1) * _STEPS + 1
        states = np.zeros((count, 3))
        if self.drawn_by is not None:
            x, y, yaw = self.drawn_by.states.T
            joints = np.stack([x, y], axis=1) + self.joint_m * _ahead(yaw)
            heading = float(yaw[0])
            axle = joints[0] - self.reach_m * _ahead(heading)
            for row, joint in enumerate(joints):
                heading = float(np.arctan2(*(joint - axle)[::-1]))
                axle = joint - self.reach_m * _ahead(heading)
                states[row] = *axle, heading
            states[:, 2] = np.unwrap(states[:, 2])
            return states
        ends, speed, curvature = np.cumsum([leg.seconds for leg in self.legs]), 0.0, 0.0
        states[0] = self.start
        for row in range(count):
            number = int(np.searchsorted(ends, row * step_s, side="right"))
            leg = self.legs[number] if number < len(self.legs) else Leg(0.0, 0.0)
            if row == 0:
                speed, curvature = leg.speed, leg.curvature
                continue
            most = _ACCELERATION_M_S2 * step_s, _STEERING * step_s
            speed += float(np.clip(leg.speed - speed, -most[0], most[0]))
            curvature += float(np.clip(leg.curvature - curvature, -most[1], most[1]))
            x, y, yaw = states[row - 1]
            way = speed * step_s
            states[row, :2] = np.array([x, y]) + way * _ahead(yaw + way * curvature / 2)
            states[row, 2] = yaw + way * curvature
        return states

    def pose(self, frame: int, step: int = 0) -> Transform:
        """Return (4, 4) world_T_vehicle; the origin is below its centre."""
        x, y, yaw = self.states[frame * _STEPS + step]
        ahead_m = (0.5 - self.kind.wheels[0][0]) * self.kind.length_m
        return translation((x, y, 0.0)) @ rotation_z(yaw) @ translation((ahead_m, 0.0, 0.0))

    def at(self, number: int, frame: int) -> TownActor:
        """Return it in a frame, as the actor of a number."""
        here, soon = self.pose(frame), self.pose(frame, 1)
        velocity = (soon - here)[:3, 3] * _STEPS / FRAME_PERIOD_S
        return TownActor(number, here, velocity, vehicle_mesh(self.kind))


class Manoeuvres(StreetPopulation):
    """Everything that moves or is parked in the square: the vehicle that records first.

    Attributes:
        movers: all of it, by number from `EGO_ID` on: the vehicle that records first.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        speed = float(rng.uniform(1.5, 3.0))
        self.movers: list[Vehicle] = [
            Vehicle("ego", EGO_KIND, (-1.4, 1.75, 0.0), [Leg(20.0, speed)]),
            *_lorry(rng),
            *_bus(rng),
            _three_moves(rng),
            _circle(rng),
            *_parking(rng),
            *_queue(rng),
        ]


class ManoeuvreDrive(StreetDrive):
    """A drive along such a street."""

    def __init__(self, seed: int, lidar: Lidar | None = None) -> None:
        """Build the square and its traffic; the arguments are those of `Drive`."""
        rng = np.random.default_rng([seed, _STREAM])
        self.seed, self.traffic = seed, "heavy"
        self.lidar = Lidar() if lidar is None else lidar
        street = build_street(rng, houses=(-1.0,), sidewalks=(-1.0,))
        plan, whole = TownPlan(rng, PlantCatalogue(rng)), MeshBuilder()
        lay_strip(plan, ROAD, (HALF_ROAD_M, 0.0), (_SQUARE_M, 0.0))
        for x in np.arange(-60.0, 90.0, 21.0):
            size = (float(rng.uniform(12.0, 19.0)), 9.0)
            add_building(
                plan,
                Rectangle(np.array([x, _SQUARE_M + 6.0]), size, 0.0),
                float(rng.uniform(5.0, 14.0)),
                pitched=bool(rng.random() < 0.4),
            )
        for mesh in (street.mesh, plan.builder.build()):
            whole.add_mesh(mesh, np.eye(4))
        buildings = (*street.buildings, *plan.buildings)
        self.town = replace(street, mesh=whole.build(), buildings=buildings)
        self._population = self.manoeuvres = Manoeuvres(rng)
        self._snapshot = None


def _ahead(yaw: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Return (..., 2) the direction of a heading."""
    return np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)


def _car(rng: np.random.Generator) -> VehicleKind:
    return _KINDS[_CARS[int(rng.integers(len(_CARS)))]]


def _lorry(rng: np.random.Generator) -> Iterator[Vehicle]:
    """Yield a tractor and its trailer, which turn into the depth of the square."""
    speed, radius = float(rng.uniform(3.5, 5.5)), float(rng.uniform(9.0, 12.0))
    quarter = np.pi / 2 * radius / speed
    legs = [Leg(float(rng.uniform(1.5, 2.5)), speed), Leg(quarter, speed, -1 / radius)]
    start = float(rng.uniform(43.0, 48.0)), float(rng.uniform(9.0, 11.0)), np.pi
    tractor = Vehicle("lorry with trailer", _TRACTOR, start, [*legs, Leg(20.0, speed)])
    reach = (1 - _TRAILER.wheels[0][0]) * _TRAILER.length_m - 1.6
    yield tractor
    yield Vehicle("", _TRAILER, drawn_by=tractor, joint_m=0.4, reach_m=reach)


def _bus(rng: np.random.Generator) -> Iterator[Vehicle]:
    """Yield the two parts of a bus that comes along the street, stops at the kerb, and starts."""
    speed, bend = float(rng.uniform(4.5, 6.0)), 1 / float(rng.uniform(18.0, 24.0))
    aside = 0.75  # seconds of each half of a change of lanes
    legs = [
        Leg(0.8, speed),
        Leg(aside, speed, bend),
        Leg(aside, speed, -bend),
        Leg(float(rng.uniform(3.5, 4.2)), 0.0),
        Leg(aside, speed, -bend),
        Leg(20.0, speed),
    ]
    start = float(rng.uniform(28.0, 36.0)), -4.8, np.pi
    front = Vehicle("articulated bus", _BUS_FRONT, start, legs)
    reach = (1 - _BUS_REAR.wheels[0][0]) * _BUS_REAR.length_m + 0.4
    joint = -_BUS_FRONT.wheels[0][0] * _BUS_FRONT.length_m - 0.4
    yield front
    yield Vehicle("", _BUS_REAR, drawn_by=front, joint_m=joint, reach_m=reach)


def _three_moves(rng: np.random.Generator) -> Vehicle:
    """Return a car that turns in three moves: ahead, in reverse, ahead."""
    bend, pace = 1 / float(rng.uniform(5.2, 6.0)), float(rng.uniform(1.8, 2.4))
    legs = [
        Leg(2.6, pace, bend),
        Leg(1.3, 0.0, -bend),
        Leg(2.4, -pace, -bend),
        Leg(1.3, 0.0, bend),
        Leg(20.0, pace, bend),
    ]
    start = float(rng.uniform(8.0, 11.0)), float(rng.uniform(7.0, 9.0)), 0.0
    return Vehicle("turn in three moves", _car(rng), start, legs)


def _circle(rng: np.random.Generator) -> Vehicle:
    """Return a car that drives in a tight circle."""
    pace, radius = float(rng.uniform(2.5, 3.5)), float(rng.uniform(5.5, 6.5))
    start = float(rng.uniform(-13.0, -9.0)), float(rng.uniform(7.0, 9.0)), 0.0
    return Vehicle("circle", _car(rng), start, [Leg(20.0, pace, 1 / radius)])


def _parking(rng: np.random.Generator) -> Iterator[Vehicle]:
    """Yield a row of parked cars, of which one leaves in reverse, and drives away ahead."""
    leaves, pace = int(rng.integers(2, 5)), float(rng.uniform(1.7, 2.2))
    side = float(rng.choice((-1.0, 1.0)))
    legs = [
        Leg(float(rng.uniform(0.5, 1.2)), 0.0),
        Leg(4.6 / pace + 0.4, -pace),
        Leg(6.0 / pace, -pace, side / 5.5),
        Leg(1.2, 0.0, -side / 5.5),
        Leg(20.0, pace, -side / 5.5),
    ]
    for k in range(7):
        start = 0.5 + 2.8 * k, 25.0 + float(rng.uniform(-0.2, 0.2)), np.pi / 2
        name = "leaves a space in reverse" if k == leaves else "parked"
        yield Vehicle(name, _car(rng), start, legs if k == leaves else ())


def _queue(rng: np.random.Generator) -> Iterator[Vehicle]:
    """Yield cars in a queue, which stop and go one after the other."""
    x, speed = float(rng.uniform(-14.0, -8.0)), float(rng.uniform(3.0, 4.5))
    for k in range(6):
        delay = 0.4 + 0.5 * k
        legs = [Leg(delay, 0.0), Leg(2.6, speed), Leg(3.0, 0.0), Leg(20.0, speed)]
        yield Vehicle("stop and go", _car(rng), (x, -1.6, np.pi), legs)
        x += float(rng.uniform(7.0, 8.5))
