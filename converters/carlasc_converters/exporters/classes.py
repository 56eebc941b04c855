"""From the classes of a grid or a scan to those of another data set."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from carlasc.converting import remaps_to_carla
from carlasc.core.classes import ClassTable
from carlasc.errors import FormatError
from carlasc_converters.exporters.kinds import KINDS


def mapping_of(
    maps: Mapping[str, Mapping[int, int]], kind: Literal["occ3d", "raw", "category"], table: ClassTable, where: str
) -> dict[int, int]:
    """Return the map from the ids of a class table: its own if there is one, otherwise the one by way of CarlaSC's classes.

    In the second case, classes that CarlaSC does not have are mapped by their kind.

    Args:
        maps: name of a class table -> id -> class of the other data set; "carla" is among them.
        kind: the attribute of a `Kind` that holds its class in the other data set.
        table: class table of the labels.
        where: the sequence, for errors.

    Raises:
        FormatError: nothing maps the table.
    """
    if table.name in maps:
        return dict(maps[table.name])
    remaps = remaps_to_carla(table)
    if remaps is None:
        raise FormatError(
            where,
            expected=f"classes with a map: {', '.join(maps)}, or those of an installed converter",
            found=table.name,
            advice="convert the data again with `--classes carla`",
        )
    mapping = {label: label for label in table.names}
    for remap in remaps:
        mapping = {label: remap.mapping[middle] for label, middle in mapping.items() if middle in remap.mapping}
    kinds = KINDS.get(table.name, {})
    return {
        label: getattr(kinds[table.names[label]], kind) if table.names[label] in kinds else maps["carla"][carla]
        for label, carla in mapping.items()
    }


def lookup_of(mapping: Mapping[int, int]) -> NDArray[np.int32]:
    """Return a table from ids to classes, -2 for ids without a class; its last entry stands for all larger ids."""
    lookup = np.full(max(mapping) + 2, _NONE, np.int32)
    lookup[list(mapping)] = list(mapping.values())
    return lookup


def classes_of(
    labels: NDArray[np.unsignedinteger], lookup: NDArray[np.int32], table: ClassTable, where: str
) -> NDArray[np.int32]:
    """Return labels as classes of another data set, by a table that `lookup_of` made.

    Raises:
        FormatError: a label has no class; `where` is the file or field named in the message.
    """
    beyond = len(lookup) - 1
    found: NDArray[np.int32] = lookup[labels if np.iinfo(labels.dtype).max <= beyond else np.minimum(labels, beyond)]
    if (found == _NONE).any():
        bad = int(labels[found == _NONE][0])
        times = int(np.count_nonzero(labels == bad))
        raise FormatError(where, expected=f"class ids of {table.name}", found=f"{bad} ({times} times)")
    return found


_NONE = -2
