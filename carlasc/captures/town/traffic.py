"""How vehicles and pedestrians move: vehicles follow each other along lanes and take turns at crossings, pedestrians walk round blocks.

Car following is the intelligent driver model (Treiber, Hennecke and Helbing, 2000). A vehicle enters a crossing only while
nobody on it drives a way that meets its own, and where there is room for it on the far side: so nobody is met or left standing there.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.town.meshes import closed
from carlasc.captures.town.streets import HALF_ROAD_M, Block, Lane, Streets
from carlasc.core.geometry import Transform, rotation_z, translation
from carlasc.storage.layout import FRAME_PERIOD_S

ACCELERATION = 1.8  # m/s^2
BRAKING = 2.5  # m/s^2, comfortable
HEADWAY_S = 1.2
STANDSTILL_GAP_M = 2.0
LOOK_AHEAD_M = 60.0
LATERAL_ACCELERATION = 2.4  # m/s^2, what a driver takes in a turn
CLEARANCE_M = 3.1  # between the middle lines of two turns that may be driven at once

Queues = dict[int, list[int]]
"""Vehicles on each street's lane and on the turns that lead away from it, by lane, the foremost first."""


@dataclass
class Vehicle:
    """A vehicle under way.

    Attributes:
        length_m: bumper to bumper.
        cruise_mps: the speed it would like to drive.
        turns: random numbers in 0..1 that choose its way, one a crossing.
        route: lanes it drives over, in order; the last one is where the way has been chosen to.
        starts: distance along the route at which each of these lanes starts, metres.
        along_m: distance of its middle along the route.
        speed_mps: its speed.
        leg: index in `route` of the lane its middle is on.
        granted: index in `route` up to which it may drive.
    """

    length_m: float
    cruise_mps: float
    turns: NDArray[np.float64]
    route: list[int]
    starts: list[float]
    along_m: float
    speed_mps: float = 0.0
    leg: int = 0
    granted: int = 0


@dataclass
class _Crossing:
    inside: list[int] = field(default_factory=list)  # vehicles that may drive over it and have not left it yet
    waiting: dict[int, int] = field(default_factory=dict)  # lane -> step at which its first vehicle came


