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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from carlasc.core.arrays import (
    AnyArray,
    AnyFloatArray,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
)
from carlasc.core.cameras import CameraModel
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.errors import FormatError, MissingDataError, check_types, reading
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.sequences import ScanSequence
from carlasc.groundtruth.options import FromScans, Voting
from carlasc.groundtruth.seen import see_points
from carlasc.motion import ground_points
from carlasc.relabelling.copies import (
    PREDICTED_FIELDS,
    LabelResult,
    PredictedSequence,
    begin_predicted,
    digest_of_files,
    write_in_stages,
)
from carlasc.relabelling.from_motion import points_of_actors, scan_sequences_of
from carlasc.relabelling.predictions import PredictionReader
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import as_source, layout
from carlasc.storage.arrays import NUMBERS, ArrayFormat, read_npy
from carlasc.storage.camera_files import (
    cameras_of,
    decode_image,
    image_fields,
    read_image,
    scan_T_camera,
)
from carlasc.storage.class_files import read_classes
from carlasc.storage.derived_copies import sequences_with_scans
from carlasc.storage.files import AnyPath
from carlasc.storage.protocol import Sequence, SequenceWriter, Source
from carlasc.storage.shares import Share

_SUFFIXES = (".png", ".npy")
_FIELD = "image_labels"  # of the layout

# Chosen on two simulated drives: see docs/howto/cameras.md.
# frames of images, relative to the frame of a point
_OFFSETS = (0, -3, 3, -6, 6, -10, 10, -15, 15, -20, 20)
_OTHER = np.float32(0.02)  # weight of images of other frames
_BEHIND_VOXELS = np.float32(0.25)  # weight of images of the own frame, for points behind voxels
_KEPT_BYTES = 1 << 28  # of images
_CELL_PX = 4.0  # least side of the cells in which points of a scan hide other points
_FILLED = 1.0  # mean number of points of a scan in a cell
# points that hide another are nearer by this share of the depth, and this distance
_NEARER = 0.04
_NEARER_M = 0.3
_HEIGHT_M = 1.5  # approximate height of a camera above the ground
_REACH_CELLS = 2  # cells on each side that are searched for such points
_RING = 0.5  # weight of all pixels around the pixel of a point, relative to this pixel
# cells of a scan in which points that no image shows get the classes of others
_NEAR_M = (0.25, 0.5, 1.0, 2.0)
_NEAR = np.float32(0.02)  # the probability of such a class
_EDGE = 2.0  # power of the agreement of a pixel with the pixels around it, which is its weight


