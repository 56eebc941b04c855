"""The poses of the LiDARs on a vehicle, from a YAML or JSON file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import FloatArray
from carlasc.core.geometry import Transform, check_rigid
from carlasc.errors import FormatError, import_extra
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


def in_axes(transform: Transform, poses: FloatArray) -> FloatArray:
    """Return (..., 4, 4) poses after a change of the axes of both their frames."""
    return transform @ poses @ transform.T
