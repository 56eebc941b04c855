"""Finishing a zarr store: its tables become one table per sequence, and its metadata are written, the root's last.

Everything is derived from the objects that exist, so that finishing may be interrupted and repeated, and any process can do it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ConflictError, FormatError, MissingDataError
from carlasc.storage import layout
from carlasc.storage.files import parse_json, remove_stale, to_json
from carlasc.storage.packed.arrays.blocks import Table, block_of, parse_table
from carlasc.storage.packed.arrays.chunks import SHUFFLE, Encoding, in_threads
from carlasc.storage.packed.arrays.fields import VERSION, FieldLayout
from carlasc.storage.packed.arrays.reading import FIELD, SEQUENCE, document_node, field_node
from carlasc.storage.packed.arrays.shards import encode_chunk
from carlasc.storage.packed.arrays.zarr_begin import read_root, remove_replaced
from carlasc.storage.packed.arrays.zarr_metadata import METADATA, array_metadata, group_metadata
from carlasc.storage.packed.protocol import STORE, check_names
from carlasc.storage.transport.targets import LocalTarget, Target

EXPECTED = "expected.json"  # the frames that a run has announced
_SMALL = Encoding(shuffle=SHUFFLE)


@dataclass
class FinishedStore:
    """What a store holds.

    Attributes:
        location: the store.
        sequences: number of frames of each field, by the path of the sequence.
        missing: number of announced frames that are not there, likewise.
    """

    location: str
    sequences: dict[str, dict[str, int]] = field(default_factory=dict)
    missing: dict[str, dict[str, int]] = field(default_factory=dict)


@dataclass
class _Nodes:
    """The metadata of nodes, and the files to write."""

    metadata: dict[str, Any] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)

    def group(self, node: str, attributes: Mapping[str, Any]) -> None:
        """Add a group, and the groups above it that are not there."""
        parts = node.split("/")
        for end in range(1, len(parts)):
            self.metadata.setdefault("/".join(parts[:end]), group_metadata({}))
        self.metadata[node] = group_metadata(attributes)

    def small(self, node: str, values: NDArray[Any], attributes: Mapping[str, Any]) -> None:
        """Add an array of one chunk."""
        about = {"version": VERSION, "dtype": values.dtype.name, **attributes}
        chunk = tuple(max(1, n) for n in values.shape)
        self.metadata[node] = array_metadata(values.dtype, values.shape, chunk, _SMALL, about)
        if values.size:
            (data,) = in_threads(lambda array: encode_chunk(array, _SMALL), [values])
            self.files[f"{node}/c/{'/'.join('0' * values.ndim)}"] = data


def finish(target: Target, *, incomplete: bool = False) -> FinishedStore:
    """Finish a store: write what it holds, by which it can be opened. A finished store is brought up to date.

    Args:
        target: where the store is.
        incomplete: finish although frames are missing that a run has announced.

    Returns:
        What it holds.

    Raises:
        ConflictError: announced frames are missing, and `incomplete` is not given.
        FormatError: something in it is damaged.
        MissingDataError: there is no store of version 2.
    """
    if isinstance(target, LocalTarget):
        remove_stale(target.folder, deep=True)
    paths = sorted(target.paths())
    while True:
        result = _write_metadata(target, paths, incomplete)
        before, paths = paths, sorted(target.paths())
        if _tables_of(before) == _tables_of(paths):
            return result
        # another process has added something meanwhile, and may have written its metadata before ours


def _tables_of(paths: list[str]) -> list[str]:
    return [path for path in paths if block_of(path) is not None or f"/{document_node('')}" in path]


def _write_metadata(target: Target, paths: list[str], incomplete: bool) -> FinishedStore:
    root = read_root(target)
    if root is None or root.get("type") != STORE or root.get("version") != VERSION:
        raise MissingDataError(target.location, expected=f"a zarr store of version {VERSION}", found="none")
    if not isinstance(block := root.get("block"), int) or block < 1:
        raise FormatError(
            target.location, expected="a number of frames in block", found=repr(block), advice="the store is damaged"
        )
    groups = _groups(target, paths)
    result, nodes, sequences = FinishedStore(target.location), _Nodes(), dict[str, str]()
    for node, attributes in groups.items():
        if attributes.get("type") == SEQUENCE:
            if not {"path", "split", "name", "coordinates"} <= attributes.keys():
                raise FormatError(
                    f"{target.location}/{node}", expected="a sequence", found="less", advice="the store is damaged"
                )
            sequences[attributes["path"]] = node
            inside = [path for path in paths if path.startswith(f"{node}/")]
            fields = {
                name: about
                for name, about in groups.items()
                if about.get("type") == FIELD and name == f"{node}/{field_node(about.get('field', ''))}"
            }
            _finish_sequence(target, node, attributes, inside, fields, block, nodes, result)
    check_names([*sequences, *sequences.values()], target.location)
    if result.missing and not incomplete:
        raise _missing(result)
    about = root | {"complete": True}
    sequences = dict(sorted(sequences.items()))
    if (
        root.get("complete") is True
    ):  # a store that is brought up to date cannot be opened while its tables and its root disagree
        target.put(METADATA, to_json(group_metadata(root | {"complete": False})))
    target.put_many(nodes.files | {f"{node}/{METADATA}": to_json(found) for node, found in nodes.metadata.items()})
    all_nodes = dict(sorted(nodes.metadata.items()))
    target.put(METADATA, to_json(group_metadata(about | {"sequences": sequences}, all_nodes)))
    remove_replaced(target)
    return result


def _groups(target: Target, paths: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return the attributes of the groups of sequences and fields."""
    files = [path for path in paths if path.endswith(f"/{METADATA}")]
    found = {}
    for path, data in zip(files, target.tree.read_many(files), strict=True):
        metadata = parse_json(bytes(data), target.tree.where(path))
        if metadata.get("node_type") == "group":
            found[path.removesuffix(f"/{METADATA}")] = metadata.get("attributes", {})
    return found


