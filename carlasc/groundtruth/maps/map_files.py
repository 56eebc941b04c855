"""The files of a map, and their contents."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from carlasc.core.arrays import AnyIntArray, FloatArray, IntArray, Uint16Array
from carlasc.core.classes import ClassTable
from carlasc.core.grids import Grid
from carlasc.errors import ArgumentError, ConflictError, import_extra
from carlasc.groundtruth.maps.cloud_files import (
    POINT_ENDINGS,
    PointPieces,
    write_octomap,
    write_points,
)
from carlasc.motion.box_table import BOX_ENDINGS, check_box_file
from carlasc.storage.files import AnyPath, write_output

OCTOMAP = ".bt"
ACTORS = "actors.json"
_ALIGNED = 1e-3  # greatest offset of a grid from the cells of a tree, as a share of a cell
_NEEDS = (
    ("skimage.measure", "mesh"),
    ("trimesh", "mesh"),
    ("scipy.ndimage", "mesh"),
    ("laspy", "scans"),
)


@dataclass(frozen=True)
class MapCells:
    """The known cells of a map, in memory.

    Attributes:
        index: (N, 3) indices of cells.
        labels: (N,) their classes; 0 where they are free.
        lower: (3,) lower corner of the cell (0, 0, 0), metres.
        size: (3,) size of a cell, metres.
    """

    index: IntArray
    labels: AnyIntArray
    lower: FloatArray
    size: FloatArray

    def write_octomap(self, path: Path) -> None:
        """Write the cells as a tree of OctoMap.

        Raises:
            ArgumentError: they are not cubes, or not aligned with the cells of a tree.
        """
        edge = float(self.size[0])
        first = np.rint(self.lower / edge)
        if np.ptp(self.size) > _ALIGNED * edge:
            found = " x ".join(f"{value:g}" for value in self.size)
            advice = "make the grid with `res`, as --res 0.2"
            raise ArgumentError(
                "out", expected="cubic voxels for OctoMap", found=f"{found} m", advice=advice
            )
        if np.abs(self.lower / edge - first).max() > _ALIGNED:
            expected = f"voxels that begin at multiples of {edge:g} m for OctoMap"
            found = ", ".join(f"{value:g}" for value in self.lower)
            raise ArgumentError(
                "out", expected=expected, found=found, advice="make the grid with other bounds"
            )
        write_octomap(path, self.index + first.astype(np.int64), self.labels > 0, edge)


@dataclass(frozen=True)
class MapFiles:
    """The paths of a map: points or tree, mesh, distances, trajectory, boxes, and the folder of
    actors; None: not written. `begin` is called before the first file is written.
    """

    out: Path | None
    mesh: Path | None
    distance: Path | None
    trajectory: Path | None
    boxes: Path | None
    actors: Path | None
    begin: Callable[[], None] = lambda: None

    @classmethod
    def of(cls, given: Mapping[str, Any], actors: bool, grid: str | None) -> Self:
        """Return the paths of a map; `given` has the files by name.

        Raises:
            ArgumentError: an ending is not known, or a file cannot be made from this map.
        """
        paths = {name: Path(path) for name, path in given.items() if path is not None}
        for name, path in paths.items():
            if path.suffix.lower() not in _ENDINGS[name]:
                raise ArgumentError(
                    name,
                    expected=f"a file that ends in {', '.join(_ENDINGS[name])}",
                    found=path,
                )
        if not paths:
            raise ArgumentError(
                "out", expected="a file to write, or `mesh` or `distance`", found="none of them"
            )
        if len(set(paths.values())) < len(paths):
            raise ArgumentError(
                "mesh",
                expected="files of different names",
                found=", ".join(map(str, paths.values())),
            )
        for name in paths.keys() & {"trajectory", "boxes_out"} if grid is not None else ():
            raise ArgumentError(name, expected="the map of a drive", found=f"that of {grid}")
        if "distance" in paths and grid is None:
            raise ArgumentError(
                "distance",
                expected="the `grid` whose voxels it is of",
                found="none",
                advice="scans alone do not tell free space from unknown space: make a grid with "
                "`carlasc regrid`",
            )
        if actors and (
            grid is not None or "out" not in paths or paths["out"].suffix.lower() == OCTOMAP
        ):
            raise ArgumentError(
                "actors",
                expected="a file of points of a drive in `out`",
                found=grid or paths.get("out"),
            )
        folder = paths["out"].with_name(f"{paths['out'].stem}_actors") if actors else None
        out, mesh, far, trajectory, boxes = (paths.get(name) for name in _ENDINGS)
        return cls(out, mesh, far, trajectory, boxes, folder)

    @property
    def all(self) -> list[Path]:
        """All files, and the folder."""
        return [path for path in vars(self).values() if isinstance(path, Path)]

    @property
    def ending(self) -> str:
        """The ending of `out`; "" without it."""
        return "" if self.out is None else self.out.suffix.lower()

    def check(self, overwrite: bool) -> None:
        """Check, before hours of work, that no file is replaced and that packages are installed."""
        for path in self.all:
            is_ours = (path / ACTORS).is_file() if path == self.actors else path.is_file()
            if path.exists() and not (overwrite and is_ours):
                found = "a file" if path.is_file() else "a folder"
                advice = "give another name"
                advice = f"give `overwrite=True`, or {advice[5:]}" if is_ours else advice
                raise ConflictError(path, expected="nothing", found=found, advice=advice)
        asked = (self.mesh, self.mesh, self.distance, self.ending == ".las")
        for (module, extra), needed in zip(_NEEDS, asked, strict=True):
            if needed:
                import_extra(module, extra)
        if self.boxes is not None:
            check_box_file("boxes_out", self.boxes)

    def write(self, points: PointPieces, cells: Callable[[], MapCells]) -> None:
        """Write the points, or the tree, and the mesh; `cells` returns the cells of the tree and
        the mesh.
        """
        self.begin()
        if self.out is not None and self.ending != OCTOMAP:
            write_points(self.out, points)
        if self.mesh is None and self.ending != OCTOMAP:
            return
        known = cells()
        if self.out is not None and self.ending == OCTOMAP:
            known.write_octomap(self.out)
        if self.mesh is not None:
            SurfaceMesh.of(known).write(self.mesh, points.classes)


MESH_ENDINGS = (".ply", ".glb")
_ENDINGS = {
    "out": (*POINT_ENDINGS, OCTOMAP),
    "mesh": MESH_ENDINGS,
    "distance": (".npz",),
    "trajectory": (".tum", ".txt"),
    "boxes_out": BOX_ENDINGS,
}
_BLOCK = 128  # number of cells along x and y that are meshed at once
_STEPS = (
    1024  # positions of vertices are rounded to such parts of a cell, so that blocks share them
)
_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # glTF: y is up


@dataclass(frozen=True)
class SurfaceMesh:
    """The surface of occupied cells.

    Attributes:
        vertices: (V, 3) float64, metres, between the middles of occupied cells and of free ones
            beside them.
        faces: (F, 3) int64 vertices of each triangle, anticlockwise as seen from outside, in
            right-handed axes.
        labels: (V,) class of each vertex, from its occupied cell.
    """

    vertices: FloatArray
    faces: IntArray
    labels: IntArray

    @classmethod
    def of(cls, known: MapCells) -> SurfaceMesh:
        """Mesh the occupied ones of some cells by marching cubes.

        Raises:
            DependencyError: scikit-image is not installed.
        """
        nodes = [np.empty((0, 3), np.int64)]
        faces = [np.empty((0, 3), np.int64)]
        classes = [np.empty(0, np.int64)]
        count = 0
        occupied = known.labels > 0
        for corner, volume in _blocks(known.index[occupied], known.labels[occupied]):
            vertices, triangles, own = _march(volume)
            nodes.append(vertices + _STEPS * corner)
            faces.append(triangles + count)
            classes.append(own)
            count += len(vertices)
        whole, first, place = np.unique(
            np.concatenate(nodes), axis=0, return_index=True, return_inverse=True
        )
        return cls(
            known.lower + (whole / _STEPS + 0.5) * known.size,
            place.reshape(-1)[np.concatenate(faces)],
            np.concatenate(classes)[first],
        )

    def write(self, path: AnyPath, classes: ClassTable) -> None:
        """Write the mesh with a colour for each vertex; the ending of the file, one of
        `MESH_ENDINGS`, says its format. In .glb, y is up.

        Raises:
            DependencyError: trimesh is not installed.
            StorageError: the file cannot be written; an earlier one stays.
        """
        trimesh = import_extra("trimesh", "mesh")
        kind = Path(path).suffix.lower()
        mesh = trimesh.Trimesh(
            self.vertices @ _UP.T if kind == ".glb" else self.vertices,
            self.faces,
            vertex_colors=classes.palette[self.labels],
            process=False,
        )
        write_output(Path(path), mesh.export(file_type=kind[1:]))


def _blocks(cells: IntArray, labels: AnyIntArray) -> Iterator[tuple[IntArray, Uint16Array]]:
    """Yield the first cell of each block, and the classes of its cells with a border of one cell, 0
    where free.

    Blocks share their outermost cells, so that every cube between eight cells is in one block.
    """
    owner = (
        np.concatenate([cells[:, :2] - shift for shift in ([0, 0], [1, 0], [0, 1], [1, 1])])
        // _BLOCK
    )
    blocks, block = np.unique(owner, axis=0, return_inverse=True)
    order = np.argsort(block.reshape(-1), kind="stable")
    row = np.tile(np.arange(len(cells)), 4)
    ends = np.searchsorted(block.reshape(-1)[order], np.arange(len(blocks) + 1))
    for number, (x, y) in enumerate(blocks.tolist()):
        own = np.unique(row[order[ends[number] : ends[number + 1]]])
        corner = np.array([x * _BLOCK, y * _BLOCK, int(cells[own, 2].min()) - 1])
        volume = np.zeros(
            (_BLOCK + 1, _BLOCK + 1, int(cells[own, 2].max()) + 2 - corner[2]), np.uint16
        )
        volume[tuple((cells[own] - corner).T)] = labels[own]
        yield corner, volume


def _march(
    volume: Uint16Array,
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the positions of the vertices in 1 / `_STEPS` of a cell, the triangles, and the
    classes of the vertices.
    """
    measure = import_extra("skimage.measure", "mesh")
    if not volume.any():
        return np.empty((0, 3), np.int64), np.empty((0, 3), np.int64), np.empty(0, np.int64)
    vertices, triangles, _, _ = measure.marching_cubes(
        (volume > 0).astype(np.float32), 0.5, gradient_direction="ascent"
    )
    ends = np.stack([np.floor(vertices), np.ceil(vertices)]).astype(np.int64)
    labels = np.zeros(len(vertices), np.int64)
    # one corner is occupied: most vertices are on edges of a cube
    for corner in np.ndindex(2, 2, 2):
        near = volume[tuple(ends[side, :, axis] for axis, side in enumerate(corner))]
        labels = np.maximum(labels, near)
    return np.rint(_STEPS * vertices).astype(np.int64), triangles.astype(np.int64), labels


def write_distances(path: AnyPath, grid: Grid) -> None:
    """Write the distance of each voxel from the surface: arrays `distance`, `lower`, `upper` and
    `voxel_size` in a .npz file.

    `distance`, (X, Y, Z) float32, metres between middles of voxels: to the nearest occupied voxel;
    in occupied voxels, minus the distance to the nearest other voxel; NaN in unknown voxels. A grid
    without occupied voxels has infinite distances.

    Raises:
        DependencyError: SciPy is not installed.
        StorageError: the file cannot be written; an earlier one stays.
    """
    transform = import_extra("scipy.ndimage", "mesh").distance_transform_edt
    spec = grid.spec
    buffer = io.BytesIO()
    occupied = grid.known & (grid.labels > 0)
    size = spec.voxel_size.astype(np.float64)
    if occupied.all() or not occupied.any():
        distance = np.full(spec.size, -np.inf if occupied.all() else np.inf)
    else:
        distance = transform(~occupied, sampling=size) - transform(occupied, sampling=size)
    distance[~grid.known] = np.nan
    np.savez_compressed(
        buffer,
        distance=distance.astype(np.float32),
        lower=spec.lower,
        upper=spec.upper,
        voxel_size=size,
    )
    write_output(Path(path), buffer.getvalue())
