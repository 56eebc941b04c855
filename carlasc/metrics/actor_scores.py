"""Scores of the actor and the velocity of each voxel: panoptic quality, tracking over time,
velocity errors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray, AnyFloatArray, BoolArray, Float32Array, LabelArray
from carlasc.core.classes import ClassTable
from carlasc.errors import ArgumentError
from carlasc.metrics.confusion import json_number, ratio
from carlasc.metrics.conventions import Convention
from carlasc.metrics.grids import SequenceGrid
from carlasc.metrics.pairs import Pair
from carlasc.metrics.panoptic import PanopticQuality, PanopticScore
from carlasc.metrics.temporal import TrackingQuality, TrackingScore
from carlasc.storage.field_files import dense_velocity

SPEEDS_M_S = (0.0, 2.0, 5.0, 10.0)
"""Lower bounds of the speed bands in which velocities are scored, m/s."""
Prepared = tuple[LabelArray, LabelArray, BoolArray]


@dataclass(frozen=True)
class ActorScore:
    """Scores of the predicted actors and velocities of voxels.

    Attributes:
        panoptic: panoptic quality of each class.
        tracking: quality of segmentation and tracking (LSTQ) over the frames of each sequence.
        velocity_m_s: mean length of the velocity error, over voxels that move in the ground truth,
            m/s; NaN if no voxel moves.
        velocity_by_class: mean velocity error by class name, m/s.
        velocity_by_speed: mean velocity error by the lower bound of the band of the true speed,
            m/s.
    """

    panoptic: PanopticScore
    tracking: TrackingScore
    velocity_m_s: float
    velocity_by_class: Mapping[str, float]
    velocity_by_speed: Mapping[float, float]

    def to_dict(self, classes: ClassTable) -> dict[str, Any]:
        """Return all scores by name, as fractions and m/s, for JSON; None for undefined scores."""
        pq = self.panoptic.pq
        means = {what: self.panoptic.mean(what) for what in ("pq", "sq", "rq")}
        figures = means | {"pq_things": self.panoptic.mean(which="things")} | vars(self.tracking)
        figures |= {"velocity_m_s": self.velocity_m_s}
        by_speed = {f"from {low:g} m/s": value for low, value in self.velocity_by_speed.items()}
        groups = {
            "class_pq": {n: pq[label] for label, n in classes.names.items() if label < len(pq)},
            "velocity_by_class": self.velocity_by_class,
            "velocity_by_speed": by_speed,
        }
        return {name: json_number(value) for name, value in figures.items()} | {
            name: {key: json_number(value) for key, value in group.items()}
            for name, group in groups.items()
        }


class ActorScores:
    """Accumulates frames of all sequences, in the classes of a convention."""

    def __init__(self, convention: Convention) -> None:
        self.convention = convention
        k = convention.num_classes
        free = convention.free
        table = convention.usual_truth
        scored = set(convention.averaged) - {free}
        mapping = convention.maps[table.name]
        things = frozenset({mapping[i] for i in table.movable if i in mapping} & scored)
        self.panoptic = PanopticQuality(k, things, free=free)
        self.tracking = TrackingQuality(k, things, unaveraged={free})
        # sum of errors and number of voxels, by class and speed band
        self.errors = np.zeros((2, k, len(SPEEDS_M_S)))

    @staticmethod
    def check(pair: Pair) -> None:
        """Check that the prediction and the ground truth have instances.

        Raises:
            ArgumentError: one of them has no field `instance`.
        """
        for side in (pair.truth, pair.prediction):
            if (
                not isinstance(side, SequenceGrid)
                or f"{side.grid}/instance" not in side.sequence.fields()
            ):
                raise ArgumentError(
                    "actors",
                    expected="grids with instances for prediction and ground truth",
                    found=f"no instances in {side.location}",
                    advice="make the ground truth with `regrid --keep-actors`",
                )

    def update(self, pair: Pair, frame: int, prepared: Prepared) -> None:
        """Add a frame.

        Args:
            pair: prediction and ground truth.
            frame: frame number.
            prepared: predicted and true classes of the convention, (X, Y, Z), and the mask of
                scored voxels, (X, Y, Z) bool.

        Raises:
            FormatError: a file does not fit its grid.
        """
        prediction, truth, counted = prepared
        known = dict[str, AnyArray]()
        moving = dict[str, AnyFloatArray]()
        for name, side in (("prediction", pair.prediction), ("truth", pair.truth)):
            if isinstance(side, SequenceGrid):
                known[name] = side.sequence.read(f"{side.grid}/instance", frame)
                moving[name] = _dense(side, frame, truth.shape)
        numberless = np.isin(truth, sorted(self.panoptic.things)) & (known["truth"] == 0)
        # without voxels of movable classes whose actor is not known
        counted = counted & ~numberless
        sides = (prediction, known["prediction"]), (truth, known["truth"])
        self.panoptic.update(*sides, mask=counted)
        self.tracking.update(pair.truth.path, *sides, mask=counted)
        moves = counted.reshape(-1) & (moving["truth"] != 0).any(axis=1)
        speed = np.linalg.norm(moving["truth"][moves], axis=1)
        error = np.linalg.norm(moving["prediction"][moves] - moving["truth"][moves], axis=1)
        place = (
            truth.reshape(-1)[moves].astype(np.int64),
            np.searchsorted(SPEEDS_M_S, speed, side="right") - 1,
        )
        np.add.at(self.errors[0], place, error)
        np.add.at(self.errors[1], place, 1)

    def merge(self, other: ActorScores) -> None:
        """Add the sums of another object with the same convention."""
        self.panoptic.merge(other.panoptic)
        self.tracking.merge(other.tracking)
        self.errors += other.errors

    def compute(self) -> ActorScore:
        """Return the scores of all added frames."""
        total, count = self.errors
        by_class, by_speed = (ratio(total.sum(axis=a), count.sum(axis=a)) for a in (1, 0))
        names = self.convention.classes.names
        return ActorScore(
            self.panoptic.compute(),
            self.tracking.compute(),
            float(ratio(total.sum(), count.sum())),
            {names[label]: float(by_class[label]) for label in sorted(self.panoptic.things)},
            dict(zip(SPEEDS_M_S, by_speed.tolist(), strict=True)),
        )


def _dense(side: SequenceGrid, frame: int, size: tuple[int, ...]) -> Float32Array:
    """Return (V, 3) float32 velocities of voxels, m/s; zero where nothing moves or the grid has no
    velocities.
    """
    name = f"{side.grid}/velocity"
    if name not in side.sequence.fields() or frame not in side.sequence.frames(name):
        return np.zeros((math.prod(size), 3), np.float32)
    where = f"{side.sequence.location}: {name} of frame {frame}"
    return dense_velocity(side.sequence.read(name, frame), size, where).reshape(-1, 3)
