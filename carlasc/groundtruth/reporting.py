"""The report of a grid: carlasc-report.json, which every run writes beside the grid, and the facts
that it is made from, of each frame and of each moving actor.

A frame is measured while it is made, or from its files if it exists already.
"""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from hashlib import blake2b
from typing import Any, Self, TypedDict

import numpy as np

from carlasc.core.arrays import AnyArray, AnyFloatArray, IntArray
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, thin, transform_points
from carlasc.core.grids import Grid, GridSpec, VoxelFlag
from carlasc.core.plain import from_plain
from carlasc.errors import FormatError, carlasc_version, reading, runs_of
from carlasc.motion.refinement import RefinedPoses
from carlasc.storage.files import parse_json, to_json
from carlasc.storage.inputs import digest_of, digest_of_bytes

# of one observation: points that are used, and points whose distance is measured
_MOST_POINTS = 600
_MOST_ASKED = 50


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
        one: AnyFloatArray,
        other: AnyFloatArray,
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
        one = thin(one, _MOST_POINTS)
        other = thin(other, _MOST_POINTS)
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
    same = ("instance", "first", "last", "points", "speed_m_s", "faces", "confidence")
    actors = []
    for number, facts in enumerate(summaries):
        if not facts["moves"]:
            continue
        own = by_actor.get(number, [])
        count = sum(residual.count for residual in own)
        moving, static = (
            round(sum(distances) / count, 4) if count else None
            for distances in ([r.moving_m for r in own], [r.static_m for r in own])
        )
        actors.append(
            ActorTrack(
                **{name: facts[name] for name in same},
                label=classes.names.get(facts["label"], str(facts["label"])),
                observations=facts["scans"],
                size_m=tuple(facts["size_m"]),
                seen_m=tuple(facts["seen_m"]),
                residual_m=moving,
                residual_static_m=static,
            )
        )
    return tuple(sorted(actors, key=lambda actor: (actor.first, actor.label, actor.instance)))


def _distances(one: AnyFloatArray, other: AnyFloatArray) -> AnyFloatArray:
    """Return the distances from some points of each observation to the nearest point of the other,
    metres.
    """
    nearest_m = []
    for asked, others in ((one, other), (other, one)):
        axes = zip(thin(asked, _MOST_ASKED).T, others.T, strict=True)
        # several times faster axis by axis than point by point
        squares = sum(np.square(a[:, None] - b) for a, b in axes)
        nearest_m.append(np.sqrt(np.min(squares, axis=1)))
    return np.concatenate(nearest_m)


POWERS = 24
"""Number of bins of the histogram of votes: 1, 2 to 3, 4 to 7, ..."""
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
    def of(cls, refined: RefinedPoses, frames: IntArray) -> PoseFacts:
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
    classes: IntArray
    votes: IntArray
    votes_sum: float
    changes: Changes | None = None
    residuals: Mapping[int, Residual] = field(default_factory=dict)
    inferred: int | None = None

    @classmethod
    def of(
        cls,
        frame: int,
        arrays: Mapping[str, AnyArray],
        grid: str,
        classes: ClassTable,
        changes: Changes | None = None,
        residuals: Mapping[int, Residual] | None = None,
    ) -> FrameFacts:
        """Measure a frame.

        Args:
            frame: frame number.
            arrays: the fields of the frame, by name; those of the grid among them.
            grid: name of the grid's folder.
            classes: class table of the grid's labels.
            changes: as in the attributes.
            residuals: as in the attributes.

        Raises:
            FormatError: an array does not fit its field, or a label is not in the class table.
        """
        digests = {name: digest_of(name, array) for name, array in arrays.items()}
        labels = np.asarray(arrays[f"{grid}/labels"]).reshape(-1)
        counts = arrays.get(f"{grid}/counts")
        votes = np.zeros(POWERS, np.int64)
        votes_sum = 0.0
        known = np.ones(len(labels), np.bool_)
        if counts is not None:
            seen = np.asarray(counts).reshape(-1)
            known = seen > 0
            labels = labels[known]
            seen = seen[known]
            # the exponents of float32: several times faster than `frexp`
            powers = np.clip((seen.astype(np.float32).view(np.int32) >> 23) - 127, 0, POWERS - 1)
            votes = np.bincount(powers, minlength=POWERS)
            votes_sum = float(seen.sum(dtype=np.float64))
        # counting a label of 2**32 - 1 would take 32 GB
        classes.check(labels, f"{grid}: frame {frame}")
        by_class = np.bincount(labels, minlength=classes.num_channels)
        inferred = None
        if (flags := arrays.get(f"{grid}/flags")) is not None:
            marked = np.asarray(flags).reshape(-1) & int(VoxelFlag.INFERRED) > 0
            inferred = int(np.count_nonzero(marked & known))
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


