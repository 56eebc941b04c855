"""Labels from images: a copy of a data set whose points have the classes of the pixels that show
them, with probabilities.

Each point is projected into the images of its own frame and of frames around it. An image counts if
it shows the point: no voxel of the merged grid hides the point, and no points of the scan of the
image's frame do. A moving point is projected into the images of its own frame only, at its position
when the image was taken.
"""

from __future__ import annotations

import os
import time
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cameras import CameraModel
from carlasc.core.classes import ClassTable
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.core.grids import GridSpec
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.sequences import ScanSequence
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.labelling_motion import find_moving, points_of_actors
from carlasc.groundtruth.options import FromScans, Voting
from carlasc.groundtruth.seen import see_points
from carlasc.motion import ground_points
from carlasc.motion.tracks import MovingActors
from carlasc.running.processes import one_pool
from carlasc.running.spreading import Run
from carlasc.storage import as_source, layout
from carlasc.storage.camera_files import cameras_of, scan_T_camera
from carlasc.storage.derived_copies import DerivedSequence, sequences_with_scans
from carlasc.storage.labelling import LabelResult, begin_labelled, checked_name, reader_for
from carlasc.storage.metadata import PREDICTED
from carlasc.storage.pixel_classes import PixelClasses
from carlasc.storage.predictions import PredictionReader, read_table
from carlasc.storage.protocol import Sequence, Source

_WRITTEN = ("labels", "probabilities")

# Chosen on two simulated drives: see docs/howto/cameras.md.
# frames of images, relative to the frame of a point
_OFFSETS = (
    0,
    -3,
    3,
    -6,
    6,
    -10,
    10,
    -15,
    15,
    -20,
    20,
)
_OTHER = np.float32(0.02)  # weight of images of other frames
_BEHIND_VOXELS = np.float32(0.25)  # weight of images of the own frame, for points behind voxels
_KEPT_BYTES = 1 << 28  # of images
_CELL_PX = 4.0  # least side of the cells in which points of a scan hide other points
_FILLED = 1.0  # mean number of points of a scan in a cell
# points that hide another are nearer by this share of the depth, and this distance
_NEARER, _NEARER_M = (
    0.04,
    0.3,
)
_HEIGHT_M = 1.5  # approximate height of a camera above the ground
_REACH_CELLS = 2  # cells on each side that are searched for such points
_RING = 0.5  # weight of all pixels around the pixel of a point, relative to this pixel
# cells of a scan in which points that no image shows get the classes of others
_NEAR_M = (
    0.25,
    0.5,
    1.0,
    2.0,
)
_NEAR = np.float32(0.02)  # the probability of such a class
_EDGE = 2.0  # power of the agreement of a pixel with the pixels around it, which is its weight