class Traffic:
    """All vehicles, stepped at the frame rate from frame 0; what has been stepped is kept."""

    def __init__(self, streets: Streets, vehicles: list[Vehicle]) -> None:
        """Start with the vehicles where they are; the first one is the ego vehicle."""
        self.streets = streets
        self.vehicles = vehicles
        self._conflicts = _find_conflicts(streets)
        self._crossings = [_Crossing() for _ in streets.nodes]
        self._exit_claims: dict[int, list[int]] = {}  # lane -> vehicles on a crossing that will drive onto it
        self._limits = [_speed_limit(lane) for lane in streets.lanes]
        for vehicle in vehicles:
            self._extend(vehicle)
        self._along = [np.array([vehicle.along_m for vehicle in vehicles])]
        self._speed = [np.array([vehicle.speed_mps for vehicle in vehicles])]

    def at(self, frame: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return distance along the route and speed of every vehicle at a frame: (V,) metres, (V,) m/s."""
        while len(self._along) <= frame:
            self._step(len(self._along))
            self._along.append(np.array([vehicle.along_m for vehicle in self.vehicles]))
            self._speed.append(np.array([vehicle.speed_mps for vehicle in self.vehicles]))
        return self._along[frame], self._speed[frame]

    def pose(self, index: int, along_m: float, wheelbase_m: float) -> Transform:
        """Return world_T_vehicle of a vehicle so far along its route: both axles' middles are on the route."""
        vehicle = self.vehicles[index]
        front = self._point(vehicle, along_m + wheelbase_m / 2)
        rear = self._point(vehicle, along_m - wheelbase_m / 2)
        middle, ahead = (front + rear) / 2, front - rear
        return translation((*middle, 0.0)) @ rotation_z(float(np.arctan2(ahead[1], ahead[0])))

    def _point(self, vehicle: Vehicle, along_m: float) -> NDArray[np.float64]:
        leg = int(np.searchsorted(vehicle.starts, along_m, side="right")) - 1
        leg = min(max(leg, 0), len(vehicle.route) - 1)
        lane, local = self.streets.lanes[vehicle.route[leg]], along_m - vehicle.starts[leg]
        if local < 0:  # behind the route's first lane: straight back
            return lane.path[0] + local * (lane.path[1] - lane.path[0]) / np.linalg.norm(lane.path[1] - lane.path[0])
        return lane.point(local)

    def _step(self, step: int) -> None:
        self._release_crossings()
        queues = self._queues()
        self._grant_crossings(step, queues)
        accelerations = [self._acceleration(index, queues) for index in range(len(self.vehicles))]
        for vehicle, acceleration in zip(self.vehicles, accelerations, strict=True):
            speed = max(vehicle.speed_mps + acceleration * FRAME_PERIOD_S, 0.0)
            vehicle.along_m += (vehicle.speed_mps + speed) / 2 * FRAME_PERIOD_S
            vehicle.speed_mps = speed
            while vehicle.along_m >= vehicle.starts[vehicle.leg + 1]:
                vehicle.leg += 1
            self._extend(vehicle)

    def _extend(self, vehicle: Vehicle) -> None:
        """Choose the way for at least two crossings ahead."""
        while len(vehicle.route) < vehicle.leg + 6:
            lane = self.streets.lanes[vehicle.route[-1]]
            number = vehicle.turns[len(vehicle.route) % len(vehicle.turns)]
            vehicle.route.append(lane.exits[int(number * len(lane.exits))])
            vehicle.starts.append(vehicle.starts[-1] + lane.length_m)

    def _queues(self) -> Queues:
        """Return the vehicles on each street's lane and on the turns that lead away from it, the foremost first."""
        queues: dict[int, list[tuple[float, int]]] = {}
        for index, vehicle in enumerate(self.vehicles):
            leg = self._street_leg(vehicle)
            position = vehicle.along_m - vehicle.starts[leg]
            queues.setdefault(vehicle.route[leg], []).append((-position, index))
        return {lane: [index for _, index in sorted(queue)] for lane, queue in queues.items()}

    def _street_leg(self, vehicle: Vehicle) -> int:
        """Return which leg of its route is the street's lane it is on or, on a crossing, has come from."""
        return vehicle.leg - self.streets.lanes[vehicle.route[vehicle.leg]].turn

    def _release_crossings(self) -> None:
        """Forget the vehicles that have left a crossing with their tails."""
        for crossing in self._crossings:
            crossing.inside = [index for index in crossing.inside if not self._has_left(index)]
        for claims in self._exit_claims.values():
            claims[:] = [index for index in claims if not self._has_left(index)]

    def _has_left(self, index: int) -> bool:
        vehicle = self.vehicles[index]
        return vehicle.along_m - vehicle.length_m / 2 > vehicle.starts[vehicle.granted] + 0.5

    def _grant_crossings(self, step: int, queues: Queues) -> None:
        wishes: dict[int, list[tuple[int, int]]] = {}
        for lane, queue in queues.items():
            index = next((i for i in queue if self.vehicles[i].route[self.vehicles[i].leg] == lane), None)
            if index is None:
                continue
            vehicle, node = self.vehicles[index], self.streets.lanes[lane].end
            if vehicle.granted > vehicle.leg:
                continue  # it has its permission already
            left = vehicle.starts[vehicle.leg + 1] - vehicle.along_m - vehicle.length_m / 2
            if left < 10.0 + vehicle.speed_mps**2 / (2 * BRAKING):
                self._crossings[node].waiting.setdefault(lane, step)
                wishes.setdefault(node, []).append((lane, index))
        ego_lane = self._lane_of_ego(queues)
        for node in sorted(wishes):
            self._grant(self._crossings[node], wishes[node], ego_lane, queues)

    def _grant(self, crossing: _Crossing, wishes: list[tuple[int, int]], ego_lane: int, queues: Queues) -> None:
        """Let in those whose way is clear: first come, first served, but the ego vehicle's lane before the others."""
        held: list[int] = []  # turns of those who came earlier and must still wait
        for lane, index in sorted(wishes, key=lambda wish: (wish[0] != ego_lane, crossing.waiting[wish[0]], wish[0])):
            vehicle = self.vehicles[index]
            turn = vehicle.route[vehicle.leg + 1]
            if not self._room_behind(index, queues):
                continue
            others = [self.vehicles[i] for i in crossing.inside]
            crossed = [other.route[other.granted - 1] for other in others if other.route[other.granted - 2] != lane]
            if any(self._conflicts[turn, other] for other in crossed + held):
                held.append(turn)
                continue
            crossing.inside.append(index)
            crossing.waiting.pop(lane)
            vehicle.granted = vehicle.leg + 2
            self._exit_claims.setdefault(vehicle.route[vehicle.granted], []).append(index)

    def _lane_of_ego(self, queues: Queues) -> int:
        return next((lane for lane, queue in queues.items() if 0 in queue), -1)

    def _room_behind(self, index: int, queues: Queues) -> bool:
        """Whether the lane beyond the crossing has room for the vehicle and for those already bound there."""
        vehicle = self.vehicles[index]
        exit_lane = vehicle.route[vehicle.leg + 2]
        claims = self._exit_claims.get(exit_lane, [])
        needed = vehicle.length_m + 2 * STANDSTILL_GAP_M
        needed += sum(self.vehicles[i].length_m + 2 * STANDSTILL_GAP_M for i in claims)
        queue = [i for i in queues.get(exit_lane, []) if i not in claims]
        if not queue:
            return needed < self.streets.lanes[exit_lane].length_m
        last = self.vehicles[queue[-1]]
        free = last.along_m - last.starts[self._street_leg(last)] - last.length_m / 2 + 0.5 * last.speed_mps
        return free > needed

    def _acceleration(self, index: int, queues: Queues) -> float:
        vehicle = self.vehicles[index]
        wish = min(vehicle.cruise_mps, self._limits[vehicle.route[vehicle.leg]])
        free = ACCELERATION * (1 - (vehicle.speed_mps / wish) ** 4)
        accelerations = [free, self._ahead_of_turn(vehicle)]
        gap, speed = self._leader(index, queues)
        if gap < LOOK_AHEAD_M:
            accelerations.append(_follow(vehicle.speed_mps, wish, gap, speed))
        if vehicle.granted <= vehicle.leg:
            stop = vehicle.starts[vehicle.leg + 1] - vehicle.along_m - vehicle.length_m / 2
            if stop < LOOK_AHEAD_M:
                accelerations.append(_follow(vehicle.speed_mps, wish, stop + STANDSTILL_GAP_M - 0.3, 0.0))
        return float(np.clip(min(accelerations), -9.0, ACCELERATION))

    def _ahead_of_turn(self, vehicle: Vehicle) -> float:
        """Return the braking that brings it down to the next lane's speed by the time it is there."""
        limit = self._limits[vehicle.route[vehicle.leg + 1]]
        left = max(vehicle.starts[vehicle.leg + 1] - vehicle.along_m, 0.1)
        if vehicle.speed_mps <= limit:
            return ACCELERATION
        needed = (vehicle.speed_mps**2 - limit**2) / (2 * left)
        return -needed if needed > 0.6 * BRAKING else ACCELERATION

    def _leader(self, index: int, queues: Queues) -> tuple[float, float]:
        """Return gap (metres, bumper to bumper) and speed of the next vehicle ahead."""
        vehicle = self.vehicles[index]
        leg = self._street_leg(vehicle)
        nearest, speed = np.inf, 0.0
        for ahead in range(leg, min(leg + 3, len(vehicle.route))):
            lane = vehicle.route[ahead]
            if self.streets.lanes[lane].turn:
                continue
            for other in queues.get(lane, ()):
                leader = self.vehicles[other]
                position = vehicle.starts[ahead] + leader.along_m - leader.starts[self._street_leg(leader)]
                # One behind on the same lane, or on a turn of another lane's, is no leader.
                if other == index or (position, -other) <= (vehicle.along_m, -index):
                    continue
                gap = position - vehicle.along_m - (leader.length_m + vehicle.length_m) / 2
                if gap < nearest:
                    nearest, speed = gap, leader.speed_mps
            if nearest < np.inf:
                break
        return float(nearest), speed


def _follow(speed: float, wish: float, gap: float, leader_speed: float) -> float:
    """Return the intelligent driver model's acceleration behind a leader."""
    approach = speed * (speed - leader_speed) / (2 * np.sqrt(ACCELERATION * BRAKING))
    desired = STANDSTILL_GAP_M + max(0.0, speed * HEADWAY_S + approach)
    return ACCELERATION * (1 - (speed / wish) ** 4 - (desired / max(gap, 0.1)) ** 2)


def _speed_limit(lane: Lane) -> float:
    """Return the speed that a lane can be driven at, m/s."""
    if not lane.turn or lane.turning_rad < 0.2:
        return 14.0
    return float(np.sqrt(LATERAL_ACCELERATION * lane.length_m / lane.turning_rad))


def _find_conflicts(streets: Streets) -> NDArray[np.bool_]:
    """Return (L, L) which turns of one crossing come nearer to each other than CLEARANCE_M."""
    conflicts = np.zeros((len(streets.lanes),) * 2, np.bool_)
    turns = [(index, lane) for index, lane in enumerate(streets.lanes) if lane.turn]
    for a, one in turns:
        for b, other in turns:
            if one.start == other.start:
                apart = np.linalg.norm(one.path[:, None] - other.path[None], axis=-1).min()
                conflicts[a, b] = apart < CLEARANCE_M
    return conflicts


@dataclass(frozen=True)
class Walk:
    """A pedestrian's way round a block.

    Attributes:
        loop: (P, 2) closed way, metres, the first point repeated at the end.
        start_m: where on the loop it is at frame 0.
        speed_mps: along the loop; negative walks it backwards, 0 stands.
        heading_rad: which way one who stands looks.
    """

    loop: NDArray[np.float64]
    start_m: float
    speed_mps: float
    heading_rad: float = 0.0

    def pose(self, time_s: float, height_m: float) -> Transform:
        """Return world_T_pedestrian at a time, feet at a height."""
        stations = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.loop, axis=0), axis=1))])
        along = (self.start_m + self.speed_mps * time_s) % stations[-1]
        point = [np.interp(along, stations, self.loop[:, axis]) for axis in (0, 1)]
        heading = self.heading_rad
        if self.speed_mps:
            step = min(int(np.searchsorted(stations, along, side="right")), len(stations) - 1)
            ahead = (self.loop[step] - self.loop[step - 1]) * np.sign(self.speed_mps)
            heading = float(np.arctan2(ahead[1], ahead[0]))
        return translation((*point, height_m)) @ rotation_z(heading)


