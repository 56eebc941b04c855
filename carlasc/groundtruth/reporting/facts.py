"""What a report needs to know of one frame. It is measured while the frame is made, or from the files of a frame that exists already."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.evidence import VoxelFlag
from carlasc.core.grids import Grid, GridSpec
from carlasc.groundtruth.reporting.actors import Residual
from carlasc.storage import layout

POWERS = 24
"""Number of bins of the histogram of votes: 1, 2 to 3, 4 to 7, ..."""
_DIGEST_BYTES = 16
_SAMPLED = 40  # one of so many frames is also made without a tenth of the scans


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


@dataclass(frozen=True, eq=False)
class FrameFacts:
    """What a report needs to know of one frame.

    Attributes:
        frame: frame number.
        digests: digest of each field's file, by the name of the field.
        known: number of known voxels.
        classes: (K,) int64 known voxels of each class, free space first.
        votes: (POWERS,) int64 histogram of the votes of known voxels, by powers of two.
        votes_sum: sum of these votes; 0 if the grid has no counts.
        changes: how the grid changes if a tenth of the scans is left out; None if this was not tried.
        residuals: how well the sightings of moving actors overlay with the next ones, by number of the actor.
        inferred: number of known voxels that were inferred, not seen; None if the grid does not say.
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
            votes, votes_sum = np.bincount(powers, minlength=POWERS), float(seen.sum(dtype=np.float64))
        classes.check(labels, f"{grid}: frame {frame}")  # a label of 2**32 - 1 would be counted in 32 GB
        by_class = np.bincount(labels, minlength=classes.num_channels)
        inferred = _inferred(arrays.get(f"{grid}/flags"), counts)
        return cls(frame, digests, len(labels), by_class, votes, votes_sum, changes, residuals or {}, inferred)


def _inferred(flags: NDArray[Any] | None, counts: NDArray[Any] | None) -> int | None:
    """Return the number of known voxels that were inferred, not seen; None if the grid does not say."""
    if flags is None:
        return None
    inferred = (np.asarray(flags).reshape(-1) & int(VoxelFlag.INFERRED)) > 0
    return int(np.count_nonzero(inferred if counts is None else inferred & (np.asarray(counts).reshape(-1) > 0)))


def sample_frames(numbers: Sequence[int]) -> frozenset[int]:
    """Return the frames that are also made without a tenth of the scans.

    Their choice depends on their numbers, so that runs over parts of a sequence choose the same ones; a short range has one of them.
    """
    chosen = frozenset(n for n in numbers if n % _SAMPLED == _SAMPLED // 2)
    return chosen or frozenset(numbers[len(numbers) // 2 :][:1])


def digest_of(field: str, array: NDArray[Any]) -> bytes:
    """Return the digest (BLAKE2b, 16 bytes) of a field of a frame: that of the bytes of its published file, whatever store it is in.

    Votes are compressed in their file, so theirs is the digest of their rows.

    Raises:
        FormatError: the array does not fit the field.
    """
    entry = layout.field_named(field)
    data = np.ascontiguousarray(array).tobytes() if entry.kind == "votes" else entry.encode(array, field)
    return digest_of_bytes(data)


def digest_of_bytes(data: bytes | memoryview) -> bytes:
    """Return the digest (BLAKE2b, 16 bytes) of the bytes of a file."""
    return blake2b(data, digest_size=_DIGEST_BYTES).digest()
