"""The motion of vehicles: they follow each other along lanes and give way at crossings.

Vehicles follow the intelligent driver model (Treiber, Hennecke and Helbing, 2000). A vehicle enters
a crossing only if no vehicle on it has a conflicting turn, and if the next lane has room for it.
Therefore, vehicles do not collide or stop on a crossing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from carlasc.core.arrays import BoolArray, FloatArray
from carlasc.core.geometry import Transform, rotation_z, translation
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc_recorders.town.streets import Lane, Streets

ACCELERATION = 1.8  # m/s^2
BRAKING = 2.5  # m/s^2, comfortable
HEADWAY_S = 1.2
STANDSTILL_GAP_M = 2.0  # gap between vehicles at rest
LOOK_AHEAD_M = 60.0
LATERAL_ACCELERATION = 2.4  # m/s^2, maximum in a turn
CLEARANCE_M = 3.1  # minimum distance between the centre lines of turns without a conflict

Queues = dict[int, list[int]]
"""Indices of the vehicles on the lane of a street and on the turns that leave it, by lane, the
foremost vehicle first.
"""


@dataclass
class Vehicle:
    """The state of a moving vehicle.

    Attributes:
        length_m: length from bumper to bumper, metres.
        cruise_mps: speed on a free road, m/s.
        turns: random numbers in 0..1, one per crossing, which select its turns.
        route: indices of the lanes of its route so far, in order.
        starts: distance along the route at which each of these lanes starts, metres.
        along_m: distance of its centre along the route, metres.
        speed_mps: speed, m/s.
        leg: index in `route` of the lane of its centre.
        granted: index in `route` of the last lane that it may enter.
    """

    length_m: float
    cruise_mps: float
    turns: FloatArray
    route: list[int]
    starts: list[float]
    along_m: float
    speed_mps: float = 0.0
    leg: int = 0
    granted: int = 0


@dataclass
class _Crossing:
    # vehicles that were let in and have not left yet
    inside: list[int] = field(default_factory=list)
    # step of arrival of the first vehicle, by lane
    waiting: dict[int, int] = field(default_factory=dict)


class Traffic:
    """All moving vehicles, simulated frame by frame from frame 0.

    The states of all frames are cached.
    """

    def __init__(self, streets: Streets, vehicles: list[Vehicle]) -> None:
        """Start with the initial states of the vehicles. The first one is the ego vehicle."""
        self.streets = streets
        self.vehicles = vehicles
        self._conflicts = _find_conflicts(streets)
        self._crossings = [_Crossing() for _ in streets.nodes]
        # vehicles on a crossing that will enter a lane, by lane
        self._exit_claims: dict[int, list[int]] = {}
        self._limits = [_speed_limit(lane) for lane in streets.lanes]
        for vehicle in vehicles:
            self._extend_route(vehicle)
        self._states = [self._state()]

    def at(self, frame: int) -> tuple[FloatArray, FloatArray]:
        """Return the distance along its route, (V,) metres, and the speed, (V,) m/s, of every
        vehicle in a frame.
        """
        while len(self._states) <= frame:
            self._step(len(self._states))
            self._states.append(self._state())
        return self._states[frame]

    def _state(self) -> tuple[FloatArray, FloatArray]:
        rows = [(vehicle.along_m, vehicle.speed_mps) for vehicle in self.vehicles]
        along, speed = np.array(rows).reshape(-1, 2).T
        return along, speed

    def pose(self, index: int, along_m: float, wheelbase_m: float) -> Transform:
        """Return (4, 4) world_T_vehicle of a vehicle at a distance along its route.

        The centres of both axles are on the route.
        """
        vehicle = self.vehicles[index]
        front = self._point(vehicle, along_m + wheelbase_m / 2)
        rear = self._point(vehicle, along_m - wheelbase_m / 2)
        middle = (front + rear) / 2
        ahead = front - rear
        return translation((*middle, 0.0)) @ rotation_z(float(np.arctan2(ahead[1], ahead[0])))

    def _point(self, vehicle: Vehicle, along_m: float) -> FloatArray:
        leg = int(np.searchsorted(vehicle.starts, along_m, side="right")) - 1
        leg = min(max(leg, 0), len(vehicle.route) - 1)
        lane = self.streets.lanes[vehicle.route[leg]]
        local = along_m - vehicle.starts[leg]
        if local < 0:  # before the first lane, the route is extended straight
            return lane.path[0] + local * (lane.path[1] - lane.path[0]) / np.linalg.norm(
                lane.path[1] - lane.path[0]
            )
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
            self._extend_route(vehicle)

    def _extend_route(self, vehicle: Vehicle) -> None:
        """Extend the route to at least two crossings ahead."""
        while len(vehicle.route) < vehicle.leg + 6:
            lane = self.streets.lanes[vehicle.route[-1]]
            number = vehicle.turns[len(vehicle.route) % len(vehicle.turns)]
            vehicle.route.append(lane.exits[int(number * len(lane.exits))])
            vehicle.starts.append(vehicle.starts[-1] + lane.length_m)

    def _queues(self) -> Queues:
        """Return the vehicles on the lane of each street and on the turns that leave it, the
        foremost vehicle first.
        """
        queues: dict[int, list[tuple[float, int]]] = {}
        for index, vehicle in enumerate(self.vehicles):
            leg = self._street_leg(vehicle)
            position = vehicle.along_m - vehicle.starts[leg]
            queues.setdefault(vehicle.route[leg], []).append((-position, index))
        return {lane: [index for _, index in sorted(queue)] for lane, queue in queues.items()}

    def _street_leg(self, vehicle: Vehicle) -> int:
        """Return the index in the route of the lane of the street where the vehicle is; on a
        crossing, of the lane before it.
        """
        return vehicle.leg - self.streets.lanes[vehicle.route[vehicle.leg]].turn

    def _release_crossings(self) -> None:
        """Remove the vehicles that have left a crossing completely."""
        for crossing in self._crossings:
            crossing.inside = [index for index in crossing.inside if not self._has_left(index)]
        for claims in self._exit_claims.values():
            claims[:] = [index for index in claims if not self._has_left(index)]

    def _has_left(self, index: int) -> bool:
        vehicle = self.vehicles[index]
        return vehicle.along_m - vehicle.length_m / 2 > vehicle.starts[vehicle.granted] + 0.5

    def _grant_crossings(self, step: int, queues: Queues) -> None:
        """Let vehicles enter the crossings near them."""
        requests: dict[int, list[tuple[int, int]]] = {}
        for lane, queue in queues.items():
            index = next(
                (i for i in queue if self.vehicles[i].route[self.vehicles[i].leg] == lane), None
            )
            if index is None:
                continue
            vehicle = self.vehicles[index]
            node = self.streets.lanes[lane].end
            if vehicle.granted > vehicle.leg:
                continue  # already let in
            distance = vehicle.starts[vehicle.leg + 1] - vehicle.along_m - vehicle.length_m / 2
            if distance < 10.0 + vehicle.speed_mps**2 / (2 * BRAKING):
                self._crossings[node].waiting.setdefault(lane, step)
                requests.setdefault(node, []).append((lane, index))
        ego_lane = next((lane for lane, queue in queues.items() if 0 in queue), -1)
        for node in sorted(requests):
            self._grant(self._crossings[node], requests[node], ego_lane, queues)

    def _grant(
        self, crossing: _Crossing, requests: list[tuple[int, int]], ego_lane: int, queues: Queues
    ) -> None:
        """Let vehicles enter a crossing in the order of arrival, but vehicles on the lane of the
        ego vehicle first.

        Args:
            crossing: the crossing.
            requests: (lane, vehicle) of the vehicles near the crossing.
            ego_lane: the lane of the ego vehicle.
            queues: the vehicles of each lane.
        """
        held: list[int] = []  # turns of vehicles that arrived earlier and still wait
        for lane, index in sorted(
            requests, key=lambda item: (item[0] != ego_lane, crossing.waiting[item[0]], item[0])
        ):
            vehicle = self.vehicles[index]
            turn = vehicle.route[vehicle.leg + 1]
            if not self._has_room_beyond(index, queues):
                continue
            others = [self.vehicles[i] for i in crossing.inside]
            crossed = [
                other.route[other.granted - 1]
                for other in others
                if other.route[other.granted - 2] != lane
            ]
            if any(self._conflicts[turn, other] for other in crossed + held):
                held.append(turn)
                continue
            crossing.inside.append(index)
            crossing.waiting.pop(lane)
            vehicle.granted = vehicle.leg + 2
            self._exit_claims.setdefault(vehicle.route[vehicle.granted], []).append(index)

    def _has_room_beyond(self, index: int, queues: Queues) -> bool:
        """Whether the lane after the crossing has room for the vehicle, and for vehicles on the
        crossing that will enter it.
        """
        vehicle = self.vehicles[index]
        exit_lane = vehicle.route[vehicle.leg + 2]
        claims = self._exit_claims.get(exit_lane, [])
        needed = vehicle.length_m + 2 * STANDSTILL_GAP_M
        needed += sum(self.vehicles[i].length_m + 2 * STANDSTILL_GAP_M for i in claims)
        queue = [i for i in queues.get(exit_lane, []) if i not in claims]
        if not queue:
            return needed < self.streets.lanes[exit_lane].length_m
        last = self.vehicles[queue[-1]]
        free = (
            last.along_m
            - last.starts[self._street_leg(last)]
            - last.length_m / 2
            + 0.5 * last.speed_mps
        )
        return free > needed

    def _acceleration(self, index: int, queues: Queues) -> float:
        vehicle = self.vehicles[index]
        desired_mps = min(vehicle.cruise_mps, self._limits[vehicle.route[vehicle.leg]])
        free = ACCELERATION * (1 - (vehicle.speed_mps / desired_mps) ** 4)
        accelerations = [free, self._braking_before_turn(vehicle)]
        gap, speed = self._leader(index, queues)
        if gap < LOOK_AHEAD_M:
            accelerations.append(_follow(vehicle.speed_mps, desired_mps, gap, speed))
        if vehicle.granted <= vehicle.leg:
            stop = vehicle.starts[vehicle.leg + 1] - vehicle.along_m - vehicle.length_m / 2
            if stop < LOOK_AHEAD_M:
                accelerations.append(
                    _follow(vehicle.speed_mps, desired_mps, stop + STANDSTILL_GAP_M - 0.3, 0.0)
                )
        return float(np.clip(min(accelerations), -9.0, ACCELERATION))

    def _braking_before_turn(self, vehicle: Vehicle) -> float:
        """Return the acceleration that reaches the speed limit of the next lane at its start,
        m/s^2.
        """
        limit = self._limits[vehicle.route[vehicle.leg + 1]]
        distance = max(vehicle.starts[vehicle.leg + 1] - vehicle.along_m, 0.1)
        if vehicle.speed_mps <= limit:
            return ACCELERATION
        needed = (vehicle.speed_mps**2 - limit**2) / (2 * distance)
        return -needed if needed > 0.6 * BRAKING else ACCELERATION

    def _leader(self, index: int, queues: Queues) -> tuple[float, float]:
        """Return the gap to the next vehicle ahead, metres from bumper to bumper, and its speed,
        m/s.
        """
        vehicle = self.vehicles[index]
        leg = self._street_leg(vehicle)
        nearest = np.inf
        speed = 0.0
        for ahead in range(leg, min(leg + 3, len(vehicle.route))):
            lane = vehicle.route[ahead]
            if self.streets.lanes[lane].turn:
                continue
            for other in queues.get(lane, ()):
                leader = self.vehicles[other]
                position = (
                    vehicle.starts[ahead] + leader.along_m - leader.starts[self._street_leg(leader)]
                )
                # The leader is ahead of this vehicle. Equal positions are ordered by index.
                if other == index or (position, -other) <= (vehicle.along_m, -index):
                    continue
                gap = position - vehicle.along_m - (leader.length_m + vehicle.length_m) / 2
                if gap < nearest:
                    nearest = gap
                    speed = leader.speed_mps
            if nearest < np.inf:
                break
        return float(nearest), speed


def _follow(speed: float, desired: float, gap: float, leader_speed: float) -> float:
    """Return the acceleration of the intelligent driver model behind a leader, m/s^2.

    Speeds are in m/s, the gap in metres.
    """
    approach = speed * (speed - leader_speed) / (2 * np.sqrt(ACCELERATION * BRAKING))
    desired_gap = STANDSTILL_GAP_M + max(0.0, speed * HEADWAY_S + approach)
    return ACCELERATION * (1 - (speed / desired) ** 4 - (desired_gap / max(gap, 0.1)) ** 2)


def _speed_limit(lane: Lane) -> float:
    """Return the speed limit of a lane, m/s: in turns, from the lateral acceleration."""
    if not lane.turn or lane.turning_rad < 0.2:
        return 14.0
    return float(np.sqrt(LATERAL_ACCELERATION * lane.length_m / lane.turning_rad))


def _find_conflicts(streets: Streets) -> BoolArray:
    """Return (L, L) bool: whether two turns of one crossing are closer than CLEARANCE_M."""
    conflicts = np.zeros((len(streets.lanes),) * 2, np.bool_)
    turns = [(index, lane) for index, lane in enumerate(streets.lanes) if lane.turn]
    for a, one in turns:
        for b, other in turns:
            if one.start == other.start:
                apart = np.linalg.norm(one.path[:, None] - other.path[None], axis=-1).min()
                conflicts[a, b] = apart < CLEARANCE_M
    return conflicts


def place_vehicles(
    rng: np.random.Generator,
    streets: Streets,
    lengths_m: list[float],
    ego_lane: int,
    ego_along_m: float,
) -> list[Vehicle]:
    """Place vehicles on the lanes with gaps between them.

    Args:
        rng: source of the random numbers.
        streets: the street network.
        lengths_m: length of each vehicle, metres. The first is the ego vehicle, which starts at
            rest.
        ego_lane: index of the first lane of the ego vehicle.
        ego_along_m: start of the ego vehicle along this lane, metres.

    Returns:
        The vehicles for which there was room.
    """
    lanes = [i for i, lane in enumerate(streets.lanes) if not lane.turn]
    occupied: dict[int, list[tuple[float, float]]] = {}
    vehicles: list[Vehicle] = []
    for length in lengths_m:
        turns = rng.random(997)
        cruise = rng.uniform(6.0, 12.0)
        for _ in range(1000):
            lane = ego_lane if not vehicles else lanes[rng.integers(len(lanes))]
            room = streets.lanes[lane].length_m
            along = ego_along_m if not vehicles else rng.uniform(length, room - length / 2 - 1)
            apart = all(
                abs(along - other) > (length + size) / 2 + 8.0
                for other, size in occupied.get(lane, [])
            )
            if apart:
                break
        else:
            continue  # no free position was found
        occupied.setdefault(lane, []).append((along, length))
        to_stop_line = max(streets.lanes[lane].length_m - along - length / 2 - 1.0, 0.0)
        speed = (
            0.0 if not vehicles else min(cruise, 4.0, float(np.sqrt(0.8 * BRAKING * to_stop_line)))
        )
        vehicles.append(
            Vehicle(length, 8.5 if not vehicles else cruise, turns, [lane], [0.0], along, speed)
        )
    return vehicles
