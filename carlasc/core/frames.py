"""Selections of frames: a half-open range of frame numbers, or a list; and a check that times are
in seconds.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from carlasc.core.arrays import AnyArray, AnyIntArray, FloatArray, IntArray
from carlasc.errors import ArgumentError, FormatError


@dataclass(frozen=True)
class FrameRange:
    """A half-open range of frame numbers, `start <= frame < stop`, or a selection of numbers in it.

    Attributes:
        start: first frame; None for no lower bound.
        stop: end of the range, exclusive; None for no upper bound.
        only: the selected frames; None selects all numbers from `start` to `stop`.

    Raises:
        ArgumentError: a bound is not an integer, or the range is empty.
    """

    start: int | None = None
    stop: int | None = None
    only: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        for bound in (self.start, self.stop, *(self.only or ())):
            if bound is not None and (
                isinstance(bound, bool) or not isinstance(bound, int | np.integer)
            ):
                raise ArgumentError("frames", expected="integers or None", found=repr(bound))
        if self.start is not None and self.stop is not None and self.start >= self.stop:
            raise ArgumentError("frames", expected="a range that holds a frame", found=self)

    @classmethod
    def of(cls, frames: Frames) -> FrameRange:
        """Return the range for a `frames` argument; see `Frames`.

        Raises:
            ArgumentError: it has none of these forms.
        """
        match frames:
            case None:
                return cls()
            case FrameRange():
                return frames
            case str():
                return cls.parse(frames)
            case slice(step=None | 1):
                return cls(frames.start, frames.stop)
            case (start, stop) if isinstance(frames, tuple):
                return cls(start, stop)
            case range() | list() | np.ndarray():
                return cls._listed(frames)
        expected = (
            "a range, a slice without a step, A:B, a list of frame numbers, (start, stop) or None"
        )
        raise ArgumentError("frames", expected=expected, found=repr(frames))

    @classmethod
    def _listed(cls, frames: range | list[int] | AnyIntArray) -> FrameRange:
        """Return the range of some frame numbers, in any order."""
        try:
            chosen = sorted({operator.index(frame) for frame in frames})
        except TypeError:
            raise ArgumentError(
                "frames", expected="a list of integers", found=repr(frames)
            ) from None
        if not chosen:
            raise ArgumentError("frames", expected="a range that holds a frame", found=repr(frames))
        gapless = chosen[-1] - chosen[0] == len(chosen) - 1
        return cls(chosen[0], chosen[-1] + 1, None if gapless else tuple(chosen))

    @classmethod
    def parse(cls, text: str) -> FrameRange:
        """Read "A:B", "A:", ":B", or one frame "A".

        Raises:
            ArgumentError: the text is not a range.
        """
        first, colon, last = text.partition(":")
        try:
            start = int(first) if first else None
            stop = int(last) if last else None
        except ValueError:
            raise ArgumentError(
                "frames", expected="A:B, A:, :B or a frame number", found=repr(text)
            ) from None
        if not colon:
            return cls(start, None if start is None else start + 1)
        return cls(start, stop)

    def __contains__(self, frame: int) -> bool:
        inside = (self.start is None or frame >= self.start) and (
            self.stop is None or frame < self.stop
        )
        return inside and (self.only is None or frame in self.only)

    def select(self, frames: AnyArray) -> AnyArray:
        """Return the (M,) frame numbers out of (N,) that are in the range, in their order."""
        chosen = np.ones(len(frames), np.bool_)
        if self.start is not None:
            chosen &= frames >= self.start
        if self.stop is not None:
            chosen &= frames < self.stop
        if self.only is not None:
            chosen &= np.isin(frames, self.only)
        return frames[chosen]

    def __str__(self) -> str:
        if self.only is not None:
            return ", ".join(map(str, self.only))
        return ":".join("" if bound is None else str(bound) for bound in (self.start, self.stop))


def compact(frames: IntArray) -> range | IntArray:
    """Return ascending frame numbers as a range if they are consecutive, because a range is pickled
    in a few bytes.
    """
    first, last = (int(frames[0]), int(frames[-1])) if len(frames) else (0, -1)
    return range(first, last + 1) if last - first == len(frames) - 1 else frames


def expand(frames: range | IntArray) -> IntArray:
    """Return the array of frame numbers from the result of `compact`."""
    return (
        np.arange(frames.start, frames.stop, dtype=np.int64)
        if isinstance(frames, range)
        else frames
    )


if TYPE_CHECKING:  # at run time it is not generic
    _Slice = slice[int | None, int | None, int | None]
else:
    _Slice = slice

Frames = (
    FrameRange
    | tuple[int | None, int | None]
    | _Slice
    | range
    | str
    | list[int]
    | AnyIntArray
    | None
)
"""What a `frames` argument takes: a range, a slice, "A:B", a list of frame numbers, a FrameRange, a
tuple of its bounds, or None for all frames.
"""


_LATEST_S = 1e11  # larger than any time in seconds; milliseconds since 1970 are larger


def check_seconds(seconds: FloatArray, where: str) -> FloatArray:
    """Check that (N,) times are finite and plausible as seconds, not milliseconds or nanoseconds
    since 1970, and return them.

    Args:
        seconds: the times.
        where: the file or field named in errors.

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
            advice="convert milliseconds or nanoseconds to seconds, or copy the file of times "
            "again",
        )
    return seconds
