"""The points of a sweep: taken one after the other, by a sensor that moved meanwhile. Importing this module loads Numba."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cells import distinct
from carlasc.core.compiling import cached

_TICK_S = 1e-4  # points of so short a time have the same pose: at 30 m/s this is 3 mm


def ticks_of(seconds: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the (T,) different times among those of (N,) points, in seconds, rounded and increasing, and the (N,) place of each point's among them."""
    ticks, tick_of = distinct(np.round(np.asarray(seconds, np.float64) / _TICK_S).astype(np.int64))
    return np.asarray(ticks * _TICK_S, np.float64), tick_of


@cached
def move_each(
    points: NDArray[np.floating], dst_T_then: NDArray[np.float64], tick_of: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Move each point by the transform of its time.

    Args:
        points: (N, 3 or more) metres, in the frame of the sensor at the time of each.
        dst_T_then: (T, 4, 4) transforms.
        tick_of: (N,) which of them is that of each point.

    Returns:
        (N, 3) metres.
    """
    moved = np.empty((len(points), 3))
    for i in range(len(points)):
        pose = dst_T_then[tick_of[i]]
        for a in range(3):
            moved[i, a] = pose[a, 0] * points[i, 0] + pose[a, 1] * points[i, 1] + pose[a, 2] * points[i, 2] + pose[a, 3]
    return moved
