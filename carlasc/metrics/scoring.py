"""Options of scoring, and the base class of metrics that accumulate frames."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import ClassVar, Self

from carlasc.core.arrays import BoolArray
from carlasc.core.choices import Voxels as Voxels  # noqa: PLC0414 (part of this module)
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, check_choice, check_types

Region = Callable[[GridSpec], BoolArray]
BREAKDOWNS = ("distance", "height", "visibility", "motion", "seen")


@dataclass(frozen=True)
class Scoring:
    """Voxels to score, and additional scores.

    Attributes:
        voxels: "known": score the voxels of the convention, which are known in the ground truth.
            "all": also score unknown voxels of the ground truth.
        region: function that returns an (X, Y, Z) bool mask for a GridSpec, such as `lambda spec:
            distance_band(spec, 0, 10)`. Only voxels in the mask are scored. With several processes,
            it must be picklable. None scores all voxels.
        by: also score by distance, height, visibility (from the sensor in the frame), motion or
            seen (by any camera).
        rays: also score the first occupied voxel on each ray: RayIoU. Needs poses and a Cartesian
            grid.
        actors: also score actors: panoptic quality (PQ), tracking (LSTQ), and velocities.
            Prediction and ground truth need the field `instance`, for velocities also `velocity`.
        allow_unknown: go on where an id is no class of its table, and count such voxels: they are
            not scored in the ground truth, and count as free in predictions. Otherwise the frame is
            not scored.

    Raises:
        ArgumentError: a value is not valid.
    """

    voxels: Voxels = "known"
    region: Region | None = None
    by: Collection[str] = ()
    rays: bool = False
    actors: bool = False
    allow_unknown: bool = False

    def __post_init__(self) -> None:
        check_types(Scoring, vars(self))
        check_choice("voxels", self.voxels, Voxels)
        for name in self.by:
            check_choice("by", name, BREAKDOWNS)


class Summed:
    """A metric that is computed from sums over frames."""

    _SETTINGS: ClassVar[tuple[str, ...]]
    """Names of the settings, which must be equal to merge metrics."""
    _SUMS: ClassVar[tuple[str, ...]]
    """Names of the sums, which are added."""

    def merge(self, other: Self) -> Self:
        """Add the sums of another metric with the same settings.

        Raises:
            ArgumentError: its settings differ.
        """
        for name in self._SETTINGS:
            if (mine := getattr(self, name)) != (theirs := getattr(other, name)):
                kind = type(self).__name__
                raise ArgumentError(
                    "other", expected=f"a {kind} with {name} {mine}", found=f"one with {theirs}"
                )
        for name in self._SUMS:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        return self
