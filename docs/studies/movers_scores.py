"""What `movers.py` measures of a grid, as counts that can be added, and the figures that follow
from them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from movers_drives import MOVES_M_S, Reference
from numpy.typing import NDArray

from carlasc import Grid
from carlasc.core.tables import CARLA

CLASSES = {name: CARLA.id_of(name) for name in ("Vehicle", "Pedestrian", "Road", "Building")}
GROUPS = ("free", *CLASSES, "other classes")  # of what a voxel is called
SPEEDS_M_S = (MOVES_M_S, 4.0, 8.0, np.inf)  # bands of the speed of vehicles
_BINS = 200  # of the posterior, before they are joined to bins of equal mass
_MASSES = 15
# bounds of the bins of the reliability diagram
RELIABILITY = (
    0.0,
    0.05,
    0.2,
    0.4,
    0.6,
    0.8,
    0.95,
    1.0,
)
MARGIN = 0.05  # voxels with a posterior between it and 1 - MARGIN are the uncertain ones


@dataclass
class Counts:
    """What was counted in some grids, beside references.

    Attributes:
        classes: by class: voxels known to both of the right class, of the class in the reference,
            of the class in the grid; then all of the class in the reference, those of them that are
            called free, and those that are unknown.
        occupied: voxels known to both that are wrongly occupied, and those that are wrongly free.
        movers: class, speed, sides seen, voxels of the reference, those found and those called
            free, of each mover in each frame.
        posterior: (G, 3, bins): voxels, sum of their posterior and number of the occupied ones, by
            `GROUPS` and posterior; zeros without evidence.
        seconds: time for each grid.
    """

    classes: NDArray[np.int64] = field(
        default_factory=lambda: np.zeros((len(CLASSES), 6), np.int64)
    )
    occupied: NDArray[np.int64] = field(default_factory=lambda: np.zeros(2, np.int64))
    movers: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 6)))
    posterior: NDArray[np.float64] = field(
        default_factory=lambda: np.zeros((len(GROUPS), 3, _BINS))
    )
    seconds: list[float] = field(default_factory=list)

    def __add__(self, other: Counts) -> Counts:
        return Counts(
            self.classes + other.classes,
            self.occupied + other.occupied,
            np.concatenate([self.movers, other.movers]),
            self.posterior + other.posterior,
            self.seconds + other.seconds,
        )

    def to_json(self) -> dict[str, Any]:
        """Return the counts as plain values."""
        return {
            name: value if isinstance(value, list) else value.tolist()
            for name, value in vars(self).items()
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Counts:
        """Return the counts of plain values."""
        return cls(
            np.array(values["classes"], np.int64),
            np.array(values["occupied"], np.int64),
            np.array(values["movers"], np.float64).reshape(-1, 6),
            np.array(values["posterior"], np.float64),
            list(values["seconds"]),
        )


def count(
    grid: Grid,
    reference: Reference,
    sides: Mapping[int, int],
    posterior: NDArray[np.floating] | None = None,
    seconds: float = 0.0,
) -> Counts:
    """Count what is right and wrong in a grid.

    Args:
        grid: the grid.
        reference: what other sensors saw.
        sides: number of sides that the scans saw of each actor.
        posterior: (X, Y, Z) probability that a voxel is occupied, if there is one.
        seconds: time that the grid took.
    """
    made, known = grid.labels, grid.known
    truth, judged = reference.labels, reference.judged
    both = judged & known
    rows = []
    for label in CLASSES.values():
        own, found = judged & (truth == label), made == label
        rows.append(
            [
                (own & known & found).sum(),
                (own & known).sum(),
                (both & found).sum(),
                own.sum(),
                (own & known & (made == 0)).sum(),
                (own & ~known).sum(),
            ]
        )
    wrong = [(both & (truth == 0) & (made != 0)).sum(), (both & (truth != 0) & (made == 0)).sum()]
    return Counts(
        np.array(rows, np.int64),
        np.array(wrong, np.int64),
        _movers(grid, reference, sides),
        _calibration(posterior, truth, made, both),
        [seconds],
    )


def _movers(grid: Grid, reference: Reference, sides: Mapping[int, int]) -> NDArray[np.float64]:
    """Return the rows of `Counts.movers` of a frame."""
    rows = []
    for name in ("Vehicle", "Pedestrian"):
        voxels = reference.judged & (reference.labels == CLASSES[name]) & (reference.owner > 0)
        owner, known, labels = reference.owner[voxels], grid.known[voxels], grid.labels[voxels]
        for actor in np.unique(owner).tolist():
            own = owner == actor
            found, free = own & known & (labels == CLASSES[name]), own & known & (labels == 0)
            speed = reference.speeds[actor]
            if speed > MOVES_M_S:
                rows.append(
                    [CLASSES[name], speed, sides.get(actor, 0), own.sum(), found.sum(), free.sum()]
                )
    return np.array(rows, np.float64).reshape(-1, 6)


def _calibration(
    posterior: NDArray[np.floating] | None,
    truth: NDArray[np.integer],
    made: NDArray[np.integer],
    both: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Return `Counts.posterior` of a frame."""
    if posterior is None:
        return np.zeros((len(GROUPS), 3, _BINS))
    group = np.full(256, len(GROUPS) - 1)
    group[[0, *CLASSES.values()]] = np.arange(len(GROUPS) - 1)
    groups, values, occupied = (
        group[made[both]],
        posterior[both].astype(np.float64),
        truth[both] != 0,
    )
    return np.stack(
        [histogram(values[groups == g], occupied[groups == g]) for g in range(len(GROUPS))]
    )


