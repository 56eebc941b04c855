"""The static town: streets, blocks, and the land around it with guard rails, a railway, woods, some walls and large buildings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from carlasc.captures.town import furniture
from carlasc.captures.town.blocks import BLOCK_USES, TERRAIN, fill_block, lay_sidewalk, paint_markings, pave_roads
from carlasc.captures.town.buildings import add_building
from carlasc.captures.town.furniture import add_footbridge, add_street_furniture, add_traffic_signals
from carlasc.captures.town.meshes import Mesh, at_height, close_loop
from carlasc.captures.town.plan import INNER_M, KERB_M, Land, Rectangle, TownPlan
from carlasc.captures.town.plants import PlantCatalogue
from carlasc.captures.town.streets import CityBlock, Streets, draw_streets
from carlasc.core.geometry import Transform


@dataclass(frozen=True)
class Town:
    """A town without its traffic.

    Attributes:
        streets: its street network.
        mesh: all static objects, world frame: x and y as the streets have them, z up, the road at z = 0.
        buildings: footprints of the buildings with the heights of their roofs, metres.
        parking: parking spaces: world_T_vehicle of a vehicle parked in each.
    """

    streets: Streets
    mesh: Mesh
    buildings: tuple[tuple[Rectangle, float], ...]
    parking: tuple[Transform, ...]


def build_town(rng: np.random.Generator) -> Town:
    """Build a random town: first the streets, then the sidewalk, land, buildings, plants and street furniture of each block."""
    streets = draw_streets(rng)
    plan = TownPlan(rng, PlantCatalogue(rng))
    pave_roads(plan, streets)
    paint_markings(plan, streets)
    uses = _draw_block_uses(rng, len(streets.blocks) - 1)
    for block, use in zip(streets.blocks, uses, strict=False):
        fill_block(plan, block, use)
    fill_outskirts(plan, streets.blocks[-1])
    add_traffic_signals(plan, streets)
    add_footbridge(plan, streets)
    return Town(streets, plan.builder.build(), tuple(plan.buildings), tuple(plan.parking))


def _draw_block_uses(rng: np.random.Generator, count: int) -> list[str]:
    """Draw the use of each block. Every use occurs at least once."""
    extra = rng.integers(len(BLOCK_USES), size=max(count - len(BLOCK_USES), 0))
    uses = [*BLOCK_USES, *(BLOCK_USES[int(i)] for i in extra)]
    return [uses[int(i)] for i in rng.permutation(len(uses))][:count]


OUTSKIRTS_M = 90.0  # width of the land around the town


def fill_outskirts(plan: TownPlan, block: CityBlock) -> None:
    """Add the land around the town to its plan."""
    rng, inner = plan.rng, lay_sidewalk(plan, block)
    normals = block.outline.normal
    previous = at_height(close_loop(inner), KERB_M)
    for reach, rise in ((3.0, 0.0), (10.0, 0.3), (25.0, 1.0), (50.0, 2.0), (OUTSKIRTS_M, 3.0)):
        points = inner + reach * normals
        heights = KERB_M + rise * (0.6 + 0.4 * np.sin(points[:, 0] / 23) * np.cos(points[:, 1] / 19))
        current = at_height(close_loop(points), close_loop(heights[:, None])[:, 0])
        plan.builder.ribbon(TERRAIN, previous, current)
        previous = current
    railway = int(rng.integers(len(block.sides)))
    for number, side in enumerate(block.sides):
        add_street_furniture(plan, side, trees=True)
        middle = side.length_m / 2
        plan.add(furniture.guard_rail(side.length_m), side.point(middle, INNER_M + 0.5), side.yaw_rad)
        near = abs((number - railway + len(block.sides) // 2) % len(block.sides) - len(block.sides) // 2) <= 1
        if near:
            plan.add(
                furniture.rail_track(side.length_m + 26), side.point(middle, INNER_M + 8.0), side.yaw_rad, KERB_M + 0.3
            )
        elif rng.random() < 0.6:
            plan.add(furniture.wall(side.length_m * 0.8, 2.6), side.point(middle, INNER_M + 4.0), side.yaw_rad)
        land = Land(
            np.array(
                [side.point(x, INNER_M + y) for x, y in ((0, 12), (side.length_m, 12), (side.length_m, 45), (0, 45))]
            )
        )
        if rng.random() < 0.6:
            footprint = Rectangle(side.point(middle, INNER_M + 24), (float(rng.uniform(14, 24)), 12.0), side.yaw_rad)
            if land.reserve(footprint):
                add_building(plan, footprint, float(rng.uniform(6, 14)), pitched=False, base_m=KERB_M + 0.6)
        for _ in range(22):
            position = side.point(float(rng.uniform(2, side.length_m - 2)), INNER_M + float(rng.uniform(13, 40)))
            if land.reserve(Rectangle(position, (3.0, 3.0), 0.0), 0.3):
                plan.add(plan.plants.tree(), position, 0.0, KERB_M + 0.8)
