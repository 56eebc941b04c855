"""How pedestrians move: they walk around blocks, or stand on the sidewalk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.town.meshes import close_loop
from carlasc.captures.town.streets import HALF_ROAD_M, Block
from carlasc.core.geometry import Transform, rotation_z, translation

_OFFSETS_M = (1.1, 1.75, 2.3)
"""Distance from the kerb of those who walk along the loop, of those who walk against it, and of those who stand."""


@dataclass(frozen=True)
class Walk:
    """The walk of a pedestrian around a block.

    Attributes:
        loop: (P, 2) closed path, metres. The first point is repeated at the end.
        start_m: distance along the loop at time 0.
        speed_mps: speed along the loop. It is negative for those who walk against it, and 0 for those who stand.
        heading_rad: heading of a pedestrian who stands.
    """

    loop: NDArray[np.float64]
    start_m: float
    speed_mps: float
    heading_rad: float = 0.0

    def pose(self, elapsed_s: float, height_m: float) -> Transform:
        """Return (4, 4) world_T_pedestrian at a time. The feet are at a height."""
        stations = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.loop, axis=0), axis=1))])
        along = (self.start_m + self.speed_mps * elapsed_s) % stations[-1]
        point = [np.interp(along, stations, self.loop[:, axis]) for axis in (0, 1)]
        heading = self.heading_rad
        if self.speed_mps:
            step = min(int(np.searchsorted(stations, along, side="right")), len(stations) - 1)
            ahead = (self.loop[step] - self.loop[step - 1]) * np.sign(self.speed_mps)
            heading = float(np.arctan2(ahead[1], ahead[0]))
        return translation((*point, height_m)) @ rotation_z(heading)


def draw_walks(rng: np.random.Generator, blocks: tuple[Block, ...], count: int) -> list[Walk]:
    """Draw pedestrians: a third walk around a block in each direction, and a third stand.

    Pedestrians of one block and direction have the same speed and distance from the kerb, so they do not meet.
    """
    speeds = rng.uniform(1.0, 1.8, (len(blocks), 2))
    walks: list[Walk] = []
    occupied: dict[tuple[int, int], list[float]] = {}
    while len(walks) < count:
        number, direction = int(rng.integers(len(blocks))), int(rng.integers(3))
        loop = close_loop(blocks[number].outline.at(HALF_ROAD_M + _OFFSETS_M[direction]))
        length = float(np.linalg.norm(np.diff(loop, axis=0), axis=1).sum())
        start = float(rng.uniform(0, length))
        if any(
            min(abs(start - other), length - abs(start - other)) < 1.0
            for other in occupied.get((number, direction), [])
        ):
            continue
        occupied.setdefault((number, direction), []).append(start)
        speed = float(speeds[number, direction]) * (1, -1)[direction] if direction < 2 else 0.0
        walks.append(Walk(loop, start, speed, float(rng.uniform(-np.pi, np.pi))))
    return walks
