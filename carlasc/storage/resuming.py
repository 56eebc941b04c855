"""How a run continues the output of an earlier run, and protects other data.

A grid's params.json holds the five published keys and, under `carlasc`, a record of how the grid
was made. A run continues a grid only if both are equal to its own. A grid without a record is
published data and is never written to. See the format page,
`docs/format.md#the-record-in-paramsjson`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from hashlib import sha256
from typing import Any, TypeVar

import numpy as np

from carlasc.core.arrays import AnyArray, FloatArray, IntArray
from carlasc.errors import ArgumentError, CarlascError, ConflictError, FormatError
from carlasc.storage import layout
from carlasc.storage.files import parse_json, to_json
from carlasc.storage.layout import Metadata
from carlasc.storage.protocol import Sequence, SequenceWriter

Kept = TypeVar("Kept")

RECORD = "carlasc"
RECORD_FORMAT = 1
"""Version of the record: of its keys and their meaning."""
_RENAMED = {"source": "observe", "vote": "voting"}  # old and new keys of records without a format
# metres, entries of a rotation, seconds: the last digits of poses.txt depend on the machine
_TOLERANCE = 1e-6
_LINES = {
    layout.POSES: (layout.encode_poses, layout.decode_poses),
    layout.TIMES: (layout.encode_times, layout.decode_times),
}
_OTHER_SETTINGS = "choose another `name`, or replace the grid with `overwrite=True`"
_PUBLISHED = "this is published data, which is never written to: choose another `name` or `out`"


def check_name(name: str) -> str:
    """Return the name of a grid's folder if it is valid.

    Raises:
        ArgumentError: it is not a plain folder name, or the layout reserves it.
    """
    taken = layout.scan_folders() | {layout.POSES, layout.TIMES, layout.METADATA}
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.+-]*", name):
        raise ArgumentError("name", expected="letters, digits and _ . + -", found=repr(name))
    if name in taken:
        raise ArgumentError(
            "name", expected="a name that the layout does not reserve", found=repr(name)
        )
    return name


def check_grid(
    writer: SequenceWriter,
    grid: str,
    params: dict[str, Any],
    frames: Iterable[int],
    *,
    overwrite: bool,
) -> bool:
    """Check whether a run may write to a grid.

    Args:
        writer: writes the grid.
        grid: name of its folder.
        params: the whole params.json of this run.
        frames: the frames that this run would write.
        overwrite: whether a grid that carlasc made with other settings may be replaced.

    Returns:
        Whether the grid exists. It was made by carlasc, and has the same settings unless
        `overwrite` is given.

    Raises:
        ConflictError: the grid is published data, or has other settings; the message names the
            first difference.
        FormatError: a newer version of carlasc made the grid, and this version cannot read its
            record.
    """
    where = f"{writer.location}/{layout.params_file(grid)}"
    data = writer.read_document(layout.params_file(grid))
    if data is None:
        if any(
            writer.has(f"{grid}/{part}", frame) for frame in frames for part in ("labels", "counts")
        ):
            raise ConflictError(
                where, expected="the record of a run", found="frames without one", advice=_PUBLISHED
            )
        return False
    existing = parse_json(data, where)
    if not isinstance(existing.get(RECORD), dict):
        raise ConflictError(where, expected="the record of a run", found="none", advice=_PUBLISHED)
    old, new = (
        {**document, RECORD: read_record(document[RECORD], where)}
        for document in (existing, params)
    )
    if not overwrite and (difference := _first_difference(old, new)):
        raise ConflictError(
            where,
            expected="a grid with the same settings",
            found=difference,
            advice=_OTHER_SETTINGS,
        )
    return True


def read_record(record: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the record of a grid, written by any version of carlasc, converted to `RECORD_FORMAT`.

    Records of carlasc 0.1.0 have no "format". They name the version of carlasc instead of that of
    the rule, "source" instead of "observe", and "vote" instead of "voting".

    Args:
        record: the value of `RECORD` in params.json.
        where: the file, for errors.

    Raises:
        FormatError: the format is newer than this version of carlasc, or is not a number.
    """
    version = record.get("format", 0)
    if not isinstance(version, int) or not 0 <= version <= RECORD_FORMAT:
        raise FormatError(
            where,
            expected=f"a record of format {RECORD_FORMAT} or older",
            found=f"format {version}",
            advice="upgrade carlasc: a newer version wrote it",
        )
    if version == RECORD_FORMAT:
        return dict(record)
    kept = {_RENAMED.get(name, name): value for name, value in record.items() if name != "version"}
    return {"format": RECORD_FORMAT, "rule": 1} | kept


def _first_difference(existing: dict[str, Any], wanted: dict[str, Any]) -> str | None:
    """Describe the first difference between two params.json, the five published keys first; None if
    there is none.
    """
    pairs = [(key, existing.get(key), wanted[key]) for key in wanted if key != RECORD]
    old = existing[RECORD]
    new = wanted[RECORD]
    pairs += [
        (f"{RECORD}.{key}", old.get(key), new.get(key)) for key in dict.fromkeys([*new, *old])
    ]
    for key, found, expected in pairs:
        if found != expected:
            return (
                f"{key} {to_json(found).decode()} where this run has {to_json(expected).decode()}"
            )
    return None


