"""Who drives and walks: the ego vehicle, vehicles on autopilot, pedestrians with somewhere to go."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from carlasc.captures.carla.server import Server
from carlasc.errors import MissingDataError

EGO_BLUEPRINTS = ("vehicle.tesla.model3", "vehicle.lincoln.mkz_2017", "vehicle.lincoln.mkz_2020")
WALKING_M_S = 1.4
_TRIES = 4  # places that are tried for a pedestrian: many are taken, or not reachable


@dataclass(frozen=True)
class Traffic:
    """Actors that move.

    Attributes:
        ego: the vehicle that carries the sensors.
        vehicles: the others.
        walkers: pedestrians.
    """

    ego: Any
    vehicles: tuple[Any, ...]
    walkers: tuple[Any, ...]


def populate(server: Server, count: int, port: int, rng: np.random.Generator) -> Traffic:
    """Spawn the ego vehicle, `count` vehicles and as many pedestrians, or as many as find room.

    Raises:
        MissingDataError: there is no room for the ego vehicle.
    """
    starts = server.spawn_points()
    order = [starts[i] for i in rng.permutation(len(starts))]
    vehicles = server.blueprints("vehicle.*")
    named = {str(blueprint.id): blueprint for blueprint in vehicles}
    preferred = [named[name] for name in EGO_BLUEPRINTS if name in named] or vehicles
    if not preferred or not order:
        raise MissingDataError(
            f"CARLA at {server.where}", expected="vehicles and places for them", found="none", advice="another town?"
        )

    ego = None
    while ego is None and order:
        ego = _spawn_vehicle(server, preferred[0], order.pop(), "hero", port)
    others: list[Any] = []
    while order and len(others) < count:
        vehicle = _spawn_vehicle(server, vehicles[rng.integers(len(vehicles))], order.pop(), "autopilot", port)
        others += [] if vehicle is None else [vehicle]
    if ego is None:
        raise MissingDataError(f"CARLA at {server.where}", expected="a free place for the ego vehicle", found="none")
    return Traffic(ego, tuple(others), tuple(_spawn_walkers(server, count, rng)))


def _spawn_vehicle(server: Server, blueprint: Any, place: Any, role: str, port: int) -> Any | None:
    if blueprint.has_attribute("role_name"):
        blueprint.set_attribute("role_name", role)
    vehicle = server.spawn(blueprint, place)
    if vehicle is not None:
        vehicle.set_autopilot(True, port)
    return vehicle


def _spawn_walkers(server: Server, count: int, rng: np.random.Generator) -> list[Any]:
    blueprints = server.blueprints("walker.pedestrian.*")
    (controller_blueprint, *_) = server.blueprints("controller.ai.walker") or [None]
    walkers: list[Any] = []
    controllers: list[Any] = []
    for _ in range(_TRIES * count if blueprints and controller_blueprint else 0):
        if len(walkers) == count:
            break
        place = server.walkable_place()
        walker = None if place is None else server.spawn(blueprints[rng.integers(len(blueprints))], server.at(place))
        if walker is None:
            continue
        walkers.append(walker)
        controller = server.spawn(controller_blueprint, server.transform(), parent=walker, undo="stop")
        controllers += [] if controller is None else [controller]
    server.tick()  # controllers answer only once the world has seen them
    for controller in controllers:
        controller.start()
        goal = server.walkable_place()
        if goal is not None:
            controller.go_to_location(goal)
        controller.set_max_speed(float(np.clip(rng.normal(WALKING_M_S, 0.2), 0.8, 2.2)))
    return walkers
