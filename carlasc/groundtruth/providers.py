"""What a run makes its grids of: a capture, scans merged over time, or a finer grid."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, get_args

from carlasc.captures.raw import find_captures
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.groundtruth.from_grid import grid_inputs
from carlasc.groundtruth.from_scans.inputs import scan_inputs
from carlasc.groundtruth.from_scans.windows import Merging
from carlasc.groundtruth.inputs import FrameRange, SequenceInputs, capture_inputs
from carlasc.storage import open as open_source

Observations = Literal["capture", "scans", "grid"]


def find_inputs(
    source: str | os.PathLike[str],
    observations: Observations | None,
    frames: FrameRange | None,
    spec: GridSpec,
    *,
    merging: Merging | None = None,
    from_grid: str | None = None,
    estimate_poses: bool = False,
    force: bool = False,
) -> list[SequenceInputs]:
    """Return the sequences of a source.

    Args:
        source: what holds them.
        observations: what votes; None: the capture where there is one, else scans.
        frames: which frames.
        spec: the grid to be made.
        merging: which scans are merged; only with scans.
        from_grid: name of a finer grid; only with "grid".
        estimate_poses: let KISS-ICP find the poses; only with scans.
        force: go on where poses jump.

    Raises:
        ArgumentError: nothing of that name votes, or an option is for something else.
        MissingDataError: there is no sequence, or none of its frames is in the range.
    """
    if observations is None:
        observations = _what_is_there(source)
    if observations not in get_args(Observations):
        raise ArgumentError(
            "observations", expected=f"one of {', '.join(get_args(Observations))}", found=f"{observations!r}"
        )
    if (merging is not None or estimate_poses) and observations != "scans":
        raise ArgumentError(
            "window, stride, dynamic, ranges and poses are for scans",
            expected="none of them",
            found=f"some with {observations}",
        )
    if from_grid is not None and observations != "grid":
        raise ArgumentError("from_grid", expected="a grid to resample", found=f"{observations}")
    if observations == "capture":
        return capture_inputs(source, frames)
    if observations == "scans":
        return scan_inputs(source, frames, merging or Merging(), estimate_poses=estimate_poses, force=force)
    return grid_inputs(source, frames, spec, from_grid)


def _what_is_there(source: str | os.PathLike[str]) -> Observations:
    """Return "capture" where there is one, else "scans".

    Raises:
        MissingDataError: there is neither.
    """
    if _holds_capture(source):
        return "capture"
    there = open_source(source)
    try:
        there.sequences()
    except MissingDataError as error:
        raise MissingDataError(
            source,
            expected=(
                "a capture (a folder raw/ with velodyne0/, labels0/, ...) or sequences with scans (velodyne/, "
                "poses.txt, ...)"
            ),
            found="neither",
            advice="give a sequence's folder, or a folder of sequences",
        ) from error
    return "scans"


def _holds_capture(source: str | os.PathLike[str]) -> bool:
    try:
        return Path(source).is_dir() and bool(find_captures(source))
    except MissingDataError:
        return False
