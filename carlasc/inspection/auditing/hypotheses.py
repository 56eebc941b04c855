"""What may be wrong with the geometry of a grid: families of corrections, each of which moves points by an affine map."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import GridSpec

_FINE, _VOXELS = 0.1, 1.5  # steps of a shift, in voxels, and as far as these go
_COARSE_M = {0: np.arange(-4.0, 4.5, 0.5), 1: np.arange(-4.0, 4.5, 0.5), 2: np.arange(-3.0, 3.25, 0.25)}
_YAW_DEG = np.concatenate([np.arange(-6.0, 6.01, 0.25), [-30, -20, -15, -10, -8, 8, 10, 15, 20, 30]])
_RATIOS = np.unique(np.round(np.concatenate([np.geomspace(0.5, 2.0, 57), [0.8, 1.25, 2 / 3, 1.5, 0.5, 2.0, 1.0]]), 6))
_DRIFT_M_S = np.round(np.arange(-0.3, 0.301, 0.01), 2)


@dataclass(frozen=True)
class Family:
    """Corrections of one kind; the value of the one that changes nothing is among them.

    Attributes:
        name: of the fault, such as "shift x".
        unit: of the values.
        values: (V,) size of the fault that each correction undoes, rising; numbers of the choices of axes.
        warps: (V, 3, 5) maps of points: p' = A p + b + c dt, as columns A, b, c; dt is how much later than the frame the points were seen.
        neutral: row of the correction that changes nothing.
    """

    name: str
    unit: str
    values: NDArray[np.float64]
    warps: NDArray[np.float64]
    neutral: int


def families(spec: GridSpec) -> list[Family]:
    """Return the families of corrections of a grid."""
    found = [_family("axes", "", np.arange(float(len(AXES))), [matrix for _, matrix in AXES])]
    for axis, name in enumerate("xyz"):
        step = float(spec.voxel_size[0 if spec.coordinates == "cylindrical" and axis < 2 else axis])
        fine = np.arange(-round(_VOXELS / _FINE), round(_VOXELS / _FINE) + 1) * _FINE * step
        coarse = _COARSE_M[axis][np.abs(_COARSE_M[axis]) > _VOXELS * step + 0.01]
        values = np.sort(np.concatenate([fine, coarse]))
        found.append(_family(f"shift {name}", "m", values, [np.eye(3)] * len(values), offset=np.eye(3)[axis]))
    yaw = np.sort(_YAW_DEG)
    found.append(_family("yaw", "degrees", yaw, [_turn(angle) for angle in np.radians(yaw)]))
    lower = np.array(spec.lower)
    for axes, which in (("", (1, 1, 1)), (" x, y", (1, 1, 0)), (" z", (0, 0, 1))):
        for anchor, fixed in (("", np.zeros(3)), (", lower bound kept", lower)):
            if spec.coordinates == "cylindrical" and anchor:
                continue
            # the fault: declared = ratio * true size; the cell of p in the true grid is that of p * ratio in the declared one
            scales = [np.diag(np.where(which, ratio, 1.0)) for ratio in _RATIOS]
            family = _family(f"voxel size{axes}{anchor}", "times", _RATIOS, scales, neutral=1.0)
            family.warps[:, :, 3] = fixed - np.einsum("vij,j->vi", family.warps[:, :, :3], fixed)
            found.append(family)
    return found


def drift_family() -> Family:
    """Return the corrections of heights that change with the time at which a place was seen."""
    drift = _family("height drift", "m/s", _DRIFT_M_S, [np.eye(3)] * len(_DRIFT_M_S))
    drift.warps[:, 2, 4] = _DRIFT_M_S
    return drift


def _family(
    name: str,
    unit: str,
    values: NDArray[np.float64],
    matrices: list[NDArray[np.float64]],
    *,
    offset: NDArray[np.float64] | None = None,
    neutral: float = 0.0,
) -> Family:
    warps = np.zeros((len(values), 3, 5))
    warps[:, :, :3] = matrices
    if offset is not None:
        warps[:, :, 3] = values[:, None] * offset
    return Family(name, unit, values, warps, int(np.abs(values - neutral).argmin()))


def _turn(angle: float) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _axes() -> list[tuple[str, NDArray[np.float64]]]:
    """Return the 48 choices of axes as (what the grid's x, y, z are in the axes of the scans, matrix); the right one is first."""
    choices = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            pairs = zip(signs, order, strict=True)
            names = ", ".join(f"{'-' if sign < 0 else ''}{'xyz'[axis]}" for sign, axis in pairs)
            choices.append((f"x, y, z of the grid are {names} of the scans", matrix))
    words: dict[tuple[float, ...], str] = {
        (-1.0, 1.0, 1.0): "x mirrored",
        (1.0, -1.0, 1.0): "y mirrored",
        (1.0, 1.0, -1.0): "z mirrored",
    }
    return [(words.get(tuple(np.diag(matrix).tolist()), name), matrix) for name, matrix in choices]


AXES = _axes()
"""The choices of axes: (description, (3, 3) matrix from the scans' axes to the grid's); the first is the right one."""
