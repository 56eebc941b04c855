"""Rigid transforms, and the conversion between right-handed axes and those of CarlaSC.

A transform named `dst_T_src` converts points from frame `src` to frame `dst`: `R @ p + t`.

Right-handed axes (y to the left) and the left-handed axes of CarlaSC (y to the right) differ in the
sign of y, so each function named `mirror_...` works in both directions.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from carlasc.core.arrays import AnyFloatArray, Float32Array, FloatArray, IntArray
from carlasc.errors import FormatError

Floating = TypeVar("Floating", bound=np.floating[Any])

Transform = FloatArray
"""(4, 4) float64, last row 0 0 0 1."""

_SIGNS = np.array([1, -1, 1, 1], np.float32)
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_FARTHEST_M = 1e9  # larger than any distance on Earth
_GOLDEN = 0.6180339887  # multiples of it, without their integers, are spread evenly


def rotation_z(yaw_rad: float) -> Transform:
    """Return the (4, 4) rotation by `yaw_rad` about z. A positive angle turns x towards y."""
    cos = np.cos(yaw_rad)
    sin = np.sin(yaw_rad)
    return np.array(
        [[cos, -sin, 0, 0], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float64
    )


def translation(xyz: ArrayLike) -> Transform:
    """Return the (4, 4) translation by `xyz`, (3,) metres."""
    transform = np.eye(4)
    transform[:3, 3] = xyz
    return transform


def multiply(*matrices: AnyFloatArray) -> FloatArray:
    """Return the product of (..., N, K) and (..., K, M) small matrices, from left to right, bit for
    bit equal on every CPU.

    `@` calls BLAS, whose order of summation and rounding depend on the CPU.
    """
    product = np.asarray(matrices[0], np.float64)
    for matrix in matrices[1:]:
        left = product
        product = product[..., :, 0, None] * matrix[..., None, 0, :]
        for k in range(1, matrix.shape[-2]):
            product = product + left[..., :, k, None] * matrix[..., None, k, :]
    return product


def transform_points(dst_T_src: Transform, points: AnyFloatArray) -> FloatArray:
    """Transform points from frame `src` to frame `dst`.

    Args:
        dst_T_src: (4, 4) rigid transform.
        points: (..., 3) metres, frame `src`.

    Returns:
        (..., 3) float64 metres, frame `dst`.
    """
    return rotate_vectors(dst_T_src, points) + dst_T_src[:3, 3]


def transform_each(dst_T_src: FloatArray, points: AnyFloatArray) -> FloatArray:
    """Transform (N, 3) points by (N, 4, 4) rigid transforms, each by its own."""
    return multiply(dst_T_src[:, :3, :3], points[..., None])[..., 0] + dst_T_src[:, :3, 3]


def thin(points: NDArray[Floating], most: int) -> NDArray[Floating]:
    """Return every N-th row of an array, with the smallest N that gives at most `most` rows."""
    return points[:: max(1, -(-len(points) // most))]


def spread_rows(count: int, most: int) -> IntArray:
    """Return at most `most` of the rows 0 to `count` - 1, spread evenly, but not at one distance:
    points of a LiDAR that turns are in order of columns, and every N-th may be of few channels.
    """
    steps = np.arange(min(count, most))
    apart = max(1.0, count / most)
    return np.asarray(steps * apart + (apart - 1) * (steps * _GOLDEN % 1.0), np.int64)


def moved_back(
    points: NDArray[Floating], times: AnyFloatArray | None, velocity: AnyFloatArray
) -> NDArray[Floating]:
    """Return where points are at the time of their frame, which were seen some seconds after it.

    Args:
        points: (N, 3) metres.
        times: (N,) seconds; None: the points stay.
        velocity: (3,) or (N, 3) m/s, on the axes of the points.
    """
    return points if times is None else (points - times[:, None] * velocity).astype(points.dtype)


def rotate_vectors(dst_T_src: Transform, vectors: AnyFloatArray) -> FloatArray:
    """Rotate (..., 3) vectors, such as velocities and normals, from frame `src` to frame `dst`,
    without translation.
    """
    source = np.asarray(vectors, np.float64)
    x = source[..., 0]
    y = source[..., 1]
    z = source[..., 2]
    rotated = np.empty((*source.shape[:-1], 3))
    for row, (along_x, along_y, along_z) in enumerate(dst_T_src[:3, :3]):
        rotated[..., row] = x * along_x + y * along_y + z * along_z  # not `@`: see `multiply`
    return rotated


def invert(dst_T_src: Transform) -> Transform:
    """Return the inverse `src_T_dst` of one (4, 4) or many (..., 4, 4) rigid transforms, from the
    transposed rotation.
    """
    rotation = np.swapaxes(dst_T_src[..., :3, :3], -1, -2)
    src_T_dst = np.zeros_like(dst_T_src, dtype=np.float64)
    src_T_dst[..., :3, :3] = rotation
    src_T_dst[..., :3, 3] = -multiply(rotation, dst_T_src[..., :3, 3:])[..., 0]
    src_T_dst[..., 3, 3] = 1.0
    return src_T_dst


def rotations_of(quaternions: AnyFloatArray) -> FloatArray:
    """Return the (N, 3, 3) rotations of (N, 4) quaternions w, x, y, z of any non-zero length."""
    w, x, y, z = (
        np.asarray(quaternions, np.float64) / np.linalg.norm(quaternions, axis=1, keepdims=True)
    ).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def poses_from(quaternions: AnyFloatArray, translations: AnyFloatArray) -> FloatArray:
    """Return (N, 4, 4) transforms from (N, 4) quaternions w, x, y, z of any non-zero length, and
    (N, 3) translations.
    """
    poses = np.tile(np.eye(4), (len(quaternions), 1, 1))
    poses[:, :3, :3] = rotations_of(quaternions)
    poses[:, :3, 3] = translations
    return poses


def quaternions_of(rotations: AnyFloatArray) -> FloatArray:
    """Return the (N, 4) unit quaternions w, x, y, z of (N, 3, 3) rotations.

    The first non-zero number is positive.
    """
    r = np.asarray(rotations, np.float64)
    xx = r[:, 0, 0]
    yy = r[:, 1, 1]
    zz = r[:, 2, 2]
    wx = r[:, 2, 1] - r[:, 1, 2]
    wy = r[:, 0, 2] - r[:, 2, 0]
    wz = r[:, 1, 0] - r[:, 0, 1]
    xy = r[:, 0, 1] + r[:, 1, 0]
    xz = r[:, 0, 2] + r[:, 2, 0]
    yz = r[:, 1, 2] + r[:, 2, 1]
    # Each row is 4 q_k (w, x, y, z) for one k; the longest is farthest from a division by zero.
    candidates = np.array(
        [
            [1 + xx + yy + zz, wx, wy, wz],
            [wx, 1 + xx - yy - zz, xy, xz],
            [wy, xy, 1 - xx + yy - zz, yz],
            [wz, xz, yz, 1 - xx - yy + zz],
        ]
    )
    longest = np.argmax(np.square(candidates).sum(axis=1), axis=0)
    chosen = candidates[longest, :, np.arange(len(r))]
    unit = chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
    leading = unit[np.arange(len(r)), np.argmax(np.abs(unit) > 1e-9, axis=1)]
    return np.where(leading < 0, -1.0, 1.0)[:, None] * unit


def small_motions(motions: FloatArray) -> FloatArray:
    """Return (N, 6) translations and rotation vectors of (N, 4, 4) motions.

    Valid for rotations of a few degrees at most.
    """
    m = motions
    turns = [m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]]
    return np.concatenate([m[:, :3, 3], np.stack(turns, axis=1) / 2], axis=1)


def slerp(poses: FloatArray, seconds: AnyFloatArray, at: AnyFloatArray) -> FloatArray:
    """Interpolate poses in time: positions linearly, rotations by slerp.

    Outside of the poses, the motion is extrapolated.

    Args:
        poses: (K, 4, 4) rigid transforms.
        seconds: (K,) times of the poses, increasing.
        at: (...,) times of the result, seconds.

    Returns:
        (..., 4, 4) transforms. With K = 1, all are equal to the one pose.
    """
    if len(poses) < 2:
        return np.broadcast_to(poses, (*np.shape(at), 4, 4)).copy()
    times = np.asarray(at, np.float64).reshape(-1)
    before = np.clip(np.searchsorted(seconds, times, side="right") - 1, 0, len(poses) - 2)
    share = (times - seconds[before]) / np.diff(seconds)[before]
    # The first number of a quaternion is not negative.
    turns = quaternions_of(multiply(np.swapaxes(poses[:-1, :3, :3], 1, 2), poses[1:, :3, :3]))
    axes = turns[:, 1:]
    lengths = np.linalg.norm(axes, axis=1)
    half = np.arctan2(lengths, turns[:, 0])[before] * share
    units = np.divide(axes, lengths[:, None], out=np.zeros_like(axes), where=lengths[:, None] > 0)[
        before
    ]
    between = np.tile(np.eye(4), (len(times), 1, 1))
    quaternions = np.concatenate([np.cos(half)[:, None], np.sin(half)[:, None] * units], axis=1)
    between[:, :3, :3] = multiply(poses[before, :3, :3], rotations_of(quaternions))
    between[:, :3, 3] = poses[before, :3, 3] + share[:, None] * (
        poses[before + 1, :3, 3] - poses[before, :3, 3]
    )
    return between.reshape(*np.shape(at), 4, 4)


def relative_to(first: Transform, poses: FloatArray) -> FloatArray:
    """Express world poses (..., 4, 4) in the frame `first`, as in poses.txt: inv(first) @ pose."""
    return multiply(inverse_of(first), poses)


def inverse_of(transform: Transform) -> Transform:
    """Return the inverse of a (4, 4) transform that may be slightly non-rigid, bit for bit equal on
    every CPU.
    """
    x = transform[:3, 0]
    y = transform[:3, 1]
    z = transform[:3, 2]
    rows = np.array([np.cross(y, z), np.cross(z, x), np.cross(x, y)])
    inverse = np.eye(4)
    inverse[:3, :3] = rows / (rows[0, 0] * x[0] + rows[0, 1] * x[1] + rows[0, 2] * x[2])
    inverse[:3, 3] = -multiply(inverse[:3, :3], transform[:3, 3:])[:, 0]
    return inverse


def check_rigid(transforms: AnyFloatArray, name: str, tolerance: float = 1e-3) -> FloatArray:
    """Check that transforms are finite, rigid and proper, and that their positions are plausible.

    Args:
        transforms: (4, 4) or (F, 4, 4).
        name: name of the transforms in errors: a file or an argument.
        tolerance: maximum deviation of `R @ R.T` from the identity, and of the last row from 0 0 0
            1.

    Returns:
        The same transforms as float64.

    Raises:
        FormatError: a transform is not rigid; the message names the first one and the reason.
    """
    poses = np.asarray(transforms, np.float64)
    if poses.shape[-2:] != (4, 4) or poses.ndim not in (2, 3):
        raise FormatError(name, expected="4 x 4 transforms", found=f"shape {poses.shape}")
    flat = poses.reshape(-1, 4, 4)
    rotations = flat[:, :3, :3]
    farthest = np.abs(flat[:, :3, 3]).max(axis=1)
    with np.errstate(invalid="ignore", over="ignore"):
        deviation = np.maximum(
            np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max(axis=(1, 2)),
            np.abs(flat[:, 3] - (0, 0, 0, 1)).max(axis=1),
        )
        mirrored = np.linalg.det(rotations) < 0
    checks: tuple[tuple[Any, str, str, str], ...] = (
        (~np.isfinite(flat).all(axis=(1, 2)), "finite numbers", "NaN or infinity", ""),
        (farthest > _FARTHEST_M, f"a position within {_FARTHEST_M:.0e} m", "{0:g} m", ""),
        (
            deviation > tolerance,
            "a rigid transform",
            "a deviation of {1:.3g} from a rigid transform",
            "the transform may be scaled or sheared, or may not be a pose",
        ),
        (
            mirrored,
            "a rotation",
            "a reflection (determinant -1)",
            "the axes may be mirrored: check their handedness",
        ),
    )
    wrong = np.any([mask for mask, *_ in checks], axis=0)
    if wrong.any():
        row = int(np.argmax(wrong))
        expected, found, advice = next(parts for mask, *parts in checks if mask[row])
        raise FormatError(
            name if poses.ndim == 2 else f"{name}: transform {row}",
            expected=expected,
            found=found.format(farthest[row], deviation[row]),
            advice=advice,
        )
    return poses


def mirror_points(points: Float32Array) -> Float32Array:
    """Mirror (N, 3) or (N, 4) points or vectors. A fourth column is unchanged."""
    return points * _SIGNS[: points.shape[1]]


def mirror_poses(poses: FloatArray) -> FloatArray:
    """Mirror (..., 4, 4) poses, in both the source and the destination frame."""
    return _MIRROR @ poses @ _MIRROR


DIRECTIONS = dict(
    zip("flubrd", (np.concatenate([np.eye(3), -np.eye(3)]) + 0.0).tolist(), strict=True)
)
"""Directions f(orward), l(eft), u(p), b(ackward), r(ight), d(own), in x forward, y left, z up."""


def choices_of_axes() -> Iterator[tuple[str, FloatArray]]:
    """Yield the 48 signed permutations of axes, the identity first: the new axes in terms of the
    old ones, such as "-y, x, z", and the (3, 3) matrix.
    """
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            yield (
                ", ".join(
                    f"{'-' if s < 0 else ''}{'xyz'[axis]}"
                    for s, axis in zip(signs, order, strict=True)
                ),
                matrix,
            )