def histogram(posterior: NDArray[np.floating], occupied: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return (3, bins) rows of `Counts.posterior` of (V,) voxels: their probability of being
    occupied, and whether they are.
    """
    bins = np.clip((posterior * _BINS).astype(np.int64), 0, _BINS - 1)
    weights = (np.ones(len(bins)), posterior.astype(np.float64), occupied.astype(np.float64))
    return np.stack([np.bincount(bins, weight, _BINS) for weight in weights])


def calibration_error(histogram: NDArray[np.float64], margin: float = 0.0) -> float:
    """Return the expected calibration error over bins of equal mass; NaN without voxels.

    Args:
        histogram: (3, bins) of a group, or of all, in `Counts.posterior`.
        margin: leave out posteriors below it and above 1 - margin.
    """
    bins = histogram.shape[1]
    middle = (np.arange(bins) + 0.5) / bins
    chosen = histogram[:, (middle >= margin) & (middle <= 1 - margin)]
    total = chosen[0].sum()
    if not total:
        return float("nan")
    mass = np.minimum(
        ((np.cumsum(chosen[0]) - chosen[0] / 2) / total * _MASSES).astype(np.int64), _MASSES - 1
    )
    gaps = np.bincount(mass, chosen[1] - chosen[2], _MASSES)
    return float(np.abs(gaps).sum() / total)


def figures(counts: Counts) -> dict[str, float]:
    """Return the figures of some grids, NaN where nothing was counted.

    Shares are between 0 and 1, `wrongly` counts per grid.
    """
    found: dict[str, float] = {}
    for name, (right, known, made, whole, free, _) in zip(
        CLASSES, counts.classes.tolist(), strict=True
    ):
        found[f"{name} IoU"] = _ratio(right, known + made - right)
        found[f"{name} IoU, all"] = _ratio(right, whole + made - right)
        found[f"{name} recall"] = _ratio(right, known)
        found[f"{name} found"], found[f"{name} free"] = _ratio(right, whole), _ratio(free, whole)
        found[f"wrongly {name}"] = (made - right) / max(len(counts.seconds), 1)
    found["wrongly occupied"] = counts.occupied[0] / max(len(counts.seconds), 1)
    found["ECE"] = calibration_error(counts.posterior.sum(axis=0))
    found["ECE, uncertain"] = calibration_error(counts.posterior.sum(axis=0), MARGIN)
    found["seconds"] = float(np.mean(counts.seconds)) if counts.seconds else float("nan")
    return found


def reliability(counts: Counts) -> list[tuple[float, float, int, float, float]]:
    """Return the bins of a reliability diagram: bounds of the posterior, voxels, their mean
    posterior and the share that is occupied.
    """
    voxels, posterior, occupied = counts.posterior.sum(axis=0)
    bounds = (np.array(RELIABILITY) * _BINS).round().astype(int)
    rows = []
    for first, last in pairwise(bounds.tolist()):
        count = int(voxels[first:last].sum())
        means = (
            _ratio(posterior[first:last].sum(), count),
            _ratio(occupied[first:last].sum(), count),
        )
        rows.append((first / _BINS, last / _BINS, count, *means))
    return rows


def groups(counts: Counts) -> dict[str, tuple[float, float, int]]:
    """Return the share found and the share called free of the voxels of movers, and their number,
    by group.
    """
    label, speed, sides = counts.movers[:, 0], counts.movers[:, 1], counts.movers[:, 2]
    vehicle = label == CLASSES["Vehicle"]
    chosen = {"people": ~vehicle}
    for low, high in pairwise(SPEEDS_M_S):
        name = f"{low:g} to {high:g} m/s" if np.isfinite(high) else f"over {low:g} m/s"
        chosen[f"vehicles, {name}"] = vehicle & (speed > low) & (speed <= high)
    for number in range(5):
        chosen[f"vehicles, {number} side{'s' if number != 1 else ''} seen"] = vehicle & (
            sides == number
        )
    result = {}
    for name, rows in chosen.items():
        voxels, found, free = counts.movers[rows, 3:].sum(axis=0).tolist()
        result[name] = (_ratio(found, voxels), _ratio(free, voxels), int(voxels))
    return result


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
