"""A frame of many LiDARs in a street of flat walls and boxes, ray-cast with NumPy: the input of the
benchmarks of voting.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import translation
from carlasc.groundtruth.voting.ballot import Observation

GROUND_Z = -1.8  # below the ego sensor


def street_frame(
    sensors: int = 20,
    channels: int = 64,
    columns: int = 2048,
    seed: int = 0,
    distinct: int | None = None,
) -> list[Observation]:
    """Return the observations of several LiDARs at one instant: +2 to -25 degrees, 50 m, 2 cm
    noise. The first is the ego sensor.

    Args:
        sensors: number of LiDARs.
        channels: number of channels of each.
        columns: number of rays per channel.
        seed: seed of positions, scene and noise.
        distinct: number of scans that are ray-cast. The other sensors have other positions, but the
            points of one of these. None: all.
    """
    rng = np.random.default_rng(seed)
    boxes, box_labels = street_boxes(rng)
    places = np.column_stack([rng.uniform(-20, 20, (sensors, 2)), rng.uniform(1, 5, sensors) - 1.8])
    places[0] = 0
    scans = [
        cast(place, boxes, box_labels, channels, columns, rng)
        for place in places[: distinct or sensors]
    ]
    return [
        Observation(*scans[s % len(scans)], translation(place)) for s, place in enumerate(places)
    ]


def street_boxes(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return the (B, 2, 3) lower and upper corners of houses on both sides, cars, pedestrians,
    poles and trees, and their class ids.
    """
    kinds = [  # number, class id, half of the size, smallest and greatest |y|
        (14, 1, (5.0, 4.0, 6.0), 22.0, 28.0),
        (14, 10, (2.2, 0.9, 0.8), 2.0, 14.0),
        (12, 4, (0.3, 0.3, 0.9), 8.0, 20.0),
        (10, 5, (0.1, 0.1, 3.0), 10.0, 18.0),
        (12, 9, (1.5, 1.5, 2.5), 15.0, 20.0),
    ]
    boxes, labels = [], []
    for count, label, half, near, far in kinds:
        y = rng.uniform(near, far, count) * rng.choice([-1, 1], count)
        centres = np.column_stack(
            [rng.uniform(-45, 45, count), y, np.full(count, GROUND_Z + half[2])]
        )
        boxes.append(np.stack([centres - half, centres + half], axis=1))
        labels += [label] * count
    walls = [
        [[-60, -30, -2], [60, -29, 12]],
        [[-60, 29, -2], [60, 30, 12]],
        [[-46, -30, -2], [-45, 30, 12]],
    ]
    boxes.append(np.array([*walls, [[45, -30, -2], [46, 30, 12]]], np.float64))
    return np.concatenate(boxes), np.array(labels + [11] * 4, np.uint8)


def cast(
    place: NDArray[np.float64],
    boxes: NDArray[np.float64],
    box_labels: NDArray[np.uint8],
    channels: int,
    columns: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the (N, 3) points in the sensor's frame and their class ids, in the order of the
    azimuth.
    """
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, columns, endpoint=False),
        np.deg2rad(np.linspace(2, -25, channels)),
        indexing="ij",
    )
    rays = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        -1,
    )
    rays = rays.reshape(-1, 3)
    with np.errstate(divide="ignore"):
        inverse = 1 / rays
    distance = np.where(rays[:, 2] < 0, (GROUND_Z - place[2]) * inverse[:, 2], 1e3)
    across = np.abs(place[1] + distance * rays[:, 1])
    labels = np.where(across < 7, 7, np.where(across < 15, 8, 22)).astype(np.uint8)
    for (low, high), label in zip(boxes, box_labels, strict=True):
        planes = (np.stack([low, high])[:, None] - place) * inverse
        enter, leave = planes.min(axis=0).max(axis=1), planes.max(axis=0).min(axis=1)
        hit = (enter < leave) & (enter > 0.5) & (enter < distance)
        distance[hit], labels[hit] = enter[hit], label
    seen = distance < 50
    points = distance[seen, None] * rays[seen] + rng.uniform(-0.02, 0.02, (int(seen.sum()), 3))
    return points.astype(np.float32), labels[seen]
