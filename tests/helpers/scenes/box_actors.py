"""Scans of box-shaped actors with known motion, made without the simulator."""

from __future__ import annotations

import numpy as np

from carlasc.core.geometry import invert, rotate_vectors, rotation_z, transform_points, translation
from carlasc.core.scans import Scan

PERIOD_S = 0.1


def box_surface(size, count, seed=0):
    """Return (count, 3) points on the surface of a box, actor frame.

    Its lower face, which has no points, is at z = 0.
    """
    rng = np.random.default_rng(seed)
    length, width, height = size
    areas = np.array(
        [width * height, width * height, length * height, length * height, length * width]
    )
    side = rng.choice(5, count, p=areas / areas.sum())
    points = rng.uniform(-0.5, 0.5, (count, 3)) * size
    points[side == 0, 0], points[side == 1, 0] = -length / 2, length / 2
    points[side == 2, 1], points[side == 3, 1] = -width / 2, width / 2
    points[side == 4, 2] = height / 2
    return points + (0, 0, height / 2)


class MovingBox:
    """A box-shaped actor that moves with a constant yaw rate.

    Attributes:
        speed: speed along its heading in m/s, or a function of the time that returns it.
    """

    def __init__(
        self,
        start,
        heading=0.0,
        speed=8.0,
        yaw_rate=0.0,
        size=(4.5, 1.9, 1.5),
        label=10,
        instance=7,
    ):
        self.start, self.heading, self.speed, self.yaw_rate = (
            np.array(start, float),
            heading,
            speed,
            yaw_rate,
        )
        self.size, self.label, self.instance = size, label, instance

    def speed_at(self, time_s):
        return self.speed(time_s) if callable(self.speed) else self.speed

    def pose(self, time_s):
        steps = np.linspace(0, time_s, 400)
        yaw = self.heading + self.yaw_rate * steps
        speed = np.array([self.speed_at(t) for t in steps])

        def middle(values):
            return np.concatenate([[0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(steps))])

        x, y = middle(speed * np.cos(yaw))[-1], middle(speed * np.sin(yaw))[-1]
        return translation((self.start[0] + x, self.start[1] + y, self.start[2])) @ rotation_z(
            yaw[-1]
        )

    def velocity(self, time_s):
        yaw = self.heading + self.yaw_rate * time_s
        return self.speed_at(time_s) * np.array([np.cos(yaw), np.sin(yaw), 0])


def scan_of(actors, frame, world_T_sensor=None, count=600, view_from=None, noise_m=0.01):
    """Return the scan of actors in a frame, sensor frame.

    With `view_from`, a point, only the sides that face it have points.
    """
    world_T_sensor = np.eye(4) if world_T_sensor is None else world_T_sensor
    time_s = frame * PERIOD_S
    rng = np.random.default_rng(1000 + frame)
    points, labels, flow, instances = [], [], [], []
    for number, actor in enumerate(actors):
        body = box_surface(actor.size, count, seed=frame * 31 + number)
        if view_from is not None:
            eye = transform_points(invert(actor.pose(time_s)), np.array([view_from], float))[0]
            body = body[
                (
                    (body - (0, 0, actor.size[2] / 2)) * np.sign(eye) > 0.49 * np.array(actor.size)
                ).any(axis=1)
            ]
        world = transform_points(actor.pose(time_s), body) + rng.uniform(
            -noise_m, noise_m, body.shape
        )
        points.append(transform_points(invert(world_T_sensor), world))
        labels.append(np.full(len(body), actor.label, np.uint32))
        instances.append(np.full(len(body), actor.instance, np.uint32))
        velocity = rotate_vectors(invert(world_T_sensor), actor.velocity(time_s)[None])
        flow.append(np.repeat(velocity, len(body), axis=0))
    return Scan(
        np.concatenate(points).astype(np.float32),
        np.concatenate(labels),
        np.concatenate(flow).astype(np.float32),
        np.concatenate(instances),
    )
