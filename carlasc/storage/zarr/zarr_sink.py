"""Writing packed zarr stores in place, block by block, from any number of processes."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from carlasc.core.arrays import AnyArray
from carlasc.core.grids import Coordinates
from carlasc.errors import import_extra, within
from carlasc.storage import layout
from carlasc.storage.files import AnyPath, to_json
from carlasc.storage.layout import identity_of
from carlasc.storage.packed.array_layout import SEQUENCE, document_node, field_node, typical_size
from carlasc.storage.packed.chunks import in_threads
from carlasc.storage.packed.stores import VERSION, PackOptions, check_names, node_of
from carlasc.storage.protocol import FrameArrays, SequenceWriter, Sink
from carlasc.storage.transport.trees import LocalTarget, Target
from carlasc.storage.zarr.block_tables import EncodedFrame, StoredField, encode_frame
from carlasc.storage.zarr.root import StoreRoot, existing_options
from carlasc.storage.zarr.shards import METADATA, group_metadata
from carlasc.storage.zarr.zarr_finish import EXPECTED, finish, format_expected, read_expected
from carlasc.storage.zarr.zarr_source import ZarrSource

_PUTS = 16  # objects that are written in parallel
_T = TypeVar("_T")


class ZarrSink(Sink):
    """Writes a packed zarr store in place, on a local disk or in an object store.

    Several processes may write one store at the same time, each with its own sink, or with pickled
    copies of one writer. The store cannot be opened until `finish` has written its metadata.
    """

    is_readable = True

    def __init__(
        self,
        out: AnyPath | Target,
        options: PackOptions | None = None,
        overwrite: bool = False,
    ) -> None:
        """Start a store, or continue an unfinished store with the same options.

        Frames may be added to a finished store. It can be read meanwhile, and shows the new frames
        after `finish`.

        Args:
            out: the store.
            options: options of the store; None takes those of an existing store unless `overwrite`
                is given, otherwise the defaults.
            overwrite: replace a finished store, or a store with other options. A finished local
                store is kept as `<name>.replaced` until the new store is finished; in an object
                store it is removed first.

        Raises:
            ConflictError: other data exist at `out`.
            DependencyError: zarr's codecs are not installed.
        """
        for module in ("numcodecs", "google_crc32c"):
            import_extra(module, "zarr")
        self.target = out if isinstance(out, Target) else LocalTarget(Path(out))
        self.location = self.target.location
        self.options = (
            options
            or (PackOptions() if overwrite else existing_options(self.target))
            or PackOptions()
        )
        if self.options.small:
            import_extra("pcodec", "zarr")
        self._root = StoreRoot(self.target, self.options, overwrite)
        self.is_finished = self._root.is_finished

    def sequence(self, path: str) -> ZarrWriter:
        """Start or continue a sequence."""
        return ZarrWriter(self.target, node_of(path, self.location), path, self.options, self._root)

    def finish(self, *, incomplete: bool = False) -> None:
        """Write the metadata of the store, so that it can be opened.

        Raises:
            ConflictError: announced frames (`SequenceWriter.expect`) are missing, and `incomplete`
                is not given.
        """
        self._root.begin()
        finish(self.target, incomplete=incomplete)
        self.is_finished = True

    def source(self) -> ZarrSource:
        """Return the store, which must be finished."""
        return ZarrSource(self.target.tree)


class ZarrWriter(SequenceWriter):
    """Writes one sequence of a zarr store.

    `write_frames` writes blocks of frames at once, and is several times as fast as `write`.

    Attributes:
        identity: split, name and coordinates; by default those of the path.
    """

    concurrent = True

    def __init__(
        self, target: Target, group: str, path: str, options: PackOptions, root: StoreRoot
    ) -> None:
        self.target = target
        self.group = group
        self.path = path
        self.location = f"{target.location}/{group}"
        self.identity: tuple[str | None, str, Coordinates] = identity_of(path)
        self.options = options
        self.block = options.block
        self._rows: dict[str, int] = {}
        self._root = root
        self._begun = False
        self._fields: dict[str, StoredField] = {}

    def expect(
        self, frames: Mapping[str, Iterable[int]], rows: Mapping[str, int] | None = None
    ) -> None:
        """Record the announced frames, so that the store is not finished without them."""
        self._rows.update(rows or {})
        known = read_expected(self.target, self.group)
        merged = known | {
            name: known.get(name, set()) | set(map(int, numbers))
            for name, numbers in frames.items()
        }
        if merged != known:
            self._start()
            self.target.put(f"{self.group}/{EXPECTED}", format_expected(merged))

    def is_complete(self) -> bool:
        """Whether the announced frames are written."""
        expected = read_expected(self.target, self.group)
        return bool(expected) and all(
            self.has(name, frame) for name, frames in expected.items() for frame in frames
        )

    def has(self, field: str, frame: int) -> bool:
        """Whether this or another process has written the frame."""
        layout.field_named(field)
        return self._field(field).has(frame)

    def refresh(self) -> None:
        """Discard the cached lists of missing frames."""
        for field in self._fields.values():
            field.refresh()

    def read(self, field: str, frame: int) -> AnyArray | None:
        """Return an existing frame; None if it does not exist."""
        return self._field(field).read(frame)

    def write(self, field: str, frame: int, array: AnyArray) -> None:
        """Write one frame. The objects of its block are written again."""
        self.write_frames({frame: {field: array}})

    def write_frames(self, frames: FrameArrays) -> None:
        """Write the fields of several frames, block by block."""
        for block in sorted({frame // self.block for frame in frames}):
            ours = {frame: frames[frame] for frame in frames if frame // self.block == block}
            self._put(block, self._encode(ours))

    def write_document(self, name: str, data: bytes) -> None:
        """Write a text file."""
        path = self._document(name)
        self._start()
        self.target.put(path, data)

    def remove_document(self, name: str) -> None:
        """Remove a text file, if it exists."""
        self.target.remove(self._document(name))

    def create_document(self, name: str, data: bytes) -> bool:
        """Write a text file unless it exists."""
        path = self._document(name)
        self._start()
        return self.target.put(path, data, create=True)

    def read_document(self, name: str) -> bytes | None:
        """Return the bytes of a text file, None if it does not exist."""
        return self.target.read(self._document(name))

    def remove_grid(self, grid: str) -> None:
        """Remove the report and the frames of a grid, then its params.json."""
        check_names([grid], self.location)
        self._start()
        self.target.remove(self._document(layout.report_file(grid)))
        self.target.remove(f"{self.group}/grids/{grid}")
        self.target.remove(self._document(layout.params_file(grid)))
        self._fields = {
            name: field for name, field in self._fields.items() if not name.startswith(f"{grid}/")
        }

    def remove_frames(self, fields: Iterable[str], frames: Collection[int]) -> None:
        """Remove fields of some frames, if they exist. Their bytes stay in the objects of their
        blocks until these are written again.
        """
        gone = {*frames}
        known = read_expected(self.target, self.group)
        left = known | {name: known[name] - gone for name in {*fields} & known.keys()}
        if left != known:
            self.target.put(f"{self.group}/{EXPECTED}", format_expected(left))
        for name in fields:
            self._field(name).remove(gone)

    def close(self) -> None:
        """Create the sequence, if nothing was written to it."""
        self._start()

    def _within(self, field: str, frame: int) -> AbstractContextManager[None]:
        """Add the store, the field and the frame to the place of an error."""
        return within(f"{self.location}: field {field}, frame {frame}")

    def _document(self, name: str) -> str:
        """Return the path of a text file."""
        check_names([name], self.location)
        return f"{self.group}/{document_node(name)}"

    def _start(self) -> None:
        """Create the store and the sequence, before the first write."""
        if not self._begun:
            self._root.begin()
            split, name, coordinates = self.identity
            about = {
                "type": SEQUENCE,
                "version": VERSION,
                "path": self.path,
                "split": split,
                "name": name,
            }
            data = to_json(group_metadata(about | {"coordinates": coordinates}))
            self.target.put(f"{self.group}/{METADATA}", data, create=True)
            self._begun = True

    def _field(self, field: str) -> StoredField:
        if field not in self._fields:
            check_names([field], self.location)
            self._fields[field] = StoredField(
                self.target, f"{self.group}/{field_node(field)}", field, self.options
            )
        return self._fields[field]

    def _encode(self, frames: FrameArrays) -> dict[str, dict[int, EncodedFrame]]:
        """Encode frames in threads, and create new fields."""
        self._start()
        items = [
            (field, frame, array)
            for frame, fields in frames.items()
            for field, array in fields.items()
        ]
        arrays: dict[str, list[AnyArray]] = {}
        for name, frame, array in items:
            with self._within(name, frame):
                layout.field_named(name).check(array, "its array")
            arrays.setdefault(name, []).append(array)
        layouts = {
            name: self._field(name).create(
                partial(typical_size, layout.field_named(name), found, self._rows, self.cells_of)
            )
            for name, found in arrays.items()
        }

        def encode(item: tuple[str, int, AnyArray]) -> EncodedFrame:
            name, frame, array = item
            with self._within(name, frame):
                return encode_frame(layouts[name], array)

        result: dict[str, dict[int, EncodedFrame]] = {}
        for (name, frame, _), encoded in zip(items, in_threads(encode, items), strict=True):
            result.setdefault(name, {})[frame] = encoded
        return result

    def _put(self, block: int, encoded: Mapping[str, Mapping[int, EncodedFrame]]) -> None:
        """Write the objects of a block, then the tables that mark them as complete, in the order of
        the fields.
        """
        fields = {name: self._field(name) for name in encoded}
        objects = [
            (name, column)
            for name, field in fields.items()
            for column in field.columns(block, encoded[name])
        ]
        self._each(
            lambda part: fields[part[0]].put_column(part[1], block, encoded[part[0]]), objects
        )
        *others, last = encoded
        self._each(lambda name: fields[name].put_table(block, encoded[name]), others)
        fields[last].put_table(block, encoded[last])

    def _each(self, function: Callable[[_T], None], items: list[_T]) -> None:
        """Call a function with several items in threads.

        The function mostly waits for an object store or a disk.
        """
        with ThreadPoolExecutor(_PUTS) as pool:
            list(pool.map(function, items))

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_fields": {}}
