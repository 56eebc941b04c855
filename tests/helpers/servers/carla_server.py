"""A stand-in for a CARLA server that keeps the contract of the API, as far as recording uses it.

Locations, rotations and settings are those of the official package. As on a server, sensors deliver
their measurements from other threads, after the tick and in any order; spawning at an occupied
place returns None; a call on a destroyed actor raises RuntimeError; and `tick` fails in
asynchronous mode. Vehicles on autopilot drive straight ahead at 5 m/s, and the ground is level. A
semantic LiDAR sees the ground around it, and a cloud of points in every vehicle and pedestrian
within its range, also in its own vehicle.
"""

from __future__ import annotations

import random
import threading
import time
from types import SimpleNamespace

import carla
import numpy as np
from carlasc_recorders.carla.server import DETECTION

SPEED_M_S = 5.0
ROAD, VEHICLE, PEDESTRIAN = "road", "vehicle", "pedestrian"
TAGS = {  # by whether the classes are numbered as from 0.9.14 on
    False: {ROAD: 7, VEHICLE: 10, PEDESTRIAN: 4},
    True: {ROAD: 1, VEHICLE: 14, PEDESTRIAN: 12},
}


class Blueprint:
    def __init__(self, name, attributes=("role_name",)):
        self.id, self.attributes = name, dict.fromkeys(attributes)

    def has_attribute(self, name):
        return name in self.attributes

    def set_attribute(self, name, value):
        if name not in self.attributes:
            raise IndexError(f"attribute {name} not found")
        if not isinstance(value, str):
            raise TypeError("attributes are strings")
        self.attributes[name] = value


LIDAR = (
    "channels",
    "range",
    "points_per_second",
    "rotation_frequency",
    "upper_fov",
    "lower_fov",
    "sensor_tick",
)
CAMERA = ("image_size_x", "image_size_y", "fov", "sensor_tick")


def blueprint_library():
    return [
        Blueprint("vehicle.tesla.model3"),
        Blueprint("vehicle.audi.tt"),
        Blueprint("walker.pedestrian.0001", ()),
        Blueprint("controller.ai.walker", ()),
        Blueprint("sensor.lidar.ray_cast_semantic", LIDAR),
        *(
            Blueprint(f"sensor.camera.{kind}", CAMERA)
            for kind in ("rgb", "semantic_segmentation", "depth")
        ),
    ]


class Actor:
    def __init__(self, world, blueprint, transform, parent):
        self.world, self.type_id, self.parent = world, blueprint.id, parent
        self.attributes = dict(blueprint.attributes)
        self.id = world.server.next_id()
        self.is_alive, self.driving, self.callback, self.started = True, False, None, False
        self.destination, self.max_speed = None, None
        self.offset = transform if parent else None
        self.transform = transform

    def _alive(self):
        if not self.is_alive:
            raise RuntimeError(
                "trying to operate on a destroyed actor; an actor's function was called, but the "
                "actor is already destroyed."
            )

    def get_transform(self):
        self._alive()
        if self.parent is None:
            return self.transform
        place = np.array(self.parent.get_transform().get_matrix()) @ np.array(
            self.offset.get_matrix()
        )
        turn = self.parent.get_transform().rotation
        return carla.Transform(
            carla.Location(*map(float, place[:3, 3])),
            carla.Rotation(self.offset.rotation.pitch, turn.yaw, 0.0),
        )

    def velocity(self):
        forward = self.transform.get_forward_vector()
        speed = SPEED_M_S if self.driving else 0.0
        return carla.Vector3D(forward.x * speed, forward.y * speed, forward.z * speed)

    def set_autopilot(self, on, port=8000):
        self._alive()
        assert port in self.world.server.managers, "the traffic manager was not asked for"
        self.driving = on

    def start(self):
        self._alive()
        assert self.world.server.ticks > 0, "a controller is started before the world has seen it"
        self.started = True

    def stop(self):
        self._alive()
        self.callback, self.started = None, False

    def go_to_location(self, location):
        assert isinstance(location, carla.Location) and self.started
        self.destination = location

    def set_max_speed(self, speed):
        assert isinstance(speed, float) and 0 < speed < 5
        self.max_speed = speed

    def listen(self, callback):
        self._alive()
        self.callback = callback

    def destroy(self):
        self._alive()
        if self.callback is not None:
            self.world.server.complaints.append(f"{self.type_id} was destroyed while it listened")
        if self.world.server.cannot_destroy and self.type_id.startswith("vehicle."):
            raise RuntimeError("time-out while waiting for the simulator")
        self.is_alive = False
        return True

    def distance_to(self, location):
        return self.get_transform().location.distance(location)


