"""Conventions of benchmarks: the scored voxels, the classes, and the classes of the mean.

Papers differ in all of these, so scores can be compared only if their conventions are the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Literal

import numpy as np

from carlasc.core.arrays import AnyArray, BoolArray, LabelArray, Uint8Array
from carlasc.core.benchmarks import (
    IGNORED,
    OCC3D_TO_OPENOCCUPANCY,
    TO_OCC3D,
    TO_SSCBENCH,
)
from carlasc.core.classes import ClassTable, Remap, ids_in, tables_with, times
from carlasc.core.tables import (
    CARLA,
    CARLASC11,
    OCC3D,
    OCCNET,
    OPENOCCUPANCY,
    REMAPS,
    SEMANTICKITTI,
    SEMANTICKITTI19,
    SSCBENCH,
)
from carlasc.errors import FormatError, check_choice
from carlasc.metrics.confusion import ConfusionMatrix

# values in the look-up tables; the scored ids are smaller
_LEFT_OUT = 254
_UNKNOWN = 255

Absent = Literal["zero", "skip", "skip-truth", "nan"]


@dataclass(frozen=True)
class ConventionScore:
    """The scores of a convention, as fractions.

    Attributes:
        miou: mean IoU over the classes of the convention.
        class_iou: IoU by name of each class of the mean; NaN for classes that do not occur in the
            prediction or the ground truth.
        precision: share of the voxels predicted as occupied that are occupied.
        recall: share of the occupied voxels that are predicted as occupied.
        iou: intersection over union of the occupied voxels.
        false_free: share of the occupied voxels that are predicted as free: 1 - recall.
    """

    miou: float
    class_iou: Mapping[str, float]
    precision: float
    recall: float
    iou: float
    false_free: float


@dataclass(frozen=True)
class Convention:
    """The rules by which a benchmark scores grids.

    Attributes:
        name: name of the convention on the command line and in results.
        title: readable name of the benchmark.
        classes: the scored classes.
        free: id of free space among them.
        averaged: ids of the classes of the mean.
        maps: by name of a class table, the scored id, or IGNORED, by id.
        usual_truth: default class table of ground truth files that do not name one: the table of
            the benchmark.
        usual_prediction: default class table of prediction files that do not name one.
        seen_by: sensor whose mask defines the known voxels: "lidar" or "camera".
        unknown: treatment of voxels that are unknown in the ground truth (count 0): "left out", or
            "free" if the benchmark does not distinguish them from free voxels.
        absent: treatment of classes that do not occur in the prediction or the ground truth: "zero"
            counts them as 0 in the mean; "skip" leaves them out; "skip-truth" leaves out classes
            that are not in the ground truth, even if they were predicted; "nan" makes the mean NaN.
        epsilon: added to the denominator of each IoU.
        notes: a remark about the scores, one sentence.
    """

    name: str
    title: str
    classes: ClassTable
    free: int
    averaged: tuple[int, ...]
    maps: Mapping[str, Mapping[int, int]] = field(repr=False)
    usual_truth: ClassTable
    usual_prediction: ClassTable
    seen_by: Literal["lidar", "camera"] = "lidar"
    unknown: Literal["left out", "free"] = "left out"
    absent: Absent = "zero"
    epsilon: float = 0.0
    notes: str = ""

    @property
    def num_classes(self) -> int:
        """Size of the confusion matrix."""
        return max(self.classes.names) + 1

    def check(self, table: ClassTable, where: str) -> None:
        """Check that labels of a class table can be scored.

        Raises:
            FormatError: the convention has no map from this table.
        """
        if table.name not in self.maps:
            raise FormatError(
                where,
                expected=f"a class table with a map in the convention {self.name} "
                f"({', '.join(self.maps)})",
                found=table.name,
                advice="give the classes of the predictions as a file with a `map` from the ids of "
                "the ground truth, or score the data's own classes with `convention=own`",
            )

    def prepare(
        self,
        prediction: tuple[AnyArray, ClassTable],
        truth: tuple[AnyArray, ClassTable],
        known: BoolArray | None,
        region: BoolArray | None = None,
        allow_unknown: bool = False,
    ) -> tuple[LabelArray, LabelArray, BoolArray]:
        """Convert the labels of a frame to the scored classes.

        Args:
            prediction: labels of any shape, and the table of their ids.
            truth: labels of the same shape, and the table of their ids.
            known: known voxels of the ground truth, bool, with the same number of elements; None
                for all.
            region: voxels to score, bool, with the same number of elements; None for all.
            allow_unknown: ids without a class are not scored in the ground truth, and free in
                predictions, instead of an error.

        Returns:
            Predicted and true labels in the scored classes, and the mask of scored voxels.

        Raises:
            FormatError: an id has no target.
        """
        pred, true = (
            self._map(labels, table, name, allow_unknown)
            for (labels, table), name in ((prediction, "prediction"), (truth, "truth"))
        )
        counted = true != _LEFT_OUT
        if known is not None:
            seen = known.reshape(true.shape)
            if self.unknown == "free":
                true = np.where(seen, true, self.free)
                counted |= ~seen
            else:
                counted &= seen
        if region is not None:
            counted &= region.reshape(true.shape)
        pred[pred == _LEFT_OUT] = self.free
        true[true == _LEFT_OUT] = self.free
        return pred, true, counted

    def score(self, matrix: ConfusionMatrix) -> ConventionScore:
        """Return the scores of a confusion matrix, which may be a sum over many frames."""
        union = matrix.true_positives + matrix.false_positives + matrix.false_negatives
        iou = np.divide(
            matrix.true_positives,
            union + self.epsilon,
            out=np.full(len(union), np.nan),
            where=union > 0,
        )[list(self.averaged)]
        in_truth = matrix.counts.sum(axis=1)[list(self.averaged)] > 0
        if self.absent == "zero":
            values = np.nan_to_num(iou)
        elif self.absent == "nan":
            values = iou
        else:
            values = iou[in_truth] if self.absent == "skip-truth" else iou[~np.isnan(iou)]
        if not matrix.total:
            values = np.empty(0)
        occupied = matrix.completeness()
        names = [self.classes.names[index] for index in self.averaged]
        return ConventionScore(
            float(values.mean()) if len(values) else float("nan"),
            dict(zip(names, iou.tolist(), strict=True)),
            **vars(occupied),
            false_free=1 - occupied.recall,
        )

    def unknown_ids(self, labels: AnyArray, table: ClassTable) -> dict[int, int]:
        """Return the ids in labels of a table, of any shape, for which the convention has no class,
        with their numbers of occurrences.
        """
        return ids_in(labels[self._look_up(labels, table) == _UNKNOWN])

    def _look_up(self, labels: AnyArray, table: ClassTable) -> Uint8Array:
        # the last entry is for all larger ids
        ids = labels.astype(np.uint32, copy=False)
        return self._lookups[table.name].take(ids, mode="clip")

    def _map(self, labels: AnyArray, table: ClassTable, where: str, allow: bool) -> Uint8Array:
        ids = self._look_up(labels, table)
        if (unknown := ids == _UNKNOWN).any():
            if not allow:
                found = times(self.unknown_ids(labels, table))
                advice = self._advice(set(np.unique(labels).tolist()), table, where)
                expected = f"class ids of {table.name}"
                raise FormatError(where, expected=expected, found=found, advice=advice)
            ids[unknown] = _LEFT_OUT
        return ids

    def _advice(self, ids: set[int], table: ClassTable, side: str) -> str:
        """Return what to do about ids that are not in a table: the tables that have all of them,
        that of the benchmark first.
        """
        usual = (self.classes, self.usual_truth, self.usual_prediction)
        others = [t for t in (*usual, *tables_with(ids, table)) if t != table]
        names = [t.name for t in others if t.name in self.maps and ids <= {*self.maps[t.name]}]
        allow = "`allow_unknown=True` counts such voxels without scoring them"
        if not names:
            return f"correct the labels; {allow}"
        if side == "prediction":
            return f"if they are ids of {names[0]}, give `source_classes={names[0]}`; {allow}"
        write = f'{{"format": 2, "classes": "{names[0]}"}}'
        return f"if they are ids of {names[0]}, write {write} to carlasc.json; {allow}"

    @cached_property
    def _lookups(self) -> dict[str, Uint8Array]:
        lookups = {}
        for name, mapping in self.maps.items():
            # one more entry, for all larger ids
            lookups[name] = np.full(max(mapping) + 2, _UNKNOWN, np.uint8)
            for old, new in mapping.items():
                lookups[name][old] = _LEFT_OUT if new == IGNORED else new
        return lookups


def convention_named(name: str) -> Convention:
    """Return a convention by name.

    Raises:
        ArgumentError: no convention has that name.
    """
    check_choice("convention", name, CONVENTIONS)
    return CONVENTIONS[name]


def own_convention(table: ClassTable, *, remap: Remap | None = None) -> Convention:
    """Return a convention that scores the unchanged ids of a class table: known voxels, and the
    mean over all classes that occur, including free.

    Args:
        table: the scored classes.
        remap: map from the ids of another table, whose labels can then be scored too.
    """
    maps = {table.name: _identity(table)}
    if remap is not None:
        maps[remap.source.name] = dict(remap.mapping)
    return Convention(
        "own",
        f"the data's own classes ({table.name})",
        table,
        table.free,
        tuple(sorted(table.names)),
        maps,
        table,
        table,
        absent="skip",
        notes="Scores of other data sets cannot be compared with this one.",
    )


def _identity(table: ClassTable) -> dict[int, int]:
    return {i: i for i in table.names}


def _without_zero(mapping: Mapping[int, int]) -> dict[int, int]:
    """Return a map to the 19 classes of SemanticKITTI without ids above 0 that map to 0, because 0
    is empty space.
    """
    return {old: IGNORED if new == 0 and old != 0 else new for old, new in mapping.items()}


def _via(first: Mapping[int, int], second: Mapping[int, int]) -> dict[int, int]:
    return {old: IGNORED if new == IGNORED else second[new] for old, new in first.items()}


_FROM_OCCNET = {i: OPENOCCUPANCY.id_of(name) for i, name in OCCNET.names.items() if i < 16}
_RAW_TO_19 = _without_zero(REMAPS["semantickitti19"].mapping)
_CARLA_TO_RAW = REMAPS["carla_to_semantickitti"].mapping
_CARLASC11_TO_19 = {0: 0, 1: 13, 2: 14, 3: IGNORED, 4: 6, 5: 18, 6: 9, 7: 17, 8: 11, 9: 15, 10: 1}
_OPENOCCUPANCY = Convention(
    "openoccupancy",
    "OpenOccupancy-nuScenes",
    OPENOCCUPANCY,
    0,
    tuple(range(1, 17)),
    {name: _via(mapping, OCC3D_TO_OPENOCCUPANCY) for name, mapping in TO_OCC3D.items()}
    | {"openoccupancy": _identity(OPENOCCUPANCY) | {255: IGNORED}}
    | {"occnet": _FROM_OCCNET | {16: 0, 255: IGNORED}},
    OPENOCCUPANCY,
    OPENOCCUPANCY,
    unknown="free",
    absent="nan",
    notes="The benchmark has no mask: an unobserved voxel counts as empty, and an "
    "absent class makes the mean NaN.",
)
_OCC3D_LIDAR = Convention(
    "occ3d-lidar",
    "Occ3D-nuScenes, voxels that the LiDAR observed",
    OCC3D,
    17,
    tuple(range(17)),
    dict(TO_OCC3D) | {"occ3d": _identity(OCC3D) | {255: IGNORED}},
    OCC3D,
    OCC3D,
    absent="skip",
    notes='"others" is one of the classes of the mean; SparseOcc\'s script is '
    "occ3d-lidar-sparseocc.",
)

CONVENTIONS: Mapping[str, Convention] = MappingProxyType(
    {
        convention.name: convention
        for convention in (
            Convention(
                "carlasc",
                "CarlaSC (MotionSC, RA-L 2022)",
                CARLASC11,
                0,
                tuple(range(11)),
                {
                    "carla": REMAPS["carlasc11"].mapping,
                    "carlasc11": _identity(CARLASC11),
                    "carla0.9.14": _via(
                        REMAPS["carla0914_to_carla"].mapping, REMAPS["carlasc11"].mapping
                    ),
                    "semantickitti": _via(
                        REMAPS["semantickitti_to_carla"].mapping, REMAPS["carlasc11"].mapping
                    ),
                },
                CARLA,
                CARLASC11,
                notes="Free space is one of the classes of the mean.",
            ),
            Convention(
                "semantickitti",
                "SemanticKITTI, semantic scene completion",
                SEMANTICKITTI19,
                0,
                tuple(range(1, 20)),
                {
                    "semantickitti": _RAW_TO_19,
                    "semantickitti19": _identity(SEMANTICKITTI19) | {255: IGNORED},
                    "carla0.9.14": _without_zero(
                        _via(REMAPS["carla0914_to_carla"].mapping, _via(_CARLA_TO_RAW, _RAW_TO_19))
                    )
                    | {0: 0, 11: 0, 23: 0},
                    "carla": _without_zero(_via(_CARLA_TO_RAW, _RAW_TO_19)) | {13: 0, 21: 0},
                    "carlasc11": _CARLASC11_TO_19,
                },
                SEMANTICKITTI,
                SEMANTICKITTI,
                notes="Classes outside the 19 are ignored in the ground truth, and empty in "
                "predictions (the official script stops).",
            ),
            Convention(
                "sscbench",
                "SSCBench and MonoScene",
                SSCBENCH,
                0,
                tuple(range(1, 19)),
                dict(TO_SSCBENCH) | {"sscbench": _identity(SSCBENCH) | {255: IGNORED}},
                SEMANTICKITTI,
                SEMANTICKITTI,
                epsilon=1e-5,
                notes="An unknown voxel is left out only where its label is 0; ours always are.",
            ),
            _OCC3D_LIDAR,
            replace(
                _OCC3D_LIDAR,
                name="occ3d-lidar-sparseocc",
                title="Occ3D-nuScenes as SparseOcc's script takes the mean",
                absent="skip-truth",
                notes="A class that is not in the ground truth is left out of the mean, even if it "
                "was predicted.",
            ),
            replace(
                _OCC3D_LIDAR,
                name="occ3d-camera",
                title="Occ3D-nuScenes, voxels that a camera observed",
                seen_by="camera",
                notes="This score needs grids with the field `seen`, which voxels a camera "
                "observed.",
            ),
            _OPENOCCUPANCY,
            replace(
                _OPENOCCUPANCY,
                name="surroundocc",
                title="SurroundOcc-nuScenes",
                notes="The rules of OpenOccupancy on another grid: noise does not count.",
            ),
            replace(
                _OPENOCCUPANCY,
                name="occnet",
                title="OccNet and OpenScene, voxels",
                usual_truth=OCCNET,
                usual_prediction=OCCNET,
                notes="The 16 classes of OpenOccupancy; its challenge takes RayIoU (--rays).",
            ),
        )
    }
)
