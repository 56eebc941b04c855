"""SynthCity: a simulated mobile-mapping cloud of a city, in Parquet tables, one per area of about
40 million points.

The cloud has no trajectory, and therefore no scans. Each area is cut into tiles of the size of a
voxel grid, and a frame is one tile. The positions of the sensor are not known, so that voxels with
points are known, and all others are unknown.
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from carlasc.converting import (
    Cloud,
    Converter,
    FrameHandle,
    Recording,
    Sensor,
    Trajectory,
    VoxelContent,
)
from carlasc.core.arrays import FloatArray, Uint8Array
from carlasc.core.classes import ClassTable, Remap
from carlasc.core.geometry import translation
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA, lines_of
from carlasc.errors import ArgumentError, FormatError, StorageError, import_extra
from carlasc_converters.files import no_data, opening

# name, class of CarlaSC; the data count from 0, here 0 is unlabelled
_CLASSES = [
    (" ".join(name), target)
    for *name, target in lines_of("""
    unlabelled Free
    building Building
    car Vehicle
    natural ground Terrain
    ground Ground
    pole-like Pole
    road Road
    street furniture Static
    tree Vegetation
    pavement Sidewalk
""")
]
_TARGETS = {index: CARLA.id_of(target) for index, (_, target) in enumerate(_CLASSES)}
CLASSES = ClassTable(
    "synthcity",
    {index: name for index, (name, _) in enumerate(_CLASSES)},
    {index: CARLA.colors[target] for index, target in _TARGETS.items()},
    movable=frozenset({2}),
    ground=frozenset({3, 4, 6, 9}),
)
# possible names of columns, in lower case, letters only, because the published names are not
# certain
_SYNONYMS = {
    key: {*names}
    for key, *names in lines_of("""
    x x xcoord xcoordinate posx
    y y ycoord ycoordinate posy
    z z zcoord zcoordinate posz
    label label labels labelid class classes classid classification category semantic
""")
}
_COLUMNS = "x=NAME,y=NAME,z=NAME,label=NAME"
_HEIGHT_M = (
    1.8  # height of the origin of a frame above its ground: about that of the LiDAR in CarlaSC
)
# around the middle of a tile, and least number of ground points there
_GROUND_RADIUS_M = 5.0
_GROUND_POINTS = 20
_BATCH = 1 << 18  # rows in memory
# x and y from the middle of the tile
_ROW = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f8"), ("label", "u1")])


@dataclass(eq=False)
class SynthCity(Converter):
    """Reads the areas of SynthCity, or one of them."""

    title: ClassVar[str] = "SynthCity: tiles of a static cloud, voxels without free space"
    citation = "D. Griffiths, J. Boehm, SynthCity: A large scale synthetic point cloud, 2019"
    simulated = True
    classes = CLASSES
    to_carla = Remap("synthcity_to_carla", CLASSES, CARLA, _TARGETS)
    sensor = "simulated mobile mapping (BlenSor)"

    source: Path
    _: KW_ONLY
    columns: Annotated[
        str | None,
        "Names of columns, if they are not found automatically: x=X_noise,y=Y_noise,label=Class.",
    ] = None
    grid: Annotated[
        Literal["coarse", "fine"], "Published grid with the size and voxels of tiles."
    ] = "coarse"

    def sequences(self) -> list[Recording]:
        """Return the areas, by name.

        Raises:
            MissingDataError: no table exists.
            FormatError: a file is not a Parquet table, or its columns are not found.
            ArgumentError: an option has a wrong value.
            DependencyError: pyarrow is not installed.
        """
        named = {} if self.columns is None else _parse_columns(self.columns)
        files = [self.source] if self.source.is_file() else sorted(self.source.rglob("*.parquet"))
        if not files:
            advice = "give their folder, or one of the tables"
            raise no_data(self.source, "Parquet tables, one per area", advice)
        return [
            SynthCityArea(path, _find_columns(path, named), GridSpec.published(self.grid))
            for path in files
        ]


class SynthCityArea(Recording):
    """One area.

    Its tiles lie on a lattice that is the same for all areas, and are numbered along y first.

    The rows of each tile are kept in a file of a temporary folder, which is deleted with the
    recording and its frames.

    Attributes:
        path: its table.
        columns: names of its columns x, y, z and label.
        voxels: geometry of the voxel grids, about the middle of a tile.
    """

    split = "Train"
    has_labels = True
    rays = False
    sensors = (Sensor("assumed", height_m=_HEIGHT_M),)

    def __init__(self, path: Path, columns: Mapping[str, str], voxels: GridSpec) -> None:
        self.path = path
        self.location = str(path)
        self.columns = columns
        self.voxels = self._spec = voxels
        self.name = f"SYNTHCITY_{path.stem.replace('_', '-')}"

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The tiles that have points."""
        folder, tiles = self._cut
        grounds = _grounds([_tile_file(folder.name, tile) for tile in tiles], self._centers)
        return [
            SynthCityFrame(
                number,
                f"{self.path}: tile {tile[0]}, {tile[1]}",
                _tile_file(folder.name, tile),
                self._spec,
                grounds[number] + _HEIGHT_M,
                folder,
            )
            for number, tile in enumerate(tiles)
        ]

    @cached_property
    def _cut(self) -> tuple[_TileFolder, list[tuple[int, int]]]:
        """The folder with the rows of each tile, and the tiles.

        One pass over the table makes them.
        """
        folder = _TileFolder()
        tiles = set[tuple[int, int]]()
        for points, labels in _batches(self.path, self.columns):
            tiles |= _append(folder.name, points, labels, self._step)
        if not tiles:
            raise FormatError(self.path, expected="points", found="none")
        return folder, sorted(tiles)

    @property
    def _step(self) -> float:
        return self._spec.upper[0] - self._spec.lower[0]

    @property
    def _centers(self) -> FloatArray:
        """(F, 2) middle of each tile."""
        return (np.array(self._cut[1], np.float64) + 0.5) * self._step

    def poses(self, *, force: bool = False) -> Trajectory:
        """Return the poses of the tiles in the city: 1.8 m above their ground, with the axes of the
        city.
        """
        heights = [frame.height_m for frame in self.frames if isinstance(frame, SynthCityFrame)]
        poses = np.array(
            [translation((x, y, z)) for (x, y), z in zip(self._centers, heights, strict=True)]
        )
        return Trajectory(poses, where=self.location)

    def notes(self) -> list[str]:
        """Return notes on what is missing in the data."""
        return [
            f"SynthCity is a static cloud without trajectory: each frame is a tile of "
            f"{self._step:.1f} m, in the frame of a place {_HEIGHT_M} m above its ground, where "
            f"no sensor was",
            "only voxels with points are known, because there are no rays that show free space",
        ]


