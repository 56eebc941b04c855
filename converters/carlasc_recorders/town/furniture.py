"""Street furniture, along streets and at crossings, and buildings with details such as balconies.

Each object is made in its own frame: origin on the ground, x along the street, y away from the
street.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from carlasc.core.arrays import FloatArray
from carlasc.core.geometry import Transform, rotation_z, translation
from carlasc.core.tables import CARLA
from carlasc_recorders.town.meshes import Mesh, MeshBuilder
from carlasc_recorders.town.plan import INNER_M, KERB_M, Rectangle, TownPlan
from carlasc_recorders.town.streets import BAY_M, HALF_ROAD_M, Side, Streets

FENCE, OTHER, POLE, WALL = (CARLA.id_of(name) for name in ("Fence", "Other", "Pole", "Wall"))
TRAFFIC_SIGN = CARLA.id_of("TrafficSign")
TRAFFIC_LIGHT = CARLA.id_of("TrafficLight")
GUARD_RAIL, STATIC, DYNAMIC = (CARLA.id_of(name) for name in ("GuardRail", "Static", "Dynamic"))
BRIDGE = CARLA.id_of("Bridge")
RAIL_TRACK = CARLA.id_of("RailTrack")
GROUND = CARLA.id_of("Ground")
POST_DEPTH_M = 0.3  # depth of posts below the ground, which is not level


def street_lamp() -> Mesh:
    """Return a street lamp whose arm extends over the street."""
    builder = MeshBuilder()
    builder.cylinder(POLE, (0, 0, -POST_DEPTH_M), 0.15, 1.0 + POST_DEPTH_M, 10, top=0.8)
    builder.cylinder(POLE, (0, 0, 0.7), 0.1, 6.6, 8, top=0.6)
    builder.rod(POLE, (0, 0, 7.2), (0, -1.9, 7.6), 0.05)
    builder.boxes(POLE, (0, -2.1, 7.5), (0.25, 0.6, 0.14))
    return builder.build()


def utility_pole() -> Mesh:
    """Return a wooden pole with a crossbar."""
    builder = MeshBuilder()
    builder.cylinder(POLE, (0, 0, -POST_DEPTH_M), 0.16, 8.5, 8, top=0.7)
    builder.boxes(POLE, (0, 0, 7.3), (0.12, 1.8, 0.12))
    return builder.build()


def bollard() -> Mesh:
    """Return a bollard."""
    builder = MeshBuilder()
    builder.cylinder(POLE, (0, 0, -POST_DEPTH_M), 0.09, 0.95 + POST_DEPTH_M, 8)
    return builder.build()


def sign(rng: np.random.Generator) -> Mesh:
    """Return a traffic sign that faces traffic along +x."""
    builder = MeshBuilder()
    height = rng.uniform(2.0, 2.4)
    builder.cylinder(POLE, (0, 0, -POST_DEPTH_M), 0.045, height + 0.7 + POST_DEPTH_M, 7)
    shape = rng.integers(3)
    if shape == 0:
        builder.rod(
            TRAFFIC_SIGN, (-0.07, 0, height + 0.35), (-0.04, 0, height + 0.35), 0.36, sections=14
        )
    elif shape == 1:
        builder.boxes(TRAFFIC_SIGN, (-0.055, 0, height), (0.03, 0.65, 0.65))
    else:
        builder.boxes(TRAFFIC_SIGN, (-0.055, 0, height - 0.1), (0.03, 0.6, 0.85))
    return builder.build()


def traffic_light(reach_m: float) -> Mesh:
    """Return traffic lights that face traffic along +x: one on the post, and one on an arm over the
    lane.

    Args:
        reach_m: length of the arm.
    """
    builder = MeshBuilder()
    builder.cylinder(POLE, (0, 0, -POST_DEPTH_M), 0.11, 5.9 + POST_DEPTH_M, 8, top=0.8)
    builder.rod(POLE, (0, 0, 5.6), (0, -reach_m, 5.8), 0.06)
    for y, z in ((0.0, 2.4), (-reach_m, 5.05)):
        builder.boxes(TRAFFIC_LIGHT, (-0.22, y, z), (0.26, 0.36, 1.0))
        for lamp in range(3):
            builder.boxes(TRAFFIC_LIGHT, (-0.42, y, z + 0.25 + 0.3 * lamp), (0.18, 0.24, 0.03))
    return builder.build()


def bench() -> Mesh:
    """Return a bench that faces the street."""
    builder = MeshBuilder()
    builder.boxes(STATIC, (0, 0, 0.4), (1.6, 0.45, 0.06))
    builder.boxes(STATIC, (0, 0.22, 0.5), (1.6, 0.06, 0.4))
    for x in (-0.65, 0.65):
        builder.boxes(STATIC, (x, 0, 0), (0.08, 0.42, 0.4))
    return builder.build()


def litter_bin() -> Mesh:
    """Return a litter bin."""
    builder = MeshBuilder()
    builder.cylinder(STATIC, (0, 0, 0), 0.27, 0.95, 10, top=1.1)
    return builder.build()


def planter(rng: np.random.Generator) -> Mesh:
    """Return a concrete planter."""
    builder = MeshBuilder()
    builder.boxes(STATIC, (0, 0, -0.1), (rng.uniform(1.0, 2.0), 0.8, 0.65))
    return builder.build()


def hydrant() -> Mesh:
    """Return a fire hydrant."""
    builder = MeshBuilder()
    builder.cylinder(STATIC, (0, 0, 0), 0.14, 0.65, 8)
    builder.rod(STATIC, (0, -0.2, 0.45), (0, 0.2, 0.45), 0.06)
    return builder.build()


def trash(rng: np.random.Generator) -> Mesh:
    """Return a heap of trash bags and boxes, of CARLA's class Dynamic."""
    builder = MeshBuilder()
    for _ in range(rng.integers(2, 5)):
        position = rng.uniform(-0.5, 0.5, 2)
        size = rng.uniform(0.3, 0.65, 3)
        if rng.random() < 0.5:
            builder.cylinder(
                DYNAMIC, (*position, 0), float(size[0]) / 2, float(size[2]), 7, top=0.5
            )
        else:
            builder.boxes(DYNAMIC, (*position, 0), size, rng.uniform(0, np.pi))
    return builder.build()


