"""The land around the town: guard rails, a railway, woods, some walls and large buildings."""

from __future__ import annotations

import numpy as np

from carlasc.captures.town import furniture
from carlasc.captures.town.meshes import at_height, close_loop
from carlasc.captures.town.paving import TERRAIN, lay_sidewalk
from carlasc.captures.town.plan import INNER_M, KERB_M, Plan
from carlasc.captures.town.plots import Land, Rectangle
from carlasc.captures.town.roadside import add_street_furniture
from carlasc.captures.town.streets import Block

OUTSKIRTS_M = 90.0  # width of the land around the town


def fill_outskirts(plan: Plan, block: Block) -> None:
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
                plan.add_building(footprint, float(rng.uniform(6, 14)), pitched=False, base_m=KERB_M + 0.6)
        for _ in range(22):
            position = side.point(float(rng.uniform(2, side.length_m - 2)), INNER_M + float(rng.uniform(13, 40)))
            if land.reserve(Rectangle(position, (3.0, 3.0), 0.0), 0.3):
                plan.add(plan.plants.tree(), position, 0.0, KERB_M + 0.8)