class _TileFolder:
    """A temporary folder.

    It is deleted with the last reference to this object, at the latest when the process ends.
    """

    def __init__(self) -> None:
        self.name = tempfile.mkdtemp(prefix="carlasc-synthcity-")
        weakref.finalize(self, shutil.rmtree, self.name, ignore_errors=True)


@dataclass(frozen=True, eq=False)
class SynthCityFrame(FrameHandle):
    """One tile.

    Attributes:
        number: its place among the tiles of the area.
        location: the table, and the tile.
        rows: the file with its rows.
        spec: geometry of its grid.
        height_m: height of its origin, in the coordinates of the table.
        folder: keeps the temporary folder from being deleted, in the process that made it.
    """

    number: int
    location: str
    rows: str
    spec: GridSpec
    height_m: float
    folder: object = field(default=None, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"folder": None}

    def read(self) -> Sequence[Cloud]:
        """Read the points of the tile, at all heights."""
        rows = np.fromfile(self.rows, _ROW)
        points = np.zeros((len(rows), 4), np.float32)
        points[:, 0] = rows["x"]
        points[:, 1] = rows["y"]
        points[:, 2] = rows["z"] - self.height_m
        return (Cloud(points, rows["label"]),)

    def read_voxels(self) -> VoxelContent:
        """Return the class that most points of each voxel have; the one with the smallest number if
        there are several.
        """
        (cloud,) = self.read()
        assert cloud.labels is not None
        cells = self.spec.flat_index(cloud.points[:, :3])
        inside = cells >= 0
        kinds = len(CLASSES.names)
        votes = np.bincount(
            cells[inside] * kinds + cloud.labels[inside], minlength=self.spec.num_voxels * kinds
        )
        votes = votes.reshape(*self.spec.size, kinds)
        return VoxelContent(votes.argmax(axis=-1).astype(np.uint8), votes.sum(axis=-1) > 0)


def _parse_columns(text: str) -> dict[str, str]:
    """Return the columns that a text such as "x=X,label=Class" names."""
    pairs = [part.partition("=") for part in text.split(",")]
    named = {key.strip(): name.strip() for key, _, name in pairs}
    if len(named) < len(pairs) or not set(named) <= set(_SYNONYMS) or not all(named.values()):
        raise ArgumentError("columns", expected=f"{_COLUMNS}, or some of these", found=repr(text))
    return named


def _find_columns(path: Path, named: Mapping[str, str]) -> dict[str, str]:
    """Return the names of the columns x, y, z and label of a table."""
    parquet = import_extra("pyarrow.parquet", "parquet")
    with opening(path, "a Parquet table"):
        existing = parquet.read_schema(path).names
    columns = {}
    for key, synonyms in _SYNONYMS.items():
        candidates = [
            name for name in existing if "".join(filter(str.isalpha, name.lower())) in synonyms
        ]
        candidates = (
            [name for name in existing if name == named[key]] if key in named else candidates
        )
        if len(candidates) != 1:
            raise FormatError(
                path,
                expected=f"one column {named.get(key, key)}",
                found=", ".join(candidates or existing),
                advice=f"name the columns with the option `columns`: {_COLUMNS}",
            )
        columns[key] = candidates[0]
    return columns


