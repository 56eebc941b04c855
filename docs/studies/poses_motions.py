"""How far the motions of a drive are off, for `poses.py`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import invert, multiply


def typical_errors(
    true: NDArray[np.float64], found: NDArray[np.float64], scans: int
) -> tuple[float, float]:
    """Return the root mean square error of the motion over some scans.

    Args:
        true: (F, 4, 4) world_T_sensor of each scan.
        found: (F, 4, 4) the same with errors.
        scans: number of scans that a motion takes.

    Returns:
        Of the positions in centimetres, and of the rotations in degrees.
    """
    scans = min(scans, len(true) // 2)
    motions = [multiply(invert(poses[:-scans]), poses[scans:]) for poses in (true, found)]
    off = multiply(invert(motions[0]), motions[1])
    away_m = np.linalg.norm(off[:, :3, 3], axis=1)
    turned = np.arccos(np.clip((np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    return 100 * float(np.sqrt(np.mean(away_m**2))), float(np.degrees(np.sqrt(np.mean(turned**2))))


def show(errors: tuple[float, float], digits: int = 1) -> str:
    """Return errors as text."""
    return f"{errors[0]:.{digits}f} cm, {errors[1]:.2f}°"