class World:
    def __init__(self, server, town):
        self.server, self.town, self.actors = server, town, []
        self.settings = carla.WorldSettings()
        for place in ((100.0, 100.0), (120.0, 100.0)):  # traffic lights are actors too
            self.actors.append(
                Actor(
                    self,
                    Blueprint("traffic.traffic_light", ()),
                    carla.Transform(carla.Location(*place, 4.0)),
                    None,
                )
            )

    def get_settings(self):
        settings = carla.WorldSettings()
        for name in ("synchronous_mode", "fixed_delta_seconds", "no_rendering_mode"):
            setattr(settings, name, getattr(self.settings, name))
        return settings

    def apply_settings(self, settings):
        self.settings = settings
        return self.server.ticks

    def get_actors(self):
        return [actor for actor in self.actors if actor.is_alive]

    def get_blueprint_library(self):
        return SimpleNamespace(
            filter=lambda pattern: [
                b for b in blueprint_library() if b.id.startswith(pattern.removesuffix("*"))
            ]
        )

    def get_map(self):
        points = [
            carla.Transform(
                carla.Location(8.0 * (i % 5), 8.0 * (i // 5), 0.3),
                carla.Rotation(0.0, 90.0 * (i % 4), 0.0),
            )
            for i in range(self.server.places)
        ]
        return SimpleNamespace(name=self.town, get_spawn_points=lambda: points)

    def get_random_location_from_navigation(self):
        at = self.server.navigation
        return (
            None
            if at.random() < 0.2
            else carla.Location(at.uniform(0, 60), at.uniform(-30, -5), 1.0)
        )

    def set_pedestrians_seed(self, seed):
        self.server.navigation, self.server.pedestrians_seed = random.Random(seed), seed

    def try_spawn_actor(self, blueprint, transform, attach_to=None):
        assert isinstance(transform, carla.Transform)
        self.server.check_failure("spawn")
        if attach_to is None and any(
            a.distance_to(transform.location) < 2.0
            for a in self.get_actors()
            if a.type_id[:7] in ("vehicle", "walker.")
        ):
            return None
        actor = Actor(self, blueprint, transform, attach_to)
        self.actors.append(actor)
        return actor

    def get_snapshot(self):
        alive = {actor.id: actor for actor in self.get_actors()}
        return SimpleNamespace(
            find=lambda i: SimpleNamespace(get_velocity=alive[i].velocity) if i in alive else None
        )

    def tick(self, seconds=10.0):
        if not self.settings.synchronous_mode:
            raise RuntimeError(
                f"time-out of {seconds * 1000:.0f}ms while waiting for the simulator"
            )
        assert self.settings.fixed_delta_seconds == 0.1
        self.server.check_failure("tick")
        self.server.ticks += 1
        for actor in self.get_actors():
            if actor.driving:
                v = actor.velocity()
                at = actor.transform.location
                drift = self.server.drift
                actor.transform = carla.Transform(
                    carla.Location(at.x + 0.1 * v.x + drift, at.y + 0.1 * v.y, at.z),
                    actor.transform.rotation,
                )
        sensors = [actor for actor in self.get_actors() if actor.callback is not None]
        random.shuffle(sensors)
        measured = [(sensor.callback, self.server.measure(sensor)) for sensor in sensors]
        threading.Thread(target=self._deliver, args=(measured,), daemon=True).start()
        return self.server.ticks

    def _deliver(self, measured):
        for callback, data in measured:
            if not self.server.silent:
                time.sleep(0.0002)
                callback(data)


class FakeServer:
    """Replaces the module `carla`, and is the server at the same time.

    Attributes:
        fail_at: (call, number of calls that succeed, error): makes `tick` or `spawn` fail.
        places: number of spawn points.
        silent: sensors deliver nothing.
        cannot_destroy: vehicles cannot be destroyed.
        drift: metres per tick by which the physics differ.
    """

    def __init__(self, version="0.9.13"):
        self.version, self.places, self.fail_at = version, 20, None
        self.silent, self.cannot_destroy, self.drift = False, False, 0.0
        self.ticks, self.last_id, self.complaints, self.managers = 0, 200, [], {}
        self.navigation, self.pedestrians_seed = random.Random(0), None
        self._calls = {"tick": 0, "spawn": 0}
        self.worlds = [World(self, "Town10HD_Opt")]
        for name in ("Transform", "Location", "Rotation"):
            setattr(self, name, getattr(carla, name))

    def Client(self, host, port):
        assert (host, port) == ("127.0.0.1", 2000)
        return SimpleNamespace(
            set_timeout=lambda seconds: None,
            get_server_version=lambda: self.version,
            get_available_maps=lambda: ["/Game/Carla/Maps/Town01", "/Game/Carla/Maps/Town10HD_Opt"],
            get_world=lambda: self.worlds[-1],
            load_world=self._load,
            get_trafficmanager=lambda port: self.managers.setdefault(port, Manager()),
        )

    def _load(self, town):
        for actor in self.worlds[-1].get_actors():
            actor.is_alive = False
        self.worlds.append(World(self, town))
        return self.worlds[-1]

    def next_id(self):
        self.last_id += 1
        return self.last_id

    def check_failure(self, what):
        self._calls[what] += 1
        if self.fail_at and self.fail_at[0] == what and self._calls[what] > self.fail_at[1]:
            raise self.fail_at[2]

    @property
    def left_behind(self):
        """Types of the actors that were spawned and not destroyed."""
        return [
            a.type_id
            for world in self.worlds
            for a in world.actors
            if a.is_alive and not a.type_id.startswith("traffic.")
        ]

    def measure(self, sensor):
        common = {
            "frame": self.ticks,
            "timestamp": 3.0 + 0.1 * self.ticks,
            "transform": sensor.get_transform(),
        }
        if sensor.type_id.startswith("sensor.camera"):
            width, height = (
                int(sensor.attributes["image_size_x"]),
                int(sensor.attributes["image_size_y"]),
            )
            pixels = np.zeros((height, width, 4), np.uint8)
            pixels[..., :] = (250, 120, 10, 255)  # BGRA: a blue
            if sensor.type_id.endswith("depth"):
                pixels[..., :3] = (0, 128, 64)  # 64 + 128 * 256 of 2**24 - 1, a kilometre
            return SimpleNamespace(
                raw_data=memoryview(pixels.tobytes()), width=width, height=height, **common
            )
        return SimpleNamespace(raw_data=memoryview(self.sweep(sensor).tobytes()), **common)

    def sweep(self, sensor):
        """Return the detections of a LiDAR in its own frame."""
        rng = np.random.default_rng(sensor.id)
        tags = TAGS[tuple(map(int, self.version.split("-")[0].split("."))) >= (0, 9, 14)]
        at = sensor.get_transform()
        parts = [
            (
                0,
                tags[ROAD],
                np.column_stack(
                    [rng.uniform(-20, 20, (40, 2)) + (at.location.x, at.location.y), np.zeros(40)]
                ),
            )
        ]
        for actor in sensor.world.get_actors():
            kind = {"vehicle": VEHICLE, "walker.": PEDESTRIAN}.get(actor.type_id[:7])
            if kind and actor.distance_to(at.location) < float(sensor.attributes["range"]):
                place = actor.get_transform().location
                parts.append(
                    (
                        actor.id,
                        tags[kind],
                        rng.uniform(-0.4, 0.4, (10, 3)) + (place.x, place.y, place.z),
                    )
                )
        sensor_T_world = np.array(at.get_inverse_matrix())
        found = []
        for actor_id, tag, points in parts:
            records = np.zeros(len(points), DETECTION)
            local = points @ sensor_T_world[:3, :3].T + sensor_T_world[:3, 3]
            records["x"], records["y"], records["z"] = local.T
            records["actor"], records["tag"], records["cos"] = actor_id, tag, 0.5
            found.append(records)
        return np.concatenate(found)


class Manager:
    def __init__(self):
        self.synchronous, self.was_synchronous, self.seed = False, False, None

    def set_synchronous_mode(self, on):
        self.synchronous, self.was_synchronous = on, self.was_synchronous or on

    def set_random_device_seed(self, seed):
        self.seed = seed