def _finish_sequence(
    target: Target,
    node: str,
    attributes: Mapping[str, Any],
    paths: list[str],
    groups: Mapping[str, Mapping[str, Any]],
    block: int,
    nodes: _Nodes,
    result: FinishedStore,
) -> None:
    """Add the nodes of a sequence, and count its frames."""
    fields, tables = dict[str, FieldLayout](), _read_tables(target, paths)
    for group, about in groups.items():
        name = about["field"]
        if tables.get(group):
            fields[name] = FieldLayout.read(f"{target.location}/{group}", name, about, block)
            nodes.group(group, about)
    found = {name: tables[f"{node}/{field_node(name)}"] for name in sorted(fields)}
    _count(target, node, attributes["path"], paths, found, result)
    frames = sorted({frame for table in found.values() for frame in table})
    columns: dict[str, list[int]] = {}
    for name, table in found.items():
        room = -(-(max(table) + 1) // block) * block
        firsts = {family.name for family in fields[name].packing.columns}
        for column in fields[name].columns.values():
            counts = [table[frame].get(column.name, 0) if frame in table else -1 for frame in frames]
            place = f"{field_node(name)}/{column.name}"
            if max(counts) > 0:
                nodes.metadata[f"{node}/{place}"] = fields[name].metadata(column, room)
            if max(counts) > 0 or column.name in firsts:
                columns[place] = counts
    documents = sorted(
        path.removeprefix(f"{node}/{document_node('')}")
        for path in paths
        if path.startswith(f"{node}/{document_node('')}")
    )
    nodes.group(node, {**attributes, "fields": sorted(found), "documents": documents})
    numbers = np.array(list(columns.values()), "<i8").reshape(len(columns), len(frames)).T
    nodes.small(f"{node}/frames", np.array(frames, "<i8"), {"type": "carlasc.frames", "unit": "frame"})
    nodes.small(
        f"{node}/counts",
        np.ascontiguousarray(numbers),
        {"type": "carlasc.counts", "unit": "element", "columns": list(columns)},
    )
    _add_numbers(target, node, documents, nodes)


def _read_tables(target: Target, paths: Iterable[str]) -> dict[str, Table]:
    """Return the frames of each field, by its group."""
    files = [path for path in paths if block_of(path) is not None]
    tables: dict[str, Table] = {}
    for path, data in zip(files, target.tree.read_many(files), strict=True):
        group = path.rpartition("/")[0].rpartition("/")[0]
        tables.setdefault(group, {}).update(parse_table(bytes(data), target.tree.where(path)))
    return tables


def _count(
    target: Target, node: str, path: str, paths: list[str], tables: Mapping[str, Table], result: FinishedStore
) -> None:
    """Count the frames of a sequence, and those that were announced and are missing."""
    result.sequences[path] = {name: len(table) for name, table in tables.items()}
    announced = f"{node}/{EXPECTED}"
    if announced not in paths:
        return
    expected = parse_expected(bytes(target.tree.read(announced)), target.tree.where(announced))
    missing = {name: len(frames - tables.get(name, {}).keys()) for name, frames in expected.items()}
    if missing := {name: count for name, count in missing.items() if count}:
        result.missing[path] = missing


def format_expected(frames: Mapping[str, set[int]]) -> bytes:
    """Return the bytes of the announced frames: ranges [first, end) of each field."""
    ranges: dict[str, list[list[int]]] = {}
    for name in sorted(frames):
        found = ranges.setdefault(name, [])
        for frame in sorted(frames[name]):
            if found and found[-1][1] == frame:
                found[-1][1] += 1
            else:
                found.append([frame, frame + 1])
    return to_json(ranges)


def parse_expected(data: bytes, where: str) -> dict[str, set[int]]:
    """Read the announced frames.

    Raises:
        FormatError: they are damaged.
    """
    try:
        found = parse_json(data, where).items()
        return {name: {frame for first, end in ranges for frame in range(first, end)} for name, ranges in found}
    except (TypeError, ValueError) as error:
        raise FormatError(
            where, expected="ranges of frames", found="something else", advice="remove this file and run again"
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


def _add_numbers(target: Target, node: str, documents: list[str], nodes: _Nodes) -> None:
    """Write poses and times as arrays too, for programs that do not read the text files."""
    for name, document, unit in (("poses", layout.POSES, "m"), ("times", layout.TIMES, "s")):
        if document in documents:
            data = bytes(target.tree.read(f"{node}/{document_node(document)}"))
            with suppress(FormatError):  # not numbers: the text is kept as it is, and its reader reports the error
                numbers = (
                    layout.decode_poses(data, document) if name == "poses" else layout.decode_times(data, document)
                )
                nodes.small(f"{node}/{name}", numbers, {"type": "carlasc.numbers", "unit": unit, "document": document})