def agree_lines(
    writer: SequenceWriter,
    document: str,
    ours: FloatArray | None,
    *,
    is_whole: bool = False,
    may_change: Callable[[], bool] = lambda: False,
) -> bytes | None:
    """Return the poses.txt or times.txt to write; None if there is nothing to write.

    Existing lines must be equal to those of this run. Lines without a pose (NaN: it could not be
    read) are filled in.

    Args:
        writer: writes the sequence.
        document: name of the file.
        ours: (F, 4, 4) first_T_sensor, or (F,) seconds, of this run; None if it has none.
        is_whole: whether more lines of an earlier run are left out.
        may_change: returns whether lines that are different are replaced.

    Raises:
        ConflictError: an existing line is different; the message names the frame.
    """
    if ours is None:
        return None
    encode, decode = _LINES[document]
    data = writer.read_document(document)
    where = f"{writer.location}/{document}"
    if data is None:
        return encode(ours)
    existing = decode(data, where)
    both = min(len(existing), len(ours))
    differs = np.abs(existing[:both] - ours[:both]) > _TOLERANCE  # False if either is NaN
    if differs.any():
        if may_change():
            return encode(ours)
        raise _other_data(where, int(np.argwhere(differs)[0, 0]))
    merged = np.concatenate([existing, ours[both:]])
    merged[:both] = np.where(np.isnan(existing[:both]), ours[:both], existing[:both])
    merged = merged[: len(ours)] if is_whole else merged
    return None if np.array_equal(merged, existing, equal_nan=True) else encode(merged)


def read_metadata(writer: SequenceWriter) -> Metadata | None:
    """Return the metadata that exist in the output; None if there are none."""
    data = writer.read_document(layout.METADATA)
    where = f"{writer.location}/{layout.METADATA}"
    return None if data is None else Metadata.from_json(data, where)


def agree_metadata(writer: SequenceWriter, metadata: Metadata) -> bytes | None:
    """Return the carlasc.json to write; None if it exists or would hold only the defaults.

    Raises:
        ConflictError: the existing file has other axes or other classes.
    """
    there = read_metadata(writer)
    if there is not None and (there.axes, there.classes) != (metadata.axes, metadata.classes):
        other = (
            " with other ids, names or roles" if there.classes.name == metadata.classes.name else ""
        )
        other = "" if there.classes == metadata.classes else other
        raise ConflictError(
            f"{writer.location}/{layout.METADATA}",
            expected=f"the axes {metadata.axes} and the classes {metadata.classes.name}",
            found=f"{there.axes} and {there.classes.name}{other}",
            advice="choose another `out`",
        )
    return metadata.to_json() if there is None and metadata != Metadata() else None


def check_scan(writer: SequenceWriter, field: str, frame: int, array: AnyArray) -> bool:
    """Compare an existing field of a scan with the array of this run.

    Returns:
        Whether the existing field is complete. False if it is empty after a power failure, and must
        be written again.

    Raises:
        ConflictError: they differ.
    """
    existing = writer.read(field, frame)
    if existing is not None and not existing.size and array.size:
        return False
    if existing is not None and not np.array_equal(
        existing, array, equal_nan=array.dtype.kind == "f"
    ):
        raise _other_data(f"{writer.location}/{layout.field_named(field).file(frame)}", frame)
    return True


def _other_data(where: str, frame: int) -> ConflictError:
    return ConflictError(
        where,
        expected="the data of this run",
        found=f"other data at frame {frame}",
        advice="choose another `out`, or move the existing files away",
    )


def derived_key(sequence: Sequence, frames: IntArray, scans: str, **settings: Any) -> str:
    """Return a digest of settings, poses, times and scans.

    It identifies data derived from a sequence, such as actors or refined poses.

    Args:
        sequence: the sequence.
        frames: numbers of its frames with scans.
        scans: digest of the content of all of these scans (see `carlasc.storage.inputs`).
        **settings: everything else that the result depends on.
    """
    about = {
        **settings,
        "frames": frames.tolist(),
        "scans": scans,
        "poses": sha256(sequence.poses.tobytes()).hexdigest(),
        "times": sequence.times.tolist() if layout.TIMES in sequence.documents() else None,
    }
    return sha256(to_json(about)).hexdigest()


def read_derived(
    writer: SequenceWriter, name: str, key: str, read: Callable[[bytes, str], tuple[Kept, str]]
) -> Kept | None:
    """Return derived data that an earlier run kept beside the grids of a sequence; None if no file
    has the same key.

    Args:
        writer: writes the sequence.
        name: kind of the derived data, such as "tracks".
        key: result of `derived_key`.
        read: takes the bytes and the name of a file; returns its content and its key.
    """
    file = layout.derived(name, key)
    data = writer.read_document(file)
    try:
        found, made_from = (None, None) if data is None else read(data, file)
    except CarlascError:  # from another version, or damaged: it is computed again from the scans
        return None
    return found if made_from == key else None