def label_images(
    source: AnyPath | Source,
    out: AnyPath,
    *,
    pixels: AnyPath | None = None,
    classes: AnyPath | ClassTable | None = None,
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
    check_types(label_images, locals())
    began = time.perf_counter()
    root = None if pixels is None else Path(pixels)
    by = by if by is not None else "images" if root is None else root.resolve().name
    table = None if classes is None else read_classes(classes)[0]
    share = Share(as_source(source), run)
    given = sequences_with_scans(share)
    shown = {path: PixelClasses.find(one, root) for path, one in given.items()}
    inputs = scan_sequences_of(given, observe)
    files = (path for one in shown.values() for path in one.paths())
    settings = {"observe": repr(observe), "pixels": digest_of_files(files), "by": by}
    copy = begin_predicted(share, out, settings, table, overwrite, run)

    def find(
        path: str, writer: SequenceWriter | None, pool: Run, step: StepCounter
    ) -> _ShownSequence:
        inputs[path].prepare(writer, pool, lambda steps: None)
        reader = PredictionReader.of(table, given[path], logits=False)
        return _ShownSequence(inputs[path], shown[path], reader, by)

    labelled, copied = write_in_stages(copy, given, find, share.run, scans=0, made=PREDICTED_FIELDS)
    return LabelResult.of(copied, began, by, labelled.values())


@dataclass(frozen=True)
class PixelClasses:
    """The classes of the pixels of the images of one sequence.

    Attributes:
        sequence: the sequence.
        files: the files by camera and frame; None for the files of the layout.
    """

    sequence: Sequence
    files: Mapping[str, Mapping[int, Path]] | None

    @classmethod
    def find(cls, sequence: Sequence, root: Path | None) -> PixelClasses:
        """Find the files with classes of pixels of a sequence.

        Args:
            sequence: a sequence with cameras.
            root: a folder with `<sequence>/<camera>/000000.png` or `.npy`, or `<camera>/000000.png`
                for a single sequence; None uses the `image_labels` of the sequence.

        Raises:
            MissingDataError: the sequence has no cameras, or no classes of pixels exist.
            FormatError: two folders belong to the same camera, or a camera has no calibration.
        """
        cameras = cameras_of(sequence)
        if not cameras:
            raise MissingDataError(
                sequence.location, expected=f"cameras in {layout.CAMERAS}", found="none"
            )
        files = None if root is None else _files(sequence, root)
        known = image_fields(sequence, _FIELD).keys() if files is None else files.keys()
        if lost := sorted(known - cameras.keys()):
            raise FormatError(
                root or sequence.location,
                expected=f"cameras of {layout.CAMERAS}: {', '.join(cameras)}",
                found=f"{lost[0]}, which has no calibration",
            )
        if not known:
            example = f"{sequence.name}/{next(iter(cameras))}/000000.png"
            advice = "give the folder of a network's predictions as `pixels`"
            raise MissingDataError(
                root or f"{sequence.location}/{_FIELD}",
                expected=f"classes of pixels, such as {example}",
                found="none",
                advice=advice if root is None else "",
            )
        return cls(sequence, files)

    def read(self, camera: CameraModel, frame: int) -> AnyArray | None:
        """Return (H, W) integers, class ids, or (H, W, C) floats, the probability of each id; None
        without classes of the image.

        Raises:
            FormatError: the file is damaged, or has another size than the camera's images.
        """
        if self.files is None:
            field = image_fields(self.sequence, _FIELD).get(camera.name)
            if field is None or frame not in self.sequence.frames(field):
                return None
            return read_image(self.sequence, camera, frame, _FIELD)
        path = self.files.get(camera.name, {}).get(frame)
        if path is None:
            return None
        if path.suffix == ".png":
            with reading(path, "a file that can be read"):
                data = path.read_bytes()
            return decode_image(data, str(path), camera, color=False)
        array = read_npy(path, ArrayFormat(NUMBERS, None))
        size = (camera.height, camera.width)
        is_float = array.dtype.kind == "f"
        if array.ndim != 2 + is_float or array.shape[:2] != size:
            raise FormatError(
                path,
                expected=f"{size} integers, or {size} floats per class, as camera {camera.name} is "
                f"calibrated",
                found=f"{array.dtype.name} of shape {array.shape}",
            )
        return array

    def paths(self) -> list[Path]:
        """Return the files; none for those of the layout, which belong to the source."""
        return sorted(path for files in (self.files or {}).values() for path in files.values())


def _files(sequence: Sequence, root: Path) -> dict[str, dict[int, Path]]:
    """Return the files by camera and frame: those below a folder with the name of the sequence; if
    there are none, those in folders of cameras in the root.
    """
    named: dict[str, dict[int, Path]] = {}
    unnamed: dict[str, dict[int, Path]] = {}
    for folder, _, names in os.walk(root):
        paths = {
            frame: Path(folder, name)
            for name in names
            for suffix in _SUFFIXES
            if (frame := layout.frame_of(name, suffix)) is not None
        }
        parts = Path(folder).relative_to(root).parts
        is_named = sequence.name in parts[:-1]
        if paths and (is_named or len(parts) == 1):
            mine = named if is_named else unnamed
            if parts[-1] in mine:
                raise FormatError(folder, expected=f"one folder of camera {parts[-1]}", found="two")
            mine[parts[-1]] = paths
    return named or unnamed


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
    ids: AnyArray
    sure: NDArray[np.float16] | None
    nearest: FloatArray
    cell_px: float

    def hides(self, pixels: FloatArray, depths: FloatArray) -> BoolArray:
        """Return which points have nearer ones around them: in their cell, to the left and the
        right, or above and below.
        """
        padded = np.pad(self.nearest, _REACH_CELLS, constant_values=np.inf)
        columns, rows = _cells(pixels, self.cell_px) + _REACH_CELLS
        # depth of flat ground in a cell: points of one surface do not hide each other
        across = np.square(depths) * self.cell_px / (self.camera.matrix[1, 1] * _HEIGHT_M)
        limit = depths * (1 - _NEARER) - _NEARER_M - across

        def nearer(down: int, right: int) -> BoolArray:
            steps = range(1, _REACH_CELLS + 1)
            near = [padded[rows + step * down, columns + step * right] for step in steps]
            return np.asarray(np.min(near, axis=0) < limit)

        own = padded[rows, columns] < limit
        return np.asarray(own | (nearer(0, -1) & nearer(0, 1)) | (nearer(-1, 0) & nearer(1, 0)))

    def votes(self, pixels: FloatArray, classes: int) -> tuple[Float32Array, Float32Array]:
        """Return (N, C) votes for the classes of the pixels at and around (N, 2) positions, and
        (N, 1) weights: pixels that disagree with those around them have less.
        """
        height, width = self.ids.shape
        columns, rows = np.rint(pixels).astype(np.int64).T
        votes = np.zeros((len(pixels), classes), np.float32)
        each = np.arange(len(pixels))
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                weight = np.float32(1 if down == right == 0 else _RING / 8)
                at = np.clip(rows + down, 0, height - 1), np.clip(columns + right, 0, width - 1)
                votes[each, self.ids[at]] += weight if self.sure is None else weight * self.sure[at]
        votes[:, 0] = 0  # pixels without a class
        return votes, (votes.max(axis=1, keepdims=True) / _totals(votes)) ** _EDGE


# of this process, by the key of the feed and the frame; the last used at the end
_IMAGES: OrderedDict[tuple[str, int], list[_ClassImage]] = OrderedDict()


class _ShownSequence(PredictedSequence):
    """A sequence whose points have the classes of the pixels that show them."""

    def __init__(
        self, inputs: ScanSequence, pixels: PixelClasses, reader: PredictionReader, by: str
    ) -> None:
        """Wrap a sequence.

        Args:
            inputs: the scans, and the moving actors with numbers.
            pixels: the classes of pixels.
            reader: the class tables of the pixels and of the result.
            by: source of the classes of pixels.
        """
        made = dict.fromkeys(PREDICTED_FIELDS, inputs.sequence.frames("points"))
        super().__init__(inputs.sequence, reader.target, by, made)
        self.plan = replace(inputs.plan, voting=Voting())
        self.feed = inputs.feed
        self.actors = inputs.actors
        self.pixels = pixels
        self.reader = reader

    def make(self, frame: int) -> dict[str, AnyArray]:
        """Return the classes of the points of a scan, and their field `probabilities`."""
        points = self.feed.sequence.scan(frame, ()).points
        shares = self._weigh(frame, points.astype(np.float64))
        shares /= _totals(shares)
        _fill_from_neighbours(shares, points)
        shown = shares.any(axis=1)
        pairs = np.zeros((len(shares), 6), np.uint16)
        pairs[:, :2] = self.reader.target.geometry_id, 1
        where = f"{self.location}: images of frame {frame}"
        pairs[shown] = self.reader.pairs(shares[shown], where)
        return {"labels": pairs[:, 0].astype(np.uint32), "probabilities": pairs}

    def _weigh(self, frame: int, points: FloatArray) -> Float32Array:
        """Return the (N, C) weights of classes that images give to each point of a scan, by id in
        the table of the pixels.
        """
        feed = self.feed
        spec = self.plan.spec
        pose = self.feed.pose(frame)
        flow = points_of_actors(feed, self.actors.between(frame, frame), frame)[1].astype(
            np.float64
        )
        first, last = feed.options.window
        near = self.actors.between(frame + first, frame + last)
        merged = merge_frame(self.plan, feed, near, frame, feed.reaching(frame, spec))
        solid = merged.grid.labels > 0
        sums = np.zeros((len(points), max(self.reader.classes.names) + 1), np.float32)
        for offset in _OFFSETS:
            rows = np.flatnonzero(~flow.any(axis=1)) if offset else np.arange(len(points))
            for image in self._images(frame + offset):
                frame_T_camera = invert(pose) @ image.world_T_camera
                then = points[rows] + (0 if offset else flow * image.seconds)
                in_camera = transform_points(invert(frame_T_camera), then)
                pixels = image.camera.project(in_camera)
                kept = np.flatnonzero(image.camera.contains(pixels))
                kept = kept[~image.hides(pixels[kept], in_camera[kept, 2])]
                weights = see_points(then[kept], solid, spec, frame_T_camera[:3, 3]).astype(
                    np.float32
                )
                # Points of a scan hide its own points more exactly than voxels do, which are larger
                # than their content.
                weights = weights * _OTHER if offset else np.maximum(weights, _BEHIND_VOXELS)
                votes, agreement = image.votes(pixels[kept], sums.shape[1])
                sums[rows[kept]] += votes * weights[:, None] * agreement
        return sums

    def _images(self, frame: int) -> list[_ClassImage]:
        """Return the images of a frame. The images of the frames that were read last are kept."""
        key = (self.feed.key, frame)
        if key not in _IMAGES:
            _IMAGES[key] = list(self._read_images(frame))
            while (
                len(_IMAGES) > 1
                and sum(image.ids.nbytes for kept in _IMAGES.values() for image in kept)
                > _KEPT_BYTES
            ):
                _IMAGES.popitem(last=False)
        _IMAGES.move_to_end(key)
        return _IMAGES[key]

    def _read_images(self, frame: int) -> Iterator[_ClassImage]:
        sequence = self.feed.sequence
        if frame not in self.feed.frames:
            return
        points = sequence.scan(frame, ()).points.astype(np.float64)
        pose = self.feed.pose(frame)
        for camera in cameras_of(sequence).values():
            place = scan_T_camera(sequence, camera, frame)
            ids = None if place is None else self.pixels.read(camera, frame)
            if place is None or ids is None:
                continue
            sure = None
            where = f"{sequence.location}: {camera.name}, frame {frame}"
            if ids.ndim == 3:
                shares = self.reader.probabilities(ids.reshape(-1, ids.shape[2]), where)
                shares = shares.reshape(ids.shape)
                sure = shares.max(axis=2).astype(np.float16)
                ids = shares.argmax(axis=2).astype(np.uint16)
            self.reader.check(np.unique(ids), where)
            late = 0.0
            if camera.times is not None and layout.TIMES in sequence.documents():
                line = sequence.line_of(frame, len(camera.times), layout.TIMES)
                late = float(camera.times[line]) - sequence.read_time(frame)
            in_camera = transform_points(invert(place), points)
            pixels = camera.project(in_camera)
            inside = camera.contains(pixels)
            # the least cells that hold a point of the scan on average
            area_px = _FILLED * camera.width * camera.height / max(int(inside.sum()), 1)
            cell = max(_CELL_PX, float(np.sqrt(area_px)))
            shape = int(camera.height // cell) + 1, int(camera.width // cell) + 1
            nearest = np.full(shape, np.inf)
            np.minimum.at(nearest, tuple(_cells(pixels[inside], cell)[::-1]), in_camera[inside, 2])
            yield _ClassImage(camera, pose @ place, late, ids, sure, nearest, cell)


def _totals(votes: Float32Array) -> Float32Array:
    """Return the (N, 1) sums of (N, C) votes, never 0, to divide by."""
    return np.maximum(votes.sum(axis=1, keepdims=True), np.float32(1e-6))


def _cells(pixels: FloatArray, cell_px: float) -> IntArray:
    """Return (2, N) the column and the row of the cell of each pixel."""
    return ((pixels + 0.5) // cell_px).astype(np.int64).T


def _fill_from_neighbours(shares: Float32Array, points: AnyFloatArray) -> None:
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
        likely *= _NEAR / _totals(likely)
        shares[~shown] = likely[place[~shown]]
