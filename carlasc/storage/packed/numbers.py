"""Numbers in fewer bytes: narrower types, and whole steps in the place of metres."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError


def quantise(metres: NDArray[Any], scale_m: float) -> NDArray[np.int32]:
    """Return coordinates as whole steps of `scale_m`.

    Raises:
        FormatError: a coordinate is NaN, infinite, or too large for an int32.
    """
    steps = np.rint(metres.astype(np.float64) / scale_m)
    if not (np.abs(steps) < 2**31).all():  # False for NaN too
        raise FormatError(
            "points",
            expected=f"finite coordinates within {2**31 * scale_m:.0f} m to quantise",
            found="others",
            advice="pack them without `lossy_mm`",
        )
    return steps.astype(np.int32)


def narrow(array: NDArray[Any]) -> NDArray[Any]:
    """Return whole numbers in the smallest unsigned type that holds them, and other numbers as float32, bit for bit."""
    if array.dtype.kind == "f":
        values = np.ascontiguousarray(array, "<f4")
        with np.errstate(invalid="ignore"):
            whole = values.astype(np.uint32) if values.size == 0 or values.max() < 2**32 else None  # False for NaN
        exact = whole is not None and np.array_equal(whole.astype("<f4").view(np.uint32), values.view(np.uint32))
        if whole is None or not exact:
            return values
        array = whole
    highest = int(array.max()) if array.size else 0
    return array.astype("u1" if highest < 2**8 else "<u2" if highest < 2**16 else "<u4", copy=False)


def common_type(first: np.dtype[Any], second: np.dtype[Any]) -> np.dtype[Any]:
    """Return a type that holds the values of both exactly: the wider integer, or float32, from which the integers were narrowed."""
    if first == second:
        return first
    if "f" in (first.kind, second.kind):
        return np.dtype("<f4")
    return max(first, second, key=lambda dtype: dtype.itemsize)
