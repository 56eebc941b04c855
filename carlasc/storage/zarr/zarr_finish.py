"""Finishing a zarr store: block tables are joined to one table per sequence, and the metadata are
written, the root last.

The result depends only on the existing objects, so any process can finish a store, and finishing
can be interrupted and repeated.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from carlasc.core.arrays import AnyArray
from carlasc.errors import ConflictError, FormatError, MissingDataError
from carlasc.storage.files import damaged, parse_json, remove_stale, to_json
from carlasc.storage.packed.array_layout import (
    FIELD,
    SEQUENCE,
    FieldLayout,
    FrameTable,
    count_elements,
    document_node,
    field_node,
    number_arrays,
)
from carlasc.storage.packed.chunks import SHUFFLE, Encoding, in_threads
from carlasc.storage.packed.stores import STORE, VERSION, check_names
from carlasc.storage.transport.targets import LocalTarget, Target, target_of
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

    def small(self, node: str, values: AnyArray, attributes: Mapping[str, Any]) -> None:
        """Add an array of one chunk."""
        about = {"version": VERSION, "dtype": values.dtype.name, **attributes}
        chunk = tuple(max(1, n) for n in values.shape)
        self.metadata[node] = array_metadata(values.dtype, values.shape, chunk, _SMALL, about)
        if values.size:
            (data,) = in_threads(lambda array: encode_chunk(array, _SMALL), [values])
            self.files[f"{node}/c/{'/'.join('0' * values.ndim)}"] = data


def finish(
    out: str | os.PathLike[str] | Target, *, incomplete: bool = False, **storage_options: Any
) -> FinishedStore:
    """Write the metadata of a zarr store, so that it can be opened.

    The last part of a run does this automatically. Use this function if a part failed or was never
    run. A finished store is updated with the frames that were added to it.

    Args:
        out: the store: a path, or a URL of an object store.
        incomplete: finish the store even if frames are missing.
        **storage_options: options of fsspec for a URL.

    Returns:
        The number of frames in the store, and of missing frames.

    Raises:
        ConflictError: announced frames are missing, and `incomplete` is not given.
        FormatError: a file of the store is damaged.
        MissingDataError: `out` is not a zarr store of the present version.
    """
    target = target_of(out, **storage_options)
    if isinstance(target, LocalTarget):
        remove_stale(target.folder, deep=True)
    paths = sorted(target.paths())
    while True:
        result = _write_metadata(target, paths, incomplete)
        before, paths = paths, sorted(target.paths())
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
    result, nodes, sequences = FinishedStore(target.location), StoreNodes(), dict[str, str]()
    for node, attributes in groups.items():
        if attributes.get("type") == SEQUENCE:
            if not {"path", "split", "name", "coordinates"} <= attributes.keys():
                raise damaged(
                    f"{target.location}/{node}", "the attributes of a sequence", "some missing"
                )
            sequences[attributes["path"]] = node
            inside = [path for path in paths if path.startswith(f"{node}/")]
            fields = {
                name: about
                for name, about in groups.items()
                if about.get("type") == FIELD
                and name == f"{node}/{field_node(about.get('field', ''))}"
            }
            _finish_sequence(target, node, attributes, inside, fields, block, nodes, result)
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


def _finish_sequence(
    target: Target,
    node: str,
    attributes: Mapping[str, Any],
    paths: list[str],
    groups: Mapping[str, Mapping[str, Any]],
    block: int,
    nodes: StoreNodes,
    result: FinishedStore,
) -> None:
    """Add the nodes of a sequence, and count its frames."""
    fields, tables = dict[str, FieldLayout](), _read_tables(target, paths)
    for group, about in groups.items():
        name = about["field"]
        if tables.get(group):
            fields[name] = FieldLayout.read(f"{target.location}/{group}", name, about)
            nodes.group(group, about)
    frames_by_field = {name: tables[f"{node}/{field_node(name)}"] for name in sorted(fields)}
    _count(target, node, attributes["path"], paths, frames_by_field, result)
    frames, counts, columns = count_elements(fields, frames_by_field)
    for column_path, most in zip(columns, counts.max(axis=0, initial=0).tolist(), strict=True):
        kind, _, column = column_path.rpartition("/")
        name = kind.partition("/")[2]
        if most > 0:
            room = -(-(max(frames_by_field[name]) + 1) // block) * block
            nodes.metadata[f"{node}/{column_path}"] = column_metadata(
                fields[name], fields[name].columns[column], block, room
            )
    documents = sorted(
        path.removeprefix(f"{node}/{document_node('')}")
        for path in paths
        if path.startswith(f"{node}/{document_node('')}")
    )
    nodes.group(node, {**attributes, "fields": sorted(frames_by_field), "documents": documents})
    nodes.small(f"{node}/frames", frames, {"type": "carlasc.frames", "unit": "frame"})
    nodes.small(
        f"{node}/counts", counts, {"type": "carlasc.counts", "unit": "element", "columns": columns}
    )

    def read_document(name: str) -> bytes | None:
        return (
            bytes(target.tree.read(f"{node}/{document_node(name)}")) if name in documents else None
        )

    for name, numbers, about in number_arrays(read_document):
        nodes.small(f"{node}/{name}", numbers, about)


def _read_tables(target: Target, paths: Iterable[str]) -> dict[str, FrameTable]:
    """Return the frames of each field, by its group."""
    files = [path for path in paths if block_of(path) is not None]
    tables: dict[str, FrameTable] = {}
    for path, data in zip(files, target.tree.read_many(files), strict=True):
        group = path.rpartition("/")[0].rpartition("/")[0]
        tables.setdefault(group, {}).update(parse_table(bytes(data), target.tree.where(path)))
    return tables


def _count(
    target: Target,
    node: str,
    path: str,
    paths: list[str],
    tables: Mapping[str, FrameTable],
    result: FinishedStore,
) -> None:
    """Count the frames of a sequence, and its missing announced frames."""
    result.sequences[path] = {name: len(table) for name, table in tables.items()}
    announced = f"{node}/{EXPECTED}"
    if announced not in paths:
        return
    expected = parse_expected(bytes(target.tree.read(announced)), target.tree.where(announced))
    missing = {name: len(frames - tables.get(name, {}).keys()) for name, frames in expected.items()}
    if missing := {name: count for name, count in missing.items() if count}:
        result.missing[path] = missing


def format_expected(frames: Mapping[str, set[int]]) -> bytes:
    """Return the announced frames as bytes: ranges [first, end) by field."""
    ranges: dict[str, list[list[int]]] = {}
    for name in sorted(frames):
        stretches = ranges.setdefault(name, [])
        for frame in sorted(frames[name]):
            if stretches and stretches[-1][1] == frame:
                stretches[-1][1] += 1
            else:
                stretches.append([frame, frame + 1])
    return to_json(ranges)


def parse_expected(data: bytes, where: str) -> dict[str, set[int]]:
    """Read the announced frames.

    Raises:
        FormatError: they are damaged.
    """
    try:
        tables = parse_json(data, where).items()
        return {
            name: {frame for first, end in ranges for frame in range(first, end)}
            for name, ranges in tables
        }
    except (TypeError, ValueError) as error:
        raise FormatError(
            where,
            expected="ranges of frames",
            found="something else",
            advice="remove this file and run again",
        ) from error


def _missing(result: FinishedStore) -> ConflictError:
    path, fields = next(iter(result.missing.items()))
    name, count = next(iter(fields.items()))
    total = sum(sum(counts.values()) for counts in result.missing.values())
    more = f", {total} in the whole store" if total > count else ""
    return ConflictError(
        result.location,
        expected="all frames that the run announced",
        found=f"{count} of {name} missing in {path or 'its sequence'}{more}",
        advice="run the same command again, or give `incomplete=True`",
    )
