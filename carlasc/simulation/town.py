"""The town: everything that stands still, put together from the streets outwards."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.geometry import Transform, rotation_z, translation
from carlasc.labels import CARLA
from carlasc.simulation import furniture, plants
from carlasc.simulation.buildings import building
from carlasc.simulation.meshes import Mesh, MeshBuilder, closed, lifted
from carlasc.simulation.plots import Land, Rectangle
from carlasc.simulation.streets import BAY_M, HALF_ROAD_M, SIDEWALK_M, Block, Side, Streets, lay_out

ROAD, ROAD_LINE, SIDEWALK = (CARLA.id_of(name) for name in ("Road", "RoadLine", "Sidewalk"))
GROUND, TERRAIN, WATER = (CARLA.id_of(name) for name in ("Ground", "Terrain", "Water"))

KERB_M = 0.15
PAINT_M = 0.01  # road markings lie this far above the road
INNER_M = HALF_ROAD_M + SIDEWALK_M  # from the centre line to the land behind the sidewalk
OUTSKIRTS_M = 90.0  # how far the land goes on around the town

KINDS = ("downtown", "houses", "houses", "park", "square")


@dataclass(frozen=True)
class ParkingSpace:
    """Where a vehicle may be parked.

    Attributes:
        pose: world_T_vehicle.
        long: whether a long vehicle fits.
    """

    pose: Transform
    long: bool


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
    plan = _Plan(rng, MeshBuilder(), [], [])
    _pave(plan, streets)
    _paint(plan, streets)
    kinds = _draw_kinds(rng, len(streets.blocks) - 1)
    for block, kind in zip(streets.blocks, kinds, strict=False):
        _fill_block(plan, block, kind)
    _fill_outskirts(plan, streets.blocks[-1])
    _equip_crossings(plan, streets)
    _add_footbridge(plan, streets)
    return Town(streets, plan.builder.build(), tuple(plan.solids), tuple(plan.parking))


@dataclass
class _Plan:
    """What the steps above add to."""

    rng: np.random.Generator
    builder: MeshBuilder
    solids: list[tuple[Rectangle, float]]
    parking: list[ParkingSpace]

    def put(self, mesh: Mesh, place: NDArray[np.float64], yaw_rad: float, height_m: float = KERB_M) -> None:
        self.builder.add_mesh(mesh, translation((*place, height_m)) @ rotation_z(yaw_rad))


def _draw_kinds(rng: np.random.Generator, count: int) -> list[str]:
    """Return what each block is used for: every use at least once."""
    kinds = list(KINDS) + [KINDS[int(i)] for i in rng.integers(len(KINDS), size=max(count - len(KINDS), 0))]
    return [kinds[int(i)] for i in rng.permutation(len(kinds))][:count]


def _pave(plan: _Plan, streets: Streets) -> None:
    """One level road under everything; the blocks stand on it."""
    low, high = streets.nodes.min(axis=0) - 8, streets.nodes.max(axis=0) + 8
    tile = 12.0  # small enough for rays to be exact and for a search tree to sort well
    xs, ys = np.arange(low[0], high[0] + tile, tile), np.arange(low[1], high[1] + tile, tile)
    for x, following in zip(xs, xs[1:], strict=False):
        plan.builder.ribbon(ROAD, *(lifted(np.column_stack([np.full(len(ys), at), ys]), 0.0) for at in (x, following)))


def _paint(plan: _Plan, streets: Streets) -> None:
    """Centre lines, edge lines, stop lines and crosswalks."""
    for block in streets.blocks:
        for side in block.sides:
            solid = plan.rng.random() < 0.4
            _line(plan, side, 0.0 if not solid else 0.12, 0.0, side.length_m, dash=not solid)
            _line(plan, side, HALF_ROAD_M - 0.25, 0.0, side.length_m, dash=side.bay)
            zebra = np.arange(0.4, HALF_ROAD_M, 0.9)
            bars = np.array([side.point(-2.0 - 0.5, offset) for offset in zebra])
            plan.builder.boxes(ROAD_LINE, lifted(bars, PAINT_M / 2), (2.4, 0.45, PAINT_M / 2), side.yaw_rad)
            bars = np.array([side.point(side.length_m + 2.0 + 0.5, offset) for offset in zebra])
            plan.builder.boxes(ROAD_LINE, lifted(bars, PAINT_M / 2), (2.4, 0.45, PAINT_M / 2), side.yaw_rad)
            stop = side.point(side.length_m + 0.25, HALF_ROAD_M / 2)
            plan.builder.boxes(ROAD_LINE, (*stop, PAINT_M / 2), (0.4, HALF_ROAD_M - 0.3, PAINT_M / 2), side.yaw_rad)


def _line(plan: _Plan, side: Side, offset: float, start: float, end: float, dash: bool) -> None:
    length, gap = (3.0, 4.5) if dash else (6.0, 0.0)
    starts = np.arange(start, end - 0.5, length + gap)
    lengths = np.minimum(length, end - starts)
    middles = np.array([side.point(at + run / 2, offset) for at, run in zip(starts, lengths, strict=True)])
    sizes = np.column_stack([lengths, np.full(len(starts), 0.15), np.full(len(starts), PAINT_M / 2)])
    plan.builder.boxes(ROAD_LINE, lifted(middles, PAINT_M / 2), sizes, side.yaw_rad)


def _sidewalk(plan: _Plan, block: Block) -> NDArray[np.float64]:
    """Kerb and sidewalk around a block; returns the loop behind it."""
    kerb, inner = closed(block.outline.at(HALF_ROAD_M)), block.outline.at(INNER_M)
    plan.builder.ribbon(SIDEWALK, lifted(kerb, -0.05), lifted(kerb, KERB_M))
    plan.builder.ribbon(SIDEWALK, lifted(kerb, KERB_M), lifted(closed(inner), KERB_M))
    return inner


def _fill_block(plan: _Plan, block: Block, kind: str) -> None:
    inner = _sidewalk(plan, block)
    land = Land(inner)
    _ground(plan, inner, {"downtown": GROUND, "square": GROUND}.get(kind, TERRAIN))
    if kind == "park":
        _park(plan, block, land)
    elif kind == "square":
        _square(plan, block, land)
    else:
        for side in block.sides:
            _row_of_buildings(plan, side, land, downtown=kind == "downtown")
        _yard(plan, block, land, kind)
    for side in block.sides:
        _equip_side(plan, side, trees=kind != "square")
        _park_in_bay(plan, side)


def _ground(plan: _Plan, loop: NDArray[np.float64], label: int) -> None:
    """The land inside a loop: rings towards its middle, gently uneven where it is terrain."""
    centre, rings = loop.mean(axis=0), 10
    relief = 0.35 if label == TERRAIN else 0.0
    phase = plan.rng.uniform(0, 2 * np.pi, 4)
    previous = lifted(closed(loop), KERB_M)
    for ring in range(1, rings + 1):
        points = closed(centre + (loop - centre) * (1 - ring / rings))
        x, y = points[:, 0] / 7.0, points[:, 1] / 9.0
        waves = np.sin(x + phase[0]) * np.sin(y + phase[1]) + 0.4 * np.sin(2.3 * x + phase[2]) * np.sin(
            1.9 * y + phase[3]
        )
        height = KERB_M + relief * min(ring / 4, 1.0) * (0.5 + 0.5 * waves)
        current = lifted(points, height)
        plan.builder.ribbon(label, previous, current)
        previous = current


def _row_of_buildings(plan: _Plan, side: Side, land: Land, downtown: bool) -> None:
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
            mesh, pose = building(rng, footprint, height, pitched=not downtown)
            plan.builder.add_mesh(mesh, translation((0, 0, KERB_M)) @ pose)
            plan.solids.append((footprint, height))
            if not downtown:
                _front_garden(plan, side, land, along, width, back)
            along += width + float(rng.uniform(0.0, 0.4) if downtown else rng.uniform(3.0, 7.0))
            if downtown and rng.random() < 0.2:
                along += float(rng.uniform(4, 8))  # an alley
        else:
            along += 2.0


def _front_garden(plan: _Plan, side: Side, land: Land, along: float, width: float, back: float) -> None:
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
            plan.put(plants.bush(rng), place, 0.0)


def _yard(plan: _Plan, block: Block, land: Land, kind: str) -> None:
    """What is behind the buildings: trees, sheds' clutter, fences."""
    rng = plan.rng
    span = np.ptp(land.boundary, axis=0)
    low = land.boundary.min(axis=0)
    for _ in range(60 if kind == "houses" else 25):
        place = low + rng.uniform(0, 1, 2) * span
        pick = rng.random()
        if pick < 0.55:
            if land.claim(Rectangle(place, (2.4, 2.4), 0.0), 0.5, 1.5):
                plan.put(plants.broadleaf(rng) if rng.random() < 0.7 else plants.conifer(rng), place, rng.uniform(0, 6))
        elif pick < 0.75:
            yaw = block.sides[int(rng.integers(len(block.sides)))].yaw_rad
            length = float(rng.uniform(6, 12))
            if land.claim(Rectangle(place, (length, 0.4), yaw), 0.2, 0.5):
                plan.put(
                    furniture.fence(length, 1.7) if rng.random() < 0.6 else furniture.wall(length, 1.9), place, yaw
                )
        elif pick < 0.9:
            if land.claim(Rectangle(place, (1.4, 1.4), 0.0), 0.1, 0.5):
                plan.put(plants.bush(rng), place, 0.0)
        elif land.claim(Rectangle(place, (1.6, 1.6), 0.0), 0.1, 0.5):
            plan.put(furniture.trash(rng), place, 0.0)


