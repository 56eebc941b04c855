"""Free space of scans: each ray is followed once, into cells that are fixed in a frame, and every
grid takes its free space from these cells.

A drive has a map of cells for the static scene, and one for each actor, in the frame of the actor.
The cells are smaller than the voxels, and stored in blocks, so that memory grows with the space
that rays pass through. Counts are integers: scans are added and removed in any order, and a grid
does not depend on the grids that were made before it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection, Iterable
from typing import Literal, NamedTuple

import numpy as np

from carlasc.core.arrays import (
    AnyArray,
    Float32Array,
    FloatArray,
    Int32Array,
    IntArray,
    Uint32Array,
)
from carlasc.core.cells import Cells, Pose, Real, Triple, as_pose, pose_of, transform
from carlasc.core.compiling import cached, inlined, jit
from carlasc.core.geometry import Transform, invert
from carlasc.core.grids import GridSpec
from carlasc.groundtruth.from_scans.merging import RECENT_S, Cast, Instant, SeenBody
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.voting.kernel import BLOCK
from carlasc.groundtruth.voting.rays import DROPPED, clip, empty_rays, view_from

_BITS = 3  # a block has 2 ** _BITS cells along each edge
_EDGE = 1 << _BITS
_CELLS = _EDGE**3  # of a block
# About the height of a cell, as most rays graze the ground, and its width in the map of an actor.
# With wider ones, pedestrians lose: see docs/studies/rays.md.
_CELL_M = 0.05
_MOST = 8  # greatest number of cells along an edge of a voxel, as in those of 0.4 m; least: 2
_MANY = 4096  # samples that are found before their cells change: they fit into the L1 cache
_FEWEST = 256  # least number of blocks by which a map grows
Counted = Literal["samples", "scans", "last"]
"""What cells count: samples, or scans; or they keep the last scan, which takes no removal."""


class FreeSpace:
    """The maps of free space of a drive, which slide with the window of the frames.

    Args:
        plan: the grids, and how votes are counted: by the rule "sensor", each scan counts once in a
            voxel, otherwise all samples.
        map_T_world: (4, 4), which fixes the cells of the static scene.
        stride: frames share scans with every `stride`-th one.
        cast_of: returns the rays of a scan, in the frame of the map, which count in the grids that
            it may be merged into within some seconds.
    """

    def __init__(
        self,
        plan: GridPlan,
        map_T_world: Transform,
        stride: int,
        cast_of: Callable[[int, float], Cast],
    ) -> None:
        self.plan = plan
        self._map_T_world = map_T_world
        self._stride = stride
        self._cast_of = cast_of
        # by the frames that share it, and what is in it: an actor has its number
        self._maps = dict[tuple[int, str | int], FreeMap]()
        self._lock = threading.Lock()  # an executor may be of threads

    def count(
        self, kind: str, now: Instant, window: Collection[int], voxels: IntArray | None = None
    ) -> Uint32Array:
        """Return what the rays of a window passed through: counts of each of (M,) voxels.

        Args:
            kind: "scene": by the rule of votes; "views": scans; "recent": whether scans within
                `RECENT_S` of a frame saw the voxel, as 0 and other numbers.
            now: the frame.
            window: frames of the scans.
            voxels: (M,) flat indices; None: all voxels.
        """
        within_s = RECENT_S if kind == "recent" else math.inf
        with self._lock:
            cells = self._map_of(kind, now)
            cells.hold(window, lambda frame: self._cast_of(frame, within_s))
            return cells.count(self._map_T_world @ now.world_T_grid, voxels)

    def add_bodies(self, bodies: Iterable[SeenBody], now: Instant, free: Uint32Array) -> None:
        """Add the free samples in the body of each actor to (V,) those of all voxels."""
        for body in bodies:
            voxels = np.flatnonzero(body.points.regions == body.points.region)
            with self._lock:
                cells = self._map_of(body.number, now)
                cells.hold(body.casts, body.casts.__getitem__)
                actor_T_grid = invert(body.world_T_actor) @ now.world_T_grid
                free[voxels] += cells.count(actor_T_grid, voxels)

    def _map_of(self, kind: str | int, now: Instant) -> FreeMap:
        key, plan = (now.frame % self._stride, kind), self.plan
        if key not in self._maps:
            counted: Counted = "scans" if plan.rule == "sensor" else "samples"
            counted = "last" if kind == "recent" else "scans" if kind == "views" else counted
            fine, step_m = isinstance(kind, int), plan.voting.free_step_m
            self._maps[key] = FreeMap(plan.spec, step_m, counted, fine=fine)
        return self._maps[key]

    def forget_others(self, actors: Collection[int]) -> None:
        """Clear the maps of all other actors."""
        with self._lock:
            for key in [key for key in self._maps if isinstance(key[1], int)]:
                if key[1] not in actors:
                    del self._maps[key]


class _Blocks(NamedTuple):
    """The blocks of a map.

    Attributes:
        first: (3,) the first block of `slots` along each axis.
        slots: (X, Y, Z) index of each block in `counts`; -1 without one.
        unused: (U,) indices; the first ones are of blocks that are not in use.
        left: (1,) how many of them there are.
        counts: (B * cells,) samples or scans in each cell, or the last scan.
        stamps: (B * cells,) the last scan that was added or removed, if scans are counted.
    """

    first: IntArray
    slots: Int32Array
    unused: Int32Array
    left: IntArray
    counts: Int32Array
    stamps: Int32Array


class FreeMap:
    """The free space that the rays of some scans passed through, in cells.

    Args:
        spec: the grids that take their free space from the map.
        step_m: distance between two samples of a ray, metres.
        counted: what cells count. Those that count scans are as large as a voxel.
        fine: make the cells as small in x and y as in z, for small things.
    """

    def __init__(
        self, spec: GridSpec, step_m: float, counted: Counted = "samples", *, fine: bool = False
    ) -> None:
        x, y, z = spec.voxel_size.tolist()
        # a cylindrical voxel is as wide as deep at some radius
        size = (x, x if spec.coordinates == "cylindrical" else y, z)
        parts = [min(max(round(edge / _CELL_M), 2), _MOST) for edge in size]
        self.spec = spec
        self._counted = counted
        self._step_m = step_m
        self._stamp = 0
        across = tuple(parts[:2]) if fine else (2, 2)
        self._parts = (1, 1, 1) if counted == "scans" else (*across, parts[2])
        self._cell = np.array(size) / self._parts
        self._margin_m = np.linalg.norm(size)  # a voxel that touches a region is counted whole
        # the rays of each scan, the first and the last block of their region, and the scan's stamp
        self._held = dict[int, tuple[Cast, IntArray, IntArray, int]]()
        self._clear()

    def _clear(self) -> None:
        self._held.clear()
        slots, unused = np.empty((0, 0, 0), np.int32), np.empty(0, np.int32)
        counts, stamps = (np.empty(0, np.int32) for _ in range(2))
        origin, left = np.zeros(3, np.int64), np.zeros(1, np.int64)
        self._blocks = _Blocks(origin, slots, unused, left, counts, stamps)

    def hold(self, scans: Collection[int], cast_of: Callable[[int], Cast]) -> None:
        """Add and remove scans, so that the map has the rays of some scans and no others.

        Args:
            scans: numbers of the scans.
            cast_of: returns the rays of a scan.
        """
        others = [scan for scan in self._held if scan not in scans]
        is_last = self._counted == "last"
        if is_last:  # earlier scans than those that stay need not be removed; others cannot be
            first = min((held[3] for scan, held in self._held.items() if scan in scans), default=0)
            anew = any(self._held[scan][3] > first for scan in others)
        else:  # adding the rest anew may cost less than removing these
            anew = 2 * len(others) > len(self._held)
        if anew:
            self._clear()
        for scan in () if anew else others:
            cast, lower, upper, _ = self._held.pop(scan)
            if not is_last:
                self._trace(cast, lower, upper, -1)
        for scan in scans:
            if scan not in self._held:
                cast = cast_of(scan)
                lower, upper = (
                    np.floor(corner / self._cell).astype(np.int64) >> _BITS
                    for corner in (cast.lower - self._margin_m, cast.upper + self._margin_m)
                )
                upper = np.maximum(upper + 1, lower)  # a region may be empty
                try:
                    self._make_room(lower, upper)
                    self._trace(cast, lower, upper, 0 if is_last else 1)
                except BaseException:  # half a scan must not stay
                    self._clear()
                    raise
                self._held[scan] = cast, lower, upper, self._stamp

    def _trace(self, cast: Cast, lower: IntArray, upper: IntArray, sign: int) -> None:
        self._stamp += 1
        points = np.ascontiguousarray(cast.points).reshape(-1)
        places = cast.map_T_places[:, :3].reshape(-1, 12)
        size, low, high, cell = (
            (x, y, z)
            for x, y, z in (
                ((upper - lower) * _EDGE).tolist(),
                (lower * _EDGE * self._cell).tolist(),
                (upper * _EDGE * self._cell).tolist(),
                self._cell.tolist(),
            )
        )
        region = Cells(False, size, low, high, cell)
        begin, change, ray = lower - self._blocks.first, (sign, self._stamp), 0
        while ray < len(cast.points):
            ray = _trace(
                points, cast.ends, places, ray, region, self._step_m, begin, change, self._blocks
            )
            if ray < len(cast.points):
                self._grow()

    def _grow(self) -> None:
        """Make room for more blocks."""
        old, size = self._blocks, len(self._blocks.counts) // _CELLS
        more = max(size // 4, _FEWEST)
        for cells in (old.counts, old.stamps) if self._counted == "scans" else (old.counts,):
            cells.resize((size + more) * _CELLS, refcheck=False)  # without a copy
        # the lowest ones are taken first, from the end: memory that was used before
        unused = np.concatenate([np.arange(size + more - 1, size - 1, -1), old.unused])
        old.left[0] += more
        self._blocks = old._replace(unused=unused.astype(np.int32))

    def _make_room(self, lower: IntArray, upper: IntArray) -> None:
        """Extend the index of blocks to a region, and release blocks that no region contains."""
        old = self._blocks
        if (lower >= old.first).all() and (upper <= old.first + old.slots.shape).all():
            return
        first = np.min([lower, *(held[1] for held in self._held.values())], axis=0)
        last = np.max([upper, *(held[2] for held in self._held.values())], axis=0)
        slots = np.full(last - first, -1, np.int32)
        low = np.maximum(first, old.first)
        high = np.maximum(np.minimum(last, old.first + old.slots.shape), low)
        kept = old.slots[tuple(map(slice, low - old.first, high - old.first))]
        slots[tuple(map(slice, low - first, high - first))] = kept
        is_unused = np.ones(len(old.counts) // _CELLS, np.bool_)
        is_unused[kept[kept >= 0]] = False
        unused = np.flatnonzero(is_unused)[::-1].astype(np.int32)
        left = np.array([len(unused)])
        self._blocks = old._replace(first=first, slots=slots, unused=unused, left=left)

    def count(self, map_T_grid: Transform, voxels: IntArray | None = None) -> Uint32Array:
        """Return the number of samples, or of scans, in each of (M,) voxels of a grid.

        Args:
            map_T_grid: (4, 4), which may mirror.
            voxels: (M,) flat indices; None: all voxels.
        """
        chosen = np.empty(0, np.int64) if voxels is None else voxels
        found = np.empty(self.spec.num_voxels if voxels is None else len(voxels), np.uint32)
        cells_T_grid = map_T_grid.copy()
        cells_T_grid[:3] /= self._cell[:, None]
        pose = as_pose(cells_T_grid)
        cells = Cells.of(self.spec)
        volume = float(self._cell.prod())
        least = 1
        if self._counted == "last":
            least = min((held[3] for held in self._held.values()), default=1)
        _gather(chosen, pose, cells, self._parts, volume, least, self._blocks, found)
        return found


@cached
def _trace(
    points: Float32Array,
    ends: IntArray,
    poses: FloatArray,
    ray: int,
    region: Cells,
    step_m: float,
    begin: IntArray,
    change: tuple[int, int],
    blocks: _Blocks,
) -> int:
    """Add the samples of rays in a region to the cells, or remove them; return the first ray for
    which there may be no room, or the number of rays.

    Args:
        points: (3 N,) metres, from the origins of the rays.
        ends: (K,) index after the last point of each origin.
        poses: (K, 12) map_T_place of the origins.
        ray: the first ray.
        region: the cells of the region, of whole blocks.
        step_m: distance between two samples, metres.
        begin: (3,) the first block of the region, counted from that of the map.
        change: what a sample adds, or 0: the cells get the stamp; and the stamp, a number that no
            scan before had. If scans are counted, each counts once in a cell.
        blocks: the blocks.
    """
    # A scan is removed with the poses, the region and the arithmetic with which it was added. So
    # the same cells change, and their counts return to what they were. Samples near the edge of a
    # cell need no exact rule therefore, unlike those of the kernel.
    _, slots, unused, left, counts, stamps = blocks
    # unsigned: Numba need not look for negative indices
    block_x = np.uint64(begin[0])
    block_y = np.uint64(begin[1])
    block_z = np.uint64(begin[2])
    bits, places, used = np.uint64(_BITS), np.empty(_MANY, np.uint64), 0
    rays, labels = empty_rays(BLOCK), np.ones(BLOCK, np.uint16)
    top_x = region.size[0] - 1.0
    top_y = region.size[1] - 1.0
    top_z = region.size[2] - 1.0
    for place in range(len(ends)):
        view = view_from(pose_of(poses, place), region)
        while ray < ends[place]:
            count = min(BLOCK, ends[place] - ray)
            clip(points[3 * ray : 3 * (ray + count)], labels[:count], step_m, view, rays)
            for i in range(count):
                x = rays.x[i]
                y = rays.y[i]
                z = rays.z[i]
                step = rays.first[i]
                last = rays.last[i]
                dx, dy, dz = rays.dx[i], rays.dy[i], rays.dz[i]
                if rays.state[i] == DROPPED or last < step:
                    continue
                # Each sample may need a block. A ray is added whole, so that it can begin again.
                if left[0] <= last - step:
                    _change(places[:used], change, counts, stamps)
                    return ray + i
                while step <= last:
                    # clipped, as rounding may put samples beyond the region
                    cell_x = np.uint64(min(max(x - step * dx, 0.0), top_x))
                    cell_y = np.uint64(min(max(y - step * dy, 0.0), top_y))
                    cell_z = np.uint64(min(max(z - step * dz, 0.0), top_z))
                    step += 1.0
                    a = (cell_x >> bits) + block_x
                    b = (cell_y >> bits) + block_y
                    c = (cell_z >> bits) + block_z
                    slot = slots[a, b, c]
                    if slot < 0:
                        left[0] -= 1
                        slot = slots[a, b, c] = unused[left[0]]
                    if used == _MANY:
                        _change(places, change, counts, stamps)
                        used = 0
                    places[used] = np.uint64(slot * _CELLS) + _in_block(cell_x, cell_y, cell_z)
                    used += 1
            ray += count
    _change(places[:used], change, counts, stamps)
    return ray


@jit
def _change(
    places: AnyArray, change: tuple[int, int], counts: Int32Array, stamps: Int32Array
) -> None:
    """Change the cells of samples."""
    # A loop of its own: the processor waits for many cells at once, as they are far from each other
    # in memory.
    sign, stamp = change
    if len(stamps):
        for place in places:
            if stamps[place] != stamp:
                stamps[place] = stamp
                counts[place] += sign
    elif sign:
        for place in places:
            counts[place] += sign
    else:
        for place in places:
            counts[place] = stamp


@inlined
def _in_block(x: Real, y: Real, z: Real) -> Real:
    """Return the index of a cell in its block."""
    last, bits = np.uint64(_EDGE - 1), np.uint64(_BITS)
    return ((((x & last) << bits) + (y & last)) << bits) + (z & last)


@inlined
def _steps(inside: float, stride: float) -> float:
    """Return the steps for which a coordinate stays in its cell, from its place in the cell."""
    return (1.0 - inside) / stride if stride >= 0.0 else inside / -stride


@jit
def _add_column(
    start: Triple,
    stride: Triple,
    least: int,
    slots: Int32Array,
    counts: Int32Array,
    column: Int32Array,
) -> None:
    """Add the counts of the cells at `start + k * stride`, in cells from the first one, to
    `column[k]`, if they are at least `least`.
    """
    end_x, end_y, end_z = slots.shape
    k = 0
    while k < len(column):
        x = start[0] + k * stride[0]
        y = start[1] + k * stride[1]
        z = start[2] + k * stride[2]
        i, j, low = math.floor(x), math.floor(y), math.floor(z)
        # The next ones are above each other, as long as the axes are almost parallel.
        more = min(_steps(x - i, stride[0]), _steps(y - j, stride[1]))
        more = min(more, _steps(z - low, stride[2] - 1.0), len(column) - k - 1.0)
        number = int(more) + 1
        a, b, end = i >> _BITS, j >> _BITS, min(low + number, end_z << _BITS)
        if 0 <= a < end_x and 0 <= b < end_y:
            cell = _in_block(np.uint64(i), np.uint64(j), np.uint64(0))
            begin = max(low, 0)
            while begin < end:
                slot = slots[a, b, begin >> _BITS]
                above = min((begin | (_EDGE - 1)) + 1, end)
                if slot >= 0:
                    first = cell + np.uint64(begin & (_EDGE - 1))
                    into = np.uint64(k + begin - low)
                    first += np.uint64(slot * _CELLS)
                    for other in range(np.uint64(above - begin)):
                        value = counts[first + other]
                        column[into + other] += value if value >= least else 0
                begin = above
        k += number


@cached
def _gather(
    voxels: IntArray,
    pose: Pose,
    cells: Cells,
    parts: tuple[int, int, int],
    volume: float,
    least: int,
    blocks: _Blocks,
    found: Uint32Array,
) -> None:
    """Sum the counts of the cells in voxels: at places that are evenly spread in each voxel.

    Args:
        voxels: (M,) flat indices; empty: all voxels. Those above each other are read together.
        pose: cells_T_grid.
        cells: the grid.
        parts: number of cells along the edges of a voxel.
        volume: of a cell.
        least: smaller counts are 0.
        blocks: the blocks.
        found: (M,) or (V,) output.
    """
    across, along, up = parts
    size, voxel_size, first = cells.size, cells.voxel_size, blocks.first
    columns, row = np.empty(size[2] * up, np.int32), 0
    rise = voxel_size[2] / up
    stride = pose[2] * rise, pose[6] * rise, pose[10] * rise
    while row < len(found):
        voxel = voxels[row] if len(voxels) else row
        i = voxel // (size[1] * size[2])
        j = voxel // size[2] % size[1]
        k = voxel % size[2]
        height, weight, many = 1, 1.0, along
        while (
            row + height < len(found)
            and k + height < size[2]
            and (len(voxels) == 0 or voxels[row + height] == voxel + height)
        ):
            height += 1
        if cells.cylindrical and along > 1:
            # about one place in the width of each cell, as in x, but not too many
            wide = (cells.lower[0] + (i + 0.5) * voxel_size[0]) * voxel_size[1]
            many = int(min(max(math.ceil(along * wide / voxel_size[0]), 1.0), 8.0 * along))
            weight = wide * voxel_size[0] * voxel_size[2] / (across * many * up * volume)
        column = columns[: height * up]
        column[:] = 0
        for a in range(across):
            u = cells.lower[0] + (i + (a + 0.5) / across) * voxel_size[0]
            for b in range(many):
                x = u
                y = cells.lower[1] + (j + (b + 0.5) / many) * voxel_size[1]
                if cells.cylindrical:
                    x, y = u * math.cos(y), u * math.sin(y)
                x, y, z = transform(pose, x, y, cells.lower[2] + (k + 0.5 / up) * voxel_size[2])
                start = x - (first[0] << _BITS), y - (first[1] << _BITS), z - (first[2] << _BITS)
                _add_column(start, stride, least, blocks.slots, blocks.counts, column)
        for k in range(height):
            total = 0
            for part in range(k * up, (k + 1) * up):
                total += column[part]
            # rays passed through the voxel: it does not become unknown by rounding
            found[row + k] = max(round(total * weight), 1) if total > 0 else 0
        row += height
