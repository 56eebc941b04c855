"""Poses from quaternions and translations, the form of several data sets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import check_rigid, poses_from
from carlasc.errors import FormatError

_UNIT_TOLERANCE = 1e-3  # greatest deviation of a quaternion's norm from 1


def poses_of(
    quaternions: NDArray[np.floating], translations: NDArray[np.floating], where: str
) -> NDArray[np.float64]:
    """Return the (N, 4, 4) float64 transforms with given rotations and translations.

    Args:
        quaternions: (N, 4) w, x, y, z.
        translations: (N, 3) metres.
        where: the file, for errors.

    Raises:
        FormatError: a quaternion does not have length 1, or a number is not finite.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        valid = np.abs(np.linalg.norm(quaternions, axis=1) - 1) <= _UNIT_TOLERANCE
    if not valid.all():
        row = int(np.argmin(valid))
        found = f"{np.asarray(quaternions[row], np.float64).tolist()} in row {row}"
        raise FormatError(
            where, expected="a rotation: a quaternion w, x, y, z of length 1", found=found
        )
    return check_rigid(poses_from(quaternions, translations), where, 4 * _UNIT_TOLERANCE)
