"""Choosing what a scene shows where it leaves a choice: the grid, the class table and the frames."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.tables import TABLES, remaps_between
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.storage import Sequence, layout
from carlasc.viewing.finding import FoundSequence
from carlasc.viewing.remapping import RemappedSequence


def table_of(classes: ClassTable | str | None) -> ClassTable | None:
    """Return a class table, which may be given by its name."""
    return TABLES[classes] if isinstance(classes, str) else classes


def choose_grid(found: FoundSequence, name: str | None) -> str:
    """Return the grid that is asked for, the one that the path names, `evaluation`, or the first."""
    names = list(found.sequence.grids)
    wanted = name or found.grid
    if wanted is None:
        wanted = layout.EVALUATION if layout.EVALUATION in names else next(iter(names), layout.EVALUATION)
    if wanted not in names:
        raise MissingDataError(
            found.sequence.location, expected=f"the grid {wanted}", found=", ".join(names) or "no grid"
        )
    return wanted


def common_table(data: RemappedSequence, truth: RemappedSequence | None, wanted: ClassTable | None) -> ClassTable:
    """Return the class table that all labels are shown in: the wanted one, the data's, or the truth's."""
    stored = [data.stored_table] + ([] if truth is None else [truth.stored_table])
    candidates = stored if wanted is None else [wanted]
    for table in candidates[:-1]:
        try:
            _check_remaps(stored, table)
        except ArgumentError:
            continue
        return table
    _check_remaps(stored, candidates[-1])
    return candidates[-1]


def _check_remaps(stored: Iterable[ClassTable], target: ClassTable) -> None:
    """Raise ArgumentError if labels of one of the tables cannot be shown in the target."""
    for table in stored:
        remaps_between(table, target)


def frames_with(data: RemappedSequence, truth: RemappedSequence | None, contents: tuple[str, ...]) -> NDArray[np.int64]:
    """Return the frames that have everything that is shown."""
    own = {"scan": ("points",), "flow": ("points", "flow"), "truth": ()}
    needed = [(data.sequence, name) for c in contents for name in own.get(c, (f"{data.grid}/labels",))]
    if truth is not None and {"truth", "errors"} & set(contents):
        needed.append((truth.sequence, f"{truth.grid}/labels"))
    frames: NDArray[np.int64] | None = None
    for sequence, name in needed:
        available = sequence.frames(name)
        if not len(available):
            raise MissingDataError(sequence.location, expected=f"the field {name}", found=list_fields(sequence))
        common = available if frames is None else np.intersect1d(frames, available)
        if frames is not None and not len(common):
            raise MissingDataError(
                sequence.location,
                expected=f"{name} of frames {describe_frames(frames)}",
                found=f"frames {describe_frames(available)}",
            )
        frames = common
    return np.empty(0, np.int64) if frames is None else frames


def list_fields(sequence: Sequence) -> str:
    """Return the names of the fields of a sequence, for a message."""
    return ", ".join(sorted(sequence.fields())) or "nothing"


def describe_frames(frames: NDArray[np.int64]) -> str:
    """Return the first and the last of some frames and their number, for a message."""
    return f"{frames[0]} to {frames[-1]} ({len(frames)} frames)"
