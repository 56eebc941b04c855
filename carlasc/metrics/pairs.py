"""Opening grids to score, also in file formats of other benchmarks, and matching predicted with
true grids.

The other formats are `.npz` of Occ3D and CarlaOcc, `.npy` of OpenOccupancy, and the folders of
SemanticKITTI and SSCBench.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal

import numpy as np

from carlasc.core.arrays import BoolArray, IntArray, LabelArray
from carlasc.core.classes import ClassTable
from carlasc.core.grids import GridSpec
from carlasc.core.tables import OCC3D, OPENOCCUPANCY, SEMANTICKITTI
from carlasc.errors import FormatError, MissingDataError, first_names
from carlasc.metrics.grids import GridFrames, LabelFolder, SeenBy, SequenceGrid, find_carlaocc
from carlasc.storage import Sequence, Source, as_source, layout
from carlasc.storage.arrays import NUMBERS, WHOLE_NUMBERS, ArrayFormat, open_npz, read_npy
from carlasc.storage.files import AnyPath
from carlasc.storage.layout import identity_of

Place = AnyPath | Source

OCC3D_SPEC = GridSpec("cartesian", (200, 200, 16), (-40.0, -40.0, -1.0), (40.0, 40.0, 5.4))
OPENOCCUPANCY_SPEC = GridSpec("cartesian", (512, 512, 40), (-51.2, -51.2, -5.0), (51.2, 51.2, 3.0))
KITTI_SPEC = GridSpec("cartesian", (256, 256, 32), (0.0, -25.6, -2.0), (51.2, 25.6, 4.4))
# possible names of the array of classes in an .npz: that of the benchmark, and other common ones
_LABELS = ("semantics", "pred", "occ_pred")
_NOISE = 255


class TokenFrames(GridFrames):
    """A scene with tokens as names of frames.

    Frames are numbered in the order of the tokens of the ground truth.

    Attributes:
        files: file of each frame, by token.
        tokens: names of the frames in order.
    """

    def __init__(self, folder: Path, path: str, files: dict[str, Path]) -> None:
        self.path, self.location, self.files = path, str(folder), files
        self.tokens = sorted(files)

    def follow(self, truth: GridFrames) -> None:
        """Take the numbering of frames from the ground truth."""
        if isinstance(truth, TokenFrames):
            self.tokens = truth.tokens

    def frames(self) -> IntArray:
        """Return the numbers of the frames that have a file."""
        return np.array([i for i, token in enumerate(self.tokens) if token in self.files], np.int64)

    def name_of(self, frame: int) -> str:
        """Return a frame's token."""
        return self.tokens[frame]

    def _file(self, frame: int) -> Path:
        return self.files[self.tokens[frame]]


class Occ3dScene(TokenFrames):
    """A scene of Occ3D-nuScenes: `{scene}/{token}/labels.npz`."""

    spec, classes, benchmark = OCC3D_SPEC, OCC3D, "occ3d-lidar"

    def labels(self, frame: int) -> LabelArray:
        """Return (200, 200, 16) labels."""
        file = self._file(frame)
        with open_npz(file) as arrays:
            name = next((name for name in _LABELS if name in arrays.names), _LABELS[0])
            name = arrays.names[0] if len(arrays.names) == 1 else name
            labels = arrays.read(name, ArrayFormat(WHOLE_NUMBERS, self.spec.size))
        if labels.min() < 0 or labels.max() > _NOISE:
            found = f"{labels.min()} to {labels.max()}"
            raise FormatError(file, expected=f"class ids 0..{_NOISE}", found=found)
        return labels.astype(np.uint8, copy=False)

    def known(self, frame: int, seen_by: SeenBy = "lidar") -> BoolArray | None:
        """Return (200, 200, 16) bool, the voxels that the LiDAR or a camera observed; None if the
        file does not contain the mask.
        """
        name = f"mask_{seen_by}"
        with open_npz(self._file(frame)) as arrays:
            if name not in arrays.names:
                return None
            return arrays.read(name, ArrayFormat(WHOLE_NUMBERS, self.spec.size)).astype(np.bool_)


