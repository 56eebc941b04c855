"""Version 1 of the format of stores of arrays: frames lie one after the other, and every column has a table of offsets.

HDF5 stores are of this version; zarr stores were until carlasc.storage.zarr.zarr_source got version 2.
"""

from __future__ import annotations

import numpy as np

from carlasc.errors import FormatError
from carlasc.storage import layout
from carlasc.storage.packed.array_reading import (
    ArrayField,
    ArraySequence,
    ArrayStore,
    StoredColumn,
    check_attributes,
    check_frames,
    document_node,
    field_node,
)
from carlasc.storage.packed.columns import Column, packing_of


class OffsetsSequence(ArraySequence):
    """One sequence of a store of version 1."""

    def read_document(self, name: str) -> bytes:
        """Return a text file's bytes."""
        self._check_document(name)
        return self.store.read_small(f"{self.group}/{document_node(name)}").tobytes()

    def _open_field(self, field: str) -> ArrayField:
        node = f"{self.group}/{field_node(field)}"
        where = f"{self.store.location}/{node}"
        attributes = self.store.attributes(node)
        if attributes is None:
            raise FormatError(
                where, expected="the field that the sequence lists", found="none", advice="the store is damaged"
            )
        check_attributes(attributes, where)
        packing = packing_of(layout.field_named(field), attributes=attributes)
        if attributes.get("kind") != packing.kind:
            raise FormatError(where, expected=f"a field of kind {packing.kind}", found=repr(attributes.get("kind")))
        frames = check_frames(self.store.read_small(f"{node}/frames").astype(np.int64), where)

        def open_columns() -> dict[str, StoredColumn]:
            nodes = {column: f"{node}/{column.name}" for column in packing.columns}
            found = {
                column.name: _open_column(self.store, path, column, len(frames), packing.kind == "grid")
                for column, path in nodes.items()
                if self.store.attributes(path) is not None
            }
            if packing.kind == "grid":
                for stored in found.values():
                    self._check_grid(field, stored.array.chunk[1:])
            return found

        return ArrayField(where, packing, frames, open_columns, self.store.local)


def _open_column(store: ArrayStore, node: str, column: Column, frames: int, is_grid: bool) -> StoredColumn:
    """Read where each frame starts and ends in a column."""
    array = store.array(node)
    step = array.step
    rest = tuple(n for axis, n in enumerate(array.chunk) if axis != array.axis)
    if array.axis != (0 if is_grid else len(rest)) or not (is_grid or rest == ((column.rows,) if column.rows else ())):
        raise FormatError(
            f"{store.location}/{node}",
            expected=f"{'one frame' if is_grid else f'{column.rows or 1} rows'} in each chunk",
            found=f"chunks of shape {array.chunk}",
            advice="the store is damaged",
        )
    if is_grid:
        spans = np.stack([np.arange(frames), np.arange(frames) + 1], axis=1)
    else:
        spans = store.read_small(f"{node}_offsets").astype(np.int64)
    fits = spans.shape == (frames, 2) and (spans[:, 0] % step == 0).all()
    fits = fits and (spans[:, 0] <= spans[:, 1]).all()
    if not fits or spans.min(initial=0) < 0 or spans.max(initial=0) > array.shape[array.axis]:
        raise FormatError(
            f"{store.location}/{node}_offsets",
            expected=f"offsets of {frames} frames inside the array",
            found="others",
            advice="the store is damaged",
        )
    return StoredColumn(column, array, spans[:, 0] // step, spans[:, 1] - spans[:, 0], is_grid)
