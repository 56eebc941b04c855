"""CarlaOcc: scans of a semantic LiDAR in CARLA 0.10, and voxel grids made from the meshes of its
towns.

The files: https://carlaocc.readthedocs.io, and the project's own code (`data_saver.py`,
`gen_pano_occ.py`, `data_converter.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np

from carlasc.converting import (
    Cloud,
    Converter,
    FrameHandle,
    Recording,
    Sensor,
    Split,
    Trajectory,
    VoxelContent,
)
from carlasc.core.arrays import FloatArray
from carlasc.core.benchmarks import CARLAOCC_TO_CARLA
from carlasc.core.geometry import check_rigid
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLAOCC
from carlasc.errors import ArgumentError, FormatError
from carlasc_converters.carlaocc_voxels import (
    CARLAOCC_GRIDS,
    read_geometry,
    read_voxels,
    sequence_name,
)
from carlasc_converters.files import missing_scans, no_data, opening, read_text
from carlasc_converters.ply import PlyVertices

# the simulation runs at 10 frames per second, and the set's own loader gives frame i the time 0.1 i
_PERIOD_S = 0.1  # fact: carlaocc-period
_SCANS = "semantic_lidar"
_PROPERTIES = ("x", "y", "z", "ObjIdx", "ObjTag")


@dataclass(eq=False)
class CarlaOcc(Converter):
    """Reads CarlaOcc, or one of its sequences."""

    title: ClassVar[str] = "CarlaOcc: CARLA 0.10 with voxels from meshes"
    citation = (
        "Y. Feng et al., An Instance-Centric Panoptic Occupancy Prediction Benchmark for "
        "Autonomous Driving, CVPR 2026"
    )
    simulated = True
    classes = CARLAOCC
    to_carla = CARLAOCC_TO_CARLA
    sensor = "simulated semantic LiDAR, 32 channels"
    min_range_m = 2.5
    max_range_m = 70.0

    source: Path
    _: KW_ONLY
    voxels: Annotated[
        str | None, "Grid that is read: a folder in occupancy/, such as vs_0_2_forward_view."
    ] = None

    def sequences(self) -> list[Recording]:
        """Return the sequences, by name.

        Raises:
            MissingDataError: no sequence exists.
            ArgumentError: no sequence has the grid that the option `voxels` names.
        """
        folders = [self.source.resolve()] if (self.source / _SCANS).is_dir() else []
        if not folders and self.source.is_dir():
            folders = sorted(path for path in self.source.iterdir() if (path / _SCANS).is_dir())
        if not folders:
            raise no_data(
                self.source,
                f"folders such as Town01_Opt_Seq07 with {_SCANS}/ in them",
                "give the folder that holds them, after the archives are unpacked",
            )
        splits = _read_splits(folders[0].parent)
        existing = sorted(
            {
                path.name
                for folder in folders
                for path in folder.glob("occupancy/*")
                if path.is_dir()
            }
        )
        if self.voxels is not None and self.voxels not in existing:
            raise ArgumentError(
                "voxels", expected=f"one of {', '.join(existing) or 'no grids'}", found=self.voxels
            )
        grid = self.voxels or next(
            (name for name in (*CARLAOCC_GRIDS, *existing) if name in existing), None
        )
        return [
            CarlaOccRecording(folder, splits.get(folder.name, "Train"), grid) for folder in folders
        ]


class CarlaOccRecording(Recording):
    """One sequence: a folder with semantic_lidar/, poses/ and occupancy/.

    Attributes:
        folder: this folder.
        grid: folder of the grids that are read, in `occupancy/`; None if there are none.
    """

    has_labels = has_instances = True
    sensors = (Sensor("lidar", height_m=1.73),)

    def __init__(self, folder: Path, split: Split, grid: str | None) -> None:
        self.folder = folder
        self.split = split
        self.location = str(folder)
        self.name = sequence_name(folder)
        self.grid = grid if grid is not None and (folder / "occupancy" / grid).is_dir() else None

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The frames that have a scan."""
        grids = self._grid_files
        reference = str(next(iter(grids.values()), ""))
        return [
            CarlaOccFrame(
                number, str(path), str(grids[number]) if number in grids else None, reference
            )
            for number, path in _numbered(self.folder / _SCANS, ".ply").items()
        ]

    @cached_property
    def _grid_files(self) -> dict[int, Path]:
        return {} if self.grid is None else _numbered(self.folder / "occupancy" / self.grid, ".npz")

    @cached_property
    def voxels(self) -> GridSpec | None:  # type: ignore[override]
        """The geometry that the first file of the grids gives; None if there are none."""
        return next((read_geometry(path) for path in self._grid_files.values()), None)

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return poses/lidar.txt: the number of a frame and 16 numbers per line, right-handed.

        Raises:
            FormatError: a line has other values, a transform is not rigid, frames do not increase,
                or a frame has no pose.
        """
        path = self.folder / "poses" / "lidar.txt"
        if not path.is_file():
            return None
        with opening(path, "17 numbers per line"):
            rows = np.loadtxt(path, ndmin=2)
        if rows.shape[1] != 17:
            raise FormatError(
                path, expected="17 numbers per line: frame and 4 x 4 pose", found=rows.shape[1]
            )
        if missing := sorted(
            {frame.number for frame in self.frames} - set(rows[:, 0].astype(int).tolist())
        ):
            raise FormatError(
                path,
                expected=f"a pose for frame {missing[0]}",
                found=f"none for {len(missing)} frames",
            )
        poses = check_rigid(rows[:, 1:].reshape(-1, 4, 4), str(path))
        return Trajectory(poses, rows[:, 0] * _PERIOD_S, str(path))

    def times(self) -> FloatArray:
        """Return the times of a simulation with ten frames per second."""
        last = max((frame.number for frame in self.frames), default=-1)
        return np.arange(last + 1, dtype=np.float64) * _PERIOD_S

    def problems(self) -> list[tuple[int, str]]:
        """Return the frames that have a grid, but no scan."""
        missing = sorted(self._grid_files.keys() - {frame.number for frame in self.frames})
        folder = self.folder / _SCANS
        return missing_scans(
            [(number, folder / f"{number:04d}.ply") for number in missing], "a scan"
        )


@dataclass(frozen=True)
class CarlaOccFrame(FrameHandle):
    """One frame's files.

    Attributes:
        number: its number.
        location: file of the scan.
        grid: file of the voxel grid; None if the frame has none.
        reference: another file of the same grids, whose geometry this one must have.
    """

    number: int
    location: str
    grid: str | None
    reference: str

    def read(self) -> Sequence[Cloud]:
        """Read points, tags, and the numbers of actors of classes that move.

        Raises:
            FormatError: the file is not a PLY file of a semantic LiDAR, or it is incomplete.
        """
        rows = PlyVertices.open(self.location, _PROPERTIES).read()
        if not len(rows):
            raise FormatError(
                self.location, expected="points", found="none", advice="copy it again"
            )
        points = np.zeros((len(rows), 4), np.float32)
        for column, name in enumerate("xyz"):
            points[:, column] = rows[name]
        labels = rows["ObjTag"].astype(np.uint32)
        moves = np.isin(labels, sorted(CARLAOCC.movable))
        instances = np.where(moves, np.maximum(rows["ObjIdx"], 0), 0).astype(np.uint32)
        return (Cloud(points, labels, instances),)

    def read_voxels(self) -> VoxelContent | None:
        """Read the grid of the frame: voxels in meshes have a class, all others are free.

        All voxels are known.

        Raises:
            FormatError: the file is not a grid, or its geometry differs from that of the others.
        """
        if self.grid is None:
            return None
        spec = read_geometry(self.grid)
        expected = read_geometry(self.reference)
        if spec != expected:
            raise FormatError(
                self.grid,
                expected=f"the geometry of {self.reference}: {expected} from {expected.lower}",
                found=f"{spec} from {spec.lower}",
            )
        return VoxelContent(*read_voxels(self.grid, spec))


def _numbered(folder: Path, suffix: str) -> dict[int, Path]:
    """Return the files with names such as 0012.ply by number, in order."""
    paths = folder.iterdir() if folder.is_dir() else ()
    named = [
        path
        for path in paths
        if path.suffix == suffix and path.stem.isascii() and path.stem.isdigit()
    ]
    return {int(path.stem): path for path in sorted(named, key=lambda path: int(path.stem))}


def _read_splits(root: Path) -> dict[str, Split]:
    """Return the split of each sequence: the one with most of its frames, by lines "town sequence
    frame".
    """
    counts: dict[str, Counter[Split]] = {}
    names: tuple[tuple[str, Split], ...] = (("train", "Train"), ("val", "Val"), ("test", "Test"))
    for file, split in names:
        path = root / "splits" / f"{file}.txt"
        for line in read_text(path).splitlines() if path.is_file() else ():
            if len(words := line.split()) == 3:
                town = "Town10HD" if words[0] == "10" else f"Town{words[0]}"
                counts.setdefault(f"{town}_Opt_Seq{words[1]}", Counter())[split] += 1
    return {name: splits.most_common(1)[0][0] for name, splits in counts.items()}
