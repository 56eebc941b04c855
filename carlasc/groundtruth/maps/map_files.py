"""The files that a map is written to, whatever it is made from."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, ConflictError, import_extra
from carlasc.groundtruth.maps.surfaces import MESH_ENDINGS, SurfaceMesh
from carlasc.storage.cloud_files import POINT_ENDINGS, PointPieces, write_octomap, write_points
from carlasc.storage.files import writing

OCTOMAP = ".bt"
ACTORS = "actors.json"
_ALIGNED = 1e-3  # of a cell, by which a grid may miss the cells of a tree
_NEEDS = (("skimage.measure", "mesh"), ("trimesh", "mesh"), ("scipy.ndimage", "mesh"), ("laspy", "scans"))


@dataclass(frozen=True)
class MapCells:
    """The cells of a map that are known, in memory.

    Attributes:
        index: (N, 3) indices of cells.
        labels: (N,) their classes; 0 where they are free.
        lower: (3,) lower corner of the cell (0, 0, 0), metres.
        size: (3,) size of a cell, metres.
    """

    index: NDArray[np.int64]
    labels: NDArray[np.integer]
    lower: NDArray[np.float64]
    size: NDArray[np.float64]

    def write_octomap(self, path: Path) -> None:
        """Write the cells as a tree of OctoMap.

        Raises:
            ArgumentError: they are not cubes, or not those of a tree.
        """
        edge = float(self.size[0])
        first = np.rint(self.lower / edge)
        if np.ptp(self.size) > _ALIGNED * edge:
            found = " x ".join(f"{value:g}" for value in self.size)
            advice = "make the grid with `res`, as --res 0.2"
            raise ArgumentError("out", expected="cubic voxels for OctoMap", found=f"{found} m", advice=advice)
        if np.abs(self.lower / edge - first).max() > _ALIGNED:
            expected = f"voxels that begin at multiples of {edge:g} m for OctoMap"
            found = ", ".join(f"{value:g}" for value in self.lower)
            raise ArgumentError("out", expected=expected, found=found, advice="make the grid with other bounds")
        write_octomap(path, self.index + first.astype(np.int64), self.labels > 0, edge)


@dataclass(frozen=True)
class MapFiles:
    """Where a map is written: its points or its tree, its mesh, its distances, and the folder of its actors; None: nowhere."""

    out: Path | None
    mesh: Path | None
    distance: Path | None
    movers: Path | None

    @classmethod
    def of(cls, out: Any, mesh: Any, distance: Any, movers: bool, grid: str | None) -> Self:
        """Return where things are written.

        Raises:
            ArgumentError: an ending is not known, or something cannot be made of this map.
        """
        endings = {"out": (*POINT_ENDINGS, OCTOMAP), "mesh": MESH_ENDINGS, "distance": (".npz",)}
        given = {"out": out, "mesh": mesh, "distance": distance}
        paths = {name: Path(path) for name, path in given.items() if path is not None}
        for name, path in paths.items():
            if path.suffix.lower() not in endings[name]:
                raise ArgumentError(name, expected=f"a file that ends in {', '.join(endings[name])}", found=str(path))
        if not paths:
            raise ArgumentError("out", expected="a file to write, or `mesh` or `distance`", found="none of them")
        if len(set(paths.values())) < len(paths):
            raise ArgumentError("mesh", expected="files of different names", found=", ".join(map(str, paths.values())))
        if distance is not None and grid is None:
            advice = "scans alone do not tell free space from unknown space: make a grid with `carlasc regrid`"
            raise ArgumentError("distance", expected="the `grid` whose voxels it is of", found="none", advice=advice)
        if movers and (grid is not None or "out" not in paths or paths["out"].suffix.lower() == OCTOMAP):
            raise ArgumentError("movers", expected="a file of points of a drive in `out`", found=str(grid or out))
        folder = paths["out"].with_name(f"{paths['out'].stem}_movers") if movers else None
        return cls(paths.get("out"), paths.get("mesh"), paths.get("distance"), folder)

    @property
    def all(self) -> list[Path]:
        """All files, and the folder."""
        return [path for path in (self.out, self.mesh, self.distance, self.movers) if path is not None]

    def check(self, overwrite: bool) -> None:
        """Check that nothing is replaced, and that packages are installed, before hours of work."""
        for path in self.all:
            is_ours = (path / ACTORS).is_file() if path == self.movers else path.is_file()
            if path.exists() and not (overwrite and is_ours):
                found, advice = "a file" if path.is_file() else "a folder", "give another name"
                advice = f"give `overwrite=True`, or {advice[5:]}" if is_ours else advice
                raise ConflictError(path, expected="nothing", found=found, advice=advice)
        is_las = self.out is not None and self.out.suffix.lower() == ".las"
        for (module, extra), needed in zip(_NEEDS, (self.mesh, self.mesh, self.distance, is_las), strict=True):
            if needed:
                import_extra(module, extra)

    def folder(self) -> tempfile.TemporaryDirectory[str]:
        """Return a folder beside the map for what does not fit into memory; it is removed at the end, also after Ctrl-C."""
        place = self.all[0].parent
        with writing(place):
            place.mkdir(parents=True, exist_ok=True)
            return tempfile.TemporaryDirectory(dir=place, prefix=f".{self.all[0].name}.", suffix=".part")

    def write(self, points: PointPieces, cells: Callable[[], MapCells]) -> None:
        """Write the points, or the tree, and the mesh; `cells` returns what the latter two are made of."""
        is_tree = self.out is not None and self.out.suffix.lower() == OCTOMAP
        if self.out is not None and not is_tree:
            write_points(self.out, points)
        if self.mesh is None and not is_tree:
            return
        known = cells()
        if self.out is not None and is_tree:
            known.write_octomap(self.out)
        if self.mesh is not None:
            occupied = known.labels > 0
            surface = SurfaceMesh.of(known.index[occupied], known.labels[occupied], known.lower, known.size)
            surface.write(self.mesh, points.classes)
