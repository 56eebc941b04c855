"""Drives through the simulated town that come back to streets that they have seen, for
`loops.py` and `parked.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from carlasc_recorders import TownActor, TownDrive
from carlasc_recorders.town.actors import Population
from carlasc_recorders.town.drive import _NOISE, Snapshot, _scan
from carlasc_recorders.town.returns import Luck
from carlasc_recorders.town.streets import HALF_ROAD_M, Streets, right_of
from numpy.typing import NDArray

from carlasc.captures import Lidar, LidarEffects, SensorRecording
from carlasc.core.geometry import Transform, rotation_z, translation
from carlasc.storage.layout import FRAME_PERIOD_S


class Route(NamedTuple):
    """Where a drive leads, and how fast.

    Attributes:
        crossings: (row, column) of each crossing at which it begins, turns or ends.
        fast_m_s: speed on straight streets.
        change_m_s2: how fast the speed changes; by default at once.
        every: which frames a LiDAR scans, at 10 Hz.
    """

    crossings: list[tuple[int, int]]
    fast_m_s: float = 10.0
    change_m_s2: float = 1e3
    every: int = 1


def _every(crossings: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return also the crossings between others, which are not quite on a line."""
    made = crossings[:1]
    for row, column in crossings[1:]:
        while made[-1] != (row, column):
            last, other = made[-1]
            made.append((last + int(np.sign(row - last)), other + int(np.sign(column - other))))
    return made


_ROUND = [(1, 1), (3, 1), (3, 3), (1, 3), (1, 2), (3, 2), (3, 1)]
_OTHER_WAY = [(1, 1), (1, 3), (3, 3), (3, 2), (1, 2)]
ROUTES = {
    "block": Route([(0, 1), (4, 1), (4, 2), (0, 2), (0, 1), (1, 1)]),
    "there and back": Route([(0, 0), (0, 1), (4, 1), (4, 2), (0, 2), (0, 1), (0, 0)]),
    "eight": Route(
        [(1, 2), (4, 2), (4, 1), (0, 1), (0, 2), (4, 2), (4, 3), (0, 3), (0, 2), (2, 2)]
    ),
    "laps": Route([*[(0, 0), (4, 0), (4, 4), (0, 4)] * 3, (0, 0), (2, 0)]),
    "small eight": Route(_every([(1, 2), (3, 2), (3, 3), (2, 3), (2, 1), (1, 1), (1, 2), (2, 2)])),
    "other way": Route(_every([(2, 1), (1, 1), (1, 2), (2, 2), (2, 3), (1, 3), (1, 1), (2, 1)])),
    "many blocks": Route(_every([*[*_ROUND, *_OTHER_WAY] * 2, (1, 1), (2, 1)]), 15.0, 4.0, 2),
}
"""Drives of 0.7, 0.8, 1.5, 3.5, 0.7, 0.6 and 3 km."""
_COLUMNS = 5
_STEP_M = 0.1  # of the path
_CORNER_M = 9.0  # from a crossing, where a turn begins
_SIDEWAYS_M_S2 = 2.5
_CLEAR_M = (7.0, 2.5)  # between the middles of two vehicles, along and across
_KEPT_M = 25.0  # driven with one search tree


class _OnRoute(Population):
    """The actors of a town, with another path of the vehicle that records."""

    def __init__(self, others: Population, poses: Sequence[Transform]) -> None:
        self._others, self._poses = others, poses
        self.gone: Callable[[TownActor, int], bool] = lambda actor, frame: False
        self._hit = self._in_the_way()

    def ego_pose(self, frame: int) -> Transform:
        return self._poses[frame]

    def at(self, frame: int) -> list[TownActor]:
        first, *others = self._others.at(frame)
        others = [
            actor for actor in others if actor.id not in self._hit and not self.gone(actor, frame)
        ]
        return [replace(first, world_T_actor=self._poses[frame]), *others]

    def _in_the_way(self) -> set[int]:
        """Return the numbers of the actors that the vehicle would drive through: inside of one, a
        scan sees nothing else, and all odometry slips.
        """
        hit = set[int]()
        for frame, pose in enumerate(self._poses):
            _, *others = self._others.at(frame)
            places = np.stack([actor.world_T_actor[:2, 3] for actor in others])
            off = np.abs((places - pose[:2, 3]) @ pose[:2, :2])
            hit |= {others[row].id for row in np.flatnonzero((off < _CLEAR_M).all(axis=1))}
        return hit


