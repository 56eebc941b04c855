"""Drawings, the parts of a picture: a grid in the colours of its classes or of its evidence, a
scan, scene flow or the errors of a prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from carlasc.core.arrays import AnyArray, AnyFloatArray, BoolArray, FloatArray, IntArray, Uint8Array
from carlasc.core.choices import Axes
from carlasc.core.choices import GridColor as GridColor  # noqa: PLC0414 (part of this module)
from carlasc.core.grids import Grid, GridSpec, VoxelFlag
from carlasc.core.scans import Scan
from carlasc.errors import ArgumentError, FormatError, MissingDataError, check_choice
from carlasc.metrics.grids import VoxelOutcome, compare_grids
from carlasc.viewing import colors as palette
from carlasc.viewing.actor_lines import MOVING_M_S, motion_arrows
from carlasc.viewing.colors import AFTER_CLASSES, ERRORS, ClassColors, Entry, as_color
from carlasc.viewing.rendering.cameras import Camera
from carlasc.viewing.rendering.meshes import (
    QuadMesh,
    arrows,
    box,
    footprint,
    grid_mesh,
    join,
    quads,
)
from carlasc.viewing.rendering.raycasting import cast, empty_canvas, splat
from carlasc.viewing.scene import RemappedSequence, SceneReader, without_invalid_points

Extent = FloatArray
"""(N, 3) float64 points, metres, that a camera fitted to the drawing shows."""

_FLOOR = (240, 240, 243)
VELOCITY = Entry("velocity (distance in 1 s)", palette.ARROW, AFTER_CLASSES)


@dataclass(frozen=True)
class Drawing:
    """A mesh and points with colours, and a legend for them.

    Attributes:
        extent: (N, 3) points, metres, that a camera fitted to the drawing shows.
        mesh: faces, or None.
        points: (N, 3) metres, or None.
        point_colors: (N, 3) uint8 RGB of the points, or None.
        legend: the meaning of the colours.
        note: a line of text in the picture, for example if the grid is empty; or None.
    """

    extent: Extent
    mesh: QuadMesh | None = None
    points: AnyFloatArray | None = None
    point_colors: Uint8Array | None = None
    legend: list[Entry] = field(default_factory=list)
    note: str | None = None

    def with_mesh(self, mesh: QuadMesh, entry: Entry) -> Drawing:
        """Return the drawing with further faces and their entry in the legend."""
        meshes = [mesh] if self.mesh is None else [self.mesh, mesh]
        return replace(self, mesh=join(meshes), legend=[*self.legend, entry])

    def render(self, camera: Camera, width: int, height: int, *, axes: Axes = "left") -> Uint8Array:
        """Return the picture, (H, W, 3) uint8, without legend or title.

        Args:
            camera: the camera.
            width: W, pixels.
            height: H, pixels.
            axes: handedness of the data.
        """
        canvas = empty_canvas(width, height)
        if self.mesh is not None:
            cast(self.mesh, camera, canvas, axes=axes)
        if self.points is not None and self.point_colors is not None:
            splat(self.points, self.point_colors, camera, canvas)
        return canvas.resolve()


def grid_extent(spec: GridSpec) -> Extent:
    """Return the corners of the floor and of the ceiling of a grid."""
    return np.concatenate(
        [footprint(spec, height).reshape(-1, 3) for height in (spec.lower[2], spec.upper[2])]
    ).astype(np.float64)


def scan_extent(scan: Scan) -> Extent:
    """Return the corners of a box that contains the sensor and most points, at most 40 m from the
    sensor.
    """
    lower = np.array([-5.0, -5.0, -2.0])
    upper = np.array([5.0, 5.0, 0.0])
    if len(scan):
        lower, upper = (np.quantile(scan.points, share, axis=0) for share in (0.03, 0.97))
    side = np.array([5.0, 5.0, 0.0])  # the sensor and its surroundings are always in the picture
    lower, upper = np.clip([np.minimum(lower, -side), np.maximum(upper, side)], -40, 40)
    corners = np.array(list(np.ndindex(2, 2, 2)))
    return lower + corners * (upper - lower)


def grid_drawing(grid: Grid, colors: ClassColors, *, ego: bool = True) -> Drawing:
    """Return the occupied voxels of a grid, without free and unknown ones: coloured by class; by
    height if the data have no classes.

    Args:
        grid: the grid.
        colors: colours of the classes.
        ego: whether a plain car is drawn at the sensor.

    Raises:
        FormatError: a label is not in the class table.
    """
    colors.table.check(grid.labels, "grid labels")
    occupied = grid.labels > 0
    ids = np.flatnonzero(np.bincount(grid.labels.reshape(-1), minlength=1))
    if not colors.tell_shapes(ids):
        low = grid.spec.lower[2]
        high = grid.spec.upper[2]
        layers = palette.height_colors(grid.spec.centers()[0, 0, :, 2], low, high)
        voxel_colors = np.broadcast_to(layers, (*grid.spec.size, 3))
        legend = palette.height_entries(low, high)
    else:
        voxel_colors = colors.by_id[grid.labels]
        legend = colors.entries(ids.tolist())
    return voxel_drawing(grid.spec, voxel_colors, occupied, legend, "no voxel is occupied", ego)


def error_drawing(prediction: Grid, truth: Grid, *, ego: bool = True) -> Drawing:
    """Return the errors of a prediction, in voxels that the ground truth knows: right, wrong class,
    missed or invented.

    Args:
        prediction: the predicted grid.
        truth: the true grid, with the same geometry.
        ego: whether a plain car is drawn at the sensor.

    Raises:
        ArgumentError: the grids differ in their geometry.
    """
    outcomes = compare_grids(prediction, truth)
    colors = ClassColors(ERRORS)
    legend = [
        entry._replace(order=AFTER_CLASSES + entry.order) for entry in colors.entries(ERRORS.names)
    ]
    empty = "no known voxel is occupied in either"
    return voxel_drawing(
        truth.spec,
        colors.by_id[outcomes],
        outcomes != VoxelOutcome.NOT_COMPARED,
        legend,
        empty,
        ego,
    )


def scan_drawing(
    scan: Scan, colors: ClassColors, *, extent: Extent | None = None, ego: bool = True
) -> Drawing:
    """Return the points of a scan, coloured by class; by height if the data have no classes, or the
    palette is "height".

    Args:
        scan: the scan.
        colors: colours of the classes.
        extent: what the picture shows; None takes most of the points.
        ego: whether a plain car is drawn at the sensor.

    Raises:
        FormatError: a label is not in the class table.
    """
    points = without_invalid_points(scan)
    extent = scan_extent(points) if extent is None else extent
    ids = (
        np.zeros(0, np.int64)
        if points.labels is None
        else np.flatnonzero(np.bincount(points.labels))
    )
    if points.labels is None or not colors.tell_shapes(ids):
        low = float(extent[:, 2].min())
        high = float(extent[:, 2].max())
        point_colors = palette.height_colors(points.points[:, 2], low, high)
        legend = palette.height_entries(low, high)
    else:
        colors.table.check(points.labels, "scan labels")
        unlabelled = [Entry("unlabelled", palette.UNLABELLED, -1)] if 0 in ids else []
        point_colors = colors.of_points(points)
        legend = unlabelled + colors.entries(ids.tolist())
    note = None if len(points) else "the scan has no point"
    car = ego_vehicle() if ego else None
    return Drawing(extent, car, points.points, point_colors, legend, note)


def flow_drawing(
    scan: Scan, colors: ClassColors, *, extent: Extent | None = None, ego: bool = True
) -> Drawing:
    """Return a scan with moving points in the colour of their class, static ones in grey, and an
    arrow for each moving actor.

    An arrow is as long as the distance that its actor moves in one second.

    Args:
        scan: the scan, with flow.
        colors: colours of the classes.
        extent: what the picture shows; None takes most of the points.
        ego: whether a plain car is drawn at the sensor.

    Raises:
        FormatError: the scan has no flow, or a label is not in the class table.
    """
    if scan.flow is None:
        raise FormatError(
            "scan",
            expected="the field flow",
            found="none",
            advice="choose other contents with `what`",
        )
    points = without_invalid_points(scan)
    extent = scan_extent(points) if extent is None else extent
    flow = np.asarray(points.flow)
    moving = np.linalg.norm(flow, axis=1) > MOVING_M_S
    point_colors = np.full((len(points), 3), palette.STATIC, np.uint8)
    legend = [Entry("standing", palette.STATIC, -1)]
    if points.labels is not None:
        colors.table.check(points.labels, "scan labels")
        point_colors[moving] = colors.by_id[points.labels[moving]]
        legend += colors.entries(np.unique(points.labels[moving]).tolist())
    note = None if moving.any() else "nothing moves"
    drawing = Drawing(
        extent, ego_vehicle() if ego else None, points.points, point_colors, legend, note
    )
    return with_arrows(drawing, points.select(moving))


def with_arrows(drawing: Drawing, moving: Scan | None) -> Drawing:
    """Return a drawing with the arrows of moving points or voxels; None if nothing moves."""
    if moving is None or not len((ends := motion_arrows(moving))[0]):
        return drawing
    return drawing.with_mesh(arrows(*ends, palette.ARROW, 0.24), VELOCITY)


def voxel_drawing(
    spec: GridSpec,
    voxel_colors: Uint8Array,
    occupied: BoolArray,
    legend: list[Entry],
    empty: str,
    ego: bool,
) -> Drawing:
    """Return voxels above the floor of their grid.

    Args:
        spec: geometry of the grid.
        voxel_colors: (*spec.size, 3) uint8 RGB.
        occupied: (*spec.size) bool, the voxels that are drawn.
        legend: the meaning of the colours.
        empty: note for a grid without any such voxel.
        ego: whether the ego vehicle is drawn.
    """
    floor = quads(footprint(spec, spec.lower[2] - 2e-3), _FLOOR, open_sky=True)
    meshes = [
        grid_mesh(spec, voxel_colors, occupied, on_floor=True),
        floor,
        *([ego_vehicle()] if ego else []),
    ]
    return Drawing(
        grid_extent(spec), join(meshes), legend=legend, note=None if occupied.any() else empty
    )


def ego_vehicle() -> QuadMesh:
    """Return a plain car under the sensor, which is mounted 0.5 m behind the middle of the car, 1.8
    m above the ground.

    See the format page, `docs/format.md#coordinate-frame`.
    """
    body = box((-1.75, -0.95, -1.62), (2.75, 0.95, -0.98), palette.EGO)
    windows = box((-1.55, -0.88, -0.98), (1.55, 0.88, -0.5), palette.GLASS, taper=0.28)
    roof = box((-1.27, -0.6, -0.5), (1.27, 0.6, -0.42), palette.EGO)
    return join([body, windows, roof])


def check_color(color: GridColor, reader: SceneReader) -> None:
    """Check that the grid of each frame has the field of its colours.

    Raises:
        ArgumentError: an unknown colour, or no grid is shown.
        MissingDataError: a frame lacks the field.
    """
    check_choice("color", color, GridColor)
    if color == "class":
        return
    if "grid" not in reader.contents:
        raise ArgumentError("color", expected="class where no grid is shown", found=repr(color))
    data = reader.data
    frames = reader.frames
    evidence = EVIDENCE[color]
    field = f"{data.grid}/{evidence.part}"
    missing = sorted(set(frames) - data.frames_with(field))
    if missing:
        keep = f"make the grid again with `carlasc regrid --keep-{evidence.kept_by}`"
        raise MissingDataError(
            data.sequence.location,
            expected=f"the field {field} in all frames that are shown",
            found=f"none in {len(missing)} of {len(frames)} frames, such as frame {missing[0]}",
            advice=keep if evidence.kept_by else "",
        )


@dataclass(frozen=True)
class Evidence:
    """What the colours of a grid show, other than classes.

    Attributes:
        part: the field of the grid.
        kept_by: the option of regrid that keeps the field; "" if all grids have it.
        legend: all classes of values, so that it is the same in all frames.
        classify: returns the number of the class of each value: its place in `colors`.
    """

    part: str
    kept_by: str
    legend: list[Entry]
    classify: Callable[[AnyArray], AnyArray]

    @property
    def colors(self) -> Uint8Array:
        """(K, 3) uint8 RGB of the classes of values."""
        if self.part == "instance":
            return palette.ACTORS.palette
        return np.array([entry.color for entry in self.legend], np.uint8)


def _scale(unit: str, names: Sequence[str]) -> list[Entry]:
    """Return a legend of rising values, from dark to light."""
    colors = palette.height_colors(np.linspace(0.0, 1.0, len(names)), 0, 1)
    return [
        Entry(name if number else unit + name, as_color(rgb), number)
        for number, (name, rgb) in enumerate(zip(names, colors, strict=True))
    ]


def _origin_of(flags: AnyArray) -> IntArray:
    seen = np.where(flags & VoxelFlag.SEEN_NOW, 0, 1)
    scanned = np.where(flags & VoxelFlag.CONTESTED, 2, seen)
    return np.where(flags & VoxelFlag.INFERRED, 3, scanned)


def _power_of(numbers: AnyArray) -> AnyArray:
    powers = np.floor(np.log2(np.maximum(numbers.astype(np.float64), 1)))
    return np.minimum(powers, len(_NUMBERS) - 1).astype(np.int64)


# upper bounds of the classes of probabilities, except for the last one
_BOUNDS = (0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
_SHARES = [f"{low * 100:.0f} to {high:.0%}" for low, high in pairwise(_BOUNDS)]
_SHARES = [f"up to {_BOUNDS[0]:.0%}", *_SHARES, f"over {_BOUNDS[-1]:.0%}"]
_NUMBERS = ["1", "2 to 3", "4 to 7", "8 to 15", "16 to 31", "32 to 63", "64 and more"]
_GREY = (190, 196, 204)
_BLUE = (0, 114, 178)
_ORANGE = (230, 110, 0)
_ORIGINS = [
    Entry("seen in this frame", _BLUE, 0),
    Entry("seen in other frames", _GREY, 1),
    Entry("contested: traffic passes at other times", (204, 121, 167), 2),
    Entry("inferred: no scan saw it", _ORANGE, 3),
]
_ACTORS = [
    Entry("no actor", palette.STATIC),
    Entry("an actor, each in a colour of its own", palette.ACTORS.colors[2], 1),
]
_CAMERAS = [
    Entry("no camera sees it", _GREY),
    Entry("one camera", _BLUE, 1),
    Entry("several cameras", _ORANGE, 2),
]
EVIDENCE = {
    "confidence": Evidence(
        "occupied",
        "evidence",
        _scale("occupied: ", _SHARES),
        lambda values: np.digitize(values.astype(np.float64), _BOUNDS),
    ),
    "views": Evidence("views", "evidence", _scale("scans: ", _NUMBERS), _power_of),
    "votes": Evidence("counts", "", _scale("votes: ", _NUMBERS), _power_of),
    "inferred": Evidence("flags", "evidence", _ORIGINS, _origin_of),
    "actor": Evidence("instance", "actors", _ACTORS, palette.actor_ids),
    "seen": Evidence(
        "seen", "seen", _CAMERAS, lambda values: np.minimum(np.bitwise_count(values), 2)
    ),
}
"""By `GridColor`, except for "class"."""


def evidence_drawing(
    data: RemappedSequence, frame: int, color: GridColor, *, ego: bool = True
) -> Drawing:
    """Return the occupied voxels of a grid, coloured by evidence.

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
    evidence = EVIDENCE[color]
    colors = evidence.colors[evidence.classify(data.read_part(evidence.part, frame))]
    empty = "no voxel is occupied"
    return voxel_drawing(grid.spec, colors, grid.labels > 0, evidence.legend, empty, ego)
