"""The fields of a sample: names, types, and collation to a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cameras import CameraModel
from carlasc.errors import import_extra

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
PLAIN = ("cameras",)  # no arrays
RAGGED = ("points", "point_labels", "flow", "remission")  # one row per point of the scan


class Sample(TypedDict, total=False):
    """A sample of a `Dataset`: the requested fields, and `valid`, `sequence` and `frame`.

    For shapes and units, see `Dataset`.
    """

    occupancy: NDArray[np.uint8]
    density: NDArray[np.uint16]
    visibility: NDArray[np.uint8]
    labels: NDArray[np.unsignedinteger[Any]]
    known: NDArray[np.bool_]
    counts: NDArray[np.float32]
    posterior: NDArray[np.float32]
    occupied: NDArray[np.float32]
    flags: NDArray[np.uint8]
    views: NDArray[np.uint16]
    instances: NDArray[np.int64]
    voxel_flow: NDArray[np.float32]
    camera_visible: NDArray[np.uint8]
    images: Mapping[str, NDArray[np.uint8]]
    cameras: Mapping[str, CameraModel]
    points: NDArray[np.float32]
    point_labels: NDArray[np.unsignedinteger[Any]]
    flow: NDArray[np.float32]
    remission: NDArray[np.float32]
    poses: NDArray[np.float64]
    valid: NDArray[np.bool_]
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
        DependencyError: torch is not installed.
    """
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