def sample_frames(numbers: Sequence[int]) -> frozenset[int]:
    """Return the frames that are made again without a tenth of the scans.

    The choice depends on the frame numbers, so that runs over parts of a sequence choose the same
    frames. A short range has one such frame.
    """
    chosen = frozenset(n for n in numbers if n % _SAMPLED == _SAMPLED // 2)
    return chosen or frozenset(numbers[len(numbers) // 2 :][:1])


REPORT_FORMAT = 1
"""Version of carlasc-report.json: of its keys and their meaning."""
LEFT_OUT = 0.1
"""Share of the scans that is left out where convergence is measured."""
_MOST_FRAMES = 10_000_000  # of a sequence: a small file must not fill the memory with frames
_SHORT = 8  # hexadecimal digits of the digest of one frame
_ABSENT = "-" * _SHORT


@dataclass(frozen=True)
class Coverage:
    """The voxels of all frames together.

    Attributes:
        voxels: number of voxels.
        known: number of known voxels, which have at least one vote.
        classes: number of known voxels of each class that occurs, by name; free space is the class
            with id 0.
        occupied: number of known voxels that are not free.
        mean_votes: mean number of votes of a known voxel, the nearest to its number of views that a
            grid keeps; None without counts.
        votes: number of known voxels with 1 vote, 2 to 3, 4 to 7, and so on, up to the last bin
            that is not empty.
    """

    voxels: int
    known: int
    classes: Mapping[str, int]
    occupied: int
    mean_votes: float | None
    votes: tuple[int, ...]

    @property
    def known_share(self) -> float:
        """Share of the voxels that are known."""
        return self.known / self.voxels if self.voxels else 0.0

    @property
    def occupied_share(self) -> float:
        """Share of the known voxels that are occupied."""
        return self.occupied / self.known if self.known else 0.0


@dataclass(frozen=True)
class Convergence:
    """How grids change if a tenth of the scans of other frames is left out, on some frames.

    Attributes:
        frames: number of frames on which this was measured.
        known: number of voxels that are known with and without these scans.
        changed: number of these with another label without the scans.
    """

    frames: int
    known: int
    changed: int

    @property
    def changed_share(self) -> float:
        """Share of the voxels known in both whose label changes."""
        return self.changed / self.known if self.known else 0.0


@dataclass(frozen=True)
class Digests:
    """Digests (BLAKE2b) of one field.

    Attributes:
        all: 32 hexadecimal digits for the field as a whole.
        frames: 8 digits for each frame of the report, in their order; "--------" for a frame
            without the field.
    """

    all: str
    frames: str

    def of(self, row: int) -> str | None:
        """Return the digits of the row-th frame of the report; None without the field."""
        digits = self.frames[_SHORT * row : _SHORT * (row + 1)]
        return None if digits == _ABSENT else digits


@dataclass(frozen=True)
class FileDigest:
    """The digest of a text file and its size. poses.txt and times.txt may get more lines later, so
    the size belongs to the digest.

    Attributes:
        size: size of the file, in bytes.
        digest: digest of these bytes, 32 hexadecimal digits.
    """

    size: int
    digest: str

    @classmethod
    def of(cls, data: bytes) -> Self:
        """Return the digest of a file."""
        return cls(len(data), digest_of_bytes(data).hex())

    def matches(self, data: bytes) -> bool:
        """Return whether a file starts with the bytes of the digest."""
        return self.of(data[: self.size]) == self


class _HeldOutRays(TypedDict):
    """The scores of the rays of left-out scans in a grid; see `carlasc.inspection.RayShares`."""

    returns: int
    free: float | None
    unknown: float | None
    occupied: float | None
    passed: float | None
    passed_object: float | None
    missed: float | None
    error_median_m: float | None
    error_90_m: float | None


class _Swept(TypedDict):
    """The score of the space that the vehicle drove through."""

    occupied_share: float | None


class _HeldOut(TypedDict):
    """Held-out scores as JSON has them."""

    rays: _HeldOutRays
    by_class: Mapping[str, _HeldOutRays]
    by_distance: Mapping[str, _HeldOutRays]
    swept: _Swept


@dataclass(frozen=True)
class Report:
    """The report of a grid of one sequence: its content, how it was made, and digests of its files.

    Attributes:
        grid: name of the grid's folder.
        frames: numbers of the frames that the report covers, sorted.
        settings: content of params.json.
        coverage: known and occupied voxels, and their votes.
        convergence: how grids change if scans are left out; None for grids that are not made from
            scans.
        actors: moving actors that were tracked; None if actors were not tracked.
        poses: how well scans agree, and how their poses were refined; None if refinement is off.
        inferred_share: share of the known voxels that were inferred, not seen; None if the grid
            does not say.
        holdout: held-out scores, as `carlasc.inspection.HeldOutScores.to_dict` returns them; None
            if they were not measured.
        digests: digests of each field beside the grid and of the grid, by name.
        documents: digest of each text file that belongs to the grid, by name.
        versions: versions of carlasc, NumPy, Numba and Python that made the report.
    """

    grid: str
    frames: tuple[int, ...]
    settings: Mapping[str, Any]
    coverage: Coverage
    convergence: Convergence | None
    actors: tuple[ActorTrack, ...] | None
    poses: PoseFacts | None
    inferred_share: float | None
    holdout: Mapping[str, Any] | None
    digests: Mapping[str, Digests]
    documents: Mapping[str, FileDigest]
    versions: Mapping[str, str]

    @classmethod
    def make(
        cls,
        grid: str,
        facts: Iterable[FrameFacts],
        settings: Mapping[str, Any],
        classes: ClassTable,
        documents: Mapping[str, bytes],
        *,
        actors: Sequence[Mapping[str, Any]] | None = None,
        poses: PoseFacts | None = None,
    ) -> Self:
        """Make a report.

        Args:
            grid: name of the grid's folder.
            facts: the facts of each frame, in any order.
            settings: content of params.json.
            classes: class table of the grid's labels.
            documents: the text files that belong to the grid, by name.
            actors: the facts of each actor, by number; None if actors were not tracked.
            poses: as in the attributes.
        """
        rows = sorted(facts, key=lambda row: row.frame)
        frames = tuple(row.frame for row in rows)
        changes = [row.changes for row in rows if row.changes is not None]
        names = sorted({name for row in rows for name in row.digests})
        counts = [row.inferred for row in rows if row.inferred is not None]
        known = sum(row.known for row in rows)
        share = sum(counts) / known if known and len(counts) == len(rows) else None
        return cls(
            grid=grid,
            frames=frames,
            settings=dict(settings),
            coverage=_coverage(rows, settings, classes),
            convergence=Convergence(
                len(changes), sum(c.known for c in changes), sum(c.changed for c in changes)
            )
            if changes
            else None,
            actors=None
            if actors is None
            else actors_of(actors, (row.residuals for row in rows), classes),
            poses=poses,
            inferred_share=share,
            holdout=None,
            digests={name: _digests(rows, name) for name in names},
            documents={name: FileDigest.of(data) for name, data in sorted(documents.items())},
            versions=_versions(),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        values = asdict(self)
        own = f"{self.grid}/"
        digests = values.pop("digests").items()
        coverage = self.coverage
        convergence = self.convergence
        shares = "known_share", "occupied_share"
        values["coverage"] |= {name: getattr(coverage, name) for name in shares}
        if convergence is not None:
            measured = values["convergence"] | {"changed_share": convergence.changed_share}
            values["convergence"] = {"left_out": LEFT_OUT, **measured}
        values["frames"] = [(first, last + 1) for first, last in runs_of(self.frames)]
        values["inputs"] = {name: value for name, value in digests if not name.startswith(own)}
        values["outputs"] = {name: value for name, value in digests if name.startswith(own)}
        return {"format": REPORT_FORMAT} | {name: values[name] for name in _KINDS}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], where: str = "report") -> Self:
        """Return the report that `to_dict` describes; `where` is the file named in errors.

        Raises:
            FormatError: the values are not those of a report, or a newer version of carlasc wrote
                them.
        """
        version = values.get("format")
        if version != REPORT_FORMAT:
            newer = isinstance(version, int) and version > REPORT_FORMAT
            raise FormatError(
                where,
                expected=f"a report of format {REPORT_FORMAT}",
                found=f"format {version}",
                advice="upgrade carlasc" if newer else "make it again with `remake=True`",
            )
        with reading(where, "a report", "make it again with `remake=True`"):
            GridSpec.from_params(values["settings"], where)
            parts = {name: from_plain(values[name], kind, name) for name, kind in _KINDS.items()}
            digests = {**parts.pop("inputs"), **parts.pop("outputs")}
            return cls(**{**parts, "frames": _frames(parts["frames"])}, digests=digests)

    def to_json(self) -> bytes:
        """Return the bytes of carlasc-report.json."""
        return to_json(self.to_dict())

    @classmethod
    def from_json(cls, data: bytes, where: str) -> Self:
        """Read carlasc-report.json; `where` is the file named in errors.

        Raises:
            FormatError: it holds something else.
        """
        return cls.from_dict(parse_json(data, where), where)


_KINDS: dict[str, Any] = {
    "grid": str,
    "frames": tuple[tuple[int, int], ...],
    "settings": Mapping[str, Any],
    "coverage": Coverage,
    "convergence": Convergence | None,
    "actors": tuple[ActorTrack, ...] | None,
    "poses": PoseFacts | None,
    "inferred_share": float | None,
    "holdout": _HeldOut | None,
    "inputs": Mapping[str, Digests],
    "outputs": Mapping[str, Digests],
    "documents": Mapping[str, FileDigest],
    "versions": Mapping[str, str],
}
"""The parts of carlasc-report.json, in their order, besides its format."""


def short(digest: bytes) -> str:
    """Return the digits of the digest of a frame in `Digests.frames`."""
    return digest.hex()[:_SHORT]


def _coverage(rows: list[FrameFacts], settings: Mapping[str, Any], classes: ClassTable) -> Coverage:
    by_class: IntArray = sum(
        (row.classes for row in rows), start=np.zeros(classes.num_channels, np.int64)
    )
    votes = sum((row.votes for row in rows), start=np.zeros(1, np.int64))
    known = sum(row.known for row in rows)
    total = sum(row.votes_sum for row in rows)
    voxels = len(rows) * int(np.prod(settings["grid_size"], dtype=np.int64))
    return Coverage(
        voxels=voxels,
        known=known,
        classes={
            classes.names.get(i, str(i)): int(by_class[i])
            for i in np.flatnonzero(by_class).tolist()
        },
        occupied=known - int(by_class[0]),
        mean_votes=round(total / known, 4) if known and total else None,
        votes=tuple(np.trim_zeros(votes, "b").tolist()),
    )


def _digests(rows: list[FrameFacts], name: str) -> Digests:
    whole = blake2b(digest_size=16)
    frames = []
    for row in rows:
        digest = row.digests.get(name)
        frames.append(_ABSENT if digest is None else short(digest))
        if digest is not None:
            whole.update(row.frame.to_bytes(8, "little") + digest)
    return Digests(whole.hexdigest(), "".join(frames))


def _versions() -> dict[str, str]:
    import numba

    return {
        "carlasc": carlasc_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
        "python": platform.python_version(),
    }


def _frames(spans: tuple[tuple[int, int], ...]) -> tuple[int, ...]:
    """Return the frame numbers of half-open ranges.

    Raises:
        ValueError: the ranges are not valid, or have too many frames.
    """
    ranges = [range(start, stop) for start, stop in spans]
    if (
        not all(0 <= span.start <= span.stop for span in ranges)
        or sum(map(len, ranges)) > _MOST_FRAMES
    ):
        raise ValueError(
            f"{len(ranges)} ranges of frames with negative numbers, or of more than {_MOST_FRAMES} "
            f"frames"
        )
    return tuple(frame for span in ranges for frame in span)
