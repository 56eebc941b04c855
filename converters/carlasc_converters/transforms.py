"""Poses from quaternions and translations, and the tree of coordinate frames over time."""

from __future__ import annotations

from array import array
from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from carlasc.core.arrays import AnyFloatArray, BoolArray, FloatArray, IntArray
from carlasc.core.geometry import check_rigid, inverse_of, multiply, poses_from, slerp
from carlasc.errors import FormatError

_UNIT_TOLERANCE = 1e-3  # greatest deviation of a quaternion's norm from 1
BAD_SHARE = 0.1
"""Greatest share of the poses of a recording that are left out because they are no poses."""


def poses_of(quaternions: AnyFloatArray, translations: AnyFloatArray, where: str) -> FloatArray:
    """Return the (N, 4, 4) float64 transforms with given rotations and translations.

    Args:
        quaternions: (N, 4) w, x, y, z.
        translations: (N, 3) metres.
        where: the file, for errors.

    Raises:
        FormatError: a quaternion does not have length 1, or a number is not finite.
    """
    valid = are_poses(np.concatenate([np.zeros_like(translations), quaternions], axis=1))
    if not valid.all():
        row = int(np.argmin(valid))
        found = f"{np.asarray(quaternions[row], np.float64).tolist()} in row {row}"
        raise FormatError(
            where, expected="a rotation: a quaternion w, x, y, z of length 1", found=found
        )
    return check_rigid(poses_from(quaternions, translations), where, 4 * _UNIT_TOLERANCE)


def are_poses(numbers: ArrayLike) -> BoolArray:
    """Return (N,) whether rows x, y, z, and of a quaternion in any order, are finite, and the
    quaternion has length 1.
    """
    rows = np.asarray(numbers, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        valid = np.abs(np.linalg.norm(rows[..., 3:], axis=-1) - 1) <= _UNIT_TOLERANCE
    valid &= np.isfinite(rows[..., :3]).all(axis=-1)
    return np.asarray(valid)


_STILL = 1e-9  # a transform that changes by less is static


@dataclass(frozen=True)
class PlacedFrame:
    """The pose of a frame in another one at one time.

    Attributes:
        stamp_ns: the time.
        parent: the other frame.
        child: the frame; empty if the message does not name it.
        pose: x, y, z in metres, and a quaternion w, x, y, z: parent_T_child.
    """

    stamp_ns: int
    parent: str
    child: str
    pose: tuple[float, float, float, float, float, float, float]


class FrameTrack:
    """The poses of one frame in another over time."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._stamps = array("q")
        self._poses = array("d")

    def add(self, placed: PlacedFrame) -> None:
        """Add a time."""
        self._stamps.append(placed.stamp_ns)
        self._poses.extend(placed.pose)

    def __len__(self) -> int:
        return len(self._stamps)

    @cached_property
    def values(self) -> tuple[IntArray, FloatArray]:
        """(K,) increasing times in nanoseconds, and (K, 4, 4) poses: the last of each time.

        Raises:
            FormatError: a quaternion is not a rotation.
        """
        stamps = np.array(self._stamps, np.int64)
        numbers = np.array(self._poses, np.float64).reshape(-1, 7)
        poses = poses_of(numbers[:, 3:], numbers[:, :3], self._where)
        times, last = np.unique(stamps[::-1], return_index=True)
        return times, poses[::-1][last]

    @cached_property
    def moves(self) -> bool:
        """Whether the pose changes."""
        poses = self.values[1]
        return bool(np.abs(poses - poses[0]).max() > _STILL)

    def at(self, stamps: IntArray) -> FloatArray:
        """Return (M, 4, 4) poses at some times: interpolated, and constant before the first and
        after the last.
        """
        times, poses = self.values
        after = (np.clip(stamps, times[0], times[-1]) - times[0]) * 1e-9
        return slerp(poses, (times - times[0]) * 1e-9, after)


class FrameTree:
    """The frames of a bag, each in its parent."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._used = set[tuple[str, str]]()
        self._tracks: dict[str, dict[str, FrameTrack]] = defaultdict(dict)

    def add(self, placed: PlacedFrame) -> None:
        """Add a transform."""
        parents = self._tracks[placed.child]
        if placed.parent not in parents:
            parents[placed.parent] = FrameTrack(f"{self._where}: {placed.parent} to {placed.child}")
        parents[placed.parent].add(placed)

    def ancestors(self, frame: str) -> list[str]:
        """Return a frame, its parent, and so on up to the root.

        Raises:
            FormatError: the frames form a circle.
        """
        line = [frame]
        while parents := self._tracks.get(line[-1]):
            line.append(max(parents, key=lambda parent: len(parents[parent])))
            if line[-1] in line[:-1]:
                raise FormatError(
                    self._where, expected="a tree of frames", found=f"a circle: {', '.join(line)}"
                )
        return line

    def edges(self, frame: str, ancestor: str) -> list[FrameTrack]:
        """Return the tracks from a frame up to one of its ancestors."""
        line = self.ancestors(frame)
        line = line[: line.index(ancestor) + 1]
        self._used |= {(parent, child) for child, parent in pairwise(line)}
        return [self._tracks[child][parent] for child, parent in pairwise(line)]

    @property
    def moves(self) -> bool:
        """Whether any frame moves in another one."""
        return any(track.moves for parents in self._tracks.values() for track in parents.values())

    def connected(self, one: str, other: str) -> bool:
        """Return whether there is a path between two frames."""
        return self.ancestors(one)[-1] == self.ancestors(other)[-1]

    def motion(self, target: str, source: str) -> IntArray | None:
        """Return the (K,) nanoseconds at which the motion of one of two connected frames in the
        other is known; None if it does not move there.
        """
        above = self.ancestors(target)
        common = next(frame for frame in self.ancestors(source) if frame in above)
        tracks = self.edges(source, common) + self.edges(target, common)
        return max((track.values[0] for track in tracks if track.moves), key=len, default=None)

    @property
    def unused(self) -> list[str]:
        """The transforms that were not used, each as parent > child."""
        return [name for pair, name in self._named.items() if pair not in self._used]

    def lookup(self, target: str, source: str, stamps: IntArray) -> FloatArray:
        """Return (M, 4, 4) target_T_source at some times, of two frames that are connected."""
        above = self.ancestors(target)
        common = next(frame for frame in self.ancestors(source) if frame in above)
        up = self._climb(source, common, stamps)
        down = self._climb(target, common, stamps)
        return (
            up
            if target == common
            else np.array([multiply(inverse_of(a), b) for a, b in zip(down, up, strict=True)])
        )

    def _climb(self, frame: str, ancestor: str, stamps: IntArray) -> FloatArray:
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        for track in self.edges(frame, ancestor):
            poses = multiply(track.at(stamps), poses)
        return poses

    def __str__(self) -> str:
        """Name the frames, each with its parent."""
        return ", ".join(sorted(self._named.values())) or "no frames"

    @property
    def _named(self) -> dict[tuple[str, str], str]:
        return {
            (parent, child): f"{parent} > {child}"
            for child, parents in self._tracks.items()
            for parent in parents
        }
