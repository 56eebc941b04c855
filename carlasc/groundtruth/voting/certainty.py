"""Certainty and consensus: whether a voxel is occupied, the probability of it, and its class.

The rule "ray" decides from hits and free paths whether a voxel is occupied.
A ray that ends in a voxel is a hit. A ray that passes through adds its free path. The number of
hits per metre of free path is a property of the matter in the voxel (the decay rate of Schaefer,
Luft and Burgard, 2017). It does not depend on the number of channels of a LiDAR, its turn rate, or
the number of merged scans. A wall stops every ray; most rays that graze a road pass through the
voxels of its surface.

The probability that a voxel is occupied is a logistic function of the logarithm of this ratio. It
is calibrated on simulated drives in which many other sensors see the same instant.

The class comes from the consensus of scans, whose errors are estimated where scans disagree. In a
voxel with twenty scans, the majority decides. Many voxels have one or two hits, and a single wrong
label decides them. Dawid and Skene (1979) estimate the confusion of classes from voters that judge
the same object. Here, scans that see the same voxel give the confusion. Where few scans vote, the
classes of the neighbours give a prior. Both have an effect only as far as labels are wrong: if all
scans agree, each voxel keeps the class with most votes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from carlasc.core.arrays import (
    AnyArray,
    AnyFloatArray,
    AnyIntArray,
    BoolArray,
    Float32Array,
    FloatArray,
    Int32Array,
    IntArray,
    LabelArray,
    Uint16Array,
)
from carlasc.core.classes import ClassTable
from carlasc.core.compiling import cached, inlined, jit
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


# by `Matter`. A mirrored side has the threshold of the side that was seen.
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


def matter_of(labels: AnyIntArray, in_body: BoolArray, classes: ClassTable) -> NDArray[np.int8]:
    """Return the kind of matter in each voxel.

    Args:
        labels: (V,) most frequent class of the hits.
        in_body: (V,) bool, voxels of bodies of actors.
        classes: class table of the labels.
    """
    # Ground is written last: classes that are ground and movable are ground.
    kinds = np.full(classes.num_channels, Matter.SOLID, np.int8)
    kinds[sorted(classes.movable)] = Matter.MOVABLE
    kinds[sorted(classes.ground)] = Matter.GROUND
    matter = kinds[labels]
    matter[in_body & (matter == Matter.MOVABLE)] = Matter.BODY
    return matter


def is_occupied(hits: AnyIntArray, free_m: AnyFloatArray, matter: NDArray[np.int8]) -> BoolArray:
    """Return (V,) bool: which voxels have more hits per metre of free path than the threshold of
    their matter.

    Args:
        hits: (V,) number of points in each voxel.
        free_m: (V,) free path of rays through each voxel, metres.
        matter: (V,) kind of matter: see `Matter`.
    """
    return hits > _PER_M[matter] * free_m


def probability(
    hits: AnyIntArray,
    free_m: AnyFloatArray,
    matter: NDArray[np.int8],
    in_body: BoolArray,
    spec: GridSpec,
    step_m: float,
) -> Float32Array:
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
    # the volume of a cell, m^3; in a cylindrical grid at half the greatest radius
    x, y, z = spec.voxel_size.tolist()
    volume = x * z * (y * spec.upper[0] / 2 if spec.coordinates == "cylindrical" else y)
    # 0 for voxels of 0.4 m, 1 for voxels of 0.2 m: the two sizes of the calibration.
    finer = math.log2(0.4 / min(max(float(np.cbrt(volume)), _SMALLEST_M), _LARGEST_M))
    curves = _HIT[:, 0] + finer * (_HIT[:, 1] - _HIT[:, 0])
    for begin in range(0, len(hits), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        path_m = free_m[part]
        samples = np.log(np.maximum(path_m / step_m, 1.0))
        score = np.where(
            in_body[part],
            _FREE_IN_BODY[0] + _FREE_IN_BODY[1] * samples,
            _FREE[0] + _FREE[1] * samples,
        )
        # One half is added to hits and to the hits at the threshold: few hits are weak evidence,
        # and the ratio is finite without a free path.
        hit = hits[part] > 0
        kinds = matter[part][hit]
        offset, slope = curves[kinds].T
        ratio = np.log((hits[part][hit] + 0.5) / (_PER_M[kinds] * path_m[hit] + 0.5))
        # More hits must never lower a probability, also where the slope is extrapolated to other
        # sizes.
        score[hit] = offset + np.maximum(slope, 0.2) * ratio
        posterior[part] = np.where(hit | (path_m > 0), 1 / (1 + np.exp(-score)), UNKNOWN)
    return posterior


@dataclass(frozen=True, eq=False)
class VoxelCertainty:
    """The certainty of each voxel of a grid.

    The attributes are the fields of the grid: see `docs/format.md#evidence`.

    Attributes:
        occupied: (X, Y, Z) floating, probability that the voxel is occupied; 0.5 if it is unknown.
        classes: (M,) `field_files.VOTES_DTYPE` or `field_files.WIDE_VOTES_DTYPE`, sorted by voxel,
            then by label: the probability of each class if the voxel is occupied, in 1/65535, in
            the column `votes`; only non-zero ones.
        views: (X, Y, Z) uint16, number of scans that saw the voxel.

    Raises:
        FormatError: the arrays differ in shape.
    """

    occupied: AnyFloatArray
    classes: AnyArray
    views: Uint16Array

    def __post_init__(self) -> None:
        if self.views.shape != self.occupied.shape:
            raise FormatError(
                "evidence views",
                expected=f"shape {self.occupied.shape}",
                found=self.views.shape,
            )


def class_shares(votes: AnyArray, classes: ClassTable) -> AnyArray:
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
    shares = np.zeros(len(pairs), field_files.votes_dtype(classes))
    shares["voxel"], shares["label"] = voxel, label
    shares["votes"] = np.floor(of_pair / of_voxel[voxel] * layout.CERTAIN)
    return shares[shares["votes"] > 0]


# Chosen on simulated drives whose labels were made wrong: see docs/studies/wrong-labels.md.
_MIN_SCANS = 4.0  # least number of scans with hits in a voxel that counts for the confusion
_SMOOTHING = 20.0  # number of prior votes in each row of the confusion
_LEAST_WRONG = 1e-3  # least share of wrong labels
_REACH = (2, 2, 1)  # neighbours of a voxel, in voxels along each axis
_PASSES = 2  # number of passes over the neighbours
_SURE = 0.999  # neighbours do not change a voxel with a greater probability
_LEAST_PRIOR = 1e-3  # least prior probability of a class from neighbours
_PRIOR = 6.0  # weight of the most probable class in the shares of a voxel, in votes
_ENOUGH_VOTES = 5.0  # more votes do not raise a probability: a voxel may hold two objects
_FEW = 2.5  # fewer votes are of one object
_SHARES = 5  # number of steps of the estimate of shares


class _Cast(NamedTuple):
    """The votes, by voxel.

    Attributes:
        voxels: (N,) int32 flat indices.
        begins: (N + 1,) int64 first row of each voxel in `own` and `weight`.
        own: (M,) int64 class of each row, as an index.
        weight: (M,) float64 votes of each row.
        total: (N,) float64 votes of each voxel.
        rows: (V,) int32 index of each voxel of the grid in `voxels`; -1 without votes.
        size: of the grid.
    """

    voxels: Int32Array
    begins: IntArray
    own: IntArray
    weight: FloatArray
    total: FloatArray
    rows: Int32Array
    size: tuple[int, int, int]


@dataclass(frozen=True)
class ClassConsensus:
    """The classes on which scans agree.

    Attributes:
        labels: (V,) class of each voxel; 0 without votes.
        shares: (M,) `field_files.VOTES_DTYPE` or `field_files.WIDE_VOTES_DTYPE`, sorted by voxel,
            then by label: the probability of each class if the voxel is occupied, as
            `VoxelCertainty.classes` has them.
        wrong: estimated share of wrong votes.
    """

    labels: LabelArray
    shares: AnyArray
    wrong: float


def agree(votes: AnyArray, spec: GridSpec, classes: ClassTable) -> ClassConsensus:
    """Return the class of each voxel from the votes of all scans.

    Args:
        votes: (M,) structured, as `Votes.occupied`: `voxel`, `label`, `votes`, `voters` and `sure`,
            sorted by voxel, then by label.
        spec: the grid.
        classes: class table of the labels.
    """
    labels = np.zeros(spec.num_voxels, classes.dtype)
    dtype = field_files.votes_dtype(classes)
    if not len(votes):
        return ClassConsensus(labels, np.empty(0, dtype), 0.0)
    counted = np.bincount(votes["label"]) > 0
    present = np.flatnonzero(counted)
    numbers = np.cumsum(counted) - 1
    cast = _Cast._make((*_split_votes(votes, numbers, spec.num_voxels), spec.size))

    # The majority in voxels with many scans stands for the truth there, instead of the iterations
    # of Dawid and Skene. Classes without such voxels get the usual share of errors, spread evenly
    # over the other classes.
    confusion = np.zeros((len(present), len(present)))
    frequency = np.zeros(len(present))
    _compare(cast, confusion, frequency)
    compared = float(confusion.sum())
    wrong = (
        max(1 - float(np.trace(confusion)) / compared, _LEAST_WRONG) if compared else _LEAST_WRONG
    )
    usual = np.full_like(confusion, wrong / max(len(present) - 1, 1))
    np.fill_diagonal(usual, 1 - wrong)
    confusion += _SMOOTHING * usual
    confusion /= confusion.sum(axis=1, keepdims=True)

    # Voxels with enough votes for one class and none for others are decided here, without a search
    # of their neighbours.
    frequency /= frequency.sum()
    first = cast.begins[:-1]
    is_enough = cast.weight[first] >= _needed(confusion, frequency)[cast.own[first]]
    plain = (np.diff(cast.begins) == 1) & is_enough
    place = np.where(plain, -1, np.cumsum(~plain) - 1)
    shares = np.empty((np.count_nonzero(~plain), len(present)), np.float32)
    _find_shares(cast, confusion, frequency, place, shares)
    # Shares are rounded down, so that the sum of a voxel is at most 1.
    shares *= layout.CERTAIN
    table = np.empty(np.count_nonzero(plain) + np.count_nonzero(shares >= 1), dtype)
    _write_shares(cast, present, place, shares, labels, table)
    return ClassConsensus(labels, table, wrong)


def _needed(confusion: FloatArray, frequency: FloatArray) -> FloatArray:
    """Return (K,) the number of votes for one class alone with which neighbours are not needed."""
    gain = np.log(np.diag(confusion)) - np.log(confusion)  # (other class, voted class)
    odds = np.log(_SURE / (1 - _SURE)) + np.log(
        (frequency[:, None] + _LEAST_PRIOR) / (frequency + _LEAST_PRIOR)
    )
    needed = np.where(
        gain > 0,
        odds / np.maximum(gain, 1e-9),
        np.where(np.eye(len(gain), dtype=np.bool_), -np.inf, np.inf),
    )
    return np.asarray(needed.max(axis=0), np.float64)


@cached
def _split_votes(votes: AnyArray, numbers: IntArray, num_voxels: int) -> Any:
    """Return the arrays of `_Cast` for (M,) votes, as in `agree`, with an index for each class."""
    voxels, begins = np.empty(len(votes), np.int32), np.zeros(len(votes) + 1, np.int64)
    own, weight, total = np.empty(len(votes), np.int64), np.empty(len(votes)), np.zeros(len(votes))
    rows = np.full(num_voxels, -1, np.int32)  # dense: neighbours are found without a search
    row, count = 0, 0
    while row < len(votes):
        voxel, voters, points = votes[row].voxel, 0, 0
        voxels[count], rows[voxel] = voxel, count
        while row < len(votes) and votes[row].voxel == voxel:
            voters, points = max(voters, votes[row].voters), points + votes[row].votes
            row += 1
        # Errors of the points of one scan are correlated, so each scan has one vote, which is split
        # among its classes.
        for k in range(begins[count], row):
            own[k] = numbers[votes[k].label]
            weight[k] = votes[k].sure * (voters / points)
            total[count] += weight[k]
        count += 1
        begins[count] = row
    return voxels[:count], begins[: count + 1], own, weight, total[:count], rows


@cached
def _write_shares(
    cast: _Cast,
    present: IntArray,
    place: IntArray,
    shares: Float32Array,
    labels: LabelArray,
    table: AnyArray,
) -> None:
    """Write the likeliest class of each voxel, and the table of shares.

    Args:
        cast: the votes.
        present: (K,) the classes.
        place: (N,) row of each voxel in `shares`; -1 if it has the class of its only row.
        shares: (D, K) in the unit of the table.
        labels: (V,) output.
        table: output, with room for all shares of at least 1.
    """
    end = 0
    for i in range(len(cast.voxels)):
        voxel, likeliest = cast.voxels[i], cast.own[cast.begins[i]]
        if place[i] >= 0:
            likeliest = shares[place[i]].argmax()
        labels[voxel] = present[likeliest]
        for kind in range(len(present)):
            share = np.float32(layout.CERTAIN) if kind == likeliest else np.float32(0)
            if place[i] >= 0:
                share = shares[place[i], kind]
            if share >= 1:
                table[end].voxel, table[end].label = voxel, present[kind]
                table[end].votes = np.uint16(share)
                end += 1


@inlined
def _cell(cast: _Cast, i: int) -> tuple[int, int, int]:
    """Return the cell of voxel i in the grid."""
    voxel, size = cast.voxels[i], cast.size
    return voxel // (size[1] * size[2]), voxel // size[2] % size[1], voxel % size[2]


@cached
def _compare(cast: _Cast, confusion: FloatArray, frequency: FloatArray) -> None:
    """Count votes in voxels among neighbours of their class: `confusion[a, b]`: votes for b in
    voxels of a. `frequency` counts all voxels.
    """
    voxels = cast.voxels
    begins = cast.begins
    own = cast.own
    weight = cast.weight
    most = np.empty(len(voxels), np.int64)
    for i in range(len(voxels)):
        best = begins[i]
        for row in range(begins[i], begins[i + 1]):
            if weight[row] > weight[best]:
                best = row
        most[i] = own[best]
        frequency[most[i]] += 1
    for i in range(len(voxels)):
        if cast.total[i] >= _MIN_SCANS and _is_inside(cast, i, most):
            for row in range(begins[i], begins[i + 1]):
                confusion[most[i], own[row]] += weight[row]


@jit
def _is_inside(cast: _Cast, i: int, most: IntArray) -> bool:
    """Return whether at least two neighbours of a voxel have votes, all most for its class."""
    rows, around = cast.rows, 0
    (a, b, c), (nx, ny, nz) = _cell(cast, i), cast.size
    for x in range(max(a - 1, 0), min(a + 2, nx)):
        for y in range(max(b - 1, 0), min(b + 2, ny)):
            for z in range(max(c - 1, 0), min(c + 2, nz)):
                other = rows[(x * ny + y) * nz + z]
                if other >= 0:  # counts the voxel itself too
                    # One neighbour of another class is a border, where the errors of positions look
                    # like errors of labels.
                    if most[other] != most[i]:
                        return False
                    around += 1
    return around >= 3


@cached
def _find_shares(
    cast: _Cast,
    confusion: FloatArray,
    frequency: FloatArray,
    place: IntArray,
    shares: Float32Array,
) -> None:
    """Find the shares of classes: the probabilities from the votes, and from neighbours if these
    are uncertain, then the mixture.

    Args:
        cast: the votes.
        confusion: (K, K) probability that a point of the first class has a label of the second one.
        frequency: (K,) share of each class.
        place: (N,) row of each voxel in `shares`; -1 if it certainly has the class of its only row.
        shares: (D, K) output.
    """
    kinds, few = len(frequency), np.log(confusion)
    # Many votes for two classes are of two objects in the voxel, so their confusion is made
    # symmetric.
    many = (few + few.T) / 2
    doubtful = np.empty(len(shares), np.int64)
    unsure = 0
    scores = np.empty(kinds)
    usual = np.log(frequency + _LEAST_PRIOR)
    for i in range(len(cast.voxels)):
        if place[i] >= 0:
            scores[:] = usual
            _posterior(cast, i, few, many, scores, shares[place[i]])
            if shares[place[i]].max() < _SURE:
                doubtful[unsure] = i
                unsure += 1
    changed, prior = np.empty((unsure, kinds), np.float32), np.empty(kinds)
    for _ in range(_PASSES):
        # All voxels of a pass see the shares before it: the result does not depend on their order.
        for k in range(unsure):
            i = doubtful[k]
            _neighbour_prior(cast, i, frequency, place, shares, prior)
            for kind in range(kinds):
                scores[kind] = np.log(prior[kind] + _LEAST_PRIOR)
            _posterior(cast, i, few, many, scores, changed[k])
        for k in range(unsure):
            shares[place[doubtful[k]]] = changed[k]
    likeliest, left = np.empty(kinds), np.empty(kinds)
    for i in range(len(cast.voxels)):
        if place[i] >= 0:
            _mix_shares(cast, i, confusion, shares[place[i]], likeliest, left)


@jit
def _posterior(
    cast: _Cast,
    i: int,
    few: FloatArray,
    many: FloatArray,
    scores: FloatArray,
    out: Float32Array,
) -> None:
    """Write the probability of each class of a voxel from its votes and `scores`, the logarithms of
    a prior, which are overwritten.
    """
    begins = cast.begins
    own = cast.own
    weight = cast.weight
    total = cast.total[i]
    likely = few if total < _FEW else many
    for row in range(begins[i], begins[i + 1]):
        votes = min(1.0, _ENOUGH_VOTES / total) * weight[row]
        for c in range(len(scores)):
            scores[c] += votes * likely[c, own[row]]
    # The best score becomes 0 before the exponential, which cannot overflow then.
    best, whole = scores.max(), 0.0
    for c in range(len(scores)):
        scores[c] = np.exp(scores[c] - best)
        whole += scores[c]
    for c in range(len(scores)):
        out[c] = scores[c] / whole


@jit
def _neighbour_prior(
    cast: _Cast,
    i: int,
    frequency: FloatArray,
    place: IntArray,
    shares: Float32Array,
    prior: FloatArray,
) -> None:
    """Write the prior of each class from the neighbours of a voxel.

    Near neighbours, and those with many votes, have more weight.
    """
    # the share of each class counts like a tenth of a neighbour: it decides where there is none
    total = 0.1
    prior[:] = 0.1 * frequency
    # Arrays are taken out of the tuple once: Numba counts a reference each time.
    rows, totals, begins, own = cast.rows, cast.total, cast.begins, cast.own
    (a, b, c), (nx, ny, nz) = _cell(cast, i), cast.size
    low, high = max(c - _REACH[2], 0), min(c + _REACH[2] + 1, nz)
    for x in range(max(a - _REACH[0], 0), min(a + _REACH[0] + 1, nx)):
        for y in range(max(b - _REACH[1], 0), min(b + _REACH[1] + 1, ny)):
            column = (x * ny + y) * nz
            for z in range(low, high):
                other = rows[column + z]
                if other >= 0 and other != i:
                    votes = totals[other]
                    away = (x - a) * (x - a) + (y - b) * (y - b) + 2 * (z - c) * (z - c)
                    part = votes / (votes + 2) / (1 + away)
                    if place[other] >= 0:
                        for kind in range(len(prior)):
                            prior[kind] += part * shares[place[other], kind]
                    else:
                        prior[own[begins[other]]] += part
                    total += part
    prior /= total


@jit
def _mix_shares(
    cast: _Cast,
    i: int,
    confusion: FloatArray,
    shares: Float32Array,
    likeliest: FloatArray,
    left: FloatArray,
) -> None:
    """Replace the class probabilities of a voxel by the shares of classes that fit its votes: a
    voxel may hold two objects.
    """
    begins = cast.begins
    own = cast.own
    weight = cast.weight
    total = cast.total[i]
    # Expectation and maximisation of a mixture: each vote is split among the classes that explain
    # it, and the likeliest classes keep a prior. The start is between both, so that no share of a
    # class with votes is 0: a share of 0 would stay 0.
    likeliest[:] = shares
    shares *= np.float32(0.5)
    for row in range(begins[i], begins[i + 1]):
        shares[own[row]] += np.float32(0.5 * weight[row] / total)
    for _ in range(_SHARES):
        left[:] = _PRIOR * likeliest
        for row in range(begins[i], begins[i + 1]):
            whole = 0.0
            for c in range(len(left)):
                whole += shares[c] * confusion[c, own[row]]
            for c in range(len(left)):
                left[c] += weight[row] * (shares[c] * confusion[c, own[row]]) / whole
        for c in range(len(left)):
            shares[c] = left[c] / (total + _PRIOR)