def barrier() -> Mesh:
    """Return a movable street barrier, of CARLA's class Dynamic."""
    builder = MeshBuilder()
    builder.boxes(DYNAMIC, (0, 0, 0.35), (1.3, 0.06, 0.6))
    for x in (-0.5, 0.5):
        builder.boxes(DYNAMIC, (x, 0, 0), (0.06, 0.5, 0.4))
    return builder.build()


def kiosk() -> Mesh:
    """Return a kiosk, of CARLA's class Other."""
    builder = MeshBuilder()
    builder.boxes(OTHER, (0, 0, -0.2), (2.4, 1.8, 2.6))
    builder.boxes(OTHER, (0, -0.3, 2.4), (3.0, 2.6, 0.12))
    return builder.build()


def _post_places(length_m: float, spacing_m: float) -> FloatArray:
    """Return (P,) x of posts, about a spacing apart, from one end of an object to the other."""
    return np.linspace(-length_m / 2, length_m / 2, max(int(length_m / spacing_m), 1) + 1)


def _row(x: FloatArray, z: float) -> FloatArray:
    """Return (P, 3) points on a line along x, at a height z."""
    return np.column_stack([x, 0 * x, 0 * x + z])


def fence(length_m: float, height_m: float = 1.3) -> Mesh:
    """Return a fence along x with its middle at the origin: posts, rails, and slats with gaps that
    some rays pass.
    """
    builder = MeshBuilder()
    posts = _row(_post_places(length_m, 2.2), -POST_DEPTH_M)
    builder.boxes(FENCE, posts, (0.1, 0.1, height_m + POST_DEPTH_M))
    slats = _row(np.arange(-length_m / 2 + 0.1, length_m / 2, 0.17), 0.0)
    builder.boxes(FENCE, slats, (0.1, 0.025, height_m - 0.08))
    for z in (0.25, height_m - 0.3):
        builder.boxes(FENCE, (0, 0.03, z), (length_m, 0.04, 0.09))
    return builder.build()


