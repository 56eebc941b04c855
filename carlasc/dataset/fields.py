"""The fields of a sample: names, types, and collation to a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from carlasc.core.arrays import (
    AnyArray,
    BoolArray,
    Float32Array,
    FloatArray,
    Int32Array,
    IntArray,
    Uint8Array,
)
from carlasc.core.cameras import CameraModel
from carlasc.errors import ArgumentError, check_types, import_extra

FIELDS = (
    "occupancy",
    "density",
    "visibility",
    "labels",
    "known",
    "counts",
    "points",
    "point_labels",
    "flow",
    "remission",
    "poses",
)
"""Fields that are available with published data."""
EVIDENCE_FIELDS = ("posterior", "occupied", "flags", "views")
"""Fields of grids about the certainty of each voxel. Published grids do not have them."""
ACTOR_FIELDS = ("instances", "voxel_flow")
"""Fields of grids about the actor and the velocity of each voxel."""
CAMERA_FIELDS = ("camera_visible", "images", "cameras")
"""Fields of data with cameras."""
ALWAYS = ("valid", "sequence", "frame")
STACKS = frozenset({"occupancy", "density", "visibility"})  # one grid per scan
PLAIN = ("cameras",)  # no arrays
RAGGED = ("points", "point_labels", "flow", "remission")  # one row per point of the scan


class Sample(TypedDict, total=False):
    """A sample of a `Dataset`: the requested fields, and `valid`, `sequence` and `frame`.

    For shapes and units, see `Dataset`.
    """

    occupancy: Uint8Array
    density: Int32Array
    visibility: Uint8Array
    labels: NDArray[np.integer[Any]]
    known: BoolArray
    counts: Float32Array
    posterior: Float32Array
    occupied: Float32Array
    flags: Uint8Array
    views: Int32Array
    instances: IntArray
    voxel_flow: Float32Array
    camera_visible: Uint8Array
    images: Mapping[str, Uint8Array]
    cameras: Mapping[str, CameraModel]
    points: Float32Array
    point_labels: NDArray[np.integer[Any]]
    flow: Float32Array
    remission: Float32Array
    poses: FloatArray
    valid: BoolArray
    sequence: str
    frame: int


Values = dict[str, Any]
"""Some fields of a sample, with names that are known at run time only."""


def collate(samples: Sequence[Mapping[str, object]]) -> dict[str, Any]:
    """Return a batch of samples, also with fields that have one row per point.

    Use it as the `collate_fn` of a DataLoader.

    `points`, `point_labels`, `flow` and `remission` become lists of B tensors, and `cameras` a
    list, one per sample. All other fields are stacked as by torch's default_collate does.

    Raises:
        ArgumentError: there are no samples.
        DependencyError: torch is not installed.
    """
    check_types(collate, locals())
    if not samples or not all(isinstance(sample, Mapping) for sample in samples):
        raise ArgumentError("samples", expected="samples of a Dataset", found=repr(samples)[:80])
    torch = import_extra("torch", "torch")
    given: list[Values] = [dict(sample) for sample in samples]
    dense = [
        {name: value for name, value in sample.items() if name not in (*RAGGED, *PLAIN)}
        for sample in given
    ]
    batch: dict[str, Any] = import_extra("torch.utils.data", "torch").default_collate(dense)
    ragged = {
        name: [torch.from_numpy(sample[name]) for sample in given]
        for name in given[0]
        if name in RAGGED
    }
    ragged |= {name: [sample[name] for sample in given] for name in given[0] if name in PLAIN}
    return {name: ragged[name] if name in ragged else batch[name] for name in given[0]}


def collate_sparse(samples: Sequence[Mapping[str, object]]) -> dict[str, Any]:
    """Return a batch of samples whose stacks are sparse: voxels and their features.

    Use it as the `collate_fn` of a DataLoader. `occupancy`, `density` and `visibility` become
    `indices`, (N, 4) int32: the sample in the batch, x, y and z of each voxel that is not zero in
    all scans, and `features`, (N, C) float32: its values in the T scans of each stack, in the order
    of the fields. spconv, MinkowskiEngine and torchsparse (2.1) take them as they are. All other
    fields are collated as by `collate`.

    Raises:
        ArgumentError: the samples have no stacks.
        DependencyError: torch is not installed.
    """
    check_types(collate_sparse, locals())
    given: list[Values] = [dict(sample) for sample in samples]
    names = [name for name in given[0] if name in STACKS] if given else []
    if not names:
        expected = f"samples with {', '.join(sorted(STACKS))}"
        raise ArgumentError("samples", expected=expected, found="none of them")
    indices: list[AnyArray] = []
    features: list[AnyArray] = []
    for number, sample in enumerate(given):
        stacks = np.concatenate([sample.pop(name) for name in names])
        cells = np.argwhere(stacks.any(axis=0)).astype(np.int32)
        indices.append(np.insert(cells, 0, number, axis=1))
        features.append(stacks[:, *cells.T].T.astype(np.float32))
    torch = import_extra("torch", "torch")
    sparse = {"indices": indices, "features": features}
    return collate(given) | {
        name: torch.from_numpy(np.concatenate(parts)) for name, parts in sparse.items()
    }
