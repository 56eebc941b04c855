"""The options of `regrid`: what observes the scene, and how its votes are counted.

Each is checked when it is made.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from carlasc.core.choices import Complete as Complete  # noqa: PLC0414 (part of this module)
from carlasc.core.choices import Dynamic as Dynamic  # noqa: PLC0414 (part of this module)
from carlasc.core.choices import VoteRule as VoteRule  # noqa: PLC0414 (part of this module)
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, check_choice, check_types
from carlasc.groundtruth.voting.ballot import check_rule
from carlasc.motion.options import MotionOptions, PoseOptions

if TYPE_CHECKING:
    from carlasc.motion.ground import Ground


@dataclass(frozen=True)
class FromCapture:
    """Grids from a raw capture: every sensor observes the scene at the instant of the frame."""


@dataclass(frozen=True)
class FromScans:
    """Grids from the scans of one sensor, merged over time.

    Attributes:
        window: first and last scan that are merged into a frame, relative to it, in frames; the
            range contains 0.
        window_m: merge only the scans of the window that lie within this driven distance, in
            metres, and skip scans from nearly the same place. None: no limit.
        stride: merge every N-th scan of the window, counted from the frame itself.
        dynamic: what happens to moving points. "align": each moving actor is completed from all
            scans, at its position in the frame. "current": only the moving points of the frame
            itself are used. "drop": they are left out. "tube": they stay where they were seen,
            which leaves ghost trails, as in SemanticKITTI.
        complete: what happens to the parts of an actor that no scan saw. "seen": they stay unknown.
            "mirror": an unseen side of a vehicle is taken from its other side. "body": like
            "mirror", and all other unseen parts are taken from similar vehicles of the same drive,
            or from the usual shape of vehicles. These voxels are marked as inferred.
        own_path: count the space that the recording vehicle drove through as free, which removes
            ghost trails there.
        motion: how moving points are found.
        poses: where poses come from. Missing poses are estimated from the scans, unless
            `PoseOptions("file")` is given.
        min_range_m: leave out nearer points, in metres. None: the range in carlasc.json, or 0.
        max_range_m: leave out farther points, in metres. None: the range in carlasc.json, or no
            limit.

    Raises:
        ArgumentError: a value is out of its range.
    """

    window: tuple[int, int] = (-30, 30)
    window_m: float | None = None
    stride: int = 1
    dynamic: Dynamic = "align"
    complete: Complete = "body"
    own_path: bool = True
    motion: MotionOptions = MotionOptions()  # noqa: RUF009 (frozen)
    poses: PoseOptions = PoseOptions()  # noqa: RUF009 (frozen)
    min_range_m: float | None = None
    max_range_m: float | None = None

    def __post_init__(self) -> None:
        check_types(FromScans, vars(self))
        first, last = self.window
        if first > 0 or last < 0:
            raise ArgumentError(
                "window",
                expected="a range that contains 0, such as -30:30",
                found=f"{first}:{last}",
            )
        if self.stride < 1:
            raise ArgumentError("stride", expected="at least 1", found=self.stride)
        if self.window_m is not None and not self.window_m > 0:
            raise ArgumentError(
                "window_m", expected="a positive number of metres", found=self.window_m
            )
        check_choice("dynamic", self.dynamic, Dynamic)
        check_choice("complete", self.complete, Complete)
        if self.dynamic == "tube" and self.motion.source != "auto":
            raise ArgumentError(
                "motion",
                expected='none with dynamic "tube", which ignores motion',
                found=repr(self.motion.source),
            )
        low = self.min_range_m or 0.0
        high = math.inf if self.max_range_m is None else self.max_range_m
        if not 0 <= low < high:
            raise ArgumentError(
                "min_range_m",
                expected="0 <= minimum < maximum, in metres",
                found=f"minimum {low:g} and maximum {high:g}",
            )


@dataclass(frozen=True)
class FromGrid:
    """Grids from a finer grid of the same frames: each voxel takes the class of most of the known
    cells in it.

    Attributes:
        name: folder of the finer grid; None for the finest one of the same coordinates.
    """

    name: str | None = None

    def __post_init__(self) -> None:
        check_types(FromGrid, vars(self))


Observe = FromCapture | FromScans | FromGrid
"""The type of the argument `observe` of `regrid`."""


@dataclass(frozen=True)
class Voting:
    """How votes are counted.

    Attributes:
        rule: how votes are counted. "sensor": at most one vote per sensor (scan), voxel and class,
            as in the published files. "sample": one vote per sample, as in the paper. "ray": a
            voxel is occupied if enough of the rays that enter it end in it. None: "ray" for scans,
            otherwise "sensor".
        free_step_m: distance between free-space samples on a ray, in metres.
        keep: also write the votes of each class per voxel.
        keep_evidence: also write how certain each voxel is: the fields `occupied`, `classes`,
            `flags` and `views` of the grid. Only for scans with the rule "ray".
        keep_actors: also write the actor that each voxel belongs to, and its velocity: the fields
            `instance` and `velocity` of the grid. Not for grids from a finer grid; for scans, only
            if moving points are aligned.
        min_confidence: set a voxel to unknown if it is neither free nor occupied with at least this
            probability, 0 to below 1; 0 to 0.5 keeps all. Only for scans with the rule "ray".
        keep_seen: also write which cameras see each voxel: the field `seen` of the grid. For
            Cartesian grids and up to eight cameras.

    Raises:
        ArgumentError: an unknown rule, a distance that is not positive, or a confidence outside of
            0 <= c < 1.
    """

    rule: VoteRule | None = None
    free_step_m: float = 1.5
    keep: bool = False
    keep_evidence: bool = False
    min_confidence: float = 0.0
    keep_actors: bool = False
    keep_seen: bool = False

    def __post_init__(self) -> None:
        check_types(Voting, vars(self))
        check_rule(self.rule or "sensor", self.free_step_m)
        if not 0 <= self.min_confidence < 1:
            raise ArgumentError(
                "min_confidence",
                expected="a probability from 0 to below 1",
                found=self.min_confidence,
            )


@dataclass(frozen=True)
class GridOptions:
    """The options of grids that `regrid` and `convert` share.

    Attributes:
        spec: geometry of the grids; None takes the published coarse one.
        observe: what observes the scene; None takes a capture if there is one, otherwise scans.
        voting: how votes are counted; None takes the default of `observe`.
        follow_ground: in a conversion, move the grid up or down by whole voxels where the ground is
            below it, or far above its lower bound, and make it smaller where points are near, as in
            a room; False keeps the bounds of `spec`.
    """

    spec: GridSpec | None = None
    observe: Observe | None = None
    voting: Voting | None = None
    follow_ground: bool = True


_BELOW = 0.05  # greatest share of ground points below a grid; fact: below-grid
_LOW = 0.05  # quantile of the heights of ground points that a moved grid contains
_SLACK_M = 0.6  # a grid that begins so far below the ground is moved up
_SMALLEST = 4  # a grid becomes so many times smaller at most


def share_below(ground: Ground, spec: GridSpec) -> float:
    """Return the share of ground points that are below a grid."""
    return float((ground.heights_m < spec.lower[2]).mean())


def fit_to_ground(spec: GridSpec, ground: Ground) -> GridSpec:
    """Return a grid moved up or down by whole voxels so that the ground is in its lowest layers;
    unchanged if it already is.
    """
    size = float(spec.voxel_size[2])
    low = float(np.quantile(ground.heights_m, _LOW))
    if share_below(ground, spec) <= _BELOW and low - spec.lower[2] < max(_SLACK_M, 2 * size):
        return spec
    layers = int(np.floor((low - spec.lower[2]) / size))
    if not layers:
        return spec
    (x0, y0, z0), (x1, y1, z1) = spec.lower, spec.upper
    # params.json has float32 bounds
    low, high = (float(np.float32(z + layers * size)) for z in (z0, z1))
    return replace(spec, lower=(x0, y0, low), upper=(x1, y1, high))


def fit_to_reach(spec: GridSpec, reach_m: float) -> GridSpec:
    """Return a grid of half or a quarter of the width if that still contains points up to
    `reach_m`, metres, seen from above; else the grid itself.

    The voxels of the published grid become as much smaller, and cubes, as of `--res`, keep their
    size. Other grids do not change.
    """
    published = spec == GridSpec.published()
    cubic = np.allclose(spec.voxel_size[0], spec.voxel_size)
    if spec.coordinates != "cartesian" or not (published or cubic):
        return spec
    scale = 1
    while scale < _SMALLEST and 2 * scale * reach_m <= spec.upper[0]:
        scale *= 2
    if scale == 1:
        return spec
    (x0, y0, z0), (x1, y1, z1) = spec.lower, spec.upper
    smaller = spec.with_bounds((x0 / scale, y0 / scale, z0), (x1 / scale, y1 / scale, z1))
    if published:
        return smaller.with_size((*spec.size[:2], spec.size[2] * scale))
    return smaller.with_resolution(round(float(spec.voxel_size[0]), 6))