def label_images(
    source: str | os.PathLike[str] | Source,
    out: str | os.PathLike[str],
    *,
    pixels: str | os.PathLike[str] | None = None,
    classes: str | os.PathLike[str] | ClassTable | None = None,
    by: str | None = None,
    observe: FromScans = FromScans(),  # noqa: B008 (frozen)
    overwrite: bool = False,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> LabelResult:
    """Write a copy of a data set whose points have the classes of the pixels that show them.

    The source is not changed.

    Points that no image shows get the class of scans without labels, with a probability of nearly
    0: they show that a voxel is occupied, and other scans show its class. Grids are left out. Files
    that do not change are hard links to those of the source, where both are folders of one file
    system: do not edit such files in place. An interrupted run leaves `<out>.part`; the same call
    again finishes it.

    Args:
        source: the data set with points and cameras: anything that `carlasc.open` takes, or a
            source.
        out: the folder to write: a path, or a URL of an object store.
        pixels: a folder with the classes of pixels, `<sequence>/<camera>/000000.png` (ids of
            classes) or `.npy`: (H, W) ids, or (H, W, C) probabilities by id; for a single sequence
            the folders of cameras may lie in the folder itself. None: `image_labels` of the source.
        classes: class table of the pixels: its name, a JSON file, or a table; None for the one of
            each sequence. As in `carlasc.label`.
        by: source of the classes of pixels, such as a network; None for the name of the folder
            `pixels`, or "images".
        observe: which scans are merged into the grid that hides points, how moving points are
            found, and where poses come from.
        overwrite: replace a data set at `out` that `label` has made.
        run: how the work is spread. Steps of progress are files.

    Returns:
        The files that were written.

    Raises:
        ArgumentError: `classes` or `by` is not valid.
        ConflictError: something exists at `out`, or `out` lies inside `source`, or an interrupted
            run had other options.
        MissingDataError: there are no scans, no cameras, or no classes of their pixels.
        FormatError: classes of pixels do not fit the class table or the camera, or poses or times
            are not valid.
        StorageError: the files cannot be written.
    """
    began = time.perf_counter()
    by = checked_name(
        ("images" if pixels is None else Path(pixels).resolve().name) if by is None else by
    )
    table = None if classes is None else read_table(classes)
    source = as_source(source)
    given = sequences_with_scans(source)
    found = {
        path: PixelClasses.find(one, None if pixels is None else Path(pixels))
        for path, one in given.items()
    }
    plan = GridPlan(GridSpec.published(), layout.EVALUATION, observe, Voting(), FrameRange())
    numbered = replace(plan, voting=Voting(keep_actors=True))
    inputs = {path: ScanSequence(one, numbered, observe) for path, one in given.items()}
    for one in inputs.values():
        _ = one.feed.motion  # raises errors before anything is written
    digest = blake2b(
        repr([one.stamps() for one in found.values()]).encode(errors="surrogateescape"),
        digest_size=16,
    )
    settings: dict[str, Any] = {"observe": repr(observe), "by": by, "pixels": digest.hexdigest()}
    settings |= {"classes": None if table is None else table.to_dict()}
    copy = begin_labelled(source, out, settings, overwrite, run)
    labelled = dict[str, _ShownSequence]()
    with one_pool(run) as pool:
        for path, one in inputs.items():
            find_moving(one, copy.writer(path), replace(pool, progress=None), lambda steps: None)
            painter = Painter(
                plan,
                one.feed,
                one.actors,
                found[path],
                reader_for(table, given[path], logits=False),
            )
            labelled[path] = _ShownSequence(given[path], painter, by)
        copied = copy.write(labelled, pool)
    return LabelResult(
        **vars(copied) | {"elapsed_s": time.perf_counter() - began},
        by=by,
        classes=", ".join(sorted({one.painter.reader.target.name for one in labelled.values()})),
        frames=sum(len(one.frames("labels")) for one in labelled.values()),
    )


class _ShownSequence(DerivedSequence):
    """A sequence with classes from images."""

    def __init__(self, whole: Sequence, painter: Painter, by: str) -> None:
        target = painter.reader.target
        metadata = replace(
            whole.metadata,
            classes=target,
            extra={**whole.metadata.extra, "labels": f"{PREDICTED}{by}"},
        )
        # their classes are of the other table
        stale = {"boxes"} if target != whole.metadata.classes else set()
        made = dict.fromkeys(_WRITTEN, whole.frames("points"))
        super().__init__(whole, {layout.METADATA: metadata.to_json()}, made=made, stale=stale)
        self.painter = painter

    def make(self, frame: int) -> dict[str, NDArray[Any]]:
        """Return the classes and the probabilities of a frame."""
        return dict(zip(_WRITTEN, self.painter.paint(frame), strict=True))


class _ClassImage(NamedTuple):
    """An image of classes.

    Attributes:
        camera: the camera.
        world_T_camera: (4, 4) pose of the camera.
        seconds: time of the image after the scan of its frame.
        ids: (H, W) classes of pixels.
        sure: (H, W) float16, probabilities of the classes; None: 1.
        nearest: (rows, columns) depth of the nearest point of the scan in each cell, metres,
            infinite without one.
        cell_px: side of a cell.
    """

    camera: CameraModel
    world_T_camera: Transform
    seconds: float
    ids: NDArray[Any]
    sure: NDArray[np.float16] | None
    nearest: NDArray[np.float64]
    cell_px: float


@dataclass(frozen=True)
class Painter:
    """Gives points the classes of pixels.

    Attributes:
        plan: geometry of the merged grid.
        feed: the scans of the sequence.
        actors: the moving actors, with numbers.
        pixels: the classes of pixels.
        reader: the class tables of the pixels and of the result.
        key: copies with the same key share images within a process.
    """

    plan: GridPlan
    feed: ScanFeed
    actors: MovingActors
    pixels: PixelClasses
    reader: PredictionReader
    key: str = field(default_factory=lambda: uuid4().hex)

    def paint(self, frame: int) -> tuple[NDArray[np.uint32], NDArray[np.uint16]]:
        """Return the (N,) classes of the points of a scan, and the (N, 6) field `probabilities`."""
        sums = self.sums(frame)
        shares = sums / np.maximum(sums.sum(axis=1, keepdims=True), np.float32(1e-6))
        _fill_from_neighbours(shares, self.feed.sequence.scan(frame, ()).points)
        shown = shares.any(axis=1)
        other = self.reader.target.geometry_id
        labels, pairs = np.full(len(sums), other, np.uint32), np.zeros((len(sums), 6), np.uint16)
        pairs[:, :2] = other, 1
        where = f"{self.feed.sequence.location}: images of frame {frame}"
        pairs[shown] = self.reader.pairs(shares[shown], where)
        labels[shown] = pairs[shown, 0]
        return labels, pairs

    def sums(self, frame: int, offsets: tuple[int, ...] = _OFFSETS) -> NDArray[np.float32]:
        """Return the (N, C) weights of classes that images give to each point of a scan, by id in
        the table of the pixels.

        Args:
            frame: the scan.
            offsets: frames of the images, relative to it.
        """
        feed, spec = self.feed, self.plan.spec
        pose, points = feed.pose(frame), feed.sequence.scan(frame, ()).points.astype(np.float64)
        flow = points_of_actors(feed, self.actors.between(frame, frame), frame)[1].astype(
            np.float64
        )
        moves = flow.any(axis=1)
        window = feed.reaching(frame, spec)
        first, last = feed.options.window
        near = self.actors.between(frame + first, frame + last)
        solid = merge_frame(self.plan, feed, near, frame, window).grid.labels > 0
        sums = np.zeros((len(points), max(self.reader.classes.names) + 1), np.float32)
        for offset in offsets:
            for photo in self._photos(frame + offset):
                frame_T_camera = invert(pose) @ photo.world_T_camera
                rows = np.flatnonzero(~moves) if offset else np.arange(len(points))
                then = points[rows] + (0 if offset else flow * photo.seconds)
                in_camera = transform_points(invert(frame_T_camera), then)
                pixels = photo.camera.project(in_camera)
                kept = np.flatnonzero(photo.camera.contains(pixels))
                kept = kept[~_hidden(photo, pixels[kept], in_camera[kept, 2])]
                weights = see_points(then[kept], solid, spec, frame_T_camera[:3, 3]).astype(
                    np.float32
                )
                # Points of a scan hide its own points more exactly than voxels do, which are larger
                # than their content.
                weights = weights * _OTHER if offset else np.maximum(weights, _BEHIND_VOXELS)
                _add(sums, rows[kept], weights, photo, np.rint(pixels[kept]).astype(np.int64))
        return sums

    def _photos(self, frame: int) -> Iterator[_ClassImage]:
        """Yield the images of a frame. The images of the frames that were read last are kept."""
        key = (self.key, frame)
        if key not in _PHOTOS:
            _PHOTOS[key] = list(self._read_photos(frame))
            while (
                len(_PHOTOS) > 1
                and sum(photo.ids.nbytes for kept in _PHOTOS.values() for photo in kept)
                > _KEPT_BYTES
            ):
                _PHOTOS.popitem(last=False)
        _PHOTOS.move_to_end(key)
        yield from _PHOTOS[key]

    def _read_photos(self, frame: int) -> Iterator[_ClassImage]:
        sequence = self.feed.sequence
        if frame not in self.feed.frames:
            return
        points, pose = sequence.scan(frame, ()).points.astype(np.float64), self.feed.pose(frame)
        for camera in cameras_of(sequence).values():
            if not self.pixels.has(camera.name, frame):
                continue
            place = scan_T_camera(sequence, camera, frame)
            if place is None:
                continue
            ids, sure, where = (
                self.pixels.read(camera, frame),
                None,
                f"{sequence.location}: {camera.name}, frame {frame}",
            )
            if ids.ndim == 3:
                shares = self.reader.probabilities(ids.reshape(-1, ids.shape[2]), where).reshape(
                    ids.shape
                )
                ids, sure = (
                    shares.argmax(axis=2).astype(np.uint16),
                    shares.max(axis=2).astype(np.float16),
                )
            self.reader.check(np.unique(ids), where)
            times = camera.times
            late = 0.0
            if times is not None and layout.TIMES in sequence.documents():
                late = float(
                    times[sequence.line_of(frame, len(times), layout.TIMES)]
                ) - sequence.read_time(frame)
            in_camera = transform_points(invert(place), points)
            pixels = camera.project(in_camera)
            inside = camera.contains(pixels)
            nearest, cell = _nearest(camera, pixels[inside], in_camera[inside, 2])
            yield _ClassImage(camera, pose @ place, late, ids, sure, nearest, cell)


# of this process, the last used at the end
_PHOTOS: OrderedDict[tuple[str, int], list[_ClassImage]] = OrderedDict()


def _nearest(
    camera: CameraModel, pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Return the depth of the nearest point in each cell of an image, metres, infinite without one,
    and the side of a cell, pixels.
    """
    area = camera.width * camera.height
    cell = max(_CELL_PX, float(np.sqrt(_FILLED * area / max(len(pixels), 1))))
    shape = int(camera.height // cell) + 1, int(camera.width // cell) + 1
    nearest = np.full(shape, np.inf)
    columns, rows = _cells(pixels, cell)
    np.minimum.at(nearest, (rows, columns), depths)
    return nearest, cell


def _cells(pixels: NDArray[np.float64], cell_px: float) -> NDArray[np.int64]:
    return ((pixels + 0.5) // cell_px).astype(np.int64).T


def _hidden(
    photo: _ClassImage, pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return which points have nearer ones around them in an image: in their cell, to the left and
    the right, or above and below.
    """
    padded = np.pad(photo.nearest, _REACH_CELLS, constant_values=np.inf)
    columns, rows = _cells(pixels, photo.cell_px) + _REACH_CELLS
    # of flat ground in a cell
    across = np.square(depths) * photo.cell_px / (photo.camera.matrix[1, 1] * _HEIGHT_M)
    limit = depths * (1 - _NEARER) - _NEARER_M - across

    def nearer(down: int, right: int) -> NDArray[np.bool_]:
        steps = range(1, _REACH_CELLS + 1)
        near = [padded[rows + step * down, columns + step * right] for step in steps]
        return np.asarray(np.min(near, axis=0) < limit)

    own = padded[rows, columns] < limit
    return np.asarray(own | (nearer(0, -1) & nearer(0, 1)) | (nearer(-1, 0) & nearer(1, 0)))


def _add(
    sums: NDArray[np.float32],
    rows: NDArray[np.int64],
    weights: NDArray[np.float32],
    photo: _ClassImage,
    pixels: NDArray[np.int64],
) -> None:
    """Add the classes of the pixels at some points to the weights.

    A pixel that disagrees with the pixels around it has less weight.
    """
    height, width = photo.ids.shape
    votes = np.zeros((len(rows), sums.shape[1]), np.float32)
    each = np.arange(len(rows))
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            weight = np.float32(1 if down == right == 0 else _RING / 8)
            at = (
                np.clip(pixels[:, 1] + down, 0, height - 1),
                np.clip(pixels[:, 0] + right, 0, width - 1),
            )
            votes[each, photo.ids[at]] += weight if photo.sure is None else weight * photo.sure[at]
    votes[:, 0] = 0  # pixels without a class
    total = votes.sum(axis=1, keepdims=True)
    agreement = votes.max(axis=1, keepdims=True) / np.maximum(total, np.float32(1e-6))
    sums[rows] += votes * weights[:, None] * agreement**_EDGE


def _fill_from_neighbours(shares: NDArray[np.float32], points: NDArray[np.floating]) -> None:
    """Give points that no image shows the shares of classes of other points in the same cell, the
    smallest cell with such points.

    Ground and other points are kept apart.
    """
    ground = ground_points(points)
    for side in _NEAR_M:
        cells = np.floor(points / side).astype(np.int64)
        _, place = np.unique(cells @ [1 << 41, 1 << 21, 2] + ground, return_inverse=True)
        shown = shares.any(axis=1)
        likely = np.zeros((place.max(initial=-1) + 1, shares.shape[1]), np.float32)
        np.add.at(likely, place[shown], shares[shown])
        likely *= _NEAR / np.maximum(likely.sum(axis=1, keepdims=True), np.float32(1e-6))
        shares[~shown] = likely[place[~shown]]
