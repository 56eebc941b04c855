"""The options of poses and of motion, which grids and conversions share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from carlasc.errors import ArgumentError, check_choice

PoseSource = Literal["auto", "file", "kiss-icp"]
RefineMode = Literal["auto", "always", "never"]
MotionSource = Literal["auto", "boxes", "instances", "flow", "evidence", "none"]


@dataclass(frozen=True)
class PoseOptions:
    """Where the poses of scans come from.

    Attributes:
        source: "file": the poses of the data; "kiss-icp": estimated from the scans (needs the extra
            `kitti`); "auto": the poses of the data where they exist, otherwise estimated. Estimated
            poses are written only where the sequence has none.
        refine: whether poses are changed so that neighbouring scans agree. "auto": where scans
            agree clearly better afterwards, measured in places that take no part; "always": also
            where they do not; "never". The given poses are not overwritten.
        force: accept poses that are farther apart than a vehicle can move or turn, or under which
            scans do not overlap.

    Raises:
        ArgumentError: an unknown value.
    """

    source: PoseSource = "auto"
    refine: RefineMode = "auto"
    force: bool = False

    def __post_init__(self) -> None:
        check_choice("poses", self.source, PoseSource)
        check_choice("refine", self.refine, RefineMode)


@dataclass(frozen=True)
class MotionOptions:
    """How moving points are found.

    Attributes:
        source: "boxes", "instances", "flow": the field of the sequence; "evidence": free space: a
            point moves if rays of other scans passed through its place; "none": only points of
            moving classes move; "auto": the best of these fields that exists, and "evidence" for
            what it misses, unless every point has flow.
        min_speed_m_s: slower actors count as static, in metres per second.

    Raises:
        ArgumentError: an unknown source, or a speed that is not positive.
    """

    source: MotionSource = "auto"
    min_speed_m_s: float = 0.3

    def __post_init__(self) -> None:
        check_choice("motion", self.source, MotionSource)
        if not self.min_speed_m_s > 0:
            raise ArgumentError(
                "min_speed_m_s", expected="a positive number", found=str(self.min_speed_m_s)
            )