def wall(length_m: float, height_m: float) -> Mesh:
    """Return a wall along x with its middle at the origin, with a coping and pillars."""
    builder = MeshBuilder()
    builder.boxes(WALL, (0, 0, -0.5), (length_m, 0.24, height_m + 0.5))
    builder.boxes(WALL, (0, 0, height_m), (length_m + 0.1, 0.34, 0.09))
    builder.boxes(WALL, _row(_post_places(length_m, 4), -0.5), (0.4, 0.4, height_m + 0.65))
    return builder.build()


def guard_rail(length_m: float) -> Mesh:
    """Return a guard rail along x with its middle at the origin.

    Its beam is on the side of the street.
    """
    builder = MeshBuilder()
    posts = _row(_post_places(length_m, 2.0), -POST_DEPTH_M)
    builder.boxes(GUARD_RAIL, posts, (0.1, 0.14, 0.72 + POST_DEPTH_M))
    for z, y in ((0.48, -0.12), (0.6, -0.16), (0.7, -0.12)):
        builder.boxes(GUARD_RAIL, (0, y, z), (length_m, 0.05, 0.12))
    return builder.build()


def footbridge(span_m: float) -> Mesh:
    """Return a footbridge across a street, along y, with its middle at the origin and stairs at
    both ends.
    """
    builder = MeshBuilder()
    half = span_m / 2
    deck = 5.3
    builder.boxes(BRIDGE, (0, 0, deck), (2.4, span_m, 0.35))
    for x in (-1.15, 1.15):
        builder.boxes(BRIDGE, (x, 0, deck + 0.35), (0.08, span_m, 1.1))
    for side in (-1.0, 1.0):
        for x in (-0.9, 0.9):
            builder.boxes(BRIDGE, (x, side * (half - 0.4), -0.3), (0.45, 0.45, deck + 0.3))
        steps = np.arange(16)
        rise = deck * (1 - (steps + 1) / 17)
        position = np.column_stack([1.4 + 0.3 * steps, np.full(16, side * (half - 0.7)), rise])
        builder.boxes(BRIDGE, position, (0.32, 1.3, 0.34))
    return builder.build()


def rail_track(length_m: float) -> Mesh:
    """Return a railway track along x.

    The ballast is of the class Ground, sleepers and rails of RailTrack.
    """
    builder = MeshBuilder()
    builder.boxes(GROUND, (0, 0, -0.6), (length_m, 3.6, 0.78))
    sleepers = _row(np.arange(-length_m / 2, length_m / 2, 0.65), 0.1)
    builder.boxes(RAIL_TRACK, sleepers, (0.26, 2.5, 0.16))
    for y in (-0.72, 0.72):
        builder.boxes(RAIL_TRACK, (0, y, 0.2), (length_m, 0.08, 0.2))
    return builder.build()


def add_street_furniture(plan: TownPlan, side: Side, trees: bool) -> None:
    """Add lamps, trees or bollards, signs, bins and other street furniture along the kerb of a
    sidewalk.
    """
    rng = plan.rng
    lamps = np.arange(rng.uniform(2, 8), side.length_m, 22.0)
    for at in lamps:
        plan.add(street_lamp(), side.point(at, side.kerb_offset(at) + 0.45), side.yaw_rad)
    occupied = list(lamps)
    makers: tuple[tuple[float, Callable[[], Mesh]], ...] = (
        (0.34, plan.plants.street_tree if trees else bollard),
        (0.14, litter_bin),
        (0.12, bench),
        (0.10, lambda: sign(rng)),
        (0.08, lambda: trash(rng)),
        (0.06, hydrant),
        (0.06, barrier),
        (0.05, lambda: planter(rng)),
        (0.05, utility_pole),
    )
    shares = np.cumsum([share for share, _ in makers])
    for at in np.arange(2.5, side.length_m - 1.0, 3.7):
        number = rng.random()
        if min(abs(at - other) for other in [*occupied, np.inf]) < 2.0 or number >= shares[-1]:
            continue
        maker = makers[int(np.searchsorted(shares, number, side="right"))][1]
        plan.add(maker(), side.point(at, side.kerb_offset(at) + 0.5), side.yaw_rad)


