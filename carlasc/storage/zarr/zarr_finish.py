"""Finishing a zarr store: block tables are joined to one table per sequence, and the metadata are
written, the root last.

The result depends only on the existing objects, so any process can finish a store, and finishing
can be interrupted and repeated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import ConflictError, MissingDataError, check_types
from carlasc.running.spreading import Run
from carlasc.storage.files import AnyPath, damaged, parse_json, remove_stale, to_json
from carlasc.storage.folder import FolderWriter
from carlasc.storage.inputs import MadeFrom
from carlasc.storage.layout import COPIED, place_of
from carlasc.storage.packed.array_layout import (
    FIELD,
    SEQUENCE,
    FieldLayout,
    FrameTable,
    document_node,
    field_node,
    index_arrays,
)
from carlasc.storage.packed.chunks import SHUFFLE, Encoding, in_threads
from carlasc.storage.packed.stores import STORE, VERSION, check_names
from carlasc.storage.protocol import Sequence
from carlasc.storage.published import PublishedSource
from carlasc.storage.shares import read_list
from carlasc.storage.transport.remote_tree import target_of
from carlasc.storage.transport.trees import LocalTarget, Target
from carlasc.storage.zarr.block_tables import block_of, parse_table
from carlasc.storage.zarr.root import read_root, remove_replaced
from carlasc.storage.zarr.shards import (
    METADATA,
    array_metadata,
    column_metadata,
    encode_chunk,
    group_metadata,
)

EXPECTED = "expected.json"  # the frames that a run has announced
_SMALL = Encoding(shuffle=SHUFFLE)


@dataclass
class FinishedStore:
    """The content of a finished store.

    Attributes:
        location: the store.
        sequences: number of frames by field, by the path of the sequence.
        missing: number of missing announced frames by field, by the path of the sequence.
    """

    location: str
    sequences: dict[str, dict[str, int]] = field(default_factory=dict)
    missing: dict[str, dict[str, int]] = field(default_factory=dict)


@dataclass
class StoreNodes:
    """Collects the metadata of nodes and the files to write."""

    metadata: dict[str, Any] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)

    def group(self, node: str, attributes: Mapping[str, Any]) -> None:
        """Add a group and its missing parents."""
        parts = node.split("/")
        for end in range(1, len(parts)):
            self.metadata.setdefault("/".join(parts[:end]), group_metadata({}))
        self.metadata[node] = group_metadata(attributes)

    def fields(
        self,
        node: str,
        fields: Mapping[str, FieldLayout],
        tables: Mapping[str, FrameTable],
        block: int,
    ) -> None:
        """Add the groups of the fields of a sequence, and the columns that frames use."""
        for name, found in fields.items():
            group = f"{node}/{field_node(name)}"
            table = tables[name]
            self.group(group, found.attributes)
            room = -(-(max(table) + 1) // block) * block
            for column in found.columns.values():
                if any(counts.get(column.name) for counts in table.values()):
                    metadata = column_metadata(found, column, block, room)
                    self.metadata[f"{group}/{column.name}"] = metadata

    def small(self, node: str, values: AnyArray, attributes: Mapping[str, Any]) -> None:
        """Add an array of one chunk."""
        about = {"version": VERSION, "dtype": values.dtype.name, **attributes}  # in this order
        chunk = tuple(max(1, n) for n in values.shape)
        self.metadata[node] = array_metadata(values.dtype, values.shape, chunk, _SMALL, about)
        if values.size:
            (data,) = in_threads(lambda array: encode_chunk(array, _SMALL), [values])
            self.files[f"{node}/c/{'/'.join('0' * values.ndim)}"] = data


def finish(
    out: AnyPath | Target,
    *,
    incomplete: bool = False,
    sequences_from: AnyPath | None = None,
    **storage_options: Any,
) -> FinishedStore:
    """Check that an output that was written in parts is complete, and write the metadata of a zarr
    store, so that it can be opened.

    The last part of a run does this automatically. Use this function if a part failed or was never
    run. A finished store is updated with the frames that were added to it.

    Args:
        out: the store: a path, or a URL of an object store.
        incomplete: finish the store even if frames are missing.
        sequences_from: file with the folders of the sequences of the run, one per line: those that
            do not exist are missing. None: sequences that no part began are not known.
        **storage_options: options of fsspec for a URL.

    Returns:
        The number of frames in the store, and of missing frames.

    Raises:
        ConflictError: announced frames are missing, and `incomplete` is not given.
        FormatError: a file of the store is damaged.
        MissingDataError: `out` is neither a zarr store of the present version nor a folder of
            sequences.
    """
    check_types(finish, locals())
    target = target_of(out, **storage_options)
    found = {} if read_root(target) else PublishedSource(target.tree).sequences_in([""])
    found = {path: sequence for path, sequence in found.items() if sequence.fields()}
    result = _look_at(target, found) if found else _finish_store(target, incomplete)
    if sequences_from is not None:
        begun = {place_of(path) for path in result.sequences}
        listed = read_list(Run(sequences_from=sequences_from), list)
        result.missing |= {place: {"sequences": 1} for place in listed if place not in begun}
    if result.missing and not incomplete:
        raise _missing(result, _OTHER_RULE)
    return result


def _look_at(target: Target, found: Mapping[str, Sequence]) -> FinishedStore:
    """Return the grids in a folder, and the frames that a run announced and did not make."""
    result = FinishedStore(target.location)
    for path, sequence in found.items():
        result.sequences[path] = {name: len(sequence.frames(name)) for name in sequence.fields()}
        writer = FolderWriter(target.below(path))
        missing = dict[str, int]()
        for grid in sequence.grids:
            announced = map(int, MadeFrom.read(writer, f"made-{grid}").frames)
            missing[grid] = sum(not writer.has(f"{grid}/labels", frame) for frame in announced)
        if missing := {grid: number for grid, number in missing.items() if number}:
            result.missing[path] = missing
    return result


def _finish_store(target: Target, incomplete: bool) -> FinishedStore:
    if isinstance(target, LocalTarget):
        remove_stale(target.folder)
    paths = sorted(target.paths())
    while True:
        result = _write_metadata(target, paths, incomplete)
        before = paths
        paths = sorted(target.paths())
        if _tables_of(before) == _tables_of(paths):
            return result
        # another process has added frames meanwhile, and may have written older metadata after it


def _tables_of(paths: list[str]) -> list[str]:
    return [path for path in paths if block_of(path) is not None or f"/{document_node('')}" in path]


def _write_metadata(target: Target, paths: list[str], incomplete: bool) -> FinishedStore:
    root = read_root(target)
    if root is None or root.get("type") != STORE or root.get("version") != VERSION:
        raise MissingDataError(
            target.location, expected=f"a zarr store of version {VERSION}", found="none"
        )
    if not isinstance(block := root.get("block"), int) or block < 1:
        raise damaged(target.location, "a number of frames in block", repr(block))
    groups = _groups(target, paths)
    tables = _read_tables(target, paths)
    result = FinishedStore(target.location)
    nodes = StoreNodes()
    sequences = dict[str, str]()
    for node, attributes in groups.items():
        if attributes.get("type") != SEQUENCE:
            continue
        if not {"path", "split", "name", "coordinates"} <= attributes.keys():
            raise damaged(
                f"{target.location}/{node}", "the attributes of a sequence", "some missing"
            )
        sequences[attributes["path"]] = node
        fields = {
            about["field"]: FieldLayout.read(f"{target.location}/{name}", about["field"], about)
            for name, about in groups.items()
            if about.get("type") == FIELD
            and name == f"{node}/{field_node(about.get('field', ''))}"
            and tables.get(name)
        }
        frames = {name: tables[f"{node}/{field_node(name)}"] for name in sorted(fields)}
        result.sequences[attributes["path"]] = {name: len(table) for name, table in frames.items()}
        missing = {
            name: len(numbers - frames.get(name, {}).keys())
            for name, numbers in read_expected(target, node).items()
        }
        if missing := {name: count for name, count in missing.items() if count}:
            result.missing[attributes["path"]] = missing
        documents = sorted(
            path.removeprefix(f"{node}/{document_node('')}")
            for path in paths
            if path.startswith(f"{node}/{document_node('')}") and f"/{COPIED}" not in path
        )
        nodes.group(node, {**attributes, "fields": sorted(frames), "documents": documents})
        nodes.fields(node, fields, frames, block)

        def read_document(name: str, node: str = node) -> bytes | None:
            return target.read(f"{node}/{document_node(name)}")

        for name, values, about in index_arrays(fields, frames, read_document):
            nodes.small(f"{node}/{name}", values, about)
    check_names([*sequences, *sequences.values()], target.location)
    if result.missing and not incomplete:
        raise _missing(result)
    about = root | {"complete": True}
    sequences = dict(sorted(sequences.items()))
    # a store that is updated cannot be opened while its tables and its root do not fit
    if root.get("complete") is True:
        target.put(METADATA, to_json(group_metadata(root | {"complete": False})))
    target.put_many(
        nodes.files
        | {f"{node}/{METADATA}": to_json(metadata) for node, metadata in nodes.metadata.items()}
    )
    all_nodes = dict(sorted(nodes.metadata.items()))
    target.put(METADATA, to_json(group_metadata(about | {"sequences": sequences}, all_nodes)))
    remove_replaced(target)
    return result


def _groups(target: Target, paths: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return the attributes of the groups of sequences and fields."""
    files = [path for path in paths if path.endswith(f"/{METADATA}")]
    attributes = {}
    for path, data in zip(files, target.tree.read_many(files), strict=True):
        metadata = parse_json(bytes(data), target.tree.where(path))
        if metadata.get("node_type") == "group":
            attributes[path.removesuffix(f"/{METADATA}")] = metadata.get("attributes", {})
    return attributes