class ReturningDrive(TownDrive):
    """A drive along one of `ROUTES`, in its right lane.

    Attributes:
        frames: number of frames until its end.
    """

    def __init__(self, seed: int, route: str, lidar: Lidar | None = None) -> None:
        """Build the town; the arguments are those of `TownDrive`, and a name of `ROUTES`."""
        super().__init__(seed, "light", lidar)
        _check(ROUTES[route], self.town.streets)
        poses = _poses(ROUTES[route], self.town.streets.nodes)
        self._population = self._on_route = _OnRoute(self._population, poses)
        self.frames = len(poses)
        self._world: Snapshot | None = None

    def record(self, frame: int, sensor: int = 0) -> SensorRecording:
        """Return the recording of `TownDrive.record`. The search tree of what stands still serves
        for some metres.
        """
        ego, pose = self.ego_pose(frame), self.sensor_poses(frame, sensor + 1)[sensor]
        still, others = list[TownActor](), list[TownActor]()
        for actor in self.actors(frame):
            (still if actor.id in self._parked else others).append(actor)
        ids = {actor.id for actor in still}
        if self._world is not None:
            away = np.linalg.norm(self._world.world_T_ego[:2, 3] - ego[:2, 3])
        if self._world is None or away > _KEPT_M or ids != self._world.actors.keys():
            self._world = self._place(frame, ego, still)
        moving = self._place(frame, ego, others, with_town=False)
        luck = Luck.draw(self.lidar, LidarEffects(), self._random(_NOISE, frame, sensor))
        rays = self.lidar.directions_of(frame)
        scan = _scan((self._world, moving), pose, self.lidar, rays, luck)
        return SensorRecording(scan, pose, np.empty((0, 4)))

    @cached_property
    def _parked(self) -> set[int]:
        """Numbers of the actors that are where they began when the drive ends."""
        first, last = (
            {actor.id: actor.world_T_actor for actor in self.actors(frame)[1:]}
            for frame in (0, self.frames - 1)
        )
        return {id for id in first.keys() & last if np.array_equal(first[id], last[id])}

    def leave_from(self, frame: int) -> list[int]:
        """Let every other parked vehicle be gone from a frame on; return the numbers of all."""
        every = [self._on_route.at(one) for one in (0, self.frames - 1)]
        still = {actor.id: actor.world_T_actor for actor in every[0][1:]}
        parked = sorted(
            actor.id
            for actor in every[1][1:]
            if actor.id in still and np.array_equal(actor.world_T_actor, still[actor.id])
        )
        gone = set(parked[::2])
        self._on_route.gone = lambda actor, now: now >= frame and actor.id in gone
        return parked


def _check(route: Route, streets: Streets) -> None:
    """Refuse a route where a town has no street."""
    edges = {frozenset(edge) for edge in streets.edges.tolist()}
    for (row, column), (last_row, last_column) in pairwise(route.crossings):
        count = max(abs(last_row - row), abs(last_column - column))
        down, right = (last_row - row) // count, (last_column - column) // count
        for k in range(count):
            one = (row + k * down) * _COLUMNS + column + k * right
            if frozenset((one, one + down * _COLUMNS + right)) not in edges:
                raise ValueError(f"this town has no street beyond {divmod(one, _COLUMNS)}")


def _poses(route: Route, crossings: NDArray[np.float64]) -> list[Transform]:
    """Return (4, 4) world_T_ego of each frame of a drive; the crossings of the town are (N, 2)."""
    nodes = crossings[[row * _COLUMNS + column for row, column in route.crossings]]
    path = [nodes[:1]]
    for before, node, after in zip(nodes[:-2], nodes[1:-1], nodes[2:], strict=True):
        one, other = (_towards(node, end, _CORNER_M) for end in (before, after))
        share = np.linspace(0.0, 1.0, 60)[:, None]
        path.append(one * (1 - share) ** 2 + 2 * node * share * (1 - share) + other * share**2)
    lane = _even(np.concatenate([*path, nodes[-1:]]))
    ahead = np.gradient(lane, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    lane = _even(lane + HALF_ROAD_M / 2 * right_of(ahead))
    step = np.gradient(lane, axis=0)
    yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    bend = np.abs(np.gradient(yaw, _STEP_M))
    yaw = np.convolve(np.pad(yaw, 10, mode="edge"), np.full(21, 1 / 21), mode="valid")
    slow = np.array([bend[max(0, i - 60) : i + 60].max() for i in range(len(bend))])
    speed = np.minimum(route.fast_m_s, np.sqrt(_SIDEWAYS_M_S2 / np.maximum(slow, 1e-3)))
    speed = _eased(speed, route.change_m_s2)
    times = np.concatenate([[0.0], np.cumsum(_STEP_M / speed[1:])])
    at = np.arange(0.0, times[-1], FRAME_PERIOD_S)
    x, y, turn = (np.interp(at, times, values) for values in (*lane.T, yaw))
    return [
        translation((*place, 0.0)) @ rotation_z(angle)
        for *place, angle in zip(x.tolist(), y.tolist(), turn.tolist(), strict=True)
    ]


def _eased(speed: NDArray[np.float64], change_m_s2: float) -> NDArray[np.float64]:
    """Return speeds, `_STEP_M` apart, that change no faster."""
    gain = 2 * change_m_s2 * _STEP_M * np.arange(len(speed))
    squared = np.minimum.accumulate(speed**2 - gain) + gain
    squared = (np.minimum.accumulate(squared[::-1] - gain) + gain)[::-1]
    return np.asarray(np.sqrt(squared))


def _towards(
    start: NDArray[np.float64], end: NDArray[np.float64], way: float
) -> NDArray[np.float64]:
    return np.asarray(start + way * (end - start) / np.linalg.norm(end - start))


def _even(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points of a path, `_STEP_M` apart."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.arange(0.0, along[-1], _STEP_M)
    return np.column_stack([np.interp(at, along, path[:, axis]) for axis in (0, 1)])
