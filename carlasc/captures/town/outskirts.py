"""The land around the town."""

from __future__ import annotations

import numpy as np

from carlasc.captures.town import furniture
from carlasc.captures.town.meshes import closed, lifted
from carlasc.captures.town.paving import TERRAIN, lay_sidewalk
from carlasc.captures.town.plan import INNER_M, KERB_M, Plan
from carlasc.captures.town.plots import Land, Rectangle
from carlasc.captures.town.roadside import equip_side
from carlasc.captures.town.streets import Block

OUTSKIRTS_M = 90.0  # how far the land goes on around the town


def fill_outskirts(plan: Plan, block: Block) -> None:
    """The land around the town: guard rails, a railway, woods, some walls and large buildings."""
    rng, inner = plan.rng, lay_sidewalk(plan, block)
    normals = block.outline.normal
    previous = lifted(closed(inner), KERB_M)
    for reach, rise in ((3.0, 0.0), (10.0, 0.3), (25.0, 1.0), (50.0, 2.0), (OUTSKIRTS_M, 3.0)):
        points = inner + reach * normals
        heights = KERB_M + rise * (0.6 + 0.4 * np.sin(points[:, 0] / 23) * np.cos(points[:, 1] / 19))
        current = lifted(closed(points), closed(heights[:, None])[:, 0])
        plan.builder.ribbon(TERRAIN, previous, current)
        previous = current
    railway = int(rng.integers(len(block.sides)))
    for number, side in enumerate(block.sides):
        equip_side(plan, side, trees=True)
        middle = side.length_m / 2
        plan.put(furniture.guard_rail(side.length_m), side.point(middle, INNER_M + 0.5), side.yaw_rad)
        near = abs((number - railway + len(block.sides) // 2) % len(block.sides) - len(block.sides) // 2) <= 1
        if near:
            plan.put(
                furniture.rail_track(side.length_m + 26), side.point(middle, INNER_M + 8.0), side.yaw_rad, KERB_M + 0.3
            )
        elif rng.random() < 0.6:
            plan.put(furniture.wall(side.length_m * 0.8, 2.6), side.point(middle, INNER_M + 4.0), side.yaw_rad)
        land = Land(
            np.array(
                [side.point(x, INNER_M + y) for x, y in ((0, 12), (side.length_m, 12), (side.length_m, 45), (0, 45))]
            )
        )
        if rng.random() < 0.6:
            footprint = Rectangle(side.point(middle, INNER_M + 24), (float(rng.uniform(14, 24)), 12.0), side.yaw_rad)
            if land.claim(footprint):
                plan.build(footprint, float(rng.uniform(6, 14)), pitched=False, base_m=KERB_M + 0.6)
        for _ in range(22):
            place = side.point(float(rng.uniform(2, side.length_m - 2)), INNER_M + float(rng.uniform(13, 40)))
            if land.claim(Rectangle(place, (3.0, 3.0), 0.0), 0.3):
                plan.put(plan.plants.tree(), place, 0.0, KERB_M + 0.8)
