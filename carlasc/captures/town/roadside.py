"""Street furniture along the streets and at crossings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from carlasc.captures.town import furniture
from carlasc.captures.town.meshes import Mesh
from carlasc.captures.town.plan import INNER_M, Plan
from carlasc.captures.town.streets import BAY_M, HALF_ROAD_M, Side, Streets
from carlasc.core.geometry import rotation_z, translation


def add_street_furniture(plan: Plan, side: Side, trees: bool) -> None:
    """Add lamps, trees or bollards, signs, bins and other street furniture along the kerb of a sidewalk."""
    rng = plan.rng
    lamps = np.arange(float(rng.uniform(2, 8)), side.length_m, 22.0)
    for at in lamps:
        plan.add(furniture.street_lamp(), side.point(at, side.kerb_offset(at) + 0.45), side.yaw_rad)
    occupied = list(lamps)
    makers: tuple[tuple[float, Callable[[], Mesh]], ...] = (
        (0.34, plan.plants.street_tree if trees else furniture.bollard),
        (0.14, furniture.litter_bin),
        (0.12, furniture.bench),
        (0.10, lambda: furniture.sign(rng)),
        (0.08, lambda: furniture.trash(rng)),
        (0.06, furniture.hydrant),
        (0.06, furniture.barrier),
        (0.05, lambda: furniture.planter(rng)),
        (0.05, furniture.utility_pole),
    )
    shares = np.cumsum([share for share, _ in makers])
    for at in np.arange(2.5, side.length_m - 1.0, 3.7):
        number = rng.random()
        if min(abs(at - other) for other in [*occupied, np.inf]) < 2.0 or number >= shares[-1]:
            continue
        maker = makers[int(np.searchsorted(shares, number, side="right"))][1]
        plan.add(maker(), side.point(at, side.kerb_offset(at) + 0.5), side.yaw_rad)


def mark_parking_bay(plan: Plan, side: Side) -> None:
    """Add the parking spaces of a street's parking bay, if it has one."""
    if not side.has_bay:
        return
    for at in np.arange(6.0, side.length_m - 6.0, 6.4):
        pose = translation((*side.point(at, HALF_ROAD_M + BAY_M / 2 - 0.05), 0.0)) @ rotation_z(side.yaw_rad)
        plan.parking.append(pose)


def add_traffic_signals(plan: Plan, streets: Streets) -> None:
    """Add a traffic light at the end of each lane where at least three streets meet, and a sign elsewhere."""
    for block in streets.blocks:
        for side in block.sides:
            node = int(np.argmin(np.linalg.norm(streets.nodes - side.point(side.length_m + 8, 0), axis=1)))
            position = side.point(side.length_m + 0.3, HALF_ROAD_M + 0.6)
            if streets.degree(node) >= 3:
                plan.add(furniture.traffic_light(HALF_ROAD_M / 2 + 0.6), position, side.yaw_rad)
            else:
                plan.add(furniture.sign(plan.rng), position, side.yaw_rad)


def add_footbridge(plan: Plan, streets: Streets) -> None:
    """Add one footbridge across the middle of a street."""
    block = streets.blocks[int(plan.rng.integers(len(streets.blocks) - 1))]
    side = block.sides[0]
    plan.add(furniture.footbridge(2 * INNER_M + 1.0), side.point(side.length_m / 2, 0.0), side.yaw_rad)
