"""What stands on a block, by what the block is used for."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from carlasc.captures.town import furniture, plants
from carlasc.captures.town.meshes import Mesh, lifted
from carlasc.captures.town.paving import GROUND, ROAD_LINE, TERRAIN, WATER, lay_ground, lay_sidewalk
from carlasc.captures.town.plan import INNER_M, KERB_M, PAINT_M, ParkingSpace, Plan
from carlasc.captures.town.plots import Land, Rectangle
from carlasc.captures.town.roadside import equip_side, park_in_bay
from carlasc.captures.town.streets import BAY_M, HALF_ROAD_M, Block, Side
from carlasc.core.geometry import rotation_z, translation

KINDS = ("downtown", "houses", "houses", "park", "square")
"""Uses of a block; one that stands twice is met twice as often."""


def fill_block(plan: Plan, block: Block, kind: str) -> None:
    """Lay a block's sidewalk and land and put on it what its use, one of KINDS, asks for."""
    inner = lay_sidewalk(plan, block)
    land = Land(inner)
    lay_ground(plan, inner, {"downtown": GROUND, "square": GROUND}.get(kind, TERRAIN))
    if kind == "park":
        _park(plan, block, land)
    elif kind == "square":
        _square(plan, block, land)
    else:
        for side in block.sides:
            _row_of_buildings(plan, side, land, downtown=kind == "downtown")
        _yard(plan, block, land, kind)
    for side in block.sides:
        equip_side(plan, side, trees=kind != "square")
        park_in_bay(plan, side)


def _row_of_buildings(plan: Plan, side: Side, land: Land, downtown: bool) -> None:
    """Buildings along a street, shoulder to shoulder downtown, with front gardens elsewhere."""
    rng, along = plan.rng, -6.0
    while along < side.length_m + 6:
        width = float(rng.uniform(12, 22) if downtown else rng.uniform(8, 13))
        depth = float(rng.uniform(10, 15) if downtown else rng.uniform(8, 11))
        back = float(rng.uniform(0.9, 1.6) if downtown else rng.uniform(3.0, 6.5))
        bay = side.kerb_offset(min(max(along + width / 2, 0), side.length_m)) - HALF_ROAD_M
        middle = side.point(along + width / 2, INNER_M + max(bay, BAY_M * side.bay) + back + depth / 2)
        footprint = Rectangle(middle, (width, depth), side.yaw_rad)
        if land.claim(footprint, margin_m=0.0 if downtown else 2.0, edge_m=0.6):
            height = float(rng.uniform(8, 24) if downtown else rng.uniform(3.2, 7.0))
            plan.build(footprint, height, pitched=not downtown)
            if not downtown:
                _front_garden(plan, side, land, along, width, back)
            along += width + float(rng.uniform(0.0, 0.4) if downtown else rng.uniform(3.0, 7.0))
            if downtown and rng.random() < 0.2:
                along += float(rng.uniform(4, 8))  # an alley
        else:
            along += 2.0


def _front_garden(plan: Plan, side: Side, land: Land, along: float, width: float, back: float) -> None:
    """A fence, a wall or a hedge along the sidewalk, a driveway beside the house, a bush or two."""
    rng = plan.rng
    bay = BAY_M * side.bay
    edge = side.point(along + width / 2, INNER_M + bay + 0.4)
    piece = Rectangle(edge, (width, 0.5), side.yaw_rad)
    style = rng.random()
    if style < 0.8 and land.claim(piece, 0.0):
        if style < 0.35:
            plan.put(furniture.fence(width, float(rng.uniform(1.0, 1.5))), edge, side.yaw_rad)
        elif style < 0.55:
            plan.put(furniture.wall(width, float(rng.uniform(0.7, 1.3))), edge, side.yaw_rad)
        else:
            plan.put(plants.hedge(rng, width), edge, side.yaw_rad)
    drive = side.point(along + width + 1.8, INNER_M + bay + 3.2)
    if land.claim(Rectangle(drive, (2.6, 5.6), side.yaw_rad), 0.2):
        plan.builder.boxes(GROUND, (*drive, KERB_M - 0.3), (2.8, 6.2, 0.33), side.yaw_rad)
        pose = translation((*drive, KERB_M + 0.03)) @ rotation_z(side.yaw_rad + np.pi / 2 * float(rng.choice([-1, 1])))
        plan.parking.append(ParkingSpace(pose, long=False))
    for _ in range(2):
        place = side.point(
            along + float(rng.uniform(0, width)), INNER_M + bay + float(rng.uniform(1.2, max(back - 0.5, 1.5)))
        )
        if land.claim(Rectangle(place, (1.2, 1.2), 0.0), 0.0):
            plan.put(plan.plants.bush(), place, 0.0)


