"""The facts of a report: of each frame, and of each moving actor, such as how well its observations
align.

A frame is measured while it is made, or from its files if it exists already.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, thin, transform_points
from carlasc.core.grids import Grid, GridSpec, VoxelFlag
from carlasc.motion.refinement import RefinedPoses
from carlasc.storage import layout

# of one observation: points that are used, and points whose distance is measured
_MOST_POINTS, _MOST_ASKED = (
    600,
    50,
)


@dataclass(frozen=True)
class Residual:
    """How well an observation of an actor aligns with the next one.

    Attributes:
        moving_m: sum of the distances from points of one to the nearest points of the other, with
            the motion removed, metres.
        static_m: the same without removing the motion.
        count: number of these points.
    """

    moving_m: float
    static_m: float
    count: int

    @classmethod
    def between(
        cls,
        one: NDArray[np.floating],
        other: NDArray[np.floating],
        world_T_actor: Transform,
        world_T_next: Transform,
    ) -> Residual:
        """Compare two observations.

        Args:
            one: (N, 3) points of an observation, metres, world.
            other: (M, 3) points of the next one.
            world_T_actor: (4, 4) pose of the actor at the first observation.
            world_T_next: (4, 4) its pose at the next one.
        """
        one, other = thin(one, _MOST_POINTS), thin(other, _MOST_POINTS)
        static = _distances(one, other)
        moving = _distances(
            transform_points(invert(world_T_actor), one),
            transform_points(invert(world_T_next), other),
        )
        return cls(float(moving.sum()), float(static.sum()), len(moving))


@dataclass(frozen=True)
class ActorTrack:
    """A moving actor that was tracked.

    Attributes:
        label: name of its class.
        instance: its number in the data; 0 if actors are not numbered.
        first: frame of its first observation.
        last: frame of its last observation.
        observations: number of scans that see it.
        points: number of its points in all observations.
        speed_m_s: its median speed, metres per second.
        size_m: length, width and height of its body, metres.
        seen_m: length, width and height of its visible part, metres.
        faces: number of its visible sides: front, rear, left and right.
        residual_m: how well neighbouring observations align with the motion removed: mean distance
            from a point of one to the nearest point of the one before or after, metres; None if
            none were compared. It is at least the distance between neighbouring points.
        residual_static_m: the same without removing the motion. With a correct motion, `residual_m`
            is smaller.
        confidence: probability that it is real, from 0 to 1; 1 for an actor of the data.
    """

    label: str
    instance: int
    first: int
    last: int
    observations: int
    points: int
    speed_m_s: float
    size_m: tuple[float, float, float]
    seen_m: tuple[float, float, float]
    faces: int
    residual_m: float | None
    residual_static_m: float | None
    confidence: float

    @classmethod
    def of(
        cls, summary: Mapping[str, Any], residuals: Sequence[Residual], classes: ClassTable
    ) -> ActorTrack:
        """Return the actor that a summary of the tracks describes."""
        length, width, height = summary["size_m"]
        seen_length, seen_width, seen_height = summary["seen_m"]
        count = sum(residual.count for residual in residuals)
        return cls(
            label=classes.names.get(summary["label"], str(summary["label"])),
            instance=summary["instance"],
            first=summary["first"],
            last=summary["last"],
            observations=summary["scans"],
            points=summary["points"],
            speed_m_s=summary["speed_m_s"],
            size_m=(length, width, height),
            seen_m=(seen_length, seen_width, seen_height),
            faces=summary["faces"],
            residual_m=round(sum(r.moving_m for r in residuals) / count, 4) if count else None,
            residual_static_m=round(sum(r.static_m for r in residuals) / count, 4)
            if count
            else None,
            confidence=summary["confidence"],
        )


def actors_of(
    summaries: Sequence[Mapping[str, Any]],
    residuals: Iterable[Mapping[int, Residual]],
    classes: ClassTable,
) -> tuple[ActorTrack, ...]:
    """Return the moving actors, in order of their first observation.

    Args:
        summaries: the facts of each actor, by its number.
        residuals: how well the observations in each frame align with the next ones, by number.
        classes: class table of the labels.
    """
    by_actor: dict[int, list[Residual]] = {}
    for frame in residuals:
        for number, residual in frame.items():
            by_actor.setdefault(number, []).append(residual)
    actors = [
        ActorTrack.of(s, by_actor.get(i, []), classes)
        for i, s in enumerate(summaries)
        if s["moves"]
    ]
    return tuple(sorted(actors, key=lambda actor: (actor.first, actor.label, actor.instance)))


def _distances(one: NDArray[np.floating], other: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the distances from some points of each observation to the nearest point of the other,
    metres.
    """
    found = []
    for asked, others in ((one, other), (other, one)):
        squares = np.square(thin(asked, _MOST_ASKED)[:, None] - others[None]).sum(axis=2)
        found.append(np.sqrt(squares.min(axis=1)))
    return np.concatenate(found)