class OpenOccupancyScene(TokenFrames):
    """A scene of OpenOccupancy-nuScenes: `scene_{token}/occupancy/{lidar_token}.npy` with rows z,
    y, x, ..., class of occupied voxels.
    """

    spec, classes, benchmark = OPENOCCUPANCY_SPEC, OPENOCCUPANCY, "openoccupancy"

    def labels(self, frame: int) -> LabelArray:
        """Return (512, 512, 40) labels. The stored id 0, noise, becomes 255."""
        file = self._file(frame)
        rows = read_npy(file, ArrayFormat(NUMBERS, (None, None)))
        if rows.shape[1] not in (4, 7):
            raise FormatError(
                file, expected="rows of 4 or 7 columns (z, y, x, ..., class)", found=str(rows.shape)
            )
        if not np.isfinite(rows).all():
            raise FormatError(file, expected="finite numbers", found="NaN or infinity")
        z, y, x = rows[:, :3].astype(np.int64).T
        classes = rows[:, -1].astype(np.int64)
        size = np.array(self.spec.size)[:, None]
        if (np.array([x, y, z]) >= size).any() or rows[:, :3].min(initial=0) < 0:
            raise FormatError(
                file,
                expected=f"voxels inside {self.spec}",
                found=f"({x.max()}, {y.max()}, {z.max()})",
            )
        if len(classes) and not (classes.min() >= 0 and classes.max() <= _NOISE):
            raise FormatError(
                file, expected=f"class ids 0..{_NOISE}", found=f"{classes.min()} to {classes.max()}"
            )
        labels = np.zeros(self.spec.size, np.uint8)
        labels[x, y, z] = np.where(classes == 0, _NOISE, classes)
        return labels

    def known(self, frame: int, seen_by: SeenBy = "lidar") -> None:
        """Return None, because the benchmark has no masks of observed voxels."""
        return None


class KittiFolder(LabelFolder):
    """A folder of SemanticKITTI or SSCBench: `.label` files of raw ids, uint16, and masks.

    The geometry is known if the files have the size of the grid of the benchmarks.
    """

    classes: ClassTable | None = SEMANTICKITTI
    _width = 2

    def __init__(self, folder: Path, path: str, benchmark: str) -> None:
        super().__init__(folder, path)
        self.benchmark = benchmark
        if self.voxels is None and len(frames := self.frames()):
            self.voxels = self._file(int(frames[0]), ".label").stat().st_size // self._width
        if self.voxels == KITTI_SPEC.num_voxels:
            self.spec = KITTI_SPEC


def foreign_grids(
    folder: Path, grid: str | None, role: Literal["prediction", "truth"]
) -> Iterator[GridFrames]:
    """Yield the grids of a folder in the layout of another benchmark; nothing if the folder has
    another layout.
    """
    for scene in sorted(path for path in folder.glob("*") if path.is_dir()):
        if files := {file.parent.name: file for file in scene.glob("*/labels.npz")}:
            yield Occ3dScene(scene, scene.name, files)
        elif scene.name.startswith("scene_") and (
            files := {f.stem: f for f in scene.glob("occupancy/*.npy")}
        ):
            yield OpenOccupancyScene(scene, scene.name, files)
    if (folder / "gts").is_dir():
        yield from foreign_grids(folder / "gts", grid, role)
    yield from find_carlaocc(folder, grid)
    # without a folder of predictions, the folder itself is scored, such as an export or another
    # ground truth
    names = (
        (grid,) if grid else {"prediction": ("predictions", "voxels"), "truth": ("voxels",)}[role]
    )
    for pattern, benchmark in (("sequences/*", "semantickitti"), ("data_2d_raw/*", "sscbench")):
        for sequence in sorted(folder.glob(pattern)):
            folders = (
                KittiFolder(sequence / name, sequence.name, benchmark)
                for name in names
                if (sequence / name).is_dir()
            )
            yield from islice((grids for grids in folders if len(grids.frames())), 1)


