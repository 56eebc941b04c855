"""Classes as data: tables of ids, names and colours, and the remaps between them.

Facts: FORMAT section 2 (CarlaSC, CARLA's renumbering) and section 6 (SemanticKITTI, SemanticPOSS).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, FormatError

Color = tuple[int, int, int]


@dataclass(frozen=True)
class ClassTable:
    """A set of classes: what each id is called and how it is drawn.

    Attributes:
        name: what carlasc.json calls the table.
        names: id -> name.
        colors: id -> RGB 0..255.
        moving: ids whose label itself says that the thing moves.
        movable: ids of things that may move, whether they do or not.
        deformable: ids of things that change their shape as they move: people.
        num_channels: number of vote channels: ids are below it. More than the ids need where the format says so.
    """

    name: str
    names: Mapping[int, str]
    colors: Mapping[int, Color]
    moving: frozenset[int] = field(default=frozenset())
    movable: frozenset[int] = field(default=frozenset())
    deformable: frozenset[int] = field(default=frozenset())
    num_channels: int = 0

    def __post_init__(self) -> None:
        if set(self.names) != set(self.colors):
            raise ArgumentError(f"class table {self.name}: names and colours are of different ids")
        object.__setattr__(self, "names", dict(self.names))
        object.__setattr__(self, "colors", dict(self.colors))
        object.__setattr__(self, "num_channels", self.num_channels or max(self.names) + 1)

    @property
    def dtype(self) -> np.dtype[np.unsignedinteger]:
        """The smallest unsigned type that holds every id: uint8, or uint16 where ids go over 255 (never wrapped)."""
        return np.dtype(np.uint8 if self.num_channels <= 256 else np.uint16)

    @cached_property
    def palette(self) -> NDArray[np.uint8]:
        """(num_channels, 3) uint8 RGB by id; ids without a colour are grey."""
        palette = np.full((self.num_channels, 3), 128, np.uint8)
        for index, color in self.colors.items():
            palette[index] = color
        return palette

    def id_of(self, name: str) -> int:
        """Return the id of a class by name, in any case.

        Raises:
            ArgumentError: no class has that name.
        """
        for index, candidate in self.names.items():
            if candidate.lower() == name.lower():
                return index
        raise ArgumentError(f"class {name!r}: expected one of {', '.join(self.names.values())} (table {self.name})")

    def check(self, labels: NDArray[np.integer], where: str) -> None:
        """Raise FormatError naming the largest id that is not below `num_channels`; `where` is the file."""
        if labels.size and (int(labels.max()) >= self.num_channels or int(labels.min()) < 0):
            bad = int(labels.max()) if int(labels.max()) >= self.num_channels else int(labels.min())
            count = int(np.count_nonzero(labels == bad))
            raise FormatError(
                where,
                expected=f"class ids 0..{self.num_channels - 1} (table {self.name})",
                found=f"{bad} on {count} of {labels.size}",
            )


@dataclass(frozen=True)
class Remap:
    """A mapping from the ids of one table to those of another.

    Attributes:
        name: what the command line and Dataset call it.
        source: table of the ids going in.
        target: table of the ids coming out.
        mapping: id -> id.
    """

    name: str
    source: ClassTable
    target: ClassTable
    mapping: Mapping[int, int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "mapping", dict(self.mapping))
        for old, new in self.mapping.items():
            if old < 0 or new not in self.target.names:
                raise ArgumentError(
                    f"remap {self.name}: {old} -> {new} leaves the ids of {self.source.name} or {self.target.name}"
                )

    @cached_property
    def table(self) -> NDArray[np.int32]:
        """Lookup table over 0..max id, -1 for ids that the mapping does not know."""
        table = np.full(max(self.mapping) + 1, -1, np.int32)
        table[list(self.mapping)] = list(self.mapping.values())
        return table

    @cached_property
    def _lookup(self) -> NDArray[np.unsignedinteger]:
        """The table in the target's own type, unknown ids as 0: used only once the ids have been checked."""
        return np.where(self.table < 0, 0, self.table).astype(self.target.dtype)

    def unknown(self, labels: NDArray[np.integer]) -> dict[int, int]:
        """Return the ids that the mapping does not know, each with how often it stands."""
        ids, counts = np.unique(labels, return_counts=True)
        return {int(i): int(n) for i, n in zip(ids, counts, strict=True) if int(i) not in self.mapping}

    def __call__(self, labels: NDArray[np.integer], where: str = "labels") -> NDArray[np.unsignedinteger]:
        """Return new labels in the target's dtype; the input is left as it is.

        Args:
            labels: any shape, ids of the source table.
            where: what to call the labels in an error: the file.

        Raises:
            FormatError: an id has no target; names the id and how often it stands.
        """
        labels = np.asarray(labels)
        outside = bool(labels.size) and (int(labels.max()) >= len(self.table) or int(labels.min()) < 0)
        if not outside and (self._complete or not (self.table[labels] < 0).any()):
            return self._lookup[labels]
        found = ", ".join(f"{i} ({n} times)" for i, n in self.unknown(labels).items())
        raise FormatError(
            where,
            expected=f"class ids of {self.source.name}",
            found=f"{found}",
            advice=f"no target in the remap {self.name}",
        )

    @cached_property
    def _complete(self) -> bool:
        return bool((self.table >= 0).all())


def class_weights(voxel_counts: NDArray[np.integer], remap: Remap | None = None) -> NDArray[np.float64]:
    """Return the loss weight of each class: `1 / ln(count + 0.001)` (FORMAT section 2).

    Counts of 1,000 and fewer take the largest weight of the others: there the formula means nothing (it is negative
    below 1). Absent classes take 0.

    Args:
        voxel_counts: voxels of each class, by id of the remap's source table.
        remap: sums the counts over the target's classes first; None leaves them.

    Returns:
        (K,) float64 weights by target id.
    """
    counts: NDArray[np.float64] = np.asarray(voxel_counts, np.float64)
    if remap is not None:
        counts = np.zeros(max(remap.target.names) + 1)
        for old, new in remap.mapping.items():
            counts[new] += voxel_counts[old] if old < len(voxel_counts) else 0
    common = counts > 1000
    weights = np.zeros_like(counts)
    weights[common] = 1.0 / np.log(counts[common] + 0.001)
    weights[(counts > 0) & ~common] = weights.max(initial=0.0) or 1.0
    return weights