def mark_parking_bay(plan: TownPlan, side: Side) -> None:
    """Add the parking spaces of a street's parking bay, if it has one."""
    if not side.has_bay:
        return
    for at in np.arange(6.0, side.length_m - 6.0, 6.4):
        plan.park(side.point(at, HALF_ROAD_M + BAY_M / 2 - 0.05), side.yaw_rad, 0.0)


def add_traffic_signals(plan: TownPlan, streets: Streets) -> None:
    """Add a traffic light at the end of each lane where at least three streets meet, and a sign
    elsewhere.
    """
    for block in streets.blocks:
        for side in block.sides:
            node = int(
                np.argmin(np.linalg.norm(streets.nodes - side.point(side.length_m + 8, 0), axis=1))
            )
            position = side.point(side.length_m + 0.3, HALF_ROAD_M + 0.6)
            if streets.degree(node) >= 3:
                plan.add(traffic_light(HALF_ROAD_M / 2 + 0.6), position, side.yaw_rad)
            else:
                plan.add(sign(plan.rng), position, side.yaw_rad)


def add_footbridge(plan: TownPlan, streets: Streets) -> None:
    """Add one footbridge across the middle of a street."""
    block = streets.blocks[plan.rng.integers(len(streets.blocks) - 1)]
    side = block.sides[0]
    plan.add(footbridge(2 * INNER_M + 1.0), side.point(side.length_m / 2, 0.0), side.yaw_rad)


BUILDING = CARLA.id_of("Building")
FOUNDATION_M = 1.0  # depth of the walls below the ground, which is not level


def add_building(
    plan: TownPlan, footprint: Rectangle, height_m: float, pitched: bool, base_m: float = KERB_M
) -> None:
    """Add a building to the plan of a town.

    Args:
        plan: the plan of the town.
        footprint: ground plan of the building.
        height_m: height of the walls, metres.
        pitched: whether the roof is pitched; otherwise it is flat.
        base_m: z of the ground floor, metres.
    """
    mesh, pose = make_building(plan.rng, footprint, height_m, pitched)
    plan.builder.add_mesh(mesh, translation((0, 0, base_m)) @ pose)
    plan.buildings.append((footprint, base_m + height_m))


def make_building(
    rng: np.random.Generator, footprint: Rectangle, height_m: float, pitched: bool
) -> tuple[Mesh, Transform]:
    """Make a building.

    Args:
        rng: source of the random numbers.
        footprint: ground plan of the building.
        height_m: height of the walls, metres.
        pitched: whether the roof is pitched; otherwise it is flat.

    Returns:
        The mesh in the frame of the building (x along the street, y away from the street), and (4,
        4) world_T_building.
    """
    width, depth = footprint.size
    storey = rng.uniform(2.9, 3.5)
    builder = MeshBuilder()
    builder.boxes(BUILDING, (0, 0, -FOUNDATION_M), (width, depth, height_m + FOUNDATION_M))
    _add_entrance(builder, rng, width, depth)
    _add_facades(builder, rng, width, depth, height_m, storey)
    if pitched:
        _add_pitched_roof(builder, rng, width, depth, height_m)
    else:
        _add_flat_roof(builder, rng, width, depth, height_m)
    return builder.build(), translation((*footprint.centre, 0.0)) @ rotation_z(footprint.yaw_rad)


def _add_entrance(
    builder: MeshBuilder, rng: np.random.Generator, width: float, depth: float
) -> None:
    """Add a door with steps and a porch roof on the side of the street (y < 0)."""
    x = rng.uniform(-0.3, 0.3) * width
    builder.boxes(BUILDING, (x, -depth / 2 - 0.35, -0.5), (2.0, 0.7, 0.5 + 0.3))
    builder.boxes(BUILDING, (x, -depth / 2 - 0.45, 2.6), (2.4, 0.9, 0.12))
    for side in (-1.0, 1.0):
        builder.boxes(BUILDING, (x + side * 0.7, -depth / 2 - 0.08, 0.3), (0.2, 0.16, 2.3))