@dataclass(frozen=True)
class Pair:
    """A predicted grid and its true grid."""

    prediction: GridFrames
    truth: GridFrames

    @property
    def spec(self) -> GridSpec | None:
        """Geometry of both grids; None if it is not known."""
        return self.truth.spec or self.prediction.spec


def pair_grids(
    source: Place, truth: Place, grid: str | None, truth_grid: str | None
) -> tuple[list[Pair], tuple[str, ...]]:
    """Match predictions with ground truth by the paths of sequences.

    If each side has only one sequence, they match.

    Args:
        source: the predictions, as for `evaluate`.
        truth: the ground truth.
        grid: name of the predicted grid; None takes `truth_grid`.
        truth_grid: name of the true grid; None takes `evaluation`, or the only grid of a sequence.

    Returns:
        The pairs, and notes about true sequences without a prediction.

    Raises:
        MissingDataError: prediction or ground truth has no grid, or a predicted sequence has no
            ground truth.
    """
    truths = {grids.path: grids for grids in open_grids(truth, truth_grid, "truth")}
    predictions = list(open_grids(source, grid or truth_grid, "prediction"))
    if len(predictions) == len(truths) == 1:
        pairs = [Pair(predictions[0], next(iter(truths.values())))]
    else:
        pairs = [Pair(prediction, _truth_of(prediction, truths)) for prediction in predictions]
    for pair in pairs:
        if (
            isinstance(pair.prediction, KittiFolder)
            and pair.prediction.location == pair.truth.location
        ):
            raise MissingDataError(
                pair.truth.location,
                expected="predictions in another folder than the ground truth",
                found="the ground truth itself",
            )
        pair.prediction.follow(pair.truth)
    left = sorted(set(truths) - {pair.truth.path for pair in pairs})
    if not left:
        return pairs, ()
    names = ", ".join(left[:3]) + (", ..." if len(left) > 3 else "")
    missing = f"{len(left)} of {len(truths)} sequences of the ground truth have no prediction"
    return pairs, (f"{missing} and were not scored: {names}",)


def _truth_of(prediction: GridFrames, truths: Mapping[str, GridFrames]) -> GridFrames:
    """Return the true grid with the same path, otherwise the only one with the same name, because
    other benchmarks have no split in the path.
    """
    if prediction.path in truths:
        return truths[prediction.path]
    name = identity_of(prediction.path)[1:]
    same_name = [truth for path, truth in truths.items() if identity_of(path)[1:] == name]
    if len(same_name) != 1:
        raise MissingDataError(
            prediction.location,
            expected=f"ground truth for the sequence {prediction.path!r}",
            found=first_names(truths, 3),
            advice="sequences are matched by path or by name; if names differ, give single "
            "sequences",
        )
    return same_name[0]


def open_grids(
    place: Place, grid: str | None, role: Literal["prediction", "truth"]
) -> Iterator[GridFrames]:
    """Yield the grids at a place: a data set, the folder of a grid, or files of another benchmark.

    Args:
        place: path, URL or source of the grids.
        grid: name of the grid; None takes `evaluation`, or the only grid of a sequence.
        role: whether to look for predictions or ground truth, which are in different folders of
            some benchmarks.

    Raises:
        MissingDataError: no grid exists.
    """
    if not isinstance(place, Source):
        folder = Path(place)
        # folder of one grid; the folder above is the sequence
        if (folder / layout.PARAMS).is_file():
            place, grid = folder.absolute().parent, folder.absolute().name
        elif folder.is_dir() and len((plain := LabelFolder(folder)).frames()):
            yield plain
            return
        elif foreign := list(foreign_grids(folder, grid, role)):
            yield from foreign
            return
    source = as_source(place)
    names = []
    for sequence in source.sequences().values():
        if name := _choose_grid(sequence, grid):
            names.append(name)
            yield SequenceGrid(sequence, name)
    if not names:
        raise MissingDataError(
            source.location,
            expected=f"a grid {grid or 'with labels'} in at least one sequence",
            found="none",
        )


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
