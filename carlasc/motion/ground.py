"""Ground without labels: the points of a scan that lie on the surface that the vehicle stands on.

The area around the sensor is divided into sectors and rings. In each sector the ground is followed outwards over the lowest points: the next ring
belongs to it if the step up or down is one that a road or a kerb can have. Elsewhere the ground is interpolated.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cells import cached, fast_azimuth, fingerprint

_SECTORS, _RINGS, _RING_M = 120, 160, 0.5
_STEP_M, _SLOPE, _FAR_M = (
    0.12,
    0.08,
    3.0,
)  # greatest step between rings, and its growth with their distance up to a limit
_SEED_M = (2.0, 12.0)  # rings whose lowest points tell the height of the ground below the sensor
_ABOVE_M = 0.12  # points at most this far above the ground belong to it


def ground_points(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which points of a scan lie on the ground.

    Args:
        points: (N, 3) float32, metres, in the frame of a sensor that is mounted upright.

    Returns:
        (N,) bool.
    """
    return _ground(np.ascontiguousarray(points[:, :3], np.float32))


@cached
def _ground(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    _ = _CODE
    lowest = np.full((_SECTORS, _RINGS), np.inf)
    sector, ring = np.empty(len(points), np.int32), np.empty(len(points), np.int32)
    for i in range(len(points)):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        flat = math.sqrt(x * x + y * y)
        s = int((fast_azimuth(x, y) + math.pi) * (_SECTORS / (2 * math.pi))) % _SECTORS if flat > 0 else 0
        r = min(int(flat / _RING_M), _RINGS - 1)
        sector[i], ring[i] = s, r
        if flat > 1.0 and z < lowest[s, r]:
            lowest[s, r] = z
    heights = np.empty((_SECTORS, _RINGS))
    seed = _seed(lowest)
    for s in range(_SECTORS):
        _follow(lowest[s], seed, heights[s])
    ground = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        s, r = sector[i], ring[i]
        # A neighbour corrects a sector that went astray below or beside an object.
        a, b, c = heights[s - 1, r], heights[s, r], heights[(s + 1) % _SECTORS, r]
        middle = max(min(a, b), min(max(a, b), c))
        ground[i] = points[i, 2] < middle + _ABOVE_M
    return ground


@cached
def _seed(lowest: NDArray[np.float64]) -> float:
    """Return the height of the ground below the sensor: the median of each sector's lowest point nearby."""
    found = np.empty(_SECTORS)
    count = 0
    for s in range(_SECTORS):
        least = np.inf
        for r in range(int(_SEED_M[0] / _RING_M), int(_SEED_M[1] / _RING_M)):
            least = min(least, lowest[s, r])
        if least < np.inf:
            found[count] = least
            count += 1
    return float(np.median(found[:count])) if count else -np.inf


@cached
def _follow(lowest: NDArray[np.float64], seed: float, heights: NDArray[np.float64]) -> None:
    """Fill the (R,) heights of the ground in the rings of one sector, from (R,) lowest points."""
    last, at = -1, seed
    for r in range(_RINGS):
        if lowest[r] == np.inf:
            continue
        distance = (r - last) * _RING_M
        step = abs(lowest[r] - at)
        if step > _STEP_M + _SLOPE * min(distance, _FAR_M) + (_ABOVE_M if last < 0 else 0.0):
            continue
        for k in range(last + 1, r + 1):
            heights[k] = at + (lowest[r] - at) * ((k - last) / (r - last))
        last, at = r, lowest[r]
    for k in range(last + 1, _RINGS):
        heights[k] = at


_CODE = fingerprint(__file__)
