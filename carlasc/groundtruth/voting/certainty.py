"""Certainty: the rule "ray", which decides from hits and free paths whether a voxel is occupied,
and the probability of it.

A ray that ends in a voxel is a hit. A ray that passes through adds its free path. The number of
hits per metre of free path is a property of the matter in the voxel (the decay rate of Schaefer,
Luft and Burgard, 2017). It does not depend on the number of channels of a LiDAR, its turn rate, or
the number of merged scans. A wall stops every ray; most rays that graze a road pass through the
voxels of its surface.

The probability that a voxel is occupied is a logistic function of the logarithm of this ratio. It
is calibrated on simulated drives in which many other sensors see the same instant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.grids import GridSpec
from carlasc.errors import FormatError
from carlasc.storage import field_files, layout

# Hits per metre of free path above which a voxel is occupied. Chosen on simulated drives: see
# docs/studies/movers.md.
GROUND_PER_M = 0.05  # roads, pavements and other ground, which most rays graze; fact: ground-per-m
SOLID_PER_M = 0.15  # other static objects, and actors within their bodies; fact: solid-per-m
MOVABLE_PER_M = 0.5  # movable classes, which may come or leave during the window


class Matter(IntEnum):
    """The kind of matter in a voxel, which decides the threshold of hits per metre of free path."""

    GROUND = 0
    SOLID = 1
    MOVABLE = 2  # of a movable class, outside of bodies
    BODY = 3  # an actor, within its body
    MIRRORED = 4  # a side of an actor that is mirrored from its other side


_PER_M = np.array([GROUND_PER_M, SOLID_PER_M, MOVABLE_PER_M, SOLID_PER_M, SOLID_PER_M])

# Offset and slope of the logistic functions, for voxels of 0.4 m and of 0.2 m; for other sizes,
# linear in the logarithm of the size.
_HIT = np.array(
    [
        [(-1.2, 1.34), (1.4, 0.72)],
        [(-0.9, 1.3), (-0.4, 1.3)],
        [(1.7, 0.6), (2.0, 0.7)],
        [(-0.1, 0.75), (0.0, 0.77)],
        [(0.45, 0.32), (1.2, 0.5)],
    ]
)
# of the logarithm of the number of free samples, in voxels without hits
_FREE = np.array([-4.0, -0.7])
_FREE_IN_BODY = np.array([-1.7, -0.4])
_SMALLEST_M, _LARGEST_M = 0.1, 0.8  # smaller and larger sizes count as these
UNKNOWN = 0.5
_BLOCK = 1 << 14  # voxels whose arrays fit into the L2 cache


def matter_of(
    labels: NDArray[np.integer], in_body: NDArray[np.bool_], classes: ClassTable
) -> NDArray[np.int8]:
    """Return the kind of matter in each voxel.

    Args:
        labels: (V,) most frequent class of the hits.
        in_body: (V,) bool, voxels of bodies of actors.
        classes: class table of the labels.
    """
    kinds = np.full(classes.num_channels, Matter.SOLID, np.int8)
    kinds[sorted(classes.movable)] = Matter.MOVABLE
    kinds[sorted(classes.ground)] = Matter.GROUND
    matter = kinds[labels]
    matter[in_body & (matter == Matter.MOVABLE)] = Matter.BODY
    return matter


def is_occupied(
    hits: NDArray[np.integer], free_m: NDArray[np.floating], matter: NDArray[np.int8]
) -> NDArray[np.bool_]:
    """Return (V,) bool: which voxels have more hits per metre of free path than the threshold of
    their matter.

    Args:
        hits: (V,) number of points in each voxel.
        free_m: (V,) free path of rays through each voxel, metres.
        matter: (V,) kind of matter: see `Matter`.
    """
    return hits > _PER_M[matter] * free_m


def probability(
    hits: NDArray[np.integer],
    free_m: NDArray[np.floating],
    matter: NDArray[np.int8],
    in_body: NDArray[np.bool_],
    spec: GridSpec,
    step_m: float,
) -> NDArray[np.float32]:
    """Return (V,) the calibrated probability that each voxel is occupied; `UNKNOWN` without hits
    and free path.

    Args:
        hits: (V,) number of points in each voxel.
        free_m: (V,) free path of rays through each voxel, metres.
        matter: (V,) kind of matter: see `Matter`.
        in_body: (V,) bool, voxels of bodies of actors.
        spec: the grid.
        step_m: distance between two free samples of a ray, metres.
    """
    posterior = np.empty(len(hits), np.float32)
    for begin in range(0, len(hits), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        posterior[part] = _probability(
            hits[part], free_m[part], matter[part], in_body[part], spec, step_m
        )
    return posterior


def _probability(
    hits: NDArray[np.integer],
    free_m: NDArray[np.floating],
    matter: NDArray[np.int8],
    in_body: NDArray[np.bool_],
    spec: GridSpec,
    step_m: float,
) -> NDArray[np.floating]:
    finer = math.log2(0.4 / min(max(float(np.cbrt(_volume(spec))), _SMALLEST_M), _LARGEST_M))
    samples = np.log(np.maximum(free_m / step_m, 1.0))
    score = np.where(
        in_body, _FREE_IN_BODY[0] + _FREE_IN_BODY[1] * samples, _FREE[0] + _FREE[1] * samples
    )
    hit = hits > 0
    offset, slope = (_HIT[:, 0] + finer * (_HIT[:, 1] - _HIT[:, 0]))[matter[hit]].T
    ratio = np.log((hits[hit] + 0.5) / (_PER_M[matter[hit]] * free_m[hit] + 0.5))
    score[hit] = offset + np.maximum(slope, 0.2) * ratio
    posterior = 1 / (1 + np.exp(-score))
    return np.where(hit | (free_m > 0), posterior, UNKNOWN)


def _volume(spec: GridSpec) -> float:
    """Return the volume of a cell, cubic metres; in a cylindrical grid at half the greatest radius."""
    x, y, z = spec.voxel_size.tolist()
    return float(x * z * (y * spec.upper[0] / 2 if spec.coordinates == "cylindrical" else y))


@dataclass(frozen=True, eq=False)
class VoxelCertainty:
    """The certainty of each voxel of a grid.

    The attributes are the fields of the grid: see `docs/format.md#evidence`.

    Attributes:
        occupied: (X, Y, Z) floating, probability that the voxel is occupied; 0.5 if it is unknown.
        classes: (M,) `field_files.VOTES_DTYPE` or `field_files.WIDE_VOTES_DTYPE`, sorted by voxel,
            then by label: the probability of each class if the voxel is occupied, in 1/65535, in
            the column `votes`; only non-zero ones.
        flags: (X, Y, Z) uint8, sums of `carlasc.VoxelFlag`.
        views: (X, Y, Z) uint16, number of scans that saw the voxel.

    Raises:
        FormatError: the arrays differ in shape.
    """

    occupied: NDArray[np.floating]
    classes: NDArray[Any]
    flags: NDArray[np.uint8]
    views: NDArray[np.uint16]

    def __post_init__(self) -> None:
        for name, array in (("flags", self.flags), ("views", self.views)):
            if array.shape != self.occupied.shape:
                raise FormatError(
                    f"evidence {name}",
                    expected=f"shape {self.occupied.shape}",
                    found=str(array.shape),
                )


def class_shares(votes: NDArray[Any], classes: ClassTable) -> NDArray[Any]:
    """Return the probability of each class of the voxels with votes, if they are occupied: its
    share of the votes.

    Shares are rounded down, so the sum of a voxel is at most 1.

    Args:
        votes: (M,) structured, with `voxel`, `label` (never 0) and `votes`, as in `Votes.occupied`,
            in any order. Rows of the same voxel and class are summed.
        classes: class table of the labels.

    Returns:
        (N,) `VoxelCertainty.classes`: `field_files.VOTES_DTYPE`, or `field_files.WIDE_VOTES_DTYPE`
        if class ids do not fit 8 bits.
    """
    pairs, place = np.unique(
        votes["voxel"].astype(np.int64) * classes.num_channels + votes["label"], return_inverse=True
    )
    voxel, label = np.divmod(pairs, classes.num_channels)
    of_pair = np.bincount(place, votes["votes"], len(pairs))
    of_voxel = np.bincount(voxel, of_pair)
    shares = np.zeros(
        len(pairs),
        field_files.VOTES_DTYPE if classes.dtype == np.uint8 else field_files.WIDE_VOTES_DTYPE,
    )
    shares["voxel"], shares["label"] = voxel, label
    shares["votes"] = np.floor(of_pair / of_voxel[voxel] * layout.CERTAIN)
    return shares[shares["votes"] > 0]
