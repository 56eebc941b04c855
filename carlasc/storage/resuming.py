"""What a run leaves about itself in params.json, and how it protects what is already there.

A grid's params.json holds the five published keys and, under `carlasc`, how the grid was made. A run goes on with a grid only if both are
equal to its own. A grid without our record is published data: it is never written to.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, ConflictError
from carlasc.storage import layout
from carlasc.storage.files import parse_json, to_json
from carlasc.storage.metadata import Metadata
from carlasc.storage.protocol import SequenceWriter

RECORD = "carlasc"
_POSE_TOLERANCE = 1e-6  # metres, and entries of a rotation: the last digits of poses.txt change with the machine
_MADE_AGAIN = "take another name (`--name`), or make it again (`--overwrite`)"


def check_name(name: str) -> str:
    """Return the name of a grid's folder if it can be one.

    Raises:
        ArgumentError: it is no plain folder name, or one that the layout uses for something else.
    """
    taken = layout.scan_folders() | {layout.POSES, layout.TIMES, layout.METADATA}
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.+-]*", name):
        raise ArgumentError("name", expected="letters, digits and _ . + -", found=f"{name!r}")
    if name in taken:
        raise ArgumentError(
            "name", expected="a name of your own", found=f"{name!r}, which the layout uses for something else"
        )
    return name


def check_grid(
    writer: SequenceWriter, grid: str, params: dict[str, Any], frames: Iterable[int], *, overwrite: bool
) -> bool:
    """Find out whether a run may write to a grid.

    Args:
        writer: where the grid is, or will be.
        grid: its folder.
        params: the whole params.json of this run.
        frames: the frames that it would write.
        overwrite: whether our own earlier grid may be replaced.

    Returns:
        Whether one of our own grids is there, of the same settings unless `overwrite` is given.

    Raises:
        ConflictError: it is published data, or of other settings; names the difference.
    """
    where = f"{writer.location}/{layout.params_file(grid)}"
    data = writer.read_document(layout.params_file(grid))
    if data is None:
        if any(writer.has(f"{grid}/{part}", frame) for frame in frames for part in ("labels", "counts")):
            raise ConflictError(where, expected="the record of a run", found="frames without it", advice=f"{_NOT_OURS}")
        return False
    there = parse_json(data, where)
    if not isinstance(there.get(RECORD), dict):
        raise ConflictError(where, expected="the record of a run", found="none", advice=f"{_NOT_OURS}")
    if not overwrite and (difference := _first_difference(there, params)):
        raise ConflictError(
            where, expected="a grid of the same settings", found=f"{difference}", advice=f"{_MADE_AGAIN}"
        )
    return True


_NOT_OURS = "this is published data, which is never written to: take another name (`--name`) or another place (`-o`)"


def _first_difference(there: dict[str, Any], wanted: dict[str, Any]) -> str | None:
    """Say the first thing that differs, the five keys first."""
    pairs = [(key, there.get(key), wanted[key]) for key in wanted if key != RECORD]
    old, new = there[RECORD], wanted[RECORD]
    pairs += [(f"{RECORD}.{key}", old.get(key), new.get(key)) for key in dict.fromkeys([*new, *old])]
    for key, found, expected in pairs:
        if found != expected:
            return f"{key} {to_json(found).decode()} where this run has {to_json(expected).decode()}"
    return None


def agree_poses(writer: SequenceWriter, poses: NDArray[np.float64]) -> bytes | None:
    """Return the poses.txt to write, None if the one that is there says all.

    Poses that are there must be equal; lines without a pose (NaN: it could not be read) are filled in.

    Raises:
        ConflictError: another pose is there; names the frame.
    """
    data = writer.read_document(layout.POSES)
    if data is None:
        return layout.encode_poses(poses)
    where = f"{writer.location}/{layout.POSES}"
    merged = _merge(layout.decode_poses(data, where), poses, where)
    return None if merged is None else layout.encode_poses(merged)


def agree_times(writer: SequenceWriter, times: NDArray[np.float64]) -> bytes | None:
    """Return the times.txt to write, None if the one that is there says all.

    Raises:
        ConflictError: another time is there; names the frame.
    """
    data = writer.read_document(layout.TIMES)
    if data is None:
        return layout.encode_times(times)
    where = f"{writer.location}/{layout.TIMES}"
    merged = _merge(layout.decode_times(data, where), times, where)
    return None if merged is None else layout.encode_times(merged)


def _merge(there: NDArray[np.float64], ours: NDArray[np.float64], where: str) -> NDArray[np.float64] | None:
    """Return what is there, completed by ours; None if nothing was missing."""
    both = min(len(there), len(ours))
    off = np.abs(there[:both] - ours[:both]) > _POSE_TOLERANCE  # False where either is NaN
    if off.any():
        raise _other_data(where, int(np.argwhere(off)[0, 0]))
    merged = np.concatenate([there, ours[both:]])
    merged[:both] = np.where(np.isnan(there[:both]), ours[:both], there[:both])
    return None if np.array_equal(merged, there, equal_nan=True) else merged


def agree_metadata(writer: SequenceWriter, metadata: Metadata) -> bytes | None:
    """Return the carlasc.json to write, None if it is there or would say nothing but the defaults.

    Raises:
        ConflictError: what exists has other axes or other classes.
    """
    data = writer.read_document(layout.METADATA)
    where = f"{writer.location}/{layout.METADATA}"
    there = Metadata() if data is None else Metadata.from_json(data, where)
    if data is not None and (there.axes, there.classes) != (metadata.axes, metadata.classes):
        other = " with other ids, names or roles" if there.classes.name == metadata.classes.name else ""
        other = "" if there.classes == metadata.classes else other
        raise ConflictError(
            where,
            expected=f"the axes {metadata.axes} and the classes {metadata.classes.name}",
            found=f"{there.axes} and {there.classes.name}{other}",
            advice="write to another place (`-o`)",
        )
    return metadata.to_json() if data is None and metadata != Metadata() else None


def check_scan(writer: SequenceWriter, field: str, frame: int, array: NDArray[Any]) -> None:
    """Compare a scan field that is there already with what this run would write.

    Raises:
        ConflictError: they differ.
    """
    there = writer.read(field, frame)
    if there is not None and not np.array_equal(there, array, equal_nan=array.dtype.kind == "f"):
        raise _other_data(f"{writer.location}/{layout.field_named(field).file(frame)}", frame)


def _other_data(where: str, frame: int) -> ConflictError:
    return ConflictError(
        where,
        expected="the data of this run",
        found=f"another's at frame {frame}",
        advice="write to another place (`-o`), or move what is there away",
    )
