"""The static town: its surfaces, its blocks (downtown buildings, houses with gardens, a park or a
square), and the land around it.

Around the town are guard rails, a railway, woods, some walls and large buildings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from carlasc.core.arrays import FloatArray
from carlasc.core.geometry import Transform
from carlasc.core.tables import CARLA
from carlasc_recorders.town import furniture
from carlasc_recorders.town.furniture import (
    add_building,
    add_footbridge,
    add_street_furniture,
    add_traffic_signals,
    mark_parking_bay,
)
from carlasc_recorders.town.meshes import Mesh, at_height, close_loop
from carlasc_recorders.town.plan import (
    INNER_M,
    KERB_M,
    PAINT_M,
    Land,
    PlantCatalogue,
    Rectangle,
    TownPlan,
    hedge,
)
from carlasc_recorders.town.streets import (
    BAY_M,
    HALF_ROAD_M,
    CityBlock,
    Side,
    Streets,
    draw_streets,
)

ROAD, ROAD_LINE, SIDEWALK = (CARLA.id_of(name) for name in ("Road", "RoadLine", "Sidewalk"))
GROUND, TERRAIN, WATER = (CARLA.id_of(name) for name in ("Ground", "Terrain", "Water"))


def pave_roads(plan: TownPlan, streets: Streets) -> None:
    """Add one level road surface below the whole town. The blocks lie on it."""
    low = streets.nodes.min(axis=0) - 8
    high = streets.nodes.max(axis=0) + 8
    tile = 12.0  # metres; with small triangles, rays are exact and the search tree is efficient
    xs = np.arange(low[0], high[0] + tile, tile)
    ys = np.arange(low[1], high[1] + tile, tile)
    for x, following in pairwise(xs):
        plan.builder.ribbon(
            ROAD,
            *(at_height(np.column_stack([np.full(len(ys), at), ys]), 0.0) for at in (x, following)),
        )


def paint_markings(plan: TownPlan, streets: Streets) -> None:
    """Add centre lines, edge lines, stop lines and crosswalks."""
    for block in streets.blocks:
        for side in block.sides:
            # only one of the two sides of a street adds the centre line
            if -np.pi / 2 < side.yaw_rad <= np.pi / 2:
                if plan.rng.random() < 0.4:
                    for offset in (-0.12, 0.12):
                        _paint_line(plan, side, offset, 0.0, side.length_m, dashed=False)
                else:
                    _paint_line(plan, side, 0.0, 0.0, side.length_m, dashed=True)
            _paint_line(plan, side, HALF_ROAD_M - 0.25, 0.0, side.length_m, dashed=side.has_bay)
            zebra = np.arange(0.4, HALF_ROAD_M, 0.9)
            for along in (-2.0 - 0.5, side.length_m + 2.0 + 0.5):
                bars = np.array([side.point(along, offset) for offset in zebra])
                plan.builder.level_rectangles(
                    ROAD_LINE, at_height(bars, PAINT_M), (2.4, 0.45), side.yaw_rad
                )
            stop = side.point(side.length_m + 0.25, HALF_ROAD_M / 2)
            plan.builder.level_rectangles(
                ROAD_LINE, (*stop, PAINT_M), (0.4, HALF_ROAD_M - 0.3), side.yaw_rad
            )


def _paint_line(
    plan: TownPlan, side: Side, offset: float, start: float, end: float, dashed: bool
) -> None:
    length, gap = (3.0, 4.5) if dashed else (6.0, 0.0)
    starts = np.arange(start, end - 0.5, length + gap)
    lengths = np.minimum(length, end - starts)
    middles = np.array(
        [side.point(at + run / 2, offset) for at, run in zip(starts, lengths, strict=True)]
    )
    sizes = np.column_stack([lengths, np.full(len(starts), 0.15)])
    plan.builder.level_rectangles(ROAD_LINE, at_height(middles, PAINT_M), sizes, side.yaw_rad)


def lay_sidewalk(plan: TownPlan, block: CityBlock) -> FloatArray:
    """Add the kerb and sidewalk around a block. Return the (K, 2) loop behind the sidewalk."""
    kerb = close_loop(block.outline.at(HALF_ROAD_M))
    inner = block.outline.at(INNER_M)
    plan.builder.ribbon(SIDEWALK, at_height(kerb, -0.05), at_height(kerb, KERB_M))
    plan.builder.ribbon(SIDEWALK, at_height(kerb, KERB_M), at_height(close_loop(inner), KERB_M))
    return inner


def lay_ground(plan: TownPlan, loop: FloatArray, label: int) -> None:
    """Add the land inside a loop as rings towards its centre. Terrain is slightly uneven.

    Args:
        plan: the town's plan.
        loop: (K, 2) boundary, metres.
        label: class id of the land.
    """
    centre = loop.mean(axis=0)
    rings = 10
    relief = 0.35 if label == TERRAIN else 0.0
    phase = plan.rng.uniform(0, 2 * np.pi, 4)
    previous = at_height(close_loop(loop), KERB_M)
    for ring in range(1, rings + 1):
        points = close_loop(centre + (loop - centre) * (1 - ring / rings))
        x = points[:, 0] / 7.0
        y = points[:, 1] / 9.0
        waves = np.sin(x + phase[0]) * np.sin(y + phase[1]) + 0.4 * np.sin(
            2.3 * x + phase[2]
        ) * np.sin(1.9 * y + phase[3])
        height = KERB_M + relief * float(np.clip((ring - 2) / 4, 0, 1)) * (0.5 + 0.5 * waves)
        current = at_height(points, height)
        plan.builder.ribbon(label, previous, current)
        previous = current


BLOCK_USES = ("downtown", "houses", "houses", "park", "square")
"""Uses of a block. Houses are listed twice, so they are twice as frequent."""


def fill_block(plan: TownPlan, block: CityBlock, use: str) -> None:
    """Add the sidewalk, the land and the objects of a block. `use` is one of BLOCK_USES."""
    inner = lay_sidewalk(plan, block)
    land = Land(inner)
    lay_ground(plan, inner, {"downtown": GROUND, "square": GROUND}.get(use, TERRAIN))
    if use == "park":
        _add_park(plan, block, land)
    elif use == "square":
        _add_square(plan, block, land)
    else:
        for side in block.sides:
            _add_row_of_buildings(plan, side, land, downtown=use == "downtown")
        _add_yard(plan, block, land, attempts=60 if use == "houses" else 25)
    for side in block.sides:
        add_street_furniture(plan, side, trees=use != "square")
        mark_parking_bay(plan, side)


def _add_row_of_buildings(plan: TownPlan, side: Side, land: Land, downtown: bool) -> None:
    """Add buildings along a street: without gaps downtown, with front gardens elsewhere."""
    rng = plan.rng
    along = -6.0
    while along < side.length_m + 6:
        width = rng.uniform(*((12, 22) if downtown else (8, 13)))
        depth = rng.uniform(*((10, 15) if downtown else (8, 11)))
        back = rng.uniform(*((0.9, 1.6) if downtown else (3.0, 6.5)))
        bay = side.kerb_offset(min(max(along + width / 2, 0), side.length_m)) - HALF_ROAD_M
        middle = side.point(
            along + width / 2, INNER_M + max(bay, BAY_M * side.has_bay) + back + depth / 2
        )
        footprint = Rectangle(middle, (width, depth), side.yaw_rad)
        if land.reserve(footprint, margin_m=0.0 if downtown else 2.0, edge_m=0.6):
            height = rng.uniform(*((8, 24) if downtown else (3.2, 7.0)))
            add_building(plan, footprint, height, pitched=not downtown)
            if not downtown:
                _add_front_garden(plan, side, land, along, width, back)
            along += width + rng.uniform(*((0.0, 0.4) if downtown else (3.0, 7.0)))
            if downtown and rng.random() < 0.2:
                along += rng.uniform(4, 8)  # an alley between two buildings
        else:
            along += 2.0


def _add_front_garden(
    plan: TownPlan, side: Side, land: Land, along: float, width: float, back: float
) -> None:
    """Add a fence, wall or hedge along the sidewalk, a driveway beside the house, and up to two
    bushes.
    """
    rng = plan.rng
    bay = BAY_M * side.has_bay
    edge = side.point(along + width / 2, INNER_M + bay + 0.4)
    piece = Rectangle(edge, (width, 0.5), side.yaw_rad)
    style = rng.random()
    if style < 0.8 and land.reserve(piece, 0.0):
        if style < 0.35:
            plan.add(furniture.fence(width, rng.uniform(1.0, 1.5)), edge, side.yaw_rad)
        elif style < 0.55:
            plan.add(furniture.wall(width, rng.uniform(0.7, 1.3)), edge, side.yaw_rad)
        else:
            plan.add(hedge(rng, width), edge, side.yaw_rad)
    drive = side.point(along + width + 1.8, INNER_M + bay + 3.2)
    if land.reserve(Rectangle(drive, (2.6, 5.6), side.yaw_rad), 0.2):
        plan.builder.boxes(GROUND, (*drive, KERB_M - 0.3), (2.8, 6.2, 0.33), side.yaw_rad)
        turn = np.pi / 2 * float(rng.choice([-1, 1]))
        plan.park(drive, side.yaw_rad + turn, KERB_M + 0.03)
    for _ in range(2):
        position = side.point(
            along + rng.uniform(0, width),
            INNER_M + bay + rng.uniform(1.2, max(back - 0.5, 1.5)),
        )
        if land.reserve(Rectangle(position, (1.2, 1.2), 0.0), 0.0):
            plan.add(plan.plants.bush(), position, 0.0)


def _add_yard(plan: TownPlan, block: CityBlock, land: Land, attempts: int) -> None:
    """Add trees, fences, walls, bushes and trash behind the buildings where the land is free."""
    rng = plan.rng
    for _ in range(attempts):
        position = land.draw(rng)
        number = rng.random()
        if number < 0.55:
            if land.reserve(Rectangle(position, (2.4, 2.4), 0.0), 0.5, 1.5):
                plan.add(plan.plants.tree(), position, 0.0)
        elif number < 0.75:
            yaw = block.sides[rng.integers(len(block.sides))].yaw_rad
            length = rng.uniform(6, 12)
            if land.reserve(Rectangle(position, (length, 0.4), yaw), 0.2, 0.5):
                plan.add(
                    furniture.fence(length, 1.7)
                    if rng.random() < 0.6
                    else furniture.wall(length, 1.9),
                    position,
                    yaw,
                )
        elif number < 0.9:
            if land.reserve(Rectangle(position, (1.4, 1.4), 0.0), 0.1, 0.5):
                plan.add(plan.plants.bush(), position, 0.0)
        elif land.reserve(Rectangle(position, (1.6, 1.6), 0.0), 0.1, 0.5):
            plan.add(furniture.trash(rng), position, 0.0)


def _add_park(plan: TownPlan, block: CityBlock, land: Land) -> None:
    """Add a lawn with a pond, benches, bins and many trees, a low wall along one street and a fence
    along another.
    """
    rng = plan.rng
    centre = land.boundary.mean(axis=0)
    radius = rng.uniform(5, 8)
    land.occupied.append(Rectangle(centre, (2 * radius + 2, 2 * radius + 2), 0.0))
    angles = np.linspace(0, 2 * np.pi, 25)
    rim = centre + radius * (1 + 0.15 * np.sin(3 * angles + 1))[:, None] * np.column_stack(
        [np.cos(angles), np.sin(angles)]
    )
    plan.builder.ribbon(
        WATER, at_height(rim, KERB_M + 0.42), at_height(np.tile(centre, (25, 1)), KERB_M + 0.42)
    )
    plan.builder.ribbon(
        GROUND,
        at_height(centre + (rim - centre) * 1.12, KERB_M - 0.2),
        at_height(rim, KERB_M + 0.45),
    )
    for index, side in enumerate(block.sides[:2]):
        at = side.point(side.length_m / 2, INNER_M + BAY_M * side.has_bay + 0.5)
        length = side.length_m * 0.7
        if land.reserve(Rectangle(at, (length, 0.5), side.yaw_rad), 0.0):
            plan.add(
                furniture.wall(length, 0.8) if index else furniture.fence(length, 1.2),
                at,
                side.yaw_rad,
            )
    for _ in range(150):
        position = land.draw(rng)
        number = rng.random()
        size = 2.6 if number < 0.5 else 1.4
        if not land.reserve(Rectangle(position, (size, size), 0.0), 0.4, 0.8):
            continue
        if number < 0.5:
            plan.add(plan.plants.tree(), position, 0.0)
        elif number < 0.8:
            plan.add(plan.plants.bush(), position, 0.0)
        else:
            plan.add(
                furniture.bench() if rng.random() < 0.7 else furniture.litter_bin(),
                position,
                rng.uniform(0, 6),
                KERB_M + 0.2,
            )


def _add_square(plan: TownPlan, block: CityBlock, land: Land) -> None:
    """Add a paved square: parking spaces, kiosks, planters, bollards along its edge, and one large
    building.
    """
    rng = plan.rng
    centre = land.boundary.mean(axis=0)
    side = block.sides[rng.integers(len(block.sides))]
    footprint = Rectangle(centre + side.normal * 6, (rng.uniform(18, 26), 13.0), side.yaw_rad)
    if land.reserve(footprint, edge_m=3.0):
        add_building(plan, footprint, rng.uniform(7, 14), pitched=False)
    for edge in block.sides:
        offset = INNER_M + BAY_M * edge.has_bay
        for at in np.arange(2.0, edge.length_m, 3.0):
            position = edge.point(at, offset + 0.3)
            if land.reserve(Rectangle(position, (0.25, 0.25), 0.0), 0.0):
                plan.add(furniture.bollard(), position, 0.0)
        for at in np.arange(4.0, edge.length_m - 3, 2.8):
            position = edge.point(at, offset + 6.5)
            if land.reserve(Rectangle(position, (2.2, 5.4), edge.yaw_rad), 0.2, 0.5):
                turn = np.pi / 2 * float(rng.choice([-1, 1]))
                plan.park(position, edge.yaw_rad + turn, KERB_M)
                line = edge.point(at + 1.4, offset + 6.5)
                plan.builder.level_rectangles(
                    ROAD_LINE, (*line, KERB_M + PAINT_M), (0.12, 4.8), edge.yaw_rad
                )
    makers: tuple[Callable[[], Mesh], ...] = (
        furniture.kiosk,
        lambda: furniture.planter(rng),
        plan.plants.street_tree,
        furniture.bench,
        lambda: furniture.trash(rng),
    )
    for index in range(60):
        position = land.draw(rng)
        if land.reserve(Rectangle(position, (3.2, 3.2), 0.0), 0.3, 1.0):
            plan.add(makers[index % len(makers)](), position, rng.uniform(0, 6))


@dataclass(frozen=True)
class Town:
    """A town without its traffic.

    Attributes:
        streets: the street network.
        mesh: all static objects, world frame: x and y of the streets, z up, the road at z = 0.
        buildings: footprints of the buildings with the heights of their roofs, metres.
        parking: parking spaces: world_T_vehicle of a vehicle parked in each.
    """

    streets: Streets
    mesh: Mesh
    buildings: tuple[tuple[Rectangle, float], ...]
    parking: tuple[Transform, ...]


def build_town(rng: np.random.Generator) -> Town:
    """Build a random town: first the streets, then the sidewalk, land, buildings, plants and street
    furniture of each block.
    """
    streets = draw_streets(rng)
    plan = TownPlan(rng, PlantCatalogue(rng))
    pave_roads(plan, streets)
    paint_markings(plan, streets)
    extra = rng.integers(len(BLOCK_USES), size=max(len(streets.blocks) - 1 - len(BLOCK_USES), 0))
    uses = [*BLOCK_USES, *(BLOCK_USES[int(i)] for i in extra)]  # every use occurs at least once
    for block, use in zip(streets.blocks[:-1], rng.permutation(len(uses)), strict=False):
        fill_block(plan, block, uses[int(use)])
    fill_outskirts(plan, streets.blocks[-1])
    add_traffic_signals(plan, streets)
    add_footbridge(plan, streets)
    return Town(streets, plan.builder.build(), tuple(plan.buildings), tuple(plan.parking))


OUTSKIRTS_M = 90.0  # width of the land around the town


def fill_outskirts(plan: TownPlan, block: CityBlock) -> None:
    """Add the land around the town to its plan."""
    rng = plan.rng
    inner = lay_sidewalk(plan, block)
    normals = block.outline.normal
    previous = at_height(close_loop(inner), KERB_M)
    for reach, rise in ((3.0, 0.0), (10.0, 0.3), (25.0, 1.0), (50.0, 2.0), (OUTSKIRTS_M, 3.0)):
        points = inner + reach * normals
        heights = KERB_M + rise * (
            0.6 + 0.4 * np.sin(points[:, 0] / 23) * np.cos(points[:, 1] / 19)
        )
        current = at_height(close_loop(points), close_loop(heights[:, None])[:, 0])
        plan.builder.ribbon(TERRAIN, previous, current)
        previous = current
    railway = rng.integers(len(block.sides))
    for number, side in enumerate(block.sides):
        add_street_furniture(plan, side, trees=True)
        middle = side.length_m / 2
        plan.add(
            furniture.guard_rail(side.length_m), side.point(middle, INNER_M + 0.5), side.yaw_rad
        )
        near = (
            abs(
                (number - railway + len(block.sides) // 2) % len(block.sides)
                - len(block.sides) // 2
            )
            <= 1
        )
        if near:
            plan.add(
                furniture.rail_track(side.length_m + 26),
                side.point(middle, INNER_M + 8.0),
                side.yaw_rad,
                KERB_M + 0.3,
            )
        elif rng.random() < 0.6:
            plan.add(
                furniture.wall(side.length_m * 0.8, 2.6),
                side.point(middle, INNER_M + 4.0),
                side.yaw_rad,
            )
        land = Land(
            np.array(
                [
                    side.point(x, INNER_M + y)
                    for x, y in ((0, 12), (side.length_m, 12), (side.length_m, 45), (0, 45))
                ]
            )
        )
        if rng.random() < 0.6:
            footprint = Rectangle(
                side.point(middle, INNER_M + 24), (rng.uniform(14, 24), 12.0), side.yaw_rad
            )
            if land.reserve(footprint):
                add_building(
                    plan, footprint, rng.uniform(6, 14), pitched=False, base_m=KERB_M + 0.6
                )
        for _ in range(22):
            position = side.point(rng.uniform(2, side.length_m - 2), INNER_M + rng.uniform(13, 40))
            if land.reserve(Rectangle(position, (3.0, 3.0), 0.0), 0.3):
                plan.add(plan.plants.tree(), position, 0.0, KERB_M + 0.8)
