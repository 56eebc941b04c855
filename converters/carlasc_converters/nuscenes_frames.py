"""The scans of nuScenes: points, classes, and the numbers of objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from carlasc.converting.protocol import Cloud, FrameHandle
from carlasc.core.arrays import AnyArray, Float32Array, Uint16Array, Uint32Array
from carlasc.core.boxes import Boxes
from carlasc.errors import FormatError
from carlasc.storage.arrays import ArrayFormat
from carlasc_converters.files import check_labels, read_arrays, read_bytes
from carlasc_converters.nuscenes_classes import NUSCENES

_COLUMNS = 5  # x, y, z, intensity, ring
_PER_CLASS = 1000  # panoptic labels are 1000 * class + number of the object
# added to the panoptic label of objects without a box: above the number of any track
_UNMATCHED = 1 << 16
_SURFACE_M = 0.01  # points on the surface of a box count as inside, in spite of rounding


@dataclass(frozen=True)
class NuScenesFrame(FrameHandle):
    """One LiDAR scan.

    Attributes:
        labels: the file of its point labels, or None.
        instances: the file of its panoptic labels, or None.
        boxes: its boxes in the frame of the sensor, which give panoptic instances the numbers of
            their tracks.
    """

    location: str
    number: int
    labels: str | None
    instances: str | None
    boxes: Boxes | None

    @property
    def labelled(self) -> bool:  # type: ignore[override]
        """Whether the scan is a key frame with labels."""
        return self.labels is not None or self.instances is not None

    def read(self) -> Sequence[Cloud]:
        """Read points, classes and instances."""
        data = _read(self.location)
        if not len(data) or len(data) % (4 * _COLUMNS):
            raise FormatError(
                self.location,
                expected=f"a multiple of {4 * _COLUMNS} bytes ({_COLUMNS} float32 a point)",
                found=len(data),
                advice="the file is incomplete: unpack it again",
            )
        points = np.frombuffer(data, "<f4").reshape(-1, _COLUMNS)[:, :4].copy()
        points[:, 3] /= 255.0
        panoptic = None if self.instances is None else _read_panoptic(self.instances)
        labels: AnyArray | None = None
        if self.labels is not None:
            labels = np.frombuffer(_read(self.labels), np.uint8)
            _check_labels(labels, len(points), self.labels)
        if panoptic is not None and self.instances is not None:
            _check_labels(panoptic // _PER_CLASS, len(points), self.instances)
            labels = panoptic // _PER_CLASS if labels is None else labels
        instances = None if panoptic is None else number_instances(panoptic, points, self.boxes)
        return (Cloud(points, labels, instances),)


def number_instances(
    panoptic: Uint16Array, points: Float32Array, boxes: Boxes | None
) -> Uint32Array:
    """Return the number of the object of each point: that of the box with the class of the object
    that holds most of its points.

    The data set made its panoptic labels from the boxes, so that each object has a box. An object
    without a box gets a unique number above those of the tracks, the same in all frames.

    Args:
        panoptic: (N,) panoptic labels.
        points: (N, 4) the points.
        boxes: the boxes of the frame, in the frame of the points; None if it has none.

    Returns:
        (N,) numbers, 0 for none.
    """
    numbers = np.zeros(len(panoptic), np.uint32)
    inside = None if boxes is None else boxes.contains(points[:, :3], _SURFACE_M)
    for value in np.unique(panoptic[panoptic % _PER_CLASS > 0]).tolist():
        members = panoptic == value
        numbers[members] = _UNMATCHED + value
        if boxes is not None and inside is not None:
            votes = np.where(boxes.labels == value // _PER_CLASS, inside[:, members].sum(axis=1), 0)
            if votes.max(initial=0):
                numbers[members] = boxes.tracks[votes.argmax()]
    return numbers


def _read(path: str) -> bytes:
    return read_bytes(path, "a file that the tables list", "unpack it again")


def _read_panoptic(path: str) -> Uint16Array:
    """Return the panoptic labels of a file."""
    return read_arrays(
        path, {"data": ArrayFormat(("u1", "<u2", "<u4"), (None,))}, "unpack it again"
    )[0]


def _check_labels(labels: AnyArray, points: int, path: str) -> None:
    """Check that there is a class of the table for each point."""
    check_labels(labels, points, path)
    NUSCENES.check(labels, path)
