"""Grids in the colours of their evidence: how certain each occupied voxel is, and where the knowledge comes from."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from carlasc.core.choices import GridColor as GridColor  # noqa: PLC0414 (part of this module)
from carlasc.core.evidence import VoxelFlag
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.viewing.colors import Entry, as_color, height_colors
from carlasc.viewing.remapping import RemappedSequence
from carlasc.viewing.rendering.drawings import Drawing, voxel_drawing
from carlasc.viewing.scene import SceneReader

GRID_COLORS: tuple[str, ...] = get_args(GridColor)

_PARTS = {"confidence": "occupied", "views": "views", "votes": "counts", "inferred": "flags"}
_SHARES = (0.6, 0.7, 0.8, 0.9, 0.95, 0.99)  # upper bounds of the classes of probabilities, except for the last one
_POWERS = 7  # classes of numbers: 1, 2 to 3, 4 to 7, ..., 64 and more
_ORIGINS = (
    Entry("seen in this frame", (0, 114, 178), 0),
    Entry("seen in other frames", (190, 196, 204), 1),
    Entry("contested: traffic passes here at other times", (204, 121, 167), 2),
    Entry("inferred: no scan saw it", (230, 110, 0), 3),
)


def check_color(color: GridColor, reader: SceneReader) -> None:
    """Check that the grid of each frame has what its colours are taken from.

    Raises:
        ArgumentError: an unknown colour, or no grid is shown.
        MissingDataError: a frame lacks the field.
    """
    if color not in GRID_COLORS:
        raise ArgumentError("color", expected=f"one of {', '.join(GRID_COLORS)}", found=repr(color))
    if color == "class":
        return
    if "grid" not in reader.contents:
        raise ArgumentError("color", expected="class where no grid is shown", found=repr(color))
    data, frames = reader.data, reader.frames
    field = f"{data.grid}/{_PARTS[color]}"
    missing = sorted(set(frames) - data.frames_with(field))
    if missing:
        raise MissingDataError(
            data.sequence.location,
            expected=f"the field {field} in all frames that are shown",
            found=f"none in {len(missing)} of {len(frames)} frames, such as frame {missing[0]}",
            advice="" if color == "votes" else "make the grid again with `carlasc regrid --keep-evidence`",
        )


def evidence_drawing(data: RemappedSequence, frame: int, color: GridColor, *, ego: bool = True) -> Drawing:
    """Return the occupied voxels of a grid, coloured by evidence.

    The legend has all classes of values, so that it is the same in all frames.

    Args:
        data: the sequence and its grid.
        frame: frame number.
        color: any but "class".
        ego: whether the ego vehicle is drawn.

    Raises:
        MissingDataError: the frame lacks the field.
        FormatError: the grid does not have the format.
    """
    grid = data.read_grid(frame)
    values = data.read_part(_PARTS[color], frame)
    numbers, legend = _classify(values, color)
    colors = np.array([entry.color for entry in legend], np.uint8)
    return voxel_drawing(grid.spec, colors[numbers], grid.labels > 0, legend, "no voxel is occupied", ego)


def evidence_legend(color: GridColor) -> list[Entry]:
    """Return the legend of `evidence_drawing`."""
    if color == "inferred":
        return list(_ORIGINS)
    if color == "confidence":
        names = [f"up to {_SHARES[0]:.0%}"]
        names += [f"{low * 100:.0f} to {high:.0%}" for low, high in pairwise(_SHARES)]
        names.append(f"over {_SHARES[-1]:.0%}")
        unit = "occupied: "
    else:
        names = ["1"] + [f"{2**power} to {2 ** (power + 1) - 1}" for power in range(1, _POWERS - 1)]
        names.append(f"{2 ** (_POWERS - 1)} and more")
        unit = "scans: " if color == "views" else "votes: "
    colors = height_colors(np.linspace(0.0, 1.0, len(names)), 0, 1)
    names[0] = unit + names[0]
    return [Entry(name, as_color(rgb), number) for number, (name, rgb) in enumerate(zip(names, colors, strict=True))]


def _classify(values: NDArray[Any], color: GridColor) -> tuple[NDArray[np.int64], list[Entry]]:
    """Return which entry of the legend each voxel belongs to, and the legend."""
    legend = evidence_legend(color)
    if color == "inferred":
        seen = np.where(values & VoxelFlag.SEEN_NOW, 0, 1)
        return np.where(values & VoxelFlag.INFERRED, 3, np.where(values & VoxelFlag.CONTESTED, 2, seen)), legend
    if color == "confidence":
        return np.digitize(values.astype(np.float64), _SHARES), legend
    powers = np.floor(np.log2(np.maximum(values.astype(np.float64), 1)))
    return np.minimum(powers, _POWERS - 1).astype(np.int64), legend
