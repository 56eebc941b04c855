"""What is scored of each frame, beside the classes; and what metrics have in common that add up frames."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from carlasc.core.choices import Voxels as Voxels  # noqa: PLC0414 (part of this module)
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError

Region = Callable[[GridSpec], NDArray[np.bool_]]
BREAKDOWNS = ("distance", "height", "visibility", "motion", "seen")


@dataclass(frozen=True)
class Scoring:
    """What is scored of each frame.

    Attributes:
        voxels: "known" scores the voxels that the convention scores; "all" also scores voxels that the truth never evaluated.
        region: function from a GridSpec to a (X, Y, Z) bool mask, such as `lambda spec: distance_band(spec, 0, 10)`; only voxels in
            the mask count. With several processes it must be a function that can be pickled.
        by: also give scores by any of "distance", "height", "visibility" (from the sensor, at this instant), "motion" and "seen" (by any camera).
        rays: also compute RayIoU; this needs poses and a Cartesian grid.
        actors: also score who is in each voxel and how fast: both sides need the field `instance`, and for velocities `velocity`.

    Raises:
        ArgumentError: an unknown value.
    """

    voxels: Voxels = "known"
    region: Region | None = None
    by: Collection[str] = ()
    rays: bool = False
    actors: bool = False

    def __post_init__(self) -> None:
        if self.voxels not in ("known", "all"):
            raise ArgumentError("voxels", expected="known or all", found=repr(self.voxels))
        if unknown := [name for name in self.by if name not in BREAKDOWNS]:
            raise ArgumentError("by", expected=f"any of {', '.join(BREAKDOWNS)}", found=repr(unknown[0]))


class Summed:
    """A metric that is made of sums."""

    _SETTINGS: ClassVar[tuple[str, ...]]
    """Names of the attributes in which metrics must be equal to be merged."""
    _SUMS: ClassVar[tuple[str, ...]]
    """Names of the attributes that are added."""

    def merge(self, other: Self) -> Self:
        """Add what another metric of the same settings has added up, in any order.

        Raises:
            ArgumentError: its settings differ.
        """
        for name in self._SETTINGS:
            if (mine := getattr(self, name)) != (theirs := getattr(other, name)):
                kind = type(self).__name__
                raise ArgumentError("other", expected=f"a {kind} with {name} {mine}", found=f"one with {theirs}")
        for name in self._SUMS:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        return self
