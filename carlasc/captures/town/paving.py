"""Ground surfaces: roads, road markings, sidewalks and land."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.town.meshes import at_height, close_loop
from carlasc.captures.town.plan import INNER_M, KERB_M, PAINT_M, Plan
from carlasc.captures.town.streets import HALF_ROAD_M, Block, Side, Streets
from carlasc.core.tables import CARLA

ROAD, ROAD_LINE, SIDEWALK = (CARLA.id_of(name) for name in ("Road", "RoadLine", "Sidewalk"))
GROUND, TERRAIN, WATER = (CARLA.id_of(name) for name in ("Ground", "Terrain", "Water"))


def pave_roads(plan: Plan, streets: Streets) -> None:
    """Add one level road surface below the whole town. The blocks lie on it."""
    low, high = streets.nodes.min(axis=0) - 8, streets.nodes.max(axis=0) + 8
    tile = 12.0  # metres: small triangles make rays exact and the search tree efficient
    xs, ys = np.arange(low[0], high[0] + tile, tile), np.arange(low[1], high[1] + tile, tile)
    for x, following in pairwise(xs):
        plan.builder.ribbon(
            ROAD, *(at_height(np.column_stack([np.full(len(ys), at), ys]), 0.0) for at in (x, following))
        )


def paint_markings(plan: Plan, streets: Streets) -> None:
    """Add centre lines, edge lines, stop lines and crosswalks."""
    for block in streets.blocks:
        for side in block.sides:
            if -np.pi / 2 < side.yaw_rad <= np.pi / 2:  # only one of a street's two sides adds the centre line
                if plan.rng.random() < 0.4:
                    for offset in (-0.12, 0.12):
                        _paint_line(plan, side, offset, 0.0, side.length_m, dashed=False)
                else:
                    _paint_line(plan, side, 0.0, 0.0, side.length_m, dashed=True)
            _paint_line(plan, side, HALF_ROAD_M - 0.25, 0.0, side.length_m, dashed=side.has_bay)
            zebra = np.arange(0.4, HALF_ROAD_M, 0.9)
            bars = np.array([side.point(-2.0 - 0.5, offset) for offset in zebra])
            plan.builder.level_rectangles(ROAD_LINE, at_height(bars, PAINT_M), (2.4, 0.45), side.yaw_rad)
            bars = np.array([side.point(side.length_m + 2.0 + 0.5, offset) for offset in zebra])
            plan.builder.level_rectangles(ROAD_LINE, at_height(bars, PAINT_M), (2.4, 0.45), side.yaw_rad)
            stop = side.point(side.length_m + 0.25, HALF_ROAD_M / 2)
            plan.builder.level_rectangles(ROAD_LINE, (*stop, PAINT_M), (0.4, HALF_ROAD_M - 0.3), side.yaw_rad)


def _paint_line(plan: Plan, side: Side, offset: float, start: float, end: float, dashed: bool) -> None:
    length, gap = (3.0, 4.5) if dashed else (6.0, 0.0)
    starts = np.arange(start, end - 0.5, length + gap)
    lengths = np.minimum(length, end - starts)
    middles = np.array([side.point(at + run / 2, offset) for at, run in zip(starts, lengths, strict=True)])
    sizes = np.column_stack([lengths, np.full(len(starts), 0.15)])
    plan.builder.level_rectangles(ROAD_LINE, at_height(middles, PAINT_M), sizes, side.yaw_rad)


def lay_sidewalk(plan: Plan, block: Block) -> NDArray[np.float64]:
    """Add the kerb and sidewalk around a block. Return the (K, 2) loop behind the sidewalk."""
    kerb, inner = close_loop(block.outline.at(HALF_ROAD_M)), block.outline.at(INNER_M)
    plan.builder.ribbon(SIDEWALK, at_height(kerb, -0.05), at_height(kerb, KERB_M))
    plan.builder.ribbon(SIDEWALK, at_height(kerb, KERB_M), at_height(close_loop(inner), KERB_M))
    return inner


def lay_ground(plan: Plan, loop: NDArray[np.float64], label: int) -> None:
    """Add the land inside a loop as rings towards its middle. Terrain is slightly uneven.

    Args:
        plan: the town's plan.
        loop: (K, 2) boundary, metres.
        label: class id of the land.
    """
    centre, rings = loop.mean(axis=0), 10
    relief = 0.35 if label == TERRAIN else 0.0
    phase = plan.rng.uniform(0, 2 * np.pi, 4)
    previous = at_height(close_loop(loop), KERB_M)
    for ring in range(1, rings + 1):
        points = close_loop(centre + (loop - centre) * (1 - ring / rings))
        x, y = points[:, 0] / 7.0, points[:, 1] / 9.0
        waves = np.sin(x + phase[0]) * np.sin(y + phase[1]) + 0.4 * np.sin(2.3 * x + phase[2]) * np.sin(
            1.9 * y + phase[3]
        )
        height = KERB_M + relief * float(np.clip((ring - 2) / 4, 0, 1)) * (0.5 + 0.5 * waves)
        current = at_height(points, height)
        plan.builder.ribbon(label, previous, current)
        previous = current