def _read_tables(target: Target, paths: Iterable[str]) -> dict[str, FrameTable]:
    """Return the frames of each field, by its group."""
    files = [path for path in paths if block_of(path) is not None]
    tables: dict[str, FrameTable] = {}
    for path, data in zip(files, target.tree.read_many(files), strict=True):
        group = path.rpartition("/")[0].rpartition("/")[0]
        tables.setdefault(group, {}).update(parse_table(bytes(data), target.tree.where(path)))
    return tables


def read_expected(target: Target, node: str) -> dict[str, set[int]]:
    """Return the announced frames of a sequence, by field.

    Raises:
        FormatError: they are damaged.
    """
    path = f"{node}/{EXPECTED}"
    data = target.read(path)
    where = target.tree.where(path)
    try:
        return {
            name: {frame for first, end in ranges for frame in range(first, end)}
            for name, ranges in ({} if data is None else parse_json(data, where)).items()
        }
    except (TypeError, ValueError) as error:
        raise damaged(
            where, "ranges of frames", "something else", "remove this file and run again"
        ) from error


def format_expected(frames: Mapping[str, set[int]]) -> bytes:
    """Return the announced frames as bytes: ranges [first, end) by field."""
    ranges = {}
    for name in sorted(frames):
        numbers = np.array(sorted(frames[name]), np.int64)
        stretches = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
        ranges[name] = [[int(one[0]), int(one[-1]) + 1] for one in stretches if len(one)]
    return to_json(ranges)


_AGAIN = "run the same command again, or give `incomplete=True`"
_OTHER_RULE = f"parts of another rule, or of another number, leave such gaps: {_AGAIN}"


def _missing(result: FinishedStore, advice: str = _AGAIN) -> ConflictError:
    path, fields = next(iter(result.missing.items()))
    name, count = next(iter(fields.items()))
    total = sum(sum(counts.values()) for counts in result.missing.values())
    more = f", {total} in the whole store" if total > count else ""
    return ConflictError(
        result.location,
        expected="all frames that the run announced",
        found=f"{count} of {name} missing in {path or 'its sequence'}{more}",
        advice=advice,
    )
