"""The tracked boxes of one frame: pose, size and track of each object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from carlasc.core.arrays import (
    AnyFloatArray,
    AnyIntArray,
    BoolArray,
    FloatArray,
    IntArray,
    LabelArray,
    RecordArray,
    Uint32Array,
)
from carlasc.core.geometry import (
    Transform,
    invert,
    mirror_poses,
    poses_from,
    quaternions_of,
    transform_points,
)
from carlasc.errors import FormatError, check_types

BOXES_DTYPE = np.dtype(
    [("track", "<u4"), ("label", "<u4")]
    + [
        (name, "<f8")
        for name in ("x", "y", "z", "qw", "qx", "qy", "qz", "length", "width", "height")
    ]
    + [("annotated", "u1")]
)
"""One row per box, as in the files of the layout. See `Boxes` for the meaning of the columns."""

_CENTER = ("x", "y", "z")
_QUATERNION = ("qw", "qx", "qy", "qz")
_SIZE = ("length", "width", "height")
_UNIT_TOLERANCE = (
    1e-3  # greatest deviation of a quaternion's norm from 1, as for the rotations of poses
)


@dataclass(frozen=True)
class Boxes:
    """The tracked boxes of one frame.

    Each box has a frame: its origin is the centre of the box, x points forward along the length, z
    up along the height.

    Attributes:
        tracks: (N,) uint32 track numbers of 1 or more, constant over a sequence, and equal to the
            field `instances` if it exists. A track has at most one box per frame.
        labels: (N,) uint32 class ids.
        centers: (N, 3) float64, metres, sensor frame.
        quaternions: (N, 4) float64, unit quaternions w, x, y, z of the rotation from the box to the
            sensor frame. If the sensor is tilted, boxes that are upright in the world are tilted
            too.
        sizes: (N, 3) float64, metres: length, width, height, along x, y, z of the box.
        annotated: (N,) bool: whether the box was annotated in this frame. Other boxes are
            interpolated, for example between two annotated frames.

    Raises:
        FormatError: shapes do not match, a number is not finite, a size is not positive, a
            quaternion is not a rotation, or a track is 0 or occurs twice.
    """

    tracks: Uint32Array
    labels: Uint32Array
    centers: FloatArray
    quaternions: FloatArray
    sizes: FloatArray
    annotated: BoolArray

    def __post_init__(self) -> None:
        check_types(Boxes, vars(self))
        count = len(self.tracks)
        shapes = {
            "tracks": (),
            "labels": (),
            "centers": (3,),
            "quaternions": (4,),
            "sizes": (3,),
            "annotated": (),
        }
        for name, row in shapes.items():
            array = getattr(self, name)
            if array.shape != (count, *row):
                raise FormatError(
                    f"boxes: {name}", expected=f"shape {(count, *row)}", found=array.shape
                )
        for name in ("tracks", "labels"):
            if getattr(self, name).dtype.kind != "u":
                raise FormatError(
                    f"boxes: {name}",
                    expected="unsigned integers",
                    found=getattr(self, name).dtype,
                )
        for name in ("centers", "quaternions", "sizes"):
            self._check(name, np.isfinite(getattr(self, name)).all(axis=1), "finite numbers")
        self._check(
            "sizes", (self.sizes > 0).all(axis=1), "positive lengths, widths and heights, in metres"
        )
        norms = np.linalg.norm(self.quaternions, axis=1)
        self._check(
            "quaternions",
            np.abs(norms - 1) <= _UNIT_TOLERANCE,
            "a rotation: a quaternion of length 1",
        )
        self._check("tracks", self.tracks > 0, "numbers above 0")
        first = np.zeros(count, np.bool_)
        first[np.unique(self.tracks, return_index=True)[1]] = True
        self._check("tracks", first, "one box per track in a frame")

    def _check(self, name: str, valid: BoolArray | np.bool_, expected: str) -> None:
        """Raise a FormatError for the first box that is not valid."""
        if not valid.all():
            row = int(np.argmin(valid))
            found = f"{getattr(self, name)[row].tolist()} in box {row} (track {self.tracks[row]})"
            raise FormatError(f"boxes: {name}", expected=expected, found=found)

    @classmethod
    def from_poses(
        cls,
        tracks: LabelArray,
        labels: LabelArray,
        sensor_T_box: FloatArray,
        sizes: AnyFloatArray,
        annotated: BoolArray | None = None,
    ) -> Boxes:
        """Return boxes with given poses.

        Args:
            tracks: (N,) numbers of the tracks.
            labels: (N,) class ids.
            sensor_T_box: (N, 4, 4) poses of the boxes.
            sizes: (N, 3) length, width and height, metres.
            annotated: (N,) whether a box was annotated; None for all.

        Raises:
            FormatError: as for the constructor. The poses are not checked; use
                `carlasc.core.check_rigid`.
        """
        return cls(
            np.asarray(tracks, np.uint32),
            np.asarray(labels, np.uint32),
            np.array(sensor_T_box[:, :3, 3], np.float64),
            quaternions_of(sensor_T_box[:, :3, :3]),
            np.asarray(sizes, np.float64).reshape(-1, 3),
            np.ones(len(tracks), np.bool_) if annotated is None else annotated,
        )

    @classmethod
    def from_table(cls, table: RecordArray, where: str = "boxes") -> Boxes:
        """Return the boxes of a table, (N,) `BOXES_DTYPE`; `where` is the file named in errors.

        Raises:
            FormatError: as for the constructor.
        """

        def columns(names: tuple[str, ...]) -> FloatArray:
            return np.stack([table[name] for name in names], axis=1)

        try:
            return cls(
                np.array(table["track"]),
                np.array(table["label"]),
                columns(_CENTER),
                columns(_QUATERNION),
                columns(_SIZE),
                table["annotated"] != 0,
            )
        except FormatError as error:
            raise (error if where == "boxes" else error.within(where)) from error

    def to_table(self) -> RecordArray:
        """Return the boxes as a table, (N,) `BOXES_DTYPE`."""
        table = np.empty(len(self), BOXES_DTYPE)
        table["track"] = self.tracks
        table["label"] = self.labels
        table["annotated"] = self.annotated
        numbers = np.concatenate([self.centers, self.quaternions, self.sizes], axis=1)
        for name, column in zip((*_CENTER, *_QUATERNION, *_SIZE), numbers.T, strict=True):
            table[name] = column
        return table

    def __len__(self) -> int:
        return len(self.tracks)

    @property
    def sensor_T_box(self) -> FloatArray:
        """(N, 4, 4) float64 pose of each box."""
        return poses_from(self.quaternions, self.centers)

    def select(self, keep: BoolArray | AnyIntArray) -> Boxes:
        """Return the boxes that a mask of shape (N,) or indices of shape (M,) select."""
        return Boxes(*(own[keep] for own in vars(self).values()))

    def joined(self, others: Boxes) -> Boxes:
        """Return the union of these boxes and others of the same frame.

        Raises:
            FormatError: a track has a box in both.
        """
        return Boxes(
            *(np.concatenate([own, vars(others)[name]]) for name, own in vars(self).items())
        )

    def transform(self, dst_T_sensor: Transform) -> Boxes:
        """Return the boxes in another frame, for example the world frame.

        `dst_T_sensor` is (4, 4) and rigid.
        """
        return Boxes.from_poses(
            self.tracks, self.labels, dst_T_sensor @ self.sensor_T_box, self.sizes, self.annotated
        )

    def contains(self, points: AnyFloatArray, margin_m: float = 0.0) -> BoolArray:
        """Return whether each point is in each box.

        Args:
            points: (M, 3) metres, sensor frame.
            margin_m: margin by which the boxes are enlarged on all sides, metres; a negative margin
                shrinks them.

        Returns:
            (N, M) bool.
        """
        inside = np.zeros((len(self), len(points)), np.bool_)
        for row, (pose, half) in enumerate(
            zip(self.sensor_T_box, self.sizes / 2 + margin_m, strict=True)
        ):
            near = np.flatnonzero(
                (np.abs(points - self.centers[row]) <= np.linalg.norm(half)).all(axis=1)
            )
            body = transform_points(invert(pose), points[near])
            inside[row, near] = (np.abs(body) <= half).all(axis=1)
        return inside

    def owners(self, points: AnyFloatArray, margin_m: float = 0.0) -> IntArray:
        """Return (M,) int64, the row of the box that contains each of (M, 3) points: the smallest
        of several boxes, -1 for no box.
        """
        owners = np.full(len(points), -1, np.int64)
        inside = self.contains(points, margin_m)
        for row in np.argsort(-np.prod(self.sizes, axis=1), kind="stable").tolist():
            owners[inside[row]] = row
        return owners


def mirror_boxes(boxes: Boxes) -> Boxes:
    """Mirror boxes.

    The frame of each box is mirrored too, so that x is still along its length and the rotation is
    proper.
    """
    return Boxes.from_poses(
        boxes.tracks, boxes.labels, mirror_poses(boxes.sensor_T_box), boxes.sizes, boxes.annotated
    )
