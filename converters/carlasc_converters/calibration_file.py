"""The poses of the LiDARs on a vehicle, from a YAML or JSON file, and the axes of data."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import FloatArray
from carlasc.core.geometry import DIRECTIONS, Transform, check_rigid
from carlasc.errors import ArgumentError, FormatError, import_extra
from carlasc_converters.files import opening, read_text
from carlasc_converters.transforms import poses_of

_EXPECTED = (
    "sensors, each with translation (x, y, z) and rotation (qx, qy, qz, qw), or with matrix (4 x 4)"
)


def read_calibration(path: Path) -> dict[str, Transform]:
    """Return (4, 4) vehicle_T_sensor by the name of the sensor, in the order of the file.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it has no sensors, or a pose is not a rigid transform.
        DependencyError: the file is YAML, and PyYAML is not installed.
    """
    text = read_text(path, _EXPECTED)
    with opening(path, _EXPECTED, "see the page docs/sets/scans.md for an example"):
        values = (
            json.loads(text)
            if path.suffix.lower() == ".json"
            else import_extra("yaml", "scans").safe_load(text)
        )
        sensors = {
            str(name): _pose(entry, f"{path}: sensor {name}")
            for name, entry in values["sensors"].items()
        }
    if not sensors:
        raise FormatError(path, expected=_EXPECTED, found="no sensors")
    return sensors


def _pose(entry: Mapping[str, Any], where: str) -> Transform:
    if "matrix" in entry:
        return check_rigid(np.asarray(entry["matrix"], np.float64).reshape(4, 4), where)
    x, y, z, w = map(float, entry.get("rotation", (0, 0, 0, 1)))
    place = np.asarray(entry["translation"], np.float64).reshape(1, 3)
    pose: Transform = poses_of(np.array([[w, x, y, z]]), place, where)[0]
    return pose


def axes_named(name: str) -> Transform:
    """Return (4, 4) from axes that are named by their directions to x forward, y to the left, z up.

    Args:
        name: a letter for x, y and z each: f(orward), b(ackward), l(eft), r(ight), u(p), d(own).
            "flu" are those of ROS, "fru" the left-handed ones of CARLA and Unreal, "rfu" have y
            forward, "rdf" are a camera's.

    Raises:
        ArgumentError: the letters are not three directions at right angles.
    """
    columns = np.array([DIRECTIONS.get(letter, (0, 0, 0)) for letter in name.lower()], np.float64).T
    if (
        columns.shape != (3, 3)
        or not np.array_equal(np.abs(columns).sum(axis=0), [1, 1, 1])
        or np.linalg.matrix_rank(columns) < 3
    ):
        raise ArgumentError(
            "source_axes",
            expected="directions of x, y and z, such as flu (forward, left, up), fru, rfu, frd or "
            "rdf",
            found=repr(name),
        )
    transform = np.eye(4)
    transform[:3, :3] = columns
    return transform


def in_axes(transform: Transform, poses: FloatArray) -> FloatArray:
    """Return (..., 4, 4) poses after a change of the axes of both their frames."""
    return transform @ poses @ transform.T
