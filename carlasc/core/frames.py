"""Which frames: a half-open range of frame numbers; and their times in seconds, told from counts of smaller units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, FormatError


@dataclass(frozen=True)
class FrameRange:
    """A half-open range of frame numbers, `start <= frame < stop`.

    Attributes:
        start: first frame; None leaves this end open.
        stop: the frame after the last one; None leaves this end open.

    Raises:
        ArgumentError: a bound that is not a whole number, or a range that holds no frame.
    """

    start: int | None = None
    stop: int | None = None

    def __post_init__(self) -> None:
        for bound in (self.start, self.stop):
            if bound is not None and (isinstance(bound, bool) or not isinstance(bound, int | np.integer)):
                raise ArgumentError("frames", expected="whole numbers or None", found=repr(bound))
        if self.start is not None and self.stop is not None and self.start >= self.stop:
            raise ArgumentError("frames", expected="a range that holds a frame", found=str(self))

    @classmethod
    def of(cls, frames: FrameRange | tuple[int | None, int | None] | None) -> FrameRange:
        """Return what a `frames` argument means: a FrameRange, a tuple of its bounds, or None for all frames.

        Raises:
            ArgumentError: it is none of these.
        """
        if frames is None:
            return cls()
        if isinstance(frames, FrameRange):
            return frames
        if not isinstance(frames, tuple) or len(frames) != 2:
            raise ArgumentError("frames", expected="(start, stop), a FrameRange or None", found=repr(frames))
        return cls(*frames)

    @classmethod
    def parse(cls, text: str) -> FrameRange:
        """Read "A:B", "A:", ":B", or one frame "A".

        Raises:
            ArgumentError: it is no range.
        """
        first, colon, last = text.partition(":")
        try:
            start, stop = int(first) if first else None, int(last) if last else None
        except ValueError:
            raise ArgumentError("frames", expected="A:B, A:, :B or a frame number", found=repr(text)) from None
        if not colon:
            return cls(start, None if start is None else start + 1)
        return cls(start, stop)

    def __contains__(self, frame: int) -> bool:
        return (self.start is None or frame >= self.start) and (self.stop is None or frame < self.stop)

    def select(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Return those of (N,) frame numbers that are in the range, in their order, as an array of shape (M,)."""
        chosen = np.ones(len(frames), np.bool_)
        if self.start is not None:
            chosen &= frames >= self.start
        if self.stop is not None:
            chosen &= frames < self.stop
        return frames[chosen]

    def __str__(self) -> str:
        return ":".join("" if bound is None else str(bound) for bound in (self.start, self.stop))


def compact(frames: NDArray[np.int64]) -> range | NDArray[np.int64]:
    """Return rising frame numbers as a range if none is missing between them: that is pickled in a few bytes."""
    first, last = (int(frames[0]), int(frames[-1])) if len(frames) else (0, -1)
    return range(first, last + 1) if last - first == len(frames) - 1 else frames


def expand(frames: range | NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the array of frame numbers that `compact` was given."""
    return np.arange(frames.start, frames.stop, dtype=np.int64) if isinstance(frames, range) else frames


Frames = FrameRange | tuple[int | None, int | None] | None
"""What a `frames` argument takes: a FrameRange, a tuple of its bounds, or None for all frames."""


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