def place_vehicles(
    rng: np.random.Generator, streets: Streets, lengths_m: list[float], ego_lane: int, ego_along_m: float
) -> list[Vehicle]:
    """Put vehicles on the lanes, clear of each other; the first, the ego vehicle, where it is told, at rest."""
    lanes = [i for i, lane in enumerate(streets.lanes) if not lane.turn]
    taken: dict[int, list[tuple[float, float]]] = {}
    vehicles: list[Vehicle] = []
    for length in lengths_m:
        turns = rng.random(997)
        cruise = float(rng.uniform(6.0, 12.0))
        for _ in range(1000):
            lane = ego_lane if not vehicles else lanes[int(rng.integers(len(lanes)))]
            room = streets.lanes[lane].length_m
            along = ego_along_m if not vehicles else float(rng.uniform(length, room - length / 2 - 1))
            apart = all(abs(along - other) > (length + size) / 2 + 8.0 for other, size in taken.get(lane, []))
            if apart:
                break
        else:
            continue  # the town is full
        taken.setdefault(lane, []).append((along, length))
        to_stop_line = max(streets.lanes[lane].length_m - along - length / 2 - 1.0, 0.0)
        speed = 0.0 if not vehicles else min(cruise, 4.0, float(np.sqrt(0.8 * BRAKING * to_stop_line)))
        vehicles.append(Vehicle(length, 8.5 if not vehicles else cruise, turns, [lane], [0.0], along, speed))
    return vehicles


def draw_walks(rng: np.random.Generator, blocks: tuple[Block, ...], count: int) -> list[Walk]:
    """Draw pedestrians: most walk round a block, the two directions each on their own half of the sidewalk, some stand.

    Those who share a block and a direction walk at one speed, so nobody walks through anybody.
    """
    speeds = rng.uniform(1.0, 1.8, (len(blocks), 2))
    walks: list[Walk] = []
    taken: dict[tuple[int, int], list[float]] = {}
    while len(walks) < count:
        which, way = int(rng.integers(len(blocks))), int(rng.integers(3))
        block = blocks[which]
        offset = HALF_ROAD_M + (1.1, 1.75, 2.3)[way]
        loop = closed(block.outline.at(offset))
        length = float(np.linalg.norm(np.diff(loop, axis=0), axis=1).sum())
        start = float(rng.uniform(0, length))
        if any(min(abs(start - other), length - abs(start - other)) < 1.0 for other in taken.get((which, way), [])):
            continue
        taken.setdefault((which, way), []).append(start)
        speed = float(speeds[which, way]) * (1, -1)[way] if way < 2 else 0.0
        walks.append(Walk(loop, start, speed, float(rng.uniform(-np.pi, np.pi))))
    return walks
