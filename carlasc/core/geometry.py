"""Rigid transforms. A transform named `dst_T_src` converts points from frame `src` to frame `dst`: `R @ p + t`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from carlasc.errors import FormatError

Transform = NDArray[np.float64]
"""(4, 4) float64, last row 0 0 0 1."""


def rotation_z(yaw_rad: float) -> Transform:
    """Return the (4, 4) rotation by `yaw_rad` about z. A positive angle turns x towards y."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[cos, -sin, 0, 0], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float64)


def translation(xyz: ArrayLike) -> Transform:
    """Return the (4, 4) translation by `xyz`, (3,) metres."""
    transform = np.eye(4)
    transform[:3, 3] = xyz
    return transform


def transform_points(dst_T_src: Transform, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Transform points from frame `src` to frame `dst`.

    Args:
        dst_T_src: (4, 4) rigid transform.
        points: (..., 3) metres, frame `src`.

    Returns:
        (..., 3) float64 metres, frame `dst`.
    """
    return np.asarray(points, np.float64) @ dst_T_src[:3, :3].T + dst_T_src[:3, 3]


def rotate_vectors(dst_T_src: Transform, vectors: NDArray[np.floating]) -> NDArray[np.float64]:
    """Rotate (..., 3) vectors, such as velocities and normals, from frame `src` to frame `dst`, without translation."""
    return np.asarray(vectors, np.float64) @ dst_T_src[:3, :3].T


def invert(dst_T_src: Transform) -> Transform:
    """Return the inverse `src_T_dst` of one (4, 4) or many (..., 4, 4) rigid transforms, from the transposed rotation."""
    rotation = np.swapaxes(dst_T_src[..., :3, :3], -1, -2)
    src_T_dst = np.zeros_like(dst_T_src, dtype=np.float64)
    src_T_dst[..., :3, :3] = rotation
    src_T_dst[..., :3, 3] = -(rotation @ dst_T_src[..., :3, 3:])[..., 0]
    src_T_dst[..., 3, 3] = 1.0
    return src_T_dst


def relative_to(first: Transform, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Express world poses (..., 4, 4) in the frame `first`: `inv(first) @ pose`, as in poses.txt."""
    return np.linalg.inv(first) @ poses


def check_rigid(transforms: NDArray[np.floating], name: str, tolerance: float = 1e-3) -> NDArray[np.float64]:
    """Check that transforms are finite, rigid and proper.

    Args:
        transforms: (4, 4) or (F, 4, 4).
        name: name of the transforms in errors: a file or an argument.
        tolerance: greatest deviation of `R @ R.T` from the identity, and of the last row from 0 0 0 1.

    Returns:
        The same transforms as float64.

    Raises:
        FormatError: a transform is not rigid; the message names the first one and the reason.
    """
    poses = np.asarray(transforms, np.float64)
    if poses.shape[-2:] != (4, 4) or poses.ndim not in (2, 3):
        raise FormatError(name, expected="4 x 4 transforms", found=f"shape {poses.shape}")
    for index, pose in enumerate(poses.reshape(-1, 4, 4)):
        where = name if poses.ndim == 2 else f"{name}: transform {index}"
        if not np.isfinite(pose).all():
            raise FormatError(where, expected="finite numbers", found="NaN or infinity")
        rotation = pose[:3, :3]
        deviation = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), np.abs(pose[3] - (0, 0, 0, 1)).max())
        if deviation > tolerance:
            raise FormatError(
                where,
                expected="a rigid transform",
                found=f"one off by {deviation:.3g}",
                advice="it is scaled or sheared, or is not a pose",
            )
        if np.linalg.det(rotation) < 0:
            raise FormatError(
                where, expected="a rotation", found="a reflection (determinant -1)", advice="the axes may be mirrored"
            )
    return poses
