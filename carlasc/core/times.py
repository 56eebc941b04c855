"""Times in seconds, and how to tell them from counts of smaller units."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError

_LATEST_S = 1e11  # no clock in seconds says so; milliseconds since 1970 are more


def check_seconds(seconds: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Return times, (N,), after checking that they can be seconds: finite, and no count of milliseconds or nanoseconds since 1970.

    Args:
        seconds: the times.
        where: what the error is about.

    Raises:
        FormatError: a time is not finite, or too large.
    """
    wrong = np.flatnonzero(~(np.abs(seconds) < _LATEST_S))
    if len(wrong):
        place = f" at row {wrong[0]}" if len(seconds) > 1 else ""
        raise FormatError(
            where,
            expected=f"times in seconds, below {_LATEST_S:.0e}",
            found=f"{seconds[wrong[0]]:g}{place}",
            advice="convert milliseconds or nanoseconds to seconds, or copy the file of times again",
        )
    return seconds