def _park(plan: _Plan, block: Block, land: Land) -> None:
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
            plan.put(plants.broadleaf(rng) if rng.random() < 0.75 else plants.conifer(rng), place, rng.uniform(0, 6))
        elif pick < 0.8:
            plan.put(plants.bush(rng), place, 0.0)
        else:
            plan.put(
                furniture.bench() if rng.random() < 0.7 else furniture.bin_(), place, rng.uniform(0, 6), KERB_M + 0.2
            )


def _square(plan: _Plan, block: Block, land: Land) -> None:
    """A paved square: rows of parked cars, kiosks, planters, bollards along its edge, one large building."""
    rng, centre = plan.rng, land.boundary.mean(axis=0)
    side = block.sides[int(rng.integers(len(block.sides)))]
    footprint = Rectangle(centre + side.normal * 6, (float(rng.uniform(18, 26)), 13.0), side.yaw_rad)
    if land.claim(footprint, edge_m=3.0):
        height = float(rng.uniform(7, 14))
        mesh, pose = building(rng, footprint, height, pitched=False)
        plan.builder.add_mesh(mesh, translation((0, 0, KERB_M)) @ pose)
        plan.solids.append((footprint, height))
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
                plan.builder.boxes(
                    ROAD_LINE, (*edge.point(at + 1.4, offset + 6.5), KERB_M), (0.12, 4.8, PAINT_M), edge.yaw_rad
                )
    low, span = land.boundary.min(axis=0), np.ptp(land.boundary, axis=0)
    makers = (
        furniture.kiosk,
        lambda: furniture.planter(rng),
        lambda: plants.broadleaf(rng),
        furniture.bench,
        lambda: furniture.trash(rng),
    )
    for number in range(60):
        place = low + rng.uniform(0, 1, 2) * span
        if land.claim(Rectangle(place, (3.2, 3.2), 0.0), 0.3, 1.0):
            plan.put(makers[number % len(makers)](), place, float(rng.uniform(0, 6)))


