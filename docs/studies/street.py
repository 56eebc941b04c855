"""A straight street with dense traffic, made of the simulated town's meshes: another world than the
town, for `movers.py`.

The vehicle that records drives in the inner lane, with vehicles ahead of it and behind it in the
same lane, which show it one face only. Cars, lorries and a bus drive in the lane beside it,
cyclists on the edge of the road, others come towards it, and people walk on both sidewalks. All of
them keep their speed. Nothing is parked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from carlasc_recorders import TownActor, TownDrive
from carlasc_recorders.town import furniture
from carlasc_recorders.town.actors import EGO_ID, STRIDE_M, Population
from carlasc_recorders.town.furniture import add_building
from carlasc_recorders.town.meshes import Mesh
from carlasc_recorders.town.plan import KERB_M, PAINT_M, PlantCatalogue, Rectangle, TownPlan
from carlasc_recorders.town.shapes import (
    EGO_KIND,
    GAIT_PHASES,
    VEHICLE_KINDS,
    VehicleKind,
    bicycle_mesh,
    pedestrian_mesh,
    vehicle_mesh,
)
from carlasc_recorders.town.streets import Streets
from carlasc_recorders.town.town import GROUND, ROAD, ROAD_LINE, SIDEWALK, TERRAIN, Town

from carlasc.captures import Lidar
from carlasc.core.geometry import Transform, rotation_z, translation
from carlasc.storage.layout import FRAME_PERIOD_S

START_M, END_M = -130.0, 260.0  # of the street along x; the vehicle that records starts at 0
# middles of the lanes; y is to the right
EGO_Y_M, BESIDE_Y_M, CYCLIST_Y_M, TOWARDS_Y_M = (
    1.75,
    5.25,
    7.15,
    (-1.75, -5.25),
)
HALF_ROAD_M, WALK_M, LAND_M = 7.75, 4.0, 26.0  # half the road, the sidewalk, and the land behind it
_STREAM = 1000  # of random numbers, beside those of a drive
_BUS = next(kind for kind in VEHICLE_KINDS if kind.name == "bus")
_SHARES = np.array([kind.share for kind in VEHICLE_KINDS])
# no network: nothing turns
_NO_STREETS = Streets(np.empty((0, 2)), np.empty((0, 2), np.int64), (), ())


@dataclass(frozen=True)
class Mover:
    """A road user that keeps its speed along the street.

    Attributes:
        x: where it is in frame 0, metres.
        y: metres.
        speed: along its heading, m/s.
        shape: its mesh; the height in metres if it is a person.
        backwards: whether it moves towards lower x.
    """

    x: float
    y: float
    speed: float
    shape: Mesh | float
    backwards: bool = False

    def at(self, number: int, frame: int) -> TownActor:
        """Return it in a frame, as the actor of a number."""
        way = self.speed * frame * FRAME_PERIOD_S
        sign = -1.0 if self.backwards else 1.0
        height = KERB_M if abs(self.y) > HALF_ROAD_M else 0.0
        pose = translation((self.x + sign * way, self.y, height)) @ rotation_z(
            np.pi if self.backwards else 0.0
        )
        if isinstance(self.shape, Mesh):
            mesh = self.shape
        else:
            mesh = pedestrian_mesh(
                round(self.shape, 1), int((self.x + way) / STRIDE_M * GAIT_PHASES) % GAIT_PHASES
            )
        return TownActor(number, pose, np.array([sign * self.speed, 0.0, 0.0]), mesh)


class Moving(Protocol):
    """What moves by itself."""

    def at(self, number: int, frame: int) -> TownActor:
        """Return it in a frame, with a number."""


class StreetPopulation(Population):
    """Everything that moves on a street, in any frame.

    Attributes:
        movers: all of it, by number from `EGO_ID` on: the vehicle that records first.
    """

    movers: Sequence[Moving]

    def ego_pose(self, frame: int) -> Transform:
        """Return (4, 4) world_T_ego of a frame."""
        return self.movers[0].at(EGO_ID, frame).world_T_actor

    def at(self, frame: int) -> list[TownActor]:
        """Return all actors in a frame, the vehicle that records first."""
        return [mover.at(EGO_ID + index, frame) for index, mover in enumerate(self.movers)]


class Traffic(StreetPopulation):
    """The traffic of a street."""

    def __init__(self, rng: np.random.Generator) -> None:
        speed = float(rng.uniform(6.0, 12.0))
        self.movers = [Mover(0.0, EGO_Y_M, speed, vehicle_mesh(EGO_KIND))]
        ahead, behind = _kinds(rng, 2), _kinds(rng, 2)
        self.movers += _queue(rng, ahead, EGO_KIND.length_m / 2, (5.0, 11.0), EGO_Y_M, speed)
        places = _queue(rng, behind, EGO_KIND.length_m / 2, (5.0, 10.0), EGO_Y_M, speed)
        self.movers += [Mover(-m.x, m.y, m.speed, m.shape) for m in places]
        beside = [*_kinds(rng, 2), _BUS, *_kinds(rng, 4)]
        self.movers += _queue(
            rng, beside, -60.0, (6.0, 18.0), BESIDE_Y_M, speed + float(rng.uniform(-4.0, 4.0))
        )
        for y in TOWARDS_Y_M:
            towards = _queue(
                rng, _kinds(rng, 12), -45.0, (8.0, 25.0), y, float(rng.uniform(7.0, 12.0))
            )
            self.movers += [Mover(m.x, m.y, m.speed, m.shape, backwards=True) for m in towards]
        cycling = float(rng.uniform(3.0, 6.0))
        for x in np.arange(-70.0, 90.0, 28.0):
            self.movers.append(
                Mover(float(x + rng.uniform(-8.0, 8.0)), CYCLIST_Y_M, cycling, bicycle_mesh())
            )
        for number in range(28):
            side = 1.0 if number % 2 else -1.0
            y = side * (HALF_ROAD_M + 0.6 + 0.22 * (number // 2))
            height, pace = float(rng.uniform(1.55, 1.9)), float(rng.uniform(1.1, 1.7))
            self.movers.append(
                Mover(float(rng.uniform(-40.0, 130.0)), y, pace, height, bool(rng.random() < 0.5))
            )


class StreetDrive(TownDrive):
    """A drive along a street instead of through a town."""

    def __init__(self, seed: int, lidar: Lidar | None = None) -> None:
        """Build the street and its traffic; the arguments are those of `Drive`."""
        rng = np.random.default_rng([seed, _STREAM])
        self.seed, self.traffic = seed, "heavy"
        self.lidar = Lidar() if lidar is None else lidar
        self.town = build_street(rng)
        self._population = Traffic(rng)
        self._snapshot = None


def _kinds(rng: np.random.Generator, count: int) -> list[VehicleKind]:
    return [
        VEHICLE_KINDS[int(row)]
        for row in rng.choice(len(VEHICLE_KINDS), count, p=_SHARES / _SHARES.sum())
    ]


def _queue(
    rng: np.random.Generator,
    kinds: list[VehicleKind],
    start: float,
    gap: tuple[float, float],
    y: float,
    speed: float,
) -> list[Mover]:
    """Return vehicles one after the other towards higher x, with a random gap of metres between
    them.
    """
    movers, x = [], start
    for kind in kinds:
        x += float(rng.uniform(*gap)) + kind.length_m / 2
        movers.append(Mover(x, y, speed, vehicle_mesh(kind)))
        x += kind.length_m / 2
    return movers


def build_street(
    rng: np.random.Generator,
    houses: tuple[float, ...] = (-1.0, 1.0),
    sidewalks: tuple[float, ...] = (-1.0, 1.0),
) -> Town:
    """Build what stands along a random street, with houses on one side (y < 0: -1) or both, and
    sidewalks with furniture.

    World frame: x along the street, y to the right, z up, the road at z = 0.
    """
    plan = TownPlan(rng, PlantCatalogue(rng))
    lay_strip(plan, ROAD, (-HALF_ROAD_M, 0.0), (HALF_ROAD_M, 0.0))
    for y in (-3.5, 0.0, 3.5):
        dashes = np.arange(START_M, END_M, 7.5)
        middles = np.column_stack([dashes, np.full(len(dashes), y), np.full(len(dashes), PAINT_M)])
        plan.builder.level_rectangles(ROAD_LINE, middles, (3.0, 0.15))
    for side in sidewalks:
        kerb, inner = side * HALF_ROAD_M, side * (HALF_ROAD_M + WALK_M)
        lay_strip(plan, SIDEWALK, (kerb, -0.05), (kerb, KERB_M))
        lay_strip(plan, SIDEWALK, (kerb, KERB_M), (inner, KERB_M))
        lay_strip(
            plan,
            TERRAIN if rng.random() < 0.5 else GROUND,
            (inner, KERB_M),
            (side * LAND_M, KERB_M),
        )
        if side in houses:
            _build_houses(plan, side)
        _add_furniture(plan, side)
    return Town(_NO_STREETS, plan.builder.build(), tuple(plan.buildings), ())


def lay_strip(
    plan: TownPlan, label: int, one: tuple[float, float], other: tuple[float, float]
) -> None:
    """Add a surface along the street between two lines, (y, z) each, in tiles of 6 m."""
    x = np.arange(START_M, END_M, 6.0)
    parts = max(1, round(abs(other[0] - one[0]) / 6.0))
    lines = [
        np.column_stack([x, np.full(len(x), y), np.full(len(x), z)])
        for y, z in np.linspace(one, other, parts + 1)
    ]
    for left, right in pairwise(lines):
        plan.builder.ribbon(label, left, right)


def _build_houses(plan: TownPlan, side: float) -> None:
    rng, x = plan.rng, START_M
    while x < END_M - 25:
        width, depth = float(rng.uniform(9, 20)), float(rng.uniform(7, 10))
        back = float(rng.uniform(0.5, 4.0))
        if rng.random() < 0.75:
            y = side * (HALF_ROAD_M + WALK_M + back + depth / 2)
            yaw = 0.0 if side > 0 else np.pi
            footprint = Rectangle(np.array([x + width / 2, y]), (width, depth), yaw)
            add_building(
                plan, footprint, float(rng.uniform(5, 14)), pitched=bool(rng.random() < 0.4)
            )
        x += width + float(rng.uniform(1, 6))


def _add_furniture(plan: TownPlan, side: float) -> None:
    rng, yaw = plan.rng, 0.0 if side > 0 else np.pi
    for x in np.arange(START_M + rng.uniform(0, 8), END_M, 22.0):
        plan.add(furniture.street_lamp(), np.array([x, side * (HALF_ROAD_M + 0.3)]), yaw)
    makers = (
        plan.plants.street_tree,
        plan.plants.bush,
        furniture.bench,
        furniture.litter_bin,
        lambda: furniture.sign(rng),
        lambda: furniture.planter(rng),
        lambda: furniture.fence(3.0),
    )
    for x in np.arange(START_M + 4, END_M, 6.5):
        if rng.random() < 0.7:
            place = np.array([x + rng.uniform(-2, 2), side * (HALF_ROAD_M + WALK_M - 0.1)])
            plan.add(makers[int(rng.integers(len(makers)))](), place, yaw)
