"""The static town: streets, buildings, plants and street furniture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from carlasc.captures.town.blocks import BLOCK_USES, fill_block
from carlasc.captures.town.meshes import Mesh
from carlasc.captures.town.outskirts import fill_outskirts
from carlasc.captures.town.paving import paint_markings, pave_roads
from carlasc.captures.town.plan import Plan
from carlasc.captures.town.plants import PlantCatalogue
from carlasc.captures.town.plots import Rectangle
from carlasc.captures.town.roadside import add_footbridge, add_traffic_signals
from carlasc.captures.town.streets import Streets, draw_streets
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
    plan = Plan(rng, PlantCatalogue(rng))
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
