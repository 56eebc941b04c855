"""The town: everything that stands still, put together from the streets outwards."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from carlasc.captures.town.blocks import KINDS, fill_block
from carlasc.captures.town.meshes import Mesh
from carlasc.captures.town.outskirts import fill_outskirts
from carlasc.captures.town.paving import paint, pave
from carlasc.captures.town.plan import ParkingSpace, Plan
from carlasc.captures.town.plants import Nursery
from carlasc.captures.town.plots import Rectangle
from carlasc.captures.town.roadside import add_footbridge, equip_crossings
from carlasc.captures.town.streets import Streets, lay_out


@dataclass(frozen=True)
class Town:
    """A town without its traffic.

    Attributes:
        streets: its street network.
        mesh: everything that stands still, world frame: x, y as the streets', z up, the road at 0.
        solids: footprints of buildings with their heights, metres.
        parking: parking spaces.
    """

    streets: Streets
    mesh: Mesh
    solids: tuple[tuple[Rectangle, float], ...]
    parking: tuple[ParkingSpace, ...]


def build_town(rng: np.random.Generator) -> Town:
    """Draw a town: streets first, then each block's sidewalk, land, buildings, plants and furniture."""
    streets = lay_out(rng)
    plan = Plan(rng, Nursery(rng))
    pave(plan, streets)
    paint(plan, streets)
    kinds = _draw_kinds(rng, len(streets.blocks) - 1)
    for block, kind in zip(streets.blocks, kinds, strict=False):
        fill_block(plan, block, kind)
    fill_outskirts(plan, streets.blocks[-1])
    equip_crossings(plan, streets)
    add_footbridge(plan, streets)
    return Town(streets, plan.builder.build(), tuple(plan.solids), tuple(plan.parking))


def _draw_kinds(rng: np.random.Generator, count: int) -> list[str]:
    """Return what each block is used for: every use at least once."""
    kinds = list(KINDS) + [KINDS[int(i)] for i in rng.integers(len(KINDS), size=max(count - len(KINDS), 0))]
    return [kinds[int(i)] for i in rng.permutation(len(kinds))][:count]
