"""The street network: streets, the blocks between them, and the lanes that vehicles follow.

All coordinates are x and y of the world frame, in metres. The frame is left-handed, as in CarlaSC:
for a direction d = (dx, dy), the vector (-dy, dx) points to the *right*. The outline of a block has
its inside on the right, and vehicles drive on the right.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from carlasc.core.arrays import FloatArray, IntArray

Points = FloatArray

LANE_WIDTH_M = 3.5
HALF_ROAD_M = LANE_WIDTH_M  # a road has two lanes, one per direction
SIDEWALK_M = 2.6
CORNER_RADIUS_M = 6.0  # radius of the kerb at a crossing
# distance from the end of the corner of the kerb to the stop line; the crosswalk is between them
STOP_BACK_M = 4.5
BAY_M = 2.2  # depth of a parking bay
PATH_STEP_M = 0.5


@dataclass(frozen=True)
class Outline:
    """The edge of a block at any offset from the centre lines of its streets: `anchor + offset *
    normal`.

    Attributes:
        anchor: (K, 2) metres.
        normal: (K, 2) unit vectors into the block.
    """

    anchor: Points
    normal: Points

    def at(self, offset_m: float) -> Points:
        """Return the (K, 2) loop at an offset from the centre lines.

        The offset must not exceed the radius of the corners.
        """
        return self.anchor + offset_m * self.normal


@dataclass(frozen=True)
class Side:
    """The side of a block along one street, with the block on the right.

    Attributes:
        start: (2,) start of the straight part of the street, on its centre line.
        direction: (2,) unit vector along the street.
        length_m: length of the straight part.
        has_bay: whether the street has a parking bay on this side.
    """

    start: Points
    direction: Points
    length_m: float
    has_bay: bool

    @property
    def normal(self) -> Points:
        """(2,) unit vector to the right, into the block."""
        return right_of(self.direction)

    @property
    def yaw_rad(self) -> float:
        """Heading of `direction`."""
        return float(np.arctan2(self.direction[1], self.direction[0]))

    def point(self, along_m: float, offset_m: float) -> Points:
        """Return the (2,) point at a distance along the street and an offset to the right of its
        centre line.
        """
        return self.start + along_m * self.direction + offset_m * self.normal

    def kerb_offset(self, along_m: float) -> float:
        """Return the distance of the kerb from the centre line, metres."""
        ramp = min(along_m, self.length_m - along_m) / 3.0
        return HALF_ROAD_M + (BAY_M * float(np.clip(ramp, 0, 1)) if self.has_bay else 0.0)


@dataclass(frozen=True)
class CityBlock:
    """The land between streets, or the land around the town.

    Attributes:
        outline: edge of the block.
        sides: sides of the block, one per street.
        outside: whether the block is the land around the town.
    """

    outline: Outline
    sides: tuple[Side, ...]
    outside: bool


@dataclass(frozen=True)
class Lane:
    """A lane of a street between two crossings, or a turn: a lane across a crossing.

    Attributes:
        path: (P, 2) centre line, metres, points about PATH_STEP_M apart.
        start: index of the crossing where the lane of a street starts; for a turn, of its crossing.
        end: index of the crossing where the lane of a street ends; for a turn, of its crossing.
        turn: whether it is a turn.
        exits: indices of the lanes that follow.
    """

    path: Points
    start: int
    end: int
    turn: bool
    exits: tuple[int, ...] = ()

    @cached_property
    def stations(self) -> FloatArray:
        """(P,) distance of each point from the start, metres."""
        steps = np.linalg.norm(np.diff(self.path, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @cached_property
    def length_m(self) -> float:
        """Length of the path."""
        return float(self.stations[-1])

    def point(self, along_m: float | FloatArray) -> Points:
        """Return the point (2,), or the points (N, 2), at a distance from the start."""
        x = np.interp(along_m, self.stations, self.path[:, 0])
        y = np.interp(along_m, self.stations, self.path[:, 1])
        return np.stack([x, y], axis=-1)

    @cached_property
    def turning_rad(self) -> float:
        """Absolute change of the heading from start to end."""
        first = self.path[1] - self.path[0]
        last = self.path[-1] - self.path[-2]
        cosine = first @ last / (np.linalg.norm(first) * np.linalg.norm(last))
        return float(np.arccos(np.clip(cosine, -1, 1)))


@dataclass(frozen=True)
class Streets:
    """The street network.

    Attributes:
        nodes: (N, 2) positions of the crossings, metres.
        edges: (E, 2) indices of the two crossings of each street.
        blocks: the blocks. The last one is the land around the town.
        lanes: the lanes of all streets, then the turns.
    """

    nodes: Points
    edges: IntArray
    blocks: tuple[CityBlock, ...]
    lanes: tuple[Lane, ...]

    def degree(self, node: int) -> int:
        """Return the number of streets that meet at a crossing."""
        return int((self.edges == node).sum())


def right_of(direction: Points) -> Points:
    """Return (..., 2) vectors rotated by 90 degrees to the right (x towards y)."""
    return np.stack([-direction[..., 1], direction[..., 0]], axis=-1)


def draw_streets(rng: np.random.Generator, rows: int = 5, columns: int = 5) -> Streets:
    """Draw the random streets of a town: a grid with random spacing and crossings, with some
    streets left out.
    """
    nodes, edges = _draw_grid(rng, rows, columns)
    loops = _trace_faces(nodes, edges)
    stop_distances = _stop_distances(nodes, loops)
    blocks = [_make_block(rng, nodes, loop, stop_distances) for loop in loops]
    blocks.sort(key=lambda block: block.outside)
    return Streets(nodes, edges, tuple(blocks), _make_lanes(nodes, edges, stop_distances))


def _draw_grid(rng: np.random.Generator, rows: int, columns: int) -> tuple[Points, IntArray]:
    xs = np.concatenate([[0.0], np.cumsum(rng.uniform(62, 88, rows - 1))])
    ys = np.concatenate([[0.0], np.cumsum(rng.uniform(58, 80, columns - 1))])
    nodes = np.stack(np.meshgrid(xs - xs.mean(), ys - ys.mean(), indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    nodes += rng.uniform(-5, 5, nodes.shape)
    index = np.arange(rows * columns).reshape(rows, columns)
    along = np.stack([index[:-1].ravel(), index[1:].ravel()], axis=1)
    across = np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], axis=1)
    inner = [(int(a), int(b)) for a, b in across if rows - 1 > a // columns > 0]
    dropped: set[tuple[int, int]] = set()
    touched: set[int] = set()
    # leaving out a street makes two T-junctions and one longer block
    for index_of_street in rng.permutation(len(inner)):
        a, b = inner[index_of_street]
        around = {a, b, a + columns, b + columns, a - columns, b - columns}
        inside = a % columns > 0 and b % columns < columns - 1
        if inside and not touched & around and len(dropped) < (rows * columns) // 8:
            dropped.add((a, b))
            touched |= around
    edges = [
        (int(a), int(b))
        for a, b in np.concatenate([along, across])
        if (int(a), int(b)) not in dropped
    ]
    return nodes, np.array(edges, np.int64)


def _trace_faces(nodes: Points, edges: IntArray) -> list[list[int]]:
    """Return the loop of nodes around each face of the network. The face is on the right."""
    neighbours: dict[int, list[int]] = {node: [] for node in range(len(nodes))}
    for a, b in edges.tolist():
        neighbours[a].append(b)
        neighbours[b].append(a)
    for node, others in neighbours.items():
        offsets = nodes[others] - nodes[node]
        order = np.argsort(np.arctan2(offsets[:, 1], offsets[:, 0]))
        neighbours[node] = [others[i] for i in order]
    unused = {(a, b) for a in neighbours for b in neighbours[a]}
    loops = []
    for first in sorted(unused):
        if first not in unused:
            continue
        loop = []
        step = first
        while step in unused:
            unused.remove(step)
            loop.append(step[0])
            around = neighbours[step[1]]
            step = (step[1], around[around.index(step[0]) - 1])
        loops.append(loop)
    return loops


def _unit(direction: Points) -> Points:
    return direction / np.linalg.norm(direction)


def _corner(nodes: Points, before: int, node: int, after: int) -> tuple[Points, Points, float]:
    """Return the directions into and out of a corner, and its turn to the right in radians."""
    arriving = _unit(nodes[node] - nodes[before])
    leaving = _unit(nodes[after] - nodes[node])
    turn = np.arctan2(arriving[0] * leaving[1] - arriving[1] * leaving[0], arriving @ leaving)
    return arriving, leaving, float(turn)


def _stop_distances(nodes: Points, loops: list[list[int]]) -> dict[tuple[int, int], float]:
    """Return the distance of the stop line from a crossing, metres, by (crossing, other end of the
    street).
    """
    stop_distances: dict[tuple[int, int], float] = {}
    for loop in loops:
        for before, node, after in _corners_of(loop):
            turn = _corner(nodes, before, node, after)[2]
            tangent = (HALF_ROAD_M + CORNER_RADIUS_M) * np.tan(max(turn, 0.0) / 2)
            for other in (before, after):
                stop_distances[node, other] = max(
                    stop_distances.get((node, other), 4.0), float(tangent) + STOP_BACK_M
                )
    return stop_distances


def _corners_of(loop: list[int]) -> list[tuple[int, int, int]]:
    return [(loop[i - 1], loop[i], loop[(i + 1) % len(loop)]) for i in range(len(loop))]


def _make_block(
    rng: np.random.Generator,
    nodes: Points,
    loop: list[int],
    stop_distances: dict[tuple[int, int], float],
) -> CityBlock:
    corners = nodes[loop]
    following = np.roll(corners, -1, axis=0)
    outside = float((corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]).sum()) < 0
    anchors = []
    normals = []
    sides = []
    for before, node, after in _corners_of(loop):
        arriving, leaving, turn = _corner(nodes, before, node, after)
        anchor, normal = _rounded_corner(nodes[node], arriving, leaving, turn)
        anchors.append(anchor)
        normals.append(normal)
        near = stop_distances[node, after]
        far = stop_distances[after, node]
        length = float(np.linalg.norm(nodes[after] - nodes[node])) - near - far
        side = Side(
            nodes[node] + near * leaving, leaving, length, bool(not outside and rng.random() < 0.45)
        )
        sides.append(side)
        stations = np.array([0.0, 3.0, length - 3.0, length])
        depth = np.array([0.0, BAY_M, BAY_M, 0.0]) * side.has_bay
        anchors.append(side.start + stations[:, None] * leaving + depth[:, None] * side.normal)
        normals.append(np.tile(side.normal, (4, 1)))
    return CityBlock(
        Outline(np.concatenate(anchors), np.concatenate(normals)), tuple(sides), outside
    )


def _rounded_corner(
    node: Points, arriving: Points, leaving: Points, turn: float
) -> tuple[Points, Points]:
    """Return anchors and normals of the outline of a block at a corner."""
    count = max(2, int(np.ceil(abs(turn) / 0.16)) + 1)
    heading = np.arctan2(arriving[1], arriving[0]) + np.linspace(0, turn, count)
    normal = right_of(np.stack([np.cos(heading), np.sin(heading)], axis=1))
    # the corner of the block is not convex: the outline is an arc around the crossing
    if turn <= 0:
        return np.tile(node, (count, 1)), normal
    bisector = right_of(arriving) + right_of(leaving)
    centre = node + (HALF_ROAD_M + CORNER_RADIUS_M) * bisector / (1 + arriving @ leaving)
    return centre - (HALF_ROAD_M + CORNER_RADIUS_M) * normal, normal


def _make_lanes(
    nodes: Points, edges: IntArray, stop_distances: dict[tuple[int, int], float]
) -> tuple[Lane, ...]:
    lanes: list[Lane] = []
    for a, b in edges.tolist():
        for start, end in ((a, b), (b, a)):
            direction = _unit(nodes[end] - nodes[start])
            offset = LANE_WIDTH_M / 2 * right_of(direction)
            first = nodes[start] + stop_distances[start, end] * direction + offset
            last = nodes[end] - stop_distances[end, start] * direction + offset
            count = max(2, int(np.ceil(np.linalg.norm(last - first) / PATH_STEP_M)) + 1)
            lanes.append(
                Lane(
                    first + np.linspace(0, 1, count)[:, None] * (last - first),
                    start,
                    end,
                    turn=False,
                )
            )
    streets = list(lanes)
    for index, lane in enumerate(streets):
        exits = []
        for follow, other in enumerate(streets):
            if other.start == lane.end and other.end != lane.start:
                exits.append(len(lanes))
                lanes.append(
                    Lane(
                        _curve(lane.path, other.path),
                        lane.end,
                        lane.end,
                        turn=True,
                        exits=(follow,),
                    )
                )
        lanes[index] = Lane(lane.path, lane.start, lane.end, turn=False, exits=tuple(exits))
    return tuple(lanes)


def _curve(before: Points, after: Points) -> Points:
    """Return the path of a turn from the end of one lane to the start of another: a cubic Bezier
    curve, close to an arc.
    """
    first = before[-1]
    last = after[0]
    leaving = _unit(before[-1] - before[-2])
    arriving = _unit(after[1] - after[0])
    reach = 0.38 * float(np.linalg.norm(last - first))
    control = np.stack([first, first + reach * leaving, last - reach * arriving, last])
    t = np.linspace(0, 1, max(8, int(reach / 0.38 / PATH_STEP_M) + 1))[:, None]
    weights = np.hstack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    return weights @ control