POWERS = 24
"""Number of bins of the histogram of votes: 1, 2 to 3, 4 to 7, ..."""
_DIGEST_BYTES = 16
_DRIFT = 100  # number of scans over which a drift of the height is measured
_SAMPLED = 40  # one of so many frames is made again without a tenth of the scans


@dataclass(frozen=True)
class Changes:
    """How a grid changes if a tenth of the other scans is left out.

    Attributes:
        known: number of voxels that are known in both grids.
        changed: how many of them have another label.
    """

    known: int
    changed: int

    @classmethod
    def between(cls, grid: Grid, other: Grid) -> Changes:
        """Compare two grids of the same geometry."""
        both = grid.known & other.known
        return cls(int(both.sum()), int((both & (grid.labels != other.labels)).sum()))


@dataclass(frozen=True)
class PoseFacts:
    """How well neighbouring scans agree, and how their poses were refined.

    Attributes:
        before_m: mean distance of scans from the surfaces of their neighbours, under the given
            poses, in metres; None if it is unknown.
        after_m: the same under the poses that were used.
        changed_m: (x, y, z) root mean square change of the motion from each scan to the next one,
            in metres on the axes of the sensor.
        changed_rad: (roll, pitch, yaw) the same for the rotation, in radians.
        height_drift_m: greatest change of the difference between given and used height within 100
            scans, in metres.
        left: first and last frame of the stretches that keep the given motion.
    """

    before_m: float | None
    after_m: float | None
    changed_m: tuple[float, float, float]
    changed_rad: tuple[float, float, float]
    height_drift_m: float
    left: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, refined: RefinedPoses, frames: NDArray[np.int64]) -> PoseFacts:
        """Return the facts of refined poses; `frames` are the numbers of their frames."""
        x, y, z, roll, pitch, yaw = np.sqrt(np.square(refined.changes()).mean(axis=0)).tolist()
        off = refined.given[:, 2, 3] - refined.poses[:, 2, 3]
        windows = np.lib.stride_tricks.sliding_window_view(off, min(_DRIFT, len(off)))
        drift = float(np.ptp(windows, axis=1).max())
        return cls(
            *refined.disagreements_m, (x, y, z), (roll, pitch, yaw), drift, refined.left(frames)
        )


