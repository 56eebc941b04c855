"""The class of each voxel, from scans that may be wrong: how often labels are wrong is estimated from scans that disagree.

A voxel with the votes of twenty scans has the class of most of them, but many voxels were hit once or twice, and one wrong label decides them.
Dawid and Skene (1979) estimate what each class is mistaken for from voters who judge the same thing; so do scans that see the same voxel. Where
few scans vote, the classes of the neighbours say what is likely. Both count only as much as labels are wrong: if all scans agree, each voxel
keeps the class with most votes.
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
_JUDGES = 4.0  # scans that must have hit a voxel for it to show how often labels are wrong
_SMOOTHING = 20.0  # votes that each row of the confusion starts with
_LEAST_WRONG = 1e-3  # no labels are better
_REACH = (2, 2, 1)  # neighbours of a voxel, in voxels along each axis
_ROUNDS = 2  # of asking the neighbours
_SURE = 0.999  # a voxel whose own votes say more is not changed by its neighbours
_UNHEARD = 1e-3  # least probability that neighbours give a class
_PRIOR = 6.0  # weight of the likeliest class in the shares of a voxel, in votes
_HEARD = 5.0  # votes after which more of them make no class likelier: a voxel may hold two things
_FEW = 2.5  # fewer votes are of one thing
_SHARES = 5  # steps in which shares are found


class _Cast(NamedTuple):
    """The votes that were cast, by voxel.

    Attributes:
        voxels: (N,) int32 flat indices.
        begins: (N + 1,) int64 first row of each voxel in the next two.
        own: (M,) int64 the class of each row, as an index.
        weight: (M,) float64 its votes.
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
    """What scans agree on.

    Attributes:
        labels: (V,) class of each voxel; 0 without votes.
        shares: (M,) `field_files.VOTES_DTYPE` or `field_files.WIDE_VOTES_DTYPE`, sorted by voxel, then by label: the probability of each class if the
            voxel is occupied, as `VoxelCertainty.classes` has them.
        wrong: share of the votes that are estimated to be wrong.
    """

    labels: NDArray[np.unsignedinteger]
    shares: NDArray[Any]
    wrong: float


