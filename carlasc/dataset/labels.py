"""Class ids as samples hold them: mapped by one lookup table, with errors that name the file and the id."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from carlasc.core.classes import ClassTable, Remap
from carlasc.core.tables import remap_named
from carlasc.errors import ArgumentError, FormatError

RemapLike = str | Remap | Mapping[int, int] | ArrayLike | None
"""What a `remap` argument takes: a name in `carlasc.core.REMAPS`, a Remap, a mapping or table of ids; None keeps the ids."""

_GREY = (128, 128, 128)


class LabelMap:
    """Maps the labels of one class table to those that samples hold.

    Attributes:
        name: name of the remap; "none" if ids are kept.
        source: class table of the labels that are read.
        target: class table of the labels in samples.
    """

    def __init__(self, remap: RemapLike, classes: ClassTable) -> None:
        """Prepare the lookup table; `classes` is the table of the data."""
        self._remap = None if remap is None else _as_remap(remap, classes)
        self.name = self._remap.name if self._remap else "none"
        self.source = self._remap.source if self._remap else classes
        self.target = self._remap.target if self._remap else classes
        self._table = self._remap.table if self._remap else np.arange(classes.num_channels, dtype=np.int32)

    def __call__(self, labels: NDArray[np.unsignedinteger], where: str) -> NDArray[np.unsignedinteger]:
        """Return the labels of any shape in the dtype of the target table.

        Raises:
            FormatError: an id is not in the source table; `where` names the labels.
        """
        from carlasc.dataset.stacking import look_up

        found = look_up(labels, self._table, self.target.dtype)
        if found is None and self._remap is not None:
            return self._remap(labels, where)  # raises, naming the id
        if found is None:
            self.source.check(labels, where)
            raise FormatError(where, expected=f"class ids of {self.source.name}")
        return found


def _as_remap(remap: str | Remap | Mapping[int, int] | ArrayLike, classes: ClassTable) -> Remap:
    if isinstance(remap, Remap):
        return remap
    if isinstance(remap, str):
        return remap_named(remap)
    if isinstance(remap, Mapping):
        mapping = {int(old): int(new) for old, new in remap.items()}
    else:
        table = np.asarray(remap)
        if table.ndim != 1 or table.dtype.kind not in "iu" or not table.size:
            raise ArgumentError("remap", expected="a name, a mapping or a table of ids", found=type(remap).__name__)
        mapping = dict(enumerate(table.tolist()))
    if not mapping or min(mapping.values()) < 0:
        raise ArgumentError("remap", expected="ids of 0 or more", found="a negative one" if mapping else "none")
    ids = sorted(set(mapping.values()))
    target = ClassTable("custom", {i: f"class {i}" for i in ids}, dict.fromkeys(ids, _GREY))
    return Remap("custom", classes, target, mapping)