def _yard(plan: Plan, block: Block, land: Land, kind: str) -> None:
    """What is behind the buildings: trees, sheds' clutter, fences."""
    rng = plan.rng
    span = np.ptp(land.boundary, axis=0)
    low = land.boundary.min(axis=0)
    for _ in range(60 if kind == "houses" else 25):
        place = low + rng.uniform(0, 1, 2) * span
        pick = rng.random()
        if pick < 0.55:
            if land.claim(Rectangle(place, (2.4, 2.4), 0.0), 0.5, 1.5):
                plan.put(plan.plants.tree(), place, 0.0)
        elif pick < 0.75:
            yaw = block.sides[int(rng.integers(len(block.sides)))].yaw_rad
            length = float(rng.uniform(6, 12))
            if land.claim(Rectangle(place, (length, 0.4), yaw), 0.2, 0.5):
                plan.put(
                    furniture.fence(length, 1.7) if rng.random() < 0.6 else furniture.wall(length, 1.9), place, yaw
                )
        elif pick < 0.9:
            if land.claim(Rectangle(place, (1.4, 1.4), 0.0), 0.1, 0.5):
                plan.put(plan.plants.bush(), place, 0.0)
        elif land.claim(Rectangle(place, (1.6, 1.6), 0.0), 0.1, 0.5):
            plan.put(furniture.trash(rng), place, 0.0)


def _park(plan: Plan, block: Block, land: Land) -> None:
    """Lawn with a pond, paths, benches, many trees, a low wall along one street and a fence along another."""
    rng, centre = plan.rng, land.boundary.mean(axis=0)
    radius = float(rng.uniform(5, 8))
    land.taken.append(Rectangle(centre, (2 * radius + 2, 2 * radius + 2), 0.0))
    angles = np.linspace(0, 2 * np.pi, 25)
    rim = centre + radius * (1 + 0.15 * np.sin(3 * angles + 1))[:, None] * np.column_stack(
        [np.cos(angles), np.sin(angles)]
    )
    plan.builder.ribbon(WATER, lifted(rim, KERB_M + 0.42), lifted(np.tile(centre, (25, 1)), KERB_M + 0.42))
    plan.builder.ribbon(GROUND, lifted(centre + (rim - centre) * 1.12, KERB_M - 0.2), lifted(rim, KERB_M + 0.45))
    for number, side in enumerate(block.sides[:2]):
        at = side.point(side.length_m / 2, INNER_M + BAY_M * side.bay + 0.5)
        length = side.length_m * 0.7
        if land.claim(Rectangle(at, (length, 0.5), side.yaw_rad), 0.0):
            plan.put(furniture.wall(length, 0.8) if number else furniture.fence(length, 1.2), at, side.yaw_rad)
    low, span = land.boundary.min(axis=0), np.ptp(land.boundary, axis=0)
    for _ in range(150):
        place, pick = low + rng.uniform(0, 1, 2) * span, rng.random()
        size = 2.6 if pick < 0.5 else 1.4
        if not land.claim(Rectangle(place, (size, size), 0.0), 0.4, 0.8):
            continue
        if pick < 0.5:
            plan.put(plan.plants.tree(), place, 0.0)
        elif pick < 0.8:
            plan.put(plan.plants.bush(), place, 0.0)
        else:
            plan.put(
                furniture.bench() if rng.random() < 0.7 else furniture.bin_(), place, rng.uniform(0, 6), KERB_M + 0.2
            )


def _square(plan: Plan, block: Block, land: Land) -> None:
    """A paved square: rows of parked cars, kiosks, planters, bollards along its edge, one large building."""
    rng, centre = plan.rng, land.boundary.mean(axis=0)
    side = block.sides[int(rng.integers(len(block.sides)))]
    footprint = Rectangle(centre + side.normal * 6, (float(rng.uniform(18, 26)), 13.0), side.yaw_rad)
    if land.claim(footprint, edge_m=3.0):
        plan.build(footprint, float(rng.uniform(7, 14)), pitched=False)
    for edge in block.sides:
        offset = INNER_M + BAY_M * edge.bay
        for at in np.arange(2.0, edge.length_m, 3.0):
            place = edge.point(at, offset + 0.3)
            if land.claim(Rectangle(place, (0.25, 0.25), 0.0), 0.0):
                plan.put(furniture.bollard(), place, 0.0)
        for at in np.arange(4.0, edge.length_m - 3, 2.8):
            place = edge.point(at, offset + 6.5)
            if land.claim(Rectangle(place, (2.2, 5.4), edge.yaw_rad), 0.2, 0.5):
                turn = np.pi / 2 * float(rng.choice([-1, 1]))
                pose = translation((*place, KERB_M)) @ rotation_z(edge.yaw_rad + turn)
                plan.parking.append(ParkingSpace(pose, long=False))
                line = edge.point(at + 1.4, offset + 6.5)
                plan.builder.decals(ROAD_LINE, (*line, KERB_M + PAINT_M), (0.12, 4.8), edge.yaw_rad)
    low, span = land.boundary.min(axis=0), np.ptp(land.boundary, axis=0)
    makers: tuple[Callable[[], Mesh], ...] = (
        furniture.kiosk,
        lambda: furniture.planter(rng),
        plan.plants.street_tree,
        furniture.bench,
        lambda: furniture.trash(rng),
    )
    for number in range(60):
        place = low + rng.uniform(0, 1, 2) * span
        if land.claim(Rectangle(place, (3.2, 3.2), 0.0), 0.3, 1.0):
            plan.put(makers[number % len(makers)](), place, float(rng.uniform(0, 6)))