@dataclass(frozen=True, eq=False)
class FrameFacts:
    """The facts of one frame for a report.

    Attributes:
        frame: frame number.
        digests: digest of each field's file, by the name of the field.
        known: number of known voxels.
        classes: (K,) int64 known voxels of each class, free space first.
        votes: (POWERS,) int64 histogram of the votes of known voxels, by powers of two.
        votes_sum: sum of these votes; 0 if the grid has no counts.
        changes: how the grid changes if a tenth of the scans is left out; None if this was not
            measured.
        residuals: how well the observations of moving actors align with the next ones, by number of
            the actor.
        inferred: number of known voxels that were inferred, not seen; None if the grid does not
            say.
    """

    frame: int
    digests: Mapping[str, bytes]
    known: int
    classes: NDArray[np.int64]
    votes: NDArray[np.int64]
    votes_sum: float
    changes: Changes | None = None
    residuals: Mapping[int, Residual] = field(default_factory=dict)
    inferred: int | None = None

    @classmethod
    def of(
        cls,
        frame: int,
        arrays: Mapping[str, NDArray[Any]],
        grid: str,
        spec: GridSpec,
        classes: ClassTable,
        changes: Changes | None = None,
        residuals: Mapping[int, Residual] | None = None,
    ) -> FrameFacts:
        """Measure a frame.

        Args:
            frame: frame number.
            arrays: the fields of the frame, by name; those of the grid among them.
            grid: name of the grid's folder.
            spec: geometry of the grid.
            classes: class table of the grid's labels.
            changes: as in the attributes.
            residuals: as in the attributes.

        Raises:
            FormatError: an array does not fit its field, or a label is not in the class table.
        """
        digests = {name: digest_of(name, array) for name, array in arrays.items()}
        labels = np.asarray(arrays[f"{grid}/labels"]).reshape(-1)
        counts = arrays.get(f"{grid}/counts")
        votes, votes_sum = np.zeros(POWERS, np.int64), 0.0
        if counts is not None:
            seen = np.asarray(counts).reshape(-1)
            labels, seen = labels[seen > 0], seen[seen > 0]
            powers = np.clip(np.frexp(seen.astype(np.float32))[1] - 1, 0, POWERS - 1)
            votes, votes_sum = (
                np.bincount(powers, minlength=POWERS),
                float(seen.sum(dtype=np.float64)),
            )
        # counting a label of 2**32 - 1 would take 32 GB
        classes.check(labels, f"{grid}: frame {frame}")
        by_class = np.bincount(labels, minlength=classes.num_channels)
        inferred = _inferred(arrays.get(f"{grid}/flags"), counts)
        return cls(
            frame,
            digests,
            len(labels),
            by_class,
            votes,
            votes_sum,
            changes,
            residuals or {},
            inferred,
        )


def _inferred(flags: NDArray[Any] | None, counts: NDArray[Any] | None) -> int | None:
    """Return the number of known voxels that were inferred, not seen; None if the grid does not
    say.
    """
    if flags is None:
        return None
    inferred = (np.asarray(flags).reshape(-1) & int(VoxelFlag.INFERRED)) > 0
    return int(
        np.count_nonzero(
            inferred if counts is None else inferred & (np.asarray(counts).reshape(-1) > 0)
        )
    )


def sample_frames(numbers: Sequence[int]) -> frozenset[int]:
    """Return the frames that are made again without a tenth of the scans.

    The choice depends on the frame numbers, so that runs over parts of a sequence choose the same
    frames. A short range has one such frame.
    """
    chosen = frozenset(n for n in numbers if n % _SAMPLED == _SAMPLED // 2)
    return chosen or frozenset(numbers[len(numbers) // 2 :][:1])


def digest_of(field: str, array: NDArray[Any]) -> bytes:
    """Return the digest (BLAKE2b, 16 bytes) of a field of a frame: the digest of its published
    file, for all stores.

    Votes are compressed in their file, so their digest is that of their rows.

    Raises:
        FormatError: the array does not fit the field.
    """
    entry = layout.field_named(field)
    data = (
        np.ascontiguousarray(array).tobytes()
        if entry.kind in ("votes", "velocities")
        else entry.encode(array, field)
    )
    return digest_of_bytes(data)


def digest_of_bytes(data: bytes | memoryview) -> bytes:
    """Return the digest (BLAKE2b, 16 bytes) of the bytes of a file."""
    return blake2b(data, digest_size=_DIGEST_BYTES).digest()
