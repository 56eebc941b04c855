"""Opening grids to score, in the layout or in the files of other programs, and matching predicted
with true grids.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from carlasc.core.choices import Coordinates
from carlasc.core.grids import GridSpec
from carlasc.errors import MissingDataError, count, first_names
from carlasc.metrics.grids import SequenceGrid
from carlasc.storage import Sequence, Source, as_source, layout
from carlasc.storage.files import AnyPath
from carlasc.storage.folder import FolderSequence
from carlasc.storage.layout import identity_of
from carlasc.storage.voxel_files import (
    GridFrames,
    LabelFrames,
    VoxelFrames,
    VoxelSequence,
    find_voxels,
    label_frames,
)

Place = AnyPath | Source
Role = Literal["prediction", "truth"]


@dataclass(frozen=True)
class Pair:
    """A predicted grid and its true grid."""

    prediction: GridFrames
    truth: GridFrames

    @property
    def spec(self) -> GridSpec | None:
        """Geometry of both grids; None if it is not known."""
        return self.truth.spec or self.prediction.spec

    @property
    def coordinates(self) -> Coordinates:
        """Axes of the grids; Cartesian if the geometry is not known."""
        return "cartesian" if self.spec is None else self.spec.coordinates


def pair_grids(
    source: Place,
    truth: Place,
    grid: str | None,
    truth_grid: str | None,
    sequences: Collection[str] = (),
) -> tuple[list[Pair], tuple[str, ...]]:
    """Match predictions with ground truth by the paths of sequences, or by the names of frames.

    If each side has only one sequence, they match.

    Args:
        source: the predictions, as for `evaluate`.
        truth: the ground truth.
        grid: name of the predicted grid; None takes `truth_grid`.
        truth_grid: name of the true grid; None takes `evaluation`, or the only grid of a sequence.
        sequences: paths or names of the sequences to match; empty takes all.

    Returns:
        The pairs, and notes about sequences and frames that only one side has.

    Raises:
        MissingDataError: prediction or ground truth has no grid, or no predicted sequence has
            ground truth.
    """
    truths = {g.path: g for g in open_grids(truth, truth_grid, "truth") if _chosen(g, sequences)}
    predictions = [
        g for g in open_grids(source, grid or truth_grid, "prediction") if _chosen(g, sequences)
    ]
    for side, found in ((source, predictions), (truth, [*truths.values()])):
        if not found:
            expected = f"sequences {', '.join(sequences)}"
            raise MissingDataError(str(side), expected=expected, found="none of them")
    alone: list[GridFrames] = []
    if len(predictions) == len(truths) == 1:
        pairs = [Pair(predictions[0], next(iter(truths.values())))]
    else:
        pairs, alone = _match(predictions, truths)
    notes = []
    for pair in pairs:
        itself = str(Path(source).absolute()) if not isinstance(source, Source) else ""
        same = pair.prediction.location == pair.truth.location != itself
        if same and isinstance(pair.prediction, LabelFrames) and grid is None:
            raise MissingDataError(
                pair.truth.location,
                expected="predictions in another folder than the ground truth",
                found="the ground truth itself",
            )
        pair.prediction.follow(pair.truth)
    if left := sorted(set(truths) - {pair.truth.path for pair in pairs}):
        missing = f"{len(left)} of {len(truths)} sequences of the ground truth have no prediction"
        notes.append(f"{missing} and were not scored: {first_names(left, 3)}")
    if alone:
        names = first_names((grids.path or grids.location for grids in alone), 3)
        missing = f"{len(alone)} of {len(predictions)} predicted sequences have no ground truth"
        notes.append(f"{missing} and were not scored: {names}")
    for prediction in predictions:
        found = [pair.truth for pair in pairs if pair.prediction.location == prediction.location]
        if found and (extra := _without_truth(prediction, found)):
            where = f" of {prediction.path}" if prediction.path else ""
            frames = count(len(extra), "predicted frame")
            notes.append(f"{frames}{where} without ground truth: {first_names(extra, 3)}")
    return pairs, tuple(notes)


def _without_truth(prediction: GridFrames, truths: list[GridFrames]) -> list[str]:
    """Return the names of the frames of a prediction that none of its true grids has."""
    if isinstance(prediction, VoxelFrames) and not prediction.numbered:
        files = [truth.files.keys() for truth in truths if isinstance(truth, VoxelFrames)]
        return sorted(prediction.files.keys() - set().union(*files))
    numbers = {number for truth in truths for number in truth.frames().tolist()}
    return [str(n) for n in prediction.frames().tolist() if n not in numbers]


def _chosen(grids: GridFrames, sequences: Collection[str]) -> bool:
    return not sequences or not {grids.path, identity_of(grids.path)[1]}.isdisjoint(sequences)


def _match(
    predictions: list[GridFrames], truths: Mapping[str, GridFrames]
) -> tuple[list[Pair], list[GridFrames]]:
    """Return the pairs, and the predictions without ground truth.

    Raises:
        MissingDataError: no prediction has ground truth.
    """
    pairs = list[Pair]()
    alone = list[GridFrames]()
    for prediction in predictions:
        found = _truths_of(prediction, truths)
        pairs += found
        if not found:
            alone.append(prediction)
    if not pairs:
        raise MissingDataError(
            alone[0].location,
            expected=f"ground truth for the sequence {alone[0].path!r}",
            found=first_names(truths, 3),
            advice="sequences are matched by path or by name; if names differ, give single "
            "sequences",
        )
    return pairs, alone


def _truths_of(prediction: GridFrames, truths: Mapping[str, GridFrames]) -> list[Pair]:
    """Return the pair with the true grid of the same path, otherwise with the only one of the same
    name, because other benchmarks have no split in the path; or, for a folder whose files are named
    by tokens, with each grid that has some of these.
    """
    if prediction.path in truths:
        return [Pair(prediction, truths[prediction.path])]
    name = identity_of(prediction.path)[1:]
    same_name = [truth for path, truth in truths.items() if identity_of(path)[1:] == name]
    if len(same_name) == 1:
        return [Pair(prediction, same_name[0])]
    pairs = []
    for truth in truths.values():
        if isinstance(prediction, VoxelFrames) and isinstance(truth, VoxelFrames):
            common = sorted(prediction.files.keys() & truth.files.keys())
            if common and not prediction.numbered:
                pairs.append(Pair(prediction.only(common), truth))
    return pairs


def open_grids(place: Place, grid: str | None, role: Role) -> Iterator[GridFrames]:
    """Yield the grids at a place: a data set, the folder of a grid, or files of another program.

    Args:
        place: path, URL or source of the grids.
        grid: name of the grid; None takes `evaluation`, or the only grid of a sequence.
        role: whether to look for predictions or ground truth, which are in different folders of
            some benchmarks.

    Raises:
        MissingDataError: no grid exists.
    """
    source = place
    names = list[str]()
    empty = list[str]()
    if not isinstance(source, Source):
        folder = Path(source)
        # folder of one grid; the folder above is the sequence
        if (folder / layout.PARAMS).is_file():
            source = folder.absolute().parent
            grid = folder.absolute().name
        elif folder.is_dir() and (plain := label_frames(folder)) is not None:
            # a folder in the tree of a benchmark has its rules
            yield from list(_foreign(find_voxels(folder), grid, role)) or (plain,)
            return
    source = as_source(source)
    for frames in _foreign(source, grid, role):
        yield frames
        names.append(frames.path)
    for sequence in source.sequences().values():
        if isinstance(sequence, VoxelSequence):
            continue
        name = _choose_grid(sequence, grid)
        beside = _without_params(sequence, grid)
        if name is not None:
            yield SequenceGrid(sequence, name)
        elif beside is not None:
            yield beside
        else:
            empty += sequence.grids
            continue
        names.append(sequence.path)
    if not names and not isinstance(place, Source):  # scans in the layout, and voxels beside them
        for frames in _foreign(find_voxels(Path(place)), grid, role):
            yield frames
            names.append(frames.path)
    if not names:
        raise MissingDataError(
            source.location,
            expected=f"a grid {grid or 'with labels'} in at least one sequence",
            found=f"the grids {first_names(dict.fromkeys(empty))}" if grid and empty else "none",
        )


def _foreign(source: Source | None, grid: str | None, role: Role) -> Iterator[GridFrames]:
    """Yield one grid of each sequence in files of another program: `grid`, or the first one, which
    is ground truth; for predictions the last one.
    """
    for sequence in () if source is None else source.sequences().values():
        if isinstance(sequence, VoxelSequence):
            usual = [*sequence.frames_of][-1 if role == "prediction" else 0]
            if (grid or usual) in sequence.frames_of:
                yield sequence.frames_of[grid or usual]


def _without_params(sequence: Sequence, grid: str | None) -> GridFrames | None:
    """Return the `.label` files of a folder without params.json, as networks write them; None if
    there is none.
    """
    if grid is None or not isinstance(sequence, FolderSequence):
        return None
    if grid in layout.scan_folders() or not (folder := sequence.folder / grid).is_dir():
        return None
    return label_frames(folder, sequence.path)


def _choose_grid(sequence: Sequence, grid: str | None) -> str | None:
    """Return `grid`, or by default `evaluation` or the only grid; None if the sequence has no such
    grid.
    """
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
            advice="choose a grid with `grid` or `truth_grid`",
        )
    return names[0] if names else None