def _equip_side(plan: _Plan, side: Side, trees: bool) -> None:
    """Lamps, trees, signs, bins and the rest along a sidewalk's kerb."""
    rng = plan.rng
    lamps = np.arange(float(rng.uniform(2, 8)), side.length_m, 22.0)
    for at in lamps:
        plan.put(furniture.street_lamp(), side.point(at, side.kerb_offset(at) + 0.45), side.yaw_rad)
    taken = list(lamps)
    makers = (
        (0.34, lambda: plants.broadleaf(rng) if trees else furniture.bollard()),
        (0.14, furniture.bin_),
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
        pick = rng.random()
        if min(abs(at - other) for other in [*taken, np.inf]) < 2.0 or pick >= shares[-1]:
            continue
        maker = makers[int(np.searchsorted(shares, pick, side="right"))][1]
        plan.put(maker(), side.point(at, side.kerb_offset(at) + 0.5), side.yaw_rad)


def _park_in_bay(plan: _Plan, side: Side) -> None:
    if not side.bay:
        return
    for at in np.arange(6.0, side.length_m - 6.0, 6.4):
        pose = translation((*side.point(at, HALF_ROAD_M + BAY_M / 2 - 0.05), 0.0)) @ rotation_z(side.yaw_rad)
        plan.parking.append(ParkingSpace(pose, long=False))


def _equip_crossings(plan: _Plan, streets: Streets) -> None:
    """Traffic lights where at least three streets meet, for each lane that leads there; signs elsewhere."""
    for block in streets.blocks:
        for side in block.sides:
            node = int(np.argmin(np.linalg.norm(streets.nodes - side.point(side.length_m + 8, 0), axis=1)))
            place = side.point(side.length_m + 0.3, HALF_ROAD_M + 0.6)
            if streets.degree(node) >= 3:
                plan.put(furniture.traffic_light(HALF_ROAD_M / 2 + 0.6), place, side.yaw_rad)
            else:
                plan.put(furniture.sign(plan.rng), place, side.yaw_rad)


def _fill_outskirts(plan: _Plan, block: Block) -> None:
    """The land around the town: guard rails, a railway, woods, some walls and large buildings."""
    rng, inner = plan.rng, _sidewalk(plan, block)
    normals = block.outline.normal
    previous = lifted(closed(inner), KERB_M)
    for reach, rise in ((3.0, 0.0), (10.0, 0.3), (25.0, 1.0), (50.0, 2.0), (OUTSKIRTS_M, 3.0)):
        points = inner + reach * normals
        height = KERB_M + rise * (0.6 + 0.4 * np.sin(points[:, 0] / 23) * np.cos(points[:, 1] / 19))
        current = lifted(closed(points), closed(height[:, None])[:, 0])
        plan.builder.ribbon(TERRAIN, previous, current)
        previous = current
    railway = int(rng.integers(len(block.sides)))
    for number, side in enumerate(block.sides):
        _equip_side(plan, side, trees=True)
        middle = side.length_m / 2
        plan.put(furniture.guard_rail(side.length_m), side.point(middle, INNER_M + 0.5), side.yaw_rad)
        near = abs((number - railway + len(block.sides) // 2) % len(block.sides) - len(block.sides) // 2) <= 1
        if near:
            plan.put(
                furniture.rail_track(side.length_m + 12), side.point(middle, INNER_M + 8.0), side.yaw_rad, KERB_M + 0.3
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
                height = float(rng.uniform(6, 14))
                mesh, pose = building(rng, footprint, height, pitched=False)
                plan.builder.add_mesh(mesh, translation((0, 0, KERB_M + 0.6)) @ pose)
                plan.solids.append((footprint, height))
        for _ in range(22):
            place = side.point(float(rng.uniform(2, side.length_m - 2)), INNER_M + float(rng.uniform(13, 40)))
            if land.claim(Rectangle(place, (3.0, 3.0), 0.0), 0.3):
                plan.put(plants.broadleaf(rng) if rng.random() < 0.5 else plants.conifer(rng), place, 0.0, KERB_M + 0.8)


def _add_footbridge(plan: _Plan, streets: Streets) -> None:
    """One footbridge, across the middle of an inner street."""
    block = streets.blocks[int(plan.rng.integers(len(streets.blocks) - 1))]
    side = block.sides[0]
    plan.put(furniture.footbridge(2 * INNER_M + 1.0), side.point(side.length_m / 2, 0.0), side.yaw_rad)
