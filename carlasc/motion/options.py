"""The options of poses and of motion, which grids and conversions share."""

from __future__ import annotations

from dataclasses import dataclass

from carlasc.core.choices import LoopMode as LoopMode  # noqa: PLC0414 (part of this module)
from carlasc.core.choices import MotionSource as MotionSource  # noqa: PLC0414 (part of this module)
from carlasc.core.choices import PoseSource as PoseSource  # noqa: PLC0414 (part of this module)
from carlasc.core.choices import RefineMode as RefineMode  # noqa: PLC0414 (part of this module)
from carlasc.errors import ArgumentError, check_choice


@dataclass(frozen=True)
class PoseOptions:
    """Where the poses of scans come from.

    Attributes:
        source: where poses come from. "file": the poses of the data. "kiss-icp": estimated from the
            scans (needs the extra kitti). "auto": the poses of the data if they exist, otherwise
            estimated. Estimated poses are written only where the sequence has none.
        refine: refine poses, so that neighbouring scans agree. "auto": only where scans then agree
            clearly better, measured in places that take no part. "always": all poses. "never":
            none. The given poses are not overwritten.
        force: accept poses even if they jump between frames, if scans do not overlap under them, or
            if their calibration is missing.
        odometry_voxel_m: size of the voxels in which estimation thins points, in metres. None: by
            the distances of the points.
        loops: close loops, when poses are refined. "auto": poses become consistent at places that
            are met again, if both passes then agree clearly better. "never": they may drift apart.

    Raises:
        ArgumentError: an unknown value, or a size that is not positive.
    """

    source: PoseSource = "auto"
    refine: RefineMode = "auto"
    force: bool = False
    odometry_voxel_m: float | None = None
    loops: LoopMode = "auto"

    def __post_init__(self) -> None:
        check_choice("poses", self.source, PoseSource)
        check_choice("refine", self.refine, RefineMode)
        check_choice("loops", self.loops, LoopMode)
        if self.odometry_voxel_m is not None and not self.odometry_voxel_m > 0:
            raise ArgumentError(
                "odometry_voxel_m",
                expected="a positive number of metres",
                found=self.odometry_voxel_m,
            )


@dataclass(frozen=True)
class MotionOptions:
    """How moving points are found.

    Attributes:
        source: how moving points are found. "boxes", "instances", "flow": by the field of that
            name. "evidence": a point moves if rays of other scans passed through its position.
            "none": only classes that always move. "auto": the best field that exists, and
            "evidence" for what it misses, unless every point has flow.
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
                "min_speed_m_s", expected="a positive number", found=self.min_speed_m_s
            )
