"""Class tables: the ids, names, colours and roles of classes, and the remaps from one table to
another.

See the format page, `docs/format.md#classes` (CarlaSC, and the renumbering in CARLA) and
`docs/format.md#semantickitti`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from carlasc.core.arrays import (
    AnyIntArray,
    BoolArray,
    FloatArray,
    Int32Array,
    LabelArray,
    Uint8Array,
)
from carlasc.errors import ArgumentError, FormatError, check_types, first_names, within

Color = tuple[int, int, int]
ROLES = ("moving", "movable", "deformable", "ground")
"""The roles that several classes of a table may have: names of attributes of `ClassTable`."""
_WITHOUT_LABELS = ("geometry_only", "ground_only")  # ids for points of scans without labels
_MAX_ID = 65535  # ids are kept in 16 bits in memory


@dataclass(frozen=True)
class ClassTable:
    """A set of classes: the name, the colour and the roles of each id.

    Id 0 means unlabelled for points and free for voxels. It has no role. Files of some benchmarks
    have another id for free voxels, which becomes 0 when they are read (`with_free_first`).

    Attributes:
        name: name of the table, as in carlasc.json.
        names: names by id.
        colors: RGB 0..255 by id.
        moving: ids of classes that contain only moving objects.
        movable: ids of classes of objects that can move.
        deformable: ids of classes of objects that change shape while moving, such as people.
        ground: ids of classes of ground surfaces, such as roads, pavements, grass and water.
        geometry_only: id for the points of scans without labels; None takes the largest id.
        ground_only: id for the ground points of scans without labels; None takes the lowest id of
            `ground`.
        num_channels: number of vote channels, greater than every id. It may be greater than
            necessary if the format requires it.
        free: id of free voxels.

    Raises:
        ArgumentError: an id has no name or no colour, or a value has the wrong type or range.
    """

    name: str
    names: Mapping[int, str]
    colors: Mapping[int, Color]
    moving: frozenset[int] = frozenset()
    movable: frozenset[int] = frozenset()
    deformable: frozenset[int] = frozenset()
    ground: frozenset[int] = frozenset()
    geometry_only: int | None = None
    ground_only: int | None = None
    num_channels: int = 0
    free: int = 0

    def __post_init__(self) -> None:
        check_types(ClassTable, vars(self))
        where = f"class table {self.name}"
        ids = set(self.names)
        if not ids or min(ids) < 0 or max(ids) > _MAX_ID:
            raise ArgumentError(where, expected=f"names of ids 0..{_MAX_ID}", found=sorted(ids))
        for expected, wrong in (
            ("a name and a colour for each id", ids ^ set(self.colors)),
            *((f"ids of the table in {role}", getattr(self, role) - ids) for role in ROLES),
            ("an id of the table in geometry_only", {self.geometry_only} - ids - {None}),
            ("an id of the table in free", {self.free} - ids - {0}),
            ("an id of ground in ground_only", {self.ground_only} - self.ground - {None}),
        ):
            if wrong:
                found = first_names(map(str, sorted(wrong)))
                raise ArgumentError(where, expected=expected, found=f"not so for {found}")
        for index, color in self.colors.items():
            if len(color) != 3 or not all(0 <= value <= 255 for value in color):
                raise ArgumentError(
                    where,
                    expected="three values 0..255 for each colour",
                    found=f"{color} for {index}",
                )
        if self.num_channels and not max(self.names) < self.num_channels <= _MAX_ID + 1:
            expected = f"num_channels above {max(self.names)}, up to {_MAX_ID + 1}"
            raise ArgumentError(where, expected=expected, found=self.num_channels)
        object.__setattr__(self, "names", dict(self.names))
        object.__setattr__(self, "colors", dict(self.colors))
        object.__setattr__(self, "num_channels", self.num_channels or max(self.names) + 1)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], where: str) -> Self:
        """Return the table from the values of `to_dict`. `where` is the file named in errors.

        Raises:
            FormatError: a key is missing or unknown, or a value is not valid.
        """
        known = [entry.name for entry in fields(cls)]
        if unknown := sorted(set(values) - set(known)):
            raise FormatError(
                f"{where}: classes",
                expected=f"only the keys {', '.join(known)}",
                found=", ".join(map(str, unknown)),
            )
        try:
            names = {int(i): str(name) for i, name in _by_id(values["names"]).items()}
            colors = values.get("colors", default_colors(names))
            return cls(
                str(values["name"]),
                names,
                {int(i): color_of(color) for i, color in _by_id(colors).items()},
                **{role: frozenset(map(int, values.get(role, ()))) for role in ROLES},
                geometry_only=_id_or_none(values.get("geometry_only")),
                ground_only=_id_or_none(values.get("ground_only")),
                num_channels=int(values.get("num_channels", 0)),
                free=int(values.get("free", 0)),
            )
        except KeyError as error:
            raise FormatError(
                f"{where}: classes",
                expected=f"the key {error}",
                found=", ".join(map(str, values)) or "none",
            ) from error
        except ArgumentError as error:
            raise FormatError(
                f"{where}: {error.where}", expected=error.expected, found=error.found
            ) from error
        except (TypeError, ValueError, AttributeError, OverflowError) as error:
            raise FormatError(
                f"{where}: classes",
                expected="names and colours by id, and ids in the roles",
                found=error,
            ) from error

    def to_dict(self) -> dict[str, Any]:
        """Return the table as plain values for JSON. Roles without classes are left out."""
        values: dict[str, Any] = {
            "name": self.name,
            "names": {str(index): name for index, name in self.names.items()},
            "colors": {str(index): list(color) for index, color in self.colors.items()},
        }
        values |= {role: sorted(getattr(self, role)) for role in ROLES if getattr(self, role)}
        values |= {
            name: getattr(self, name) for name in _WITHOUT_LABELS if getattr(self, name) is not None
        }
        values |= {"free": self.free} if self.free else {}
        return values | {"num_channels": self.num_channels}

    @cached_property
    def with_free_first(self) -> ClassTable:
        """The table of voxels in which the ids of free space and 0 are exchanged, so that free is
        0; the table itself if free is 0.
        """
        if not self.free:
            return self
        swap = {0: self.free, self.free: 0}

        def swapped(ids: Iterable[int]) -> list[int]:
            return [swap.get(i, i) for i in ids]

        roles: dict[str, Any] = {role: frozenset(swapped(getattr(self, role))) for role in ROLES}
        return replace(
            self,
            name=f"{self.name}-free0",
            names=dict(sorted(zip(swapped(self.names), self.names.values(), strict=True))),
            colors=dict(sorted(zip(swapped(self.colors), self.colors.values(), strict=True))),
            free=0,
            **roles,
        )

    @cached_property
    def standing(self) -> dict[int, int]:
        """Class of what moves -> class of the same kind of actor, for classes with names such as
        "moving-car" and "car".
        """
        ids = {name: label for label, name in self.names.items()}
        kinds = {label: self.names[label].removeprefix("moving-") for label in self.moving}
        return {label: ids[kind] for label, kind in kinds.items() if ids.get(kind, label) != label}

    @property
    def geometry_id(self) -> int:
        """The id for the points of scans without labels."""
        return max(self.names) if self.geometry_only is None else self.geometry_only

    @property
    def ground_id(self) -> int | None:
        """The id for the ground points of scans without labels; None if the table has no ground
        classes.
        """
        return min(self.ground, default=None) if self.ground_only is None else self.ground_only

    @property
    def dtype(self) -> np.dtype[np.unsignedinteger]:
        """The smallest unsigned type that holds every id: uint8, or uint16 if there are more than
        256 vote channels.
        """
        return np.dtype(np.uint8 if self.num_channels <= 256 else np.uint16)

    @cached_property
    def palette(self) -> Uint8Array:
        """(num_channels, 3) uint8 RGB by id; ids without a colour are grey."""
        palette = np.full((self.num_channels, 3), 128, np.uint8)
        for index, color in self.colors.items():
            palette[index] = color
        return palette

    def have_role(self, labels: AnyIntArray, role: str) -> BoolArray:
        """Return which labels are of a class with a role, one of `ROLES`: (..., ) bool.

        Args:
            labels: (...) ids below `num_channels`.
            role: the role.
        """
        has_role = np.zeros(self.num_channels, np.bool_)
        has_role[[*getattr(self, role)]] = True
        return has_role[labels]

    def id_of(self, name: str) -> int:
        """Return the id of a class by its name, case-insensitive.

        Raises:
            ArgumentError: no class has that name.
        """
        for index, candidate in self.names.items():
            if candidate.lower() == name.lower():
                return index
        raise ArgumentError(
            f"class {name!r}",
            expected=f"one of {', '.join(self.names.values())} (table {self.name})",
            found="none of them",
        )

    def unknown(self, labels: AnyIntArray) -> dict[int, int]:
        """Return the ids in `labels`, of any shape, that are no class of the table, with their
        numbers of occurrences.
        """
        top = max(self.names)
        if labels.size and int(labels.min()) >= 0 and int(labels.max()) <= top:
            listed = np.zeros(top + 1, np.bool_)
            listed[[*self.names]] = True
            if len(self.names) > top or listed[labels].all():
                return {}
        return {i: n for i, n in ids_in(labels).items() if i not in self.names}

    def check(self, labels: AnyIntArray, where: str) -> None:
        """Raise a FormatError if an id in `labels`, of any shape, is no class of the table.

        `where` is the file named in the message, which proposes a table that has all of the ids.
        """
        if unknown := self.unknown(labels):
            others = [table.name for table in tables_with(np.unique(labels).tolist(), self)]
            advice = "correct the labels"
            if others:
                advice = (
                    f"if they are ids of {others[0]}, write "
                    f'{{"format": 2, "classes": "{others[0]}"}} to carlasc.json; otherwise {advice}'
                )
            raise FormatError(
                where,
                expected=f"class ids of {self.name}",
                found=f"{times(unknown)} of {labels.size} labels",
                advice=advice,
            )


_FOUND = {
    "option": "given",
    "file": "named in the files",
    "format": "of the format",
    "ids": "found by the ids",
    "assumed": "assumed: no file names one",
}


@dataclass(frozen=True, order=True)
class TableUse:
    """A class table by which labels were read, and what named it.

    Attributes:
        table: name of the table.
        found: "option" (`source_classes`), "file" (the metadata of the data), "format" (the files
            of a benchmark), "ids" (found by the ids of the labels), or "assumed".
    """

    table: str
    found: str

    def __str__(self) -> str:
        return f"{self.table} ({_FOUND[self.found]})"


BUILT_IN: dict[str, ClassTable] = {}
"""The class tables of `carlasc.core.TABLES`, by name; `carlasc.core.tables` makes them."""


def table_named(name: str) -> ClassTable:
    """Return the class table with a name in `TABLES`.

    Raises:
        FormatError: no table has this name.
    """
    if name not in BUILT_IN:
        raise FormatError("classes", expected=f"one of {', '.join(BUILT_IN)}", found=repr(name))
    return BUILT_IN[name]


def table_from_json(value: object, where: str) -> ClassTable:
    """Return the class table that a JSON file names or contains.

    Args:
        value: the name of a table in `TABLES`, or the result of `ClassTable.to_dict`.
        where: the file, for errors.

    Raises:
        FormatError: no table has this name, the values are not valid, or a table in `TABLES` has
            the same name and other values.
    """
    if not isinstance(value, Mapping):
        with within(where):
            return table_named(str(value))
    table = ClassTable.from_dict(value, where)
    known = BUILT_IN.get(table.name, table)
    if known != table:
        raise FormatError(
            f"{where}: classes",
            expected=f"a name that is not in use, or the table {table.name} of carlasc",
            found=f"a different table with the name {table.name}",
            advice="give the table a new name",
        )
    return known


def table_to_json(table: ClassTable) -> str | dict[str, Any]:
    """Return a class table for JSON: its name if it is in `TABLES`, otherwise the whole table."""
    return table.name if BUILT_IN.get(table.name) == table else table.to_dict()


def tables_with(ids: Collection[int], like: ClassTable) -> list[ClassTable]:
    """Return the other built-in tables that have all of the ids, those named after `like` first."""
    tables = [t for t in BUILT_IN.values() if t != like and t.names.keys() >= set(ids)]
    return sorted(tables, key=lambda t: (not t.name.startswith(like.name), len(t.names)))


def ids_in(labels: AnyIntArray) -> dict[int, int]:
    """Return the ids in labels, of any shape, with their numbers of occurrences."""
    ids, counts = np.unique(labels, return_counts=True)
    return dict(zip(ids.tolist(), counts.tolist(), strict=True))


def times(counts: Mapping[int, int]) -> str:
    """Return ids with their numbers of occurrences, for messages: "23 (4 times), 24 (2 times)"."""
    return ", ".join(f"{i} ({n} times)" for i, n in counts.items())


@dataclass(frozen=True)
class Remap:
    """A mapping from the ids of one table to those of another.

    Attributes:
        name: name of the remap on the command line and in `Dataset`.
        source: class table of the input ids.
        target: class table of the output ids.
        mapping: output id by input id.
    """

    name: str
    source: ClassTable
    target: ClassTable
    mapping: Mapping[int, int]

    def __post_init__(self) -> None:
        check_types(Remap, vars(self))
        object.__setattr__(self, "mapping", dict(self.mapping))
        for old, new in self.mapping.items():
            if old < 0 or new not in self.target.names:
                raise ArgumentError(
                    f"remap {self.name}",
                    expected=f"ids of {self.source.name} to ids of {self.target.name}",
                    found=f"{old} -> {new}",
                )

    @cached_property
    def table(self) -> Int32Array:
        """(max id + 1,) int32 lookup table by input id; -1 for ids that are not in the mapping."""
        table = np.full(max(self.mapping) + 1, -1, np.int32)
        table[list(self.mapping)] = list(self.mapping.values())
        return table

    @cached_property
    def _lookup(self) -> LabelArray:
        """The lookup table in the dtype of the target, with 0 for unknown ids.

        It is used only after the ids have been checked.
        """
        return np.where(self.table < 0, 0, self.table).astype(self.target.dtype)

    def unknown(self, labels: AnyIntArray) -> dict[int, int]:
        """Return the ids in `labels`, of any shape, that are not in the mapping, with their number
        of occurrences.
        """
        return {i: n for i, n in ids_in(labels).items() if i not in self.mapping}

    def __call__(self, labels: AnyIntArray, where: str = "labels") -> LabelArray:
        """Return the remapped labels in the dtype of the target. The input is not changed.

        Args:
            labels: ids of the source table, any shape.
            where: the file named in errors.

        Raises:
            FormatError: an id has no target; the message names these ids and the number of their
                occurrences.
        """
        labels = np.asarray(labels)
        outside = bool(labels.size) and (
            int(labels.max()) >= len(self.table) or int(labels.min()) < 0
        )
        if not outside and (self._complete or not (self.table[labels] < 0).any()):
            return self._lookup[labels]
        raise FormatError(
            where,
            expected=f"class ids of {self.source.name}",
            found=times(self.unknown(labels)),
            advice=f"the remap {self.name} has no target for these ids: use another remap, or "
            f"correct the labels",
        )

    @cached_property
    def _complete(self) -> bool:
        return bool((self.table >= 0).all())


def class_weights(voxel_counts: AnyIntArray, remap: Remap | None = None) -> FloatArray:
    """Return the loss weight of each class: `1 / ln(count + 0.001)`.

    The formula is used for counts above 1,000, because it is not valid for small counts. Classes
    with fewer voxels get the largest of the other weights, and classes without voxels get 0. See
    the format page, `docs/format.md#classes`.

    Args:
        voxel_counts: number of voxels of each class, by id of the source table of the remap.
        remap: remap of the counts: they are first summed per target class; None uses the counts
            unchanged.

    Returns:
        (K,) float64 weights, by id of the target.
    """
    counts: FloatArray = np.asarray(voxel_counts, np.float64)
    if remap is not None:
        counts = np.zeros(max(remap.target.names) + 1)
        for old, new in remap.mapping.items():
            counts[new] += voxel_counts[old] if old < len(voxel_counts) else 0
    common = counts > 1000
    weights = np.zeros_like(counts)
    weights[common] = 1.0 / np.log(counts[common] + 0.001)
    weights[(counts > 0) & ~common] = weights.max(initial=0.0) or 1.0
    return weights


def default_colors(ids: Iterable[int]) -> dict[int, Color]:
    """Return a colour for each id, for tables that name none: white for 0, otherwise well apart."""
    return {
        i: (110 + 13 * i % 120, 90 + 29 * i % 130, 80 + 47 * i % 140) if i else (255, 255, 255)
        for i in ids
    }


def _by_id(values: Any) -> Mapping[Any, Any]:
    return dict(enumerate(values)) if isinstance(values, list) else values


def _id_or_none(value: Any) -> int | None:
    return None if value is None else int(value)


def color_of(rgb: Iterable[Any]) -> Color:
    """Return a colour from its red, green and blue, which may be texts."""
    red, green, blue = map(int, rgb)
    return red, green, blue