def _batches(path: Path, columns: Mapping[str, str]) -> Iterator[tuple[FloatArray, Uint8Array]]:
    """Yield (N, 3) points and (N,) labels, counted from 1, of consecutive rows of a table.

    Raises:
        FormatError: the table is damaged, a coordinate is not finite, or a label is not one of the
            nine.
    """
    parquet = import_extra("pyarrow.parquet", "parquet")
    done = 0
    # Without these two options, whole columns of a row group are in memory, and a table may be one
    # row group.
    with (
        opening(path, "a Parquet table", "copy it again"),
        parquet.ParquetFile(path, buffer_size=1 << 20, pre_buffer=False) as table,
    ):
        for batch in table.iter_batches(_BATCH, columns=list(dict.fromkeys(columns.values()))):
            points = np.stack([_numbers(path, batch, columns[key]) for key in "xyz"], axis=1)
            labels = _numbers(path, batch, columns["label"])
            if (wrong := ~np.isfinite(points).all(axis=1)).any():
                row = done + int(np.argmax(wrong))
                raise FormatError(path, expected="finite coordinates", found=f"others in row {row}")
            if (wrong := ~np.isin(labels, np.arange(len(CLASSES.names) - 1))).any():
                value = labels[np.argmax(wrong)]
                count = int(wrong.sum())
                raise FormatError(
                    path,
                    expected=f"labels 0 to {len(CLASSES.names) - 2} in the column "
                    f"{columns['label']}",
                    found=f"{value:g} in row {done + int(np.argmax(wrong))}, and {count - 1} more "
                    f"such rows near it",
                    advice="another column may hold the labels: name it with the option `columns`",
                )
            yield points, labels.astype(np.uint8) + np.uint8(1)
            done += len(labels)


def _numbers(path: Path, batch: Any, name: str) -> FloatArray:
    """Return a column of a batch as numbers."""
    column = batch.column(name).to_numpy(zero_copy_only=False)
    if column.dtype.kind not in "iuf":
        raise FormatError(
            path, expected=f"numbers in the column {name}", found=batch.schema.field(name).type
        )
    return column.astype(np.float64)


def _append(
    folder: str, points: FloatArray, labels: Uint8Array, step: float
) -> set[tuple[int, int]]:
    """Append points to the files of their tiles, and return these tiles."""
    if not len(points):
        return set()
    tiles = np.floor(points[:, :2] / step).astype(np.int64)
    rows = np.empty(len(points), _ROW)
    rows["x"], rows["y"] = (points[:, :2] - (tiles + 0.5) * step).T
    rows["z"] = points[:, 2]
    rows["label"] = labels
    low = tiles.min(axis=0)
    codes = (tiles[:, 0] - low[0]) * (np.ptp(tiles[:, 1]) + 1) + (tiles[:, 1] - low[1])
    # 16 bits, in nearly all cases, are sorted ten times as fast as 64
    codes = codes.astype(np.min_scalar_type(codes.max()))
    order = np.argsort(codes, kind="stable")
    rows = rows[order]
    codes = codes[order]
    starts = np.append(0, np.flatnonzero(np.diff(codes)) + 1)
    squares = [(int(x), int(y)) for x, y in tiles[order[starts]]]
    try:
        for tile, part in zip(squares, np.split(rows, starts[1:]), strict=True):
            with Path(_tile_file(folder, tile)).open("ab") as file:
                part.tofile(file)
    except OSError as error:
        advice = "set TMPDIR to a folder on a disk with 17 bytes of free space per point"
        raise StorageError(
            folder, problem=f"the temporary folder cannot be written ({error})", advice=advice
        ) from error
    return set(squares)


def _tile_file(folder: str, tile: tuple[int, int]) -> str:
    return str(Path(folder) / f"{tile[0]}_{tile[1]}.bin")


def _grounds(files: list[str], centers: FloatArray) -> list[float]:
    """Return the height of the ground in each tile: the median of its ground points, those around
    the middle if there are enough.

    A tile without ground points has the height of the nearest tile that has some; if none has, that
    of its lowest point.
    """
    heights = np.full(len(files), np.nan)
    lowest = np.empty(len(files))
    for number, file in enumerate(files):
        rows = np.memmap(file, _ROW, "r")
        lowest[number] = rows["z"].min()
        ground = np.isin(rows["label"], sorted(CLASSES.ground))
        near = ground & (np.hypot(rows["x"], rows["y"]) < _GROUND_RADIUS_M)
        chosen = near if near.sum() >= _GROUND_POINTS else ground
        if chosen.any():
            heights[number] = np.median(rows["z"][chosen])
    known = np.flatnonzero(~np.isnan(heights))
    if not known.size:
        return lowest.tolist()
    away = np.linalg.norm(centers[:, None] - centers[known], axis=2)
    return heights[known[away.argmin(axis=1)]].tolist()