def _add_facades(
    builder: MeshBuilder,
    rng: np.random.Generator,
    width: float,
    depth: float,
    height: float,
    storey: float,
) -> None:
    """Add window frames and sills on all four sides, a ledge per storey, pillars at the corners,
    and some balconies.
    """
    pitch = rng.uniform(2.2, 3.6)
    floors = np.arange(int(height // storey)) * storey
    balconies = rng.random() < 0.35
    for length, reach, yaw in (
        (width, depth, 0.0),
        (width, depth, np.pi),
        (depth, width, np.pi / 2),
        (depth, width, -np.pi / 2),
    ):
        columns = max(int((length - 1.0) // pitch), 1)
        x, z = np.meshgrid((np.arange(columns) - (columns - 1) / 2) * pitch, floors + 0.9)
        x = x.ravel()
        z = z.ravel()
        out = np.full_like(x, -reach / 2)
        frame = MeshBuilder()
        frame.boxes(BUILDING, np.column_stack([x, out - 0.06, z - 0.1]), (1.5, 0.24, 0.1))
        frame.boxes(BUILDING, np.column_stack([x, out - 0.04, z + 1.4]), (1.5, 0.14, 0.12))
        for side in (-0.68, 0.68):
            frame.boxes(BUILDING, np.column_stack([x + side, out - 0.03, z]), (0.12, 0.1, 1.4))
        if balconies and yaw == 0.0:
            high = z > storey
            if high.any():
                place = np.column_stack([x[high], out[high] - 0.6, z[high] - 0.95])
                frame.boxes(BUILDING, place, (1.9, 1.2, 0.14))
                frame.boxes(BUILDING, place - (0, 0.57, -0.14), (1.9, 0.05, 0.85))
        if rng.random() < 0.7:
            levels = floors[1:]
            if len(levels):
                ledge = [(0, -reach / 2 - 0.05, level - 0.1) for level in levels]
                frame.boxes(BUILDING, ledge, (length, 0.16, 0.18))
        builder.add_mesh(frame.build(), rotation_z(yaw))
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * (width / 2, depth / 2, 1)
    builder.boxes(BUILDING, corners - (0, 0, FOUNDATION_M), (0.5, 0.5, height + FOUNDATION_M))


def _add_flat_roof(
    builder: MeshBuilder, rng: np.random.Generator, width: float, depth: float, height: float
) -> None:
    for y in (-1, 1):
        builder.boxes(BUILDING, (0, y * (depth / 2), height - 0.1), (width + 0.5, 0.45, 0.75))
    for x in (-1, 1):
        builder.boxes(BUILDING, (x * (width / 2), 0, height - 0.1), (0.45, depth, 0.75))
    for _ in range(rng.integers(1, 4)):
        place = rng.uniform(-0.3, 0.3, 2) * (width, depth)
        builder.boxes(BUILDING, (*place, height), rng.uniform((1.0, 1.0, 0.8), (2.5, 2.5, 2.0)))


def _add_pitched_roof(
    builder: MeshBuilder, rng: np.random.Generator, width: float, depth: float, height: float
) -> None:
    eaves = 0.45
    rise = depth / 2 * rng.uniform(0.5, 0.9)
    roof = np.array([(-width / 2 - eaves, height - 0.15), (width / 2 + eaves, height - 0.15)])
    x = np.array([roof[0, 0], roof[1, 0], roof[1, 0], roof[0, 0], roof[0, 0], roof[1, 0]])
    y = np.array(
        [-depth / 2 - eaves, -depth / 2 - eaves, depth / 2 + eaves, depth / 2 + eaves, 0, 0]
    )
    z = np.array([height - 0.15] * 4 + [height + rise] * 2)
    faces = [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4], [0, 2, 1], [0, 3, 2]]
    builder.add(BUILDING, np.column_stack([x, y, z]), faces)
    builder.boxes(
        BUILDING,
        (width * rng.uniform(-0.35, 0.35), depth * 0.15, height),
        (0.7, 0.7, rise + 0.6),
    )
