"""Consensus: the class of each voxel from scans with wrong labels, whose errors are estimated where
scans disagree.

In a voxel with twenty scans, the majority decides. Many voxels have one or two hits, and a single
wrong label decides them. Dawid and Skene (1979) estimate the confusion of classes from voters that
judge the same object. Here, scans that see the same voxel give the confusion. Where few scans vote,
the classes of the neighbours give a prior. Both have an effect only as far as labels are wrong: if
all scans agree, each voxel keeps the class with most votes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.compiling import cached, jit
from carlasc.core.grids import GridSpec
from carlasc.storage import field_files, layout

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
        rows: (V,) int32 index of each voxel of the grid in `voxels`; -1 without votes.
        size: (3,) int64 of the grid.
    """

    voxels: NDArray[np.int32]
    begins: NDArray[np.int64]
    own: NDArray[np.int64]
    weight: NDArray[np.float64]
    rows: NDArray[np.int32]
    size: NDArray[np.int64]


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

    labels: NDArray[np.unsignedinteger]
    shares: NDArray[Any]
    wrong: float


def agree(votes: NDArray[Any], spec: GridSpec, classes: ClassTable) -> ClassConsensus:
    """Return the class of each voxel from the votes of all scans.

    Args:
        votes: (M,) structured, as `Votes.occupied`: `voxel`, `label`, `votes`, `voters` and `sure`,
            sorted by voxel, then by label.
        spec: the grid.
        classes: class table of the labels.
    """
    labels = np.zeros(spec.num_voxels, classes.dtype)
    dtype = field_files.VOTES_DTYPE if classes.dtype == np.uint8 else field_files.WIDE_VOTES_DTYPE
    if not len(votes):
        return ClassConsensus(labels, np.empty(0, dtype), 0.0)
    counted = np.bincount(votes["label"]) > 0
    present, own = np.flatnonzero(counted), (np.cumsum(counted) - 1)[votes["label"]]
    begins = np.append(np.flatnonzero(np.diff(votes["voxel"], prepend=-1)), len(votes))
    voxels = votes["voxel"][begins[:-1]]
    rows = np.full(spec.num_voxels, -1, np.int32)
    rows[voxels] = np.arange(len(voxels))
    # Errors of the points of one scan are correlated, so each scan has one vote, which is split
    # among its classes.
    scans = np.maximum.reduceat(votes["voters"], begins[:-1]) / np.add.reduceat(
        votes["votes"], begins[:-1]
    )
    weight = votes["sure"] * np.repeat(scans, np.diff(begins))
    cast = _Cast(voxels, begins, own, weight, rows, np.array(spec.size))

    confusion, frequency = np.zeros((len(present), len(present))), np.zeros(len(present))
    _compare(cast, confusion, frequency)
    compared = float(confusion.sum())
    wrong = (
        max(1 - float(np.trace(confusion)) / compared, _LEAST_WRONG) if compared else _LEAST_WRONG
    )
    usual = np.full_like(confusion, wrong / max(len(present) - 1, 1))
    np.fill_diagonal(usual, 1 - wrong)
    confusion += _SMOOTHING * usual
    confusion /= confusion.sum(axis=1, keepdims=True)

    frequency /= frequency.sum()
    first = begins[:-1]
    plain = (np.diff(begins) == 1) & (weight[first] >= _needed(confusion, frequency)[own[first]])
    place = np.where(plain, -1, np.cumsum(~plain) - 1)
    shares = np.empty((np.count_nonzero(~plain), len(present)), np.float32)
    _find_shares(cast, confusion, frequency, place, shares)
    labels[voxels] = present[own[first]]
    labels[voxels[~plain]] = present[shares.argmax(axis=1)]

    row, column = np.nonzero(shares * layout.CERTAIN >= 1)
    found = np.empty(len(row) + np.count_nonzero(plain), dtype)
    found["voxel"] = np.concatenate([voxels[~plain][row], voxels[plain]])
    found["label"] = np.concatenate([present[column], labels[voxels[plain]]])
    found["votes"] = layout.CERTAIN
    found["votes"][: len(row)] = shares[row, column] * layout.CERTAIN
    return ClassConsensus(labels, found[np.argsort(found["voxel"], kind="stable")], wrong)


def _needed(confusion: NDArray[np.float64], frequency: NDArray[np.float64]) -> NDArray[np.float64]:
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


@jit
def _neighbour(cast: _Cast, i: int, x: int, y: int, z: int) -> int:
    """Return the index of the voxel at an offset of x, y and z voxels from voxel i; -1 if it is
    outside of the grid or has no votes.
    """
    voxel, size = cast.voxels[i], cast.size
    a = voxel // (size[1] * size[2]) + x
    b = voxel // size[2] % size[1] + y
    c = voxel % size[2] + z
    if a < 0 or b < 0 or c < 0 or a >= size[0] or b >= size[1] or c >= size[2]:
        return -1
    return int(cast.rows[(a * size[1] + b) * size[2] + c])


