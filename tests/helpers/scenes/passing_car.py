"""A street with a parked car and a passing car, scanned from a moving sensor.

All positions are known at any time.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from helpers.scenes.box_street import BUILDING, POLE, SENSOR_HEIGHT_M, VEHICLE, Street

from carlasc import Grid, GridSpec
from carlasc.core.geometry import invert, relative_to, rotate_vectors, transform_points, translation
from carlasc.core.tables import CARLA
from carlasc.groundtruth import Observation, count_votes
from carlasc.storage import FolderSink, layout

FRAMES = 41
SPEED_M_S = 10.0
SPEC = GridSpec.published().with_resolution(0.4)
CAR = (4.4, 1.9, 1.5)


def street(frame: int) -> Street:
    """Return two houses, a pole, a parked car, and (the last box) a car that overtakes on the
    right.
    """
    x = -20.0 + SPEED_M_S * frame * 0.1
    boxes = [
        ((-15, -14, 0), (10, -9, 6), BUILDING),
        ((0, 9, 0), (20, 14, 5), BUILDING),
        ((6, 7, 0), (6.3, 7.3, 4), POLE),
        ((8, -5.9, 0), (12.4, -4, 1.5), VEHICLE),
        ((x - CAR[0] / 2, 2.6, 0.25), (x + CAR[0] / 2, 2.6 + CAR[1], CAR[2]), VEHICLE),
    ]
    lower, upper, labels = zip(*boxes, strict=True)
    return Street(np.array(lower, float), np.array(upper, float), np.array(labels, np.uint32))


def sensor_pose(frame: int) -> np.ndarray:
    """Return (4, 4) world_T_sensor. The sensor moves slowly forward."""
    return translation((-3.0 + 0.1 * frame, 0.0, SENSOR_HEIGHT_M))


def scan(
    frame: int, pose: np.ndarray, columns: int = 500
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points, their labels, and which of them are on the passing car."""
    here = street(frame)
    points, labels = here.scan(pose, np.random.default_rng(frame), channels=48, columns=columns)
    world = transform_points(pose, points)
    moving = ((world > here.lower[-1] - 0.05) & (world < here.upper[-1] + 0.05)).all(axis=1) & (
        labels == VEHICLE
    )
    return points, labels, moving


def write_sequence(
    folder: Path,
    fields: tuple[str, ...] = ("labels", "flow"),
    frames: int = FRAMES,
    poses: bool = True,
) -> Path:
    """Write the drive as a sequence. Return the folder of the sequence."""
    writer = FolderSink(folder).sequence("Val/Street/cartesian")
    trajectory = np.stack([sensor_pose(frame) for frame in range(frames)])
    if poses:
        writer.write_document(
            layout.POSES, layout.encode_poses(relative_to(trajectory[0], trajectory))
        )
    writer.write_document(layout.TIMES, layout.encode_times(np.arange(frames) * 0.1))
    for frame in range(frames):
        points, labels, moving = scan(frame, trajectory[frame])
        velocity = rotate_vectors(invert(trajectory[frame]), np.array([[SPEED_M_S, 0, 0]]))[0]
        arrays = {
            "labels": labels,
            "flow": np.where(moving[:, None], velocity, 0).astype(np.float32),
            "instances": np.where(moving, 9, np.where(labels == VEHICLE, 4, 0)).astype(np.uint32),
        }
        writer.write("points", frame, np.column_stack([points, np.zeros(len(points), np.float32)]))
        for field in fields:
            writer.write(field, frame, arrays[field])
    return folder / "Val" / "Street"


def reference(frame: int, spec: GridSpec = SPEC) -> Grid:
    """Return the grid of many sensors around the scene at the instant of a frame."""
    grid_T_world = invert(sensor_pose(frame))
    observations = []
    rng = np.random.default_rng(7)
    for _ in range(24):
        place = (*rng.uniform(-18, 18, 1), *rng.uniform(-8, 8, 1), rng.uniform(1.7, 4))
        points, labels, _ = scan(frame, translation(place), columns=300)
        observations.append(Observation(points, labels, grid_T_world @ translation(place)))
    return count_votes(observations, spec, CARLA).to_grid()
