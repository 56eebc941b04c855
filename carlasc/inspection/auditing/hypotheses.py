"""What may be wrong with the geometry of a grid: families of corrections, most of which move the points of scans by an affine map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.core.axes import choices_of_axes
from carlasc.core.geometry import rotation_z
from carlasc.core.grids import GridSpec

_FINE, _VOXELS = 0.1, 1.5  # steps of a shift, in voxels, and as far as these go
_COARSE_M = {"x": np.arange(-4.0, 4.5, 0.5), "y": np.arange(-4.0, 4.5, 0.5), "z": np.arange(-3.0, 3.25, 0.25)}
_YAW_DEG = np.sort([*np.arange(-6.0, 6.01, 0.25), -30, -20, -15, -10, -8, 8, 10, 15, 20, 30])
_RATIOS = np.unique(np.round([*np.geomspace(0.5, 2.0, 57), 0.8, 1.25, 2 / 3, 1.5], 6))
_DRIFT_M_S = np.round(np.arange(-0.3, 0.301, 0.01), 2)
_LAGS = np.arange(-3.0, 4.0)


@dataclass(frozen=True)
class Family:
    """Corrections of one kind; the one that changes nothing is among them.

    Attributes:
        name: of the fault, such as "shift x".
        kind: "axes", "shift", "yaw", "voxel size", "height drift" or "lag".
        values: (V,) size of the fault that each correction undoes, rising; numbers of the choices of axes.
        warps: (V, 3, 5) maps of points: p' = A p + b + c dt, as columns A, b, c; dt is how much later than the frame the points were seen.
        neutral: row of the correction that changes nothing.
        unit: of the values.
        least: smaller faults are none.
        widest: a wider interval of values determines nothing.
        advice: what to fix.
    """

    name: str
    kind: str
    values: NDArray[np.float64]
    warps: NDArray[np.float64]
    neutral: int
    unit: str
    least: float
    widest: float
    advice: str


def families(spec: GridSpec) -> list[Family]:
    """Return the families of corrections of a grid."""
    found = [_family("axes", "axes", range(len(AXES)), [m for _, m in AXES], "give grids and scans the same axes")]
    advice = "move the bounds, or the place of the sensor in the poses that the grids were made with"
    for axis, name in enumerate("xyz"):
        step = shift_step(spec, name)
        fine = np.arange(-round(_VOXELS / _FINE), round(_VOXELS / _FINE) + 1) * _FINE * step
        values = np.sort([*fine, *_COARSE_M[name][np.abs(_COARSE_M[name]) > _VOXELS * step + 0.01]])
        shifts = _family(f"shift {name}", "shift", values, [np.eye(3)], advice, "m", 0.2 * step, step)
        shifts.warps[:, axis, 3] = values
        found.append(shifts)
    turns = [rotation_z(angle)[:3, :3] for angle in np.radians(_YAW_DEG)]
    advice = "turn the calibration of the sensor that the grids were made with"
    found.append(_family("yaw", "yaw", _YAW_DEG, turns, advice, "degrees", 0.4, 1.5))
    for axes, which in (("", (1, 1, 1)), (" x, y", (1, 1, 0)), (" z", (0, 0, 1))):
        # the fault: declared = ratio * true size; the cell of p in the true grid is that of p * ratio in the declared one
        scales = [np.diag(np.where(which, ratio, 1.0)) for ratio in _RATIOS]
        for anchor, fixed in (("", np.zeros(3)), (", lower bound kept", np.array(spec.lower))):
            if not anchor or spec.coordinates == "cartesian":
                advice = "correct the voxel size or the bounds that are declared"
                sizes = _family(f"voxel size{axes}{anchor}", "voxel size", _RATIOS, scales, advice, "times", 0.02, 0.15)
                sizes.warps[:, :, 3] = fixed - sizes.warps[:, :, :3] @ fixed
                found.append(sizes)
    advice = "refine the poses (`carlasc refine`) and make the grids again"
    drift = _family("height drift", "height drift", _DRIFT_M_S, [np.eye(3)], advice, "m/s", 0.02, 0.06)
    drift.warps[:, 2, 4] = _DRIFT_M_S
    advice = "give the grids the numbers or times of these scans"
    return [*found, drift, _family("lag", "lag", _LAGS, [np.eye(3)], advice, "frames", 1.0, 1.0)]


def shift_step(spec: GridSpec, axis: str) -> float:
    """Return the size of a voxel along x, y or z; for a cylindrical grid, x and y take that along the radius."""
    return float(spec.voxel_size[0 if spec.coordinates == "cylindrical" and axis != "z" else "xyz".index(axis)])


def _family(
    name: str,
    kind: str,
    values: Sequence[float] | NDArray[np.float64] | range,
    matrices: Sequence[NDArray[np.float64]],
    advice: str,
    unit: str = "",
    least: float = 0.0,
    widest: float = np.inf,
) -> Family:
    sizes = np.asarray(values, np.float64)
    warps = np.zeros((len(sizes), 3, 5))
    warps[:, :, :3] = matrices
    neutral = int(np.abs(sizes - (kind == "voxel size")).argmin())
    return Family(name, kind, sizes, warps, neutral, unit, least, widest, advice)


_MIRRORED = {"-x, y, z": "x mirrored", "x, -y, z": "y mirrored", "x, y, -z": "z mirrored"}
AXES = [(_MIRRORED.get(n, f"x, y, z of the grid are {n} of the scans"), matrix) for n, matrix in choices_of_axes()]
"""The choices of axes: (description, (3, 3) matrix from the scans' axes to the grid's); the first is the right one."""
