"""The report of a grid as a value: carlasc-report.json, which every run writes beside the grid."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import blake2b
from itertools import groupby
from typing import Any, Self, TypedDict

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.grids import GridSpec
from carlasc.core.plain import from_plain
from carlasc.errors import FormatError, carlasc_version, reading
from carlasc.groundtruth.reporting.facts import (
    ActorTrack,
    FrameFacts,
    PoseFacts,
    actors_of,
    digest_of_bytes,
)
from carlasc.storage.files import parse_json, to_json

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
        """Return the digits of the row-th frame of the report; None if it does not have the field."""
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
        holdout: Mapping[str, Any] | None = None,
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
            holdout: as in the attributes.
        """
        rows = sorted(facts, key=lambda row: row.frame)
        frames = tuple(row.frame for row in rows)
        changes = [row.changes for row in rows if row.changes is not None]
        names = sorted({name for row in rows for name in row.digests})
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
            inferred_share=_inferred(rows),
            holdout=holdout,
            digests={name: _digests(rows, name) for name in names},
            documents={name: FileDigest.of(data) for name, data in sorted(documents.items())},
            versions=_versions(),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        coverage, convergence = self.coverage, self.convergence
        own = f"{self.grid}/"
        digests = {name: asdict(value) for name, value in self.digests.items()}
        return {
            "format": REPORT_FORMAT,
            "grid": self.grid,
            "frames": [list(span) for span in _spans(self.frames)],
            "settings": dict(self.settings),
            "coverage": {
                **asdict(coverage),
                "classes": dict(coverage.classes),
                "votes": list(coverage.votes),
                "known_share": coverage.known_share,
                "occupied_share": coverage.occupied_share,
            },
            "convergence": None
            if convergence is None
            else {
                "left_out": LEFT_OUT,
                **asdict(convergence),
                "changed_share": convergence.changed_share,
            },
            "actors": None if self.actors is None else [_plain(actor) for actor in self.actors],
            "poses": None if self.poses is None else asdict(self.poses),
            "inferred_share": self.inferred_share,
            "holdout": None if self.holdout is None else dict(self.holdout),
            "inputs": {name: value for name, value in digests.items() if not name.startswith(own)},
            "outputs": {name: value for name, value in digests.items() if name.startswith(own)},
            "documents": {name: asdict(value) for name, value in self.documents.items()},
            "versions": dict(self.versions),
        }

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
            inputs, outputs = (
                from_plain(values[part], Mapping[str, Digests], part)
                for part in ("inputs", "outputs")
            )
            return cls(
                grid=from_plain(values["grid"], str, "grid"),
                frames=_frames(values["frames"]),
                settings=from_plain(values["settings"], Mapping[str, Any], "settings"),
                coverage=from_plain(values["coverage"], Coverage, "coverage"),
                convergence=from_plain(values["convergence"], Convergence | None, "convergence"),
                actors=from_plain(values["actors"], tuple[ActorTrack, ...] | None, "actors"),
                poses=from_plain(values["poses"], PoseFacts | None, "poses"),
                inferred_share=from_plain(values["inferred_share"], float | None, "inferred_share"),
                holdout=from_plain(values["holdout"], _HeldOut | None, "holdout"),
                digests={**inputs, **outputs},
                documents=from_plain(values["documents"], Mapping[str, FileDigest], "documents"),
                versions=from_plain(values["versions"], Mapping[str, str], "versions"),
            )

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


def short(digest: bytes) -> str:
    """Return the digits of the digest of a frame in `Digests.frames`."""
    return digest.hex()[:_SHORT]


def _coverage(rows: list[FrameFacts], settings: Mapping[str, Any], classes: ClassTable) -> Coverage:
    by_class: NDArray[np.int64] = sum(
        (row.classes for row in rows), start=np.zeros(classes.num_channels, np.int64)
    )
    votes = sum((row.votes for row in rows), start=np.zeros(1, np.int64))
    known, total = sum(row.known for row in rows), sum(row.votes_sum for row in rows)
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


def _inferred(rows: list[FrameFacts]) -> float | None:
    """Return the share of the known voxels that were inferred; None if a frame does not say."""
    counts, known = (
        [row.inferred for row in rows if row.inferred is not None],
        sum(row.known for row in rows),
    )
    return sum(counts) / known if known and len(counts) == len(rows) else None


def _digests(rows: list[FrameFacts], name: str) -> Digests:
    whole, frames = blake2b(digest_size=16), []
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


def _spans(frames: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return half-open ranges of consecutive frame numbers."""
    runs = [
        [frame for _, frame in run]
        for _, run in groupby(enumerate(frames), lambda pair: pair[1] - pair[0])
    ]
    return [(run[0], run[-1] + 1) for run in runs]


def _frames(spans: Any) -> tuple[int, ...]:
    """Return the frame numbers of half-open ranges.

    Raises:
        ValueError: the ranges are not valid, or have too many frames.
    """
    ranges = [
        range(start, stop)
        for start, stop in from_plain(spans, tuple[tuple[int, int], ...], "frames")
    ]
    if (
        not all(0 <= span.start <= span.stop for span in ranges)
        or sum(map(len, ranges)) > _MOST_FRAMES
    ):
        raise ValueError(
            f"{len(ranges)} ranges of frames with negative numbers, or of more than {_MOST_FRAMES} "
            f"frames"
        )
    return tuple(frame for span in ranges for frame in span)


def _plain(actor: ActorTrack) -> dict[str, Any]:
    return {**asdict(actor), "size_m": list(actor.size_m), "seen_m": list(actor.seen_m)}