@cached
def _compare(cast: _Cast, confusion: NDArray[np.float64], frequency: NDArray[np.float64]) -> None:
    """Count votes in voxels among neighbours of their class: `confusion[a, b]`: votes for b in
    voxels of a. `frequency` counts all voxels.
    """
    voxels, begins, own, weight = cast.voxels, cast.begins, cast.own, cast.weight
    most = np.empty(len(voxels), np.int64)
    for i in range(len(voxels)):
        best = begins[i]
        for row in range(begins[i], begins[i + 1]):
            if weight[row] > weight[best]:
                best = row
        most[i] = own[best]
        frequency[most[i]] += 1
    for i in range(len(voxels)):
        total = weight[begins[i] : begins[i + 1]].sum()
        around = 0
        for x in range(-1, 2):
            for y in range(-1, 2):
                for z in range(-1, 2):
                    other = _neighbour(cast, i, x, y, z)
                    if other >= 0:  # counts the voxel itself too
                        around += 1 if most[other] == most[i] else -27
        if total >= _MIN_SCANS and around >= 3:
            for row in range(begins[i], begins[i + 1]):
                confusion[most[i], own[row]] += weight[row]


@cached
def _find_shares(
    cast: _Cast,
    confusion: NDArray[np.float64],
    frequency: NDArray[np.float64],
    place: NDArray[np.int64],
    shares: NDArray[np.float32],
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
    doubtful, unsure = np.empty(len(shares), np.int64), 0
    for i in range(len(cast.voxels)):
        if place[i] >= 0:
            _posterior(cast, i, few, many, frequency, shares[place[i]])
            if shares[place[i]].max() < _SURE:
                doubtful[unsure] = i
                unsure += 1
    changed, prior = np.empty((unsure, kinds), np.float32), np.empty(kinds)
    for _ in range(_PASSES):
        for k in range(unsure):
            i = doubtful[k]
            _neighbour_prior(cast, i, frequency, place, shares, prior)
            _posterior(cast, i, few, many, prior, changed[k])
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
    few: NDArray[np.float64],
    many: NDArray[np.float64],
    prior: NDArray[np.float64],
    out: NDArray[np.float32],
) -> None:
    """Write the probability of each class of a voxel from its votes and a prior."""
    begins, own, weight = cast.begins, cast.own, cast.weight
    scores = np.log(prior + _LEAST_PRIOR)
    total = weight[begins[i] : begins[i + 1]].sum()
    for row in range(begins[i], begins[i + 1]):
        likely = few[:, own[row]] if total < _FEW else many[:, own[row]]
        scores += min(1.0, _ENOUGH_VOTES / total) * weight[row] * likely
    best = scores.max()
    total = 0.0
    for c in range(len(prior)):
        scores[c] = np.exp(scores[c] - best)
        total += scores[c]
    for c in range(len(prior)):
        out[c] = scores[c] / total


@jit
def _neighbour_prior(
    cast: _Cast,
    i: int,
    frequency: NDArray[np.float64],
    place: NDArray[np.int64],
    shares: NDArray[np.float32],
    prior: NDArray[np.float64],
) -> None:
    """Write the prior of each class from the neighbours of a voxel.

    Near neighbours, and those with many votes, have more weight.
    """
    begins, own, weight = cast.begins, cast.own, cast.weight
    total = 0.1
    prior[:] = 0.1 * frequency
    for x in range(-_REACH[0], _REACH[0] + 1):
        for y in range(-_REACH[1], _REACH[1] + 1):
            for z in range(-_REACH[2], _REACH[2] + 1):
                other = -1 if x == y == z == 0 else _neighbour(cast, i, x, y, z)
                if other >= 0:
                    votes = weight[begins[other] : begins[other + 1]].sum()
                    part = votes / (votes + 2) / (1 + x * x + y * y + 2 * z * z)
                    if place[other] >= 0:
                        prior += part * shares[place[other]]
                    else:
                        prior[own[begins[other]]] += part
                    total += part
    prior /= total


@jit
def _mix_shares(
    cast: _Cast,
    i: int,
    confusion: NDArray[np.float64],
    shares: NDArray[np.float32],
    likeliest: NDArray[np.float64],
    left: NDArray[np.float64],
) -> None:
    """Replace the class probabilities of a voxel by the shares of classes that fit its votes: a
    voxel may hold two objects.
    """
    begins, own, weight = cast.begins, cast.own, cast.weight
    total = weight[begins[i] : begins[i + 1]].sum()
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