def agree(votes: NDArray[Any], spec: GridSpec, classes: ClassTable) -> ClassConsensus:
    """Return the class that each voxel has by the votes of all scans.

    Args:
        votes: (M,) structured, as `Votes.occupied`: `voxel`, `label`, `votes`, `voters` and `sure`, sorted by voxel, then by label.
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
    # The points of one scan are wrong together, so each scan counts as one vote, of which each class has its share.
    scans = np.maximum.reduceat(votes["voters"], begins[:-1]) / np.add.reduceat(votes["votes"], begins[:-1])
    weight = votes["sure"] * np.repeat(scans, np.diff(begins))
    cast = _Cast(voxels, begins, own, weight, rows, np.array(spec.size))

    confusion, frequency = np.zeros((len(present), len(present))), np.zeros(len(present))
    _compare(cast, confusion, frequency)
    compared = float(confusion.sum())
    wrong = max(1 - float(np.trace(confusion)) / compared, _LEAST_WRONG) if compared else _LEAST_WRONG
    usual = np.full_like(confusion, wrong / max(len(present) - 1, 1))
    np.fill_diagonal(usual, 1 - wrong)
    confusion += _SMOOTHING * usual
    confusion /= confusion.sum(axis=1, keepdims=True)

    frequency /= frequency.sum()
    first = begins[:-1]
    plain = (np.diff(begins) == 1) & (weight[first] >= _needed(confusion, frequency)[own[first]])
    place = np.where(plain, -1, np.cumsum(~plain) - 1)
    shares = np.empty((np.count_nonzero(~plain), len(present)), np.float32)
    _ask(cast, confusion, frequency, place, shares)
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
    """Return (K,) how many votes for a class alone make it so sure that neighbours are not asked."""
    gain = np.log(np.diag(confusion)) - np.log(confusion)  # (other class, voted class)
    odds = np.log(_SURE / (1 - _SURE)) + np.log((frequency[:, None] + _UNHEARD) / (frequency + _UNHEARD))
    needed = np.where(
        gain > 0, odds / np.maximum(gain, 1e-9), np.where(np.eye(len(gain), dtype=np.bool_), -np.inf, np.inf)
    )
    return np.asarray(needed.max(axis=0), np.float64)


@jit
def _neighbour(cast: _Cast, i: int, x: int, y: int, z: int) -> int:
    """Return the index of the voxel that is x, y and z voxels away from voxel i; -1 if it is outside of the grid or has no votes."""
    voxel, size = cast.voxels[i], cast.size
    a = voxel // (size[1] * size[2]) + x
    b = voxel // size[2] % size[1] + y
    c = voxel % size[2] + z
    if a < 0 or b < 0 or c < 0 or a >= size[0] or b >= size[1] or c >= size[2]:
        return -1
    return int(cast.rows[(a * size[1] + b) * size[2] + c])


@cached
def _compare(cast: _Cast, confusion: NDArray[np.float64], frequency: NDArray[np.float64]) -> None:
    """Count the votes of voxels amid others of their class: `confusion[a, b]` of those for b in voxels of a. `frequency` counts all voxels."""
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
                    if other >= 0:  # itself among them
                        around += 1 if most[other] == most[i] else -27
        if total >= _JUDGES and around >= 3:
            for row in range(begins[i], begins[i + 1]):
                confusion[most[i], own[row]] += weight[row]


@cached
def _ask(
    cast: _Cast,
    confusion: NDArray[np.float64],
    frequency: NDArray[np.float64],
    place: NDArray[np.int64],
    shares: NDArray[np.float32],
) -> None:
    """Find the shares of classes: the likeliest class of each voxel, from its neighbours too where it is in doubt, then what explains the votes.

    Args:
        cast: the votes.
        confusion: (K, K) probability that something of the first class is called the second one.
        frequency: (K,) share of each class.
        place: (N,) row of each voxel in `shares`; -1 if it is plainly of the class of its only row.
        shares: (D, K) output.
    """
    kinds, few = len(frequency), np.log(confusion)
    # Many votes for two classes are of two things in the voxel: each explains the points of the other as badly as the other way round.
    many = (few + few.T) / 2
    doubtful, asked = np.empty(len(shares), np.int64), 0
    for i in range(len(cast.voxels)):
        if place[i] >= 0:
            _weigh(cast, i, few, many, frequency, shares[place[i]])
            if shares[place[i]].max() < _SURE:
                doubtful[asked] = i
                asked += 1
    changed, prior = np.empty((asked, kinds), np.float32), np.empty(kinds)
    for _ in range(_ROUNDS):
        for k in range(asked):
            i = doubtful[k]
            _hear(cast, i, frequency, place, shares, prior)
            _weigh(cast, i, few, many, prior, changed[k])
        for k in range(asked):
            shares[place[doubtful[k]]] = changed[k]
    likeliest, left = np.empty(kinds), np.empty(kinds)
    for i in range(len(cast.voxels)):
        if place[i] >= 0:
            _explain(cast, i, confusion, shares[place[i]], likeliest, left)


@jit
def _weigh(
    cast: _Cast,
    i: int,
    few: NDArray[np.float64],
    many: NDArray[np.float64],
    prior: NDArray[np.float64],
    out: NDArray[np.float32],
) -> None:
    """Write the probability of each class by the votes of a voxel and what is likely before."""
    begins, own, weight = cast.begins, cast.own, cast.weight
    scores = np.log(prior + _UNHEARD)
    total = weight[begins[i] : begins[i + 1]].sum()
    for row in range(begins[i], begins[i + 1]):
        likely = few[:, own[row]] if total < _FEW else many[:, own[row]]
        scores += min(1.0, _HEARD / total) * weight[row] * likely
    best = scores.max()
    total = 0.0
    for c in range(len(prior)):
        scores[c] = np.exp(scores[c] - best)
        total += scores[c]
    for c in range(len(prior)):
        out[c] = scores[c] / total


@jit
def _hear(
    cast: _Cast,
    i: int,
    frequency: NDArray[np.float64],
    place: NDArray[np.int64],
    shares: NDArray[np.float32],
    prior: NDArray[np.float64],
) -> None:
    """Write how likely each class is by the neighbours of a voxel: near ones, and those that many scans hit, count more."""
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
def _explain(
    cast: _Cast,
    i: int,
    confusion: NDArray[np.float64],
    shares: NDArray[np.float32],
    likeliest: NDArray[np.float64],
    left: NDArray[np.float64],
) -> None:
    """Replace the probabilities of a voxel's class by the shares of classes in it that explain its votes: a voxel may hold two things."""
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
