"""The actors on the server: the ego vehicle, vehicles on autopilot, and pedestrians that walk to random destinations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from carlasc.captures.carla.server import Server
from carlasc.errors import MissingDataError

EGO_BLUEPRINTS = ("vehicle.tesla.model3", "vehicle.lincoln.mkz_2017", "vehicle.lincoln.mkz_2020")
WALKING_MPS = 1.4  # mean speed of the pedestrians
_ATTEMPTS = 4  # positions that are tried per pedestrian: many are occupied or cannot be reached


@dataclass(frozen=True)
class Actors:
    """CARLA's actors that move.

    Attributes:
        ego: the vehicle with the sensors.
        vehicles: the other vehicles.
        walkers: the pedestrians.
    """

    ego: Any
    vehicles: tuple[Any, ...]
    walkers: tuple[Any, ...]


def spawn_actors(server: Server, number: int, port: int, rng: np.random.Generator) -> Actors:
    """Spawn the ego vehicle, other vehicles and pedestrians.

    Args:
        server: the server, with its town loaded.
        number: number of other vehicles, and of pedestrians. Fewer are spawned where there is no room for more.
        port: port of the traffic manager.
        rng: source of the random numbers.

    Raises:
        MissingDataError: the town has no vehicles, or no room for the ego vehicle.
        ServerError: the server does not answer.
    """
    spawn_points = server.spawn_points()
    free = [spawn_points[i] for i in rng.permutation(len(spawn_points))]
    blueprints = server.blueprints("vehicle.*")
    by_name = {str(blueprint.id): blueprint for blueprint in blueprints}
    ego_blueprints = [by_name[name] for name in EGO_BLUEPRINTS if name in by_name] or blueprints
    if not ego_blueprints or not free:
        raise MissingDataError(
            server.where, expected="vehicles and places for them", found="none", advice="try another `town`"
        )

    ego = None
    while ego is None and free:
        ego = _spawn_vehicle(server, ego_blueprints[0], free.pop(), "hero", port)
    vehicles: list[Any] = []
    while free and len(vehicles) < number:
        vehicle = _spawn_vehicle(server, blueprints[rng.integers(len(blueprints))], free.pop(), "autopilot", port)
        vehicles += [] if vehicle is None else [vehicle]
    if ego is None:
        raise MissingDataError(server.where, expected="a free place for the ego vehicle", found="none")
    return Actors(ego, tuple(vehicles), tuple(_spawn_walkers(server, number, rng)))


def _spawn_vehicle(server: Server, blueprint: Any, transform: Any, role: str, port: int) -> Any | None:
    """Spawn a vehicle on autopilot. Return None where there is no room for it."""
    if blueprint.has_attribute("role_name"):
        blueprint.set_attribute("role_name", role)
    vehicle = server.spawn(blueprint, transform)
    if vehicle is not None:
        vehicle.set_autopilot(True, port)
    return vehicle


def _spawn_walkers(server: Server, number: int, rng: np.random.Generator) -> list[Any]:
    """Spawn pedestrians, each with a controller that walks it to a random destination."""
    blueprints = server.blueprints("walker.pedestrian.*")
    controller_blueprints = server.blueprints("controller.ai.walker")
    walkers: list[Any] = []
    controllers: list[Any] = []
    for _ in range(_ATTEMPTS * number if blueprints and controller_blueprints else 0):
        if len(walkers) == number:
            break
        start = server.random_sidewalk_location()
        walker = None
        if start is not None:
            walker = server.spawn(blueprints[rng.integers(len(blueprints))], server.transform_at(start))
        if walker is None:
            continue
        walkers.append(walker)
        controller = server.spawn(controller_blueprints[0], server.transform(), parent=walker, before_destroy="stop")
        controllers += [] if controller is None else [controller]
    server.tick()  # a controller can be started only after the world's first tick with it
    for controller in controllers:
        controller.start()
        destination = server.random_sidewalk_location()
        if destination is not None:
            controller.go_to_location(destination)
        controller.set_max_speed(float(np.clip(rng.normal(WALKING_MPS, 0.2), 0.8, 2.2)))
    return walkers
