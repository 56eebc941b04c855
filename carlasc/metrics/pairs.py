"""Matching the predicted grids with the true ones."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from carlasc.errors import MissingDataError
from carlasc.metrics.foreign import foreign_grids
from carlasc.metrics.grids import GridFrames, LabelFolder, SequenceGrid
from carlasc.storage import Sequence, Source, as_source, layout

Place = str | os.PathLike[str] | Source


@dataclass(frozen=True)
class Pair:
    """A predicted grid and the true one."""

    prediction: GridFrames
    truth: GridFrames


def pair_grids(
    source: Place, truth: Place, grid: str | None, truth_grid: str | None
) -> tuple[list[Pair], tuple[str, ...]]:
    """Match predictions with the ground truth: by the paths of their sequences, or, if each side has one sequence, that one.

    Args:
        source: the predictions, as for `evaluate`.
        truth: the ground truth.
        grid: name of the predicted grid; None takes `truth_grid`.
        truth_grid: name of the true grid; None takes `evaluation`, or the only grid of a sequence.

    Returns:
        The pairs, and notes: which sequences of the truth have no prediction.

    Raises:
        MissingDataError: a side has no grid, or a predicted sequence has no ground truth.
    """
    truths = {grids.path: grids for grids in _open_grids(truth, truth_grid, "truth")}
    predictions = list(_open_grids(source, grid or truth_grid, "prediction"))
    if len(predictions) == len(truths) == 1:
        pairs = [Pair(predictions[0], next(iter(truths.values())))]
    else:
        pairs = []
        for prediction in predictions:
            if prediction.path not in truths:
                raise MissingDataError(
                    prediction.location,
                    expected=f"ground truth for the sequence {prediction.path!r}",
                    found=_shorten(truths),
                    advice="give both sides from the same level, such as two data sets or two splits",
                )
            pairs.append(Pair(prediction, truths[prediction.path]))
    for pair in pairs:
        pair.prediction.follow(pair.truth)
    left = sorted(set(truths) - {pair.truth.path for pair in pairs})
    note = f"{len(left)} of {len(truths)} sequences of the truth have no prediction and were not scored: {', '.join(left[:3])}"
    return pairs, (note + (", ..." if len(left) > 3 else ""),) if left else ()


def _open_grids(place: Place, grid: str | None, role: Literal["prediction", "truth"]) -> Iterator[GridFrames]:
    if not isinstance(place, Source):
        folder = Path(place)
        if (folder / layout.PARAMS).is_file():  # the folder of one grid: its sequence is the folder above
            place, grid = folder.absolute().parent, folder.absolute().name
        elif folder.is_dir() and len((plain := LabelFolder(folder)).frames()):
            yield plain
            return
        elif foreign := list(foreign_grids(folder, grid, role)):
            yield from foreign
            return
    source = as_source(place)
    found = False
    for sequence in source.sequences().values():
        if name := _choose_grid(sequence, grid):
            found = True
            yield SequenceGrid(sequence, name)
    if not found:
        raise MissingDataError(
            source.location, expected=f"a grid {grid or 'with labels'} in at least one sequence", found="none"
        )


def _choose_grid(sequence: Sequence, grid: str | None) -> str | None:
    """Return the grid of that name; without a name `evaluation`, or the only grid; None if the sequence has no such grid."""
    names = [name for name in sequence.grids if f"{name}/labels" in sequence.fields()]
    if grid is not None:
        return grid if grid in names else None
    if layout.EVALUATION in names:
        return layout.EVALUATION
    if len(names) > 1:
        raise MissingDataError(
            sequence.location,
            expected=f"the grid {layout.EVALUATION}",
            found=", ".join(names),
            advice="choose one with `grid` or `truth_grid`",
        )
    return names[0] if names else None


def _shorten(paths: dict[str, GridFrames]) -> str:
    return ", ".join(list(paths)[:3]) + (", ..." if len(paths) > 3 else "")
