"""Checks of the optional fields of a grid that say how certain it is: probabilities, flags and views."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.evidence import VoxelFlag
from carlasc.inspection.findings import Finding
from carlasc.storage import layout
from carlasc.storage.protocol import Sequence

_ADVICE = "make the grid again with `carlasc regrid --keep-evidence`"


def check_evidence(
    sequence: Sequence, grid: str, frame: int, arrays: Mapping[str, NDArray[Any]], classes: ClassTable | None
) -> Iterator[Finding]:
    """Check the values of the fields of a grid that say how certain it is.

    Args:
        sequence: the sequence.
        grid: name of the grid.
        frame: number of the frame.
        arrays: the fields of the frame that could be read, by name.
        classes: class table of the grid; None if it is not known.
    """
    for part in layout.EVIDENCE_FIELDS:
        name = f"{grid}/{part}"
        if name not in arrays:
            continue
        for expected, found in _mistakes(part, arrays[name], sequence.grids[grid].num_voxels, classes):
            where = f"{sequence.location}/{layout.field_named(name).file(frame)}"
            yield Finding("error", "evidence", sequence.path, where, expected, found, _ADVICE)


def _mistakes(part: str, array: NDArray[Any], num_voxels: int, classes: ClassTable | None) -> Iterator[tuple[str, str]]:
    """Yield what was expected and what was found instead, for each kind of mistake."""
    if part == "occupied":
        wrong = array[~((array >= 0) & (array <= 1))]  # NaN is wrong too
        if wrong.size:
            yield "probabilities of 0 to 1", f"{wrong[0]:g}, and {wrong.size - 1} other such values"
    elif part == "flags":
        wrong = array[array > sum(VoxelFlag)]
        if wrong.size:
            yield f"flags of 0 to {sum(VoxelFlag)}", f"{wrong[0]}, and {wrong.size - 1} other such values"
    elif part == "classes":
        yield from _mistakes_of_classes(array, num_voxels, classes)


def _mistakes_of_classes(table: NDArray[Any], num_voxels: int, classes: ClassTable | None) -> Iterator[tuple[str, str]]:
    inside = (table["voxel"] >= 0) & (table["voxel"] < num_voxels)
    if not inside.all():
        yield (
            f"voxels 0 to {num_voxels - 1}",
            f"{table['voxel'][~inside][0]}, and {(~inside).sum() - 1} other such rows",
        )
    if classes is not None:
        known = np.isin(table["label"], sorted(set(classes.names) - {0}))
        if not known.all():
            found = f"{table['label'][~known][0]}, and {(~known).sum() - 1} other such rows"
            yield f"class ids of {classes.name} other than 0", found
    voxels, place = np.unique(table["voxel"][inside], return_inverse=True)
    sums = np.bincount(place, table["votes"][inside], len(voxels))
    too_large = np.flatnonzero(
        sums > layout.CERTAIN + 0.5 * np.bincount(place, minlength=len(voxels))
    )  # each is rounded
    if len(too_large):
        first = too_large[0]
        found = f"{sums[first]:.0f} in voxel {voxels[first]}, and {len(too_large) - 1} other such voxels"
        yield f"probabilities that add up to at most {layout.CERTAIN} per voxel", found
