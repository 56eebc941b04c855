"""Scenes: frames of a sequence with a grid, its ground truth, points, boxes and pose, all in one
class table.

Pictures, pages, recordings and windows take a `Scene` and read it with a `SceneReader`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from carlasc.core.axes import mirror_boxes, mirror_poses, mirror_scan, mirror_spec, mirror_voxels
from carlasc.core.boxes import Boxes
from carlasc.core.classes import ClassTable
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.geometry import Transform
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.scans import Scan
from carlasc.core.tables import TABLES
from carlasc.errors import ArgumentError, MissingDataError, check_choice
from carlasc.metrics.grids import check_same_geometry, compare_grids
from carlasc.storage.field_files import check_velocity
from carlasc.storage.metadata import Axes
from carlasc.viewing.colors import ACTORS, ERRORS, PALETTES, ClassColors, PaletteName, actor_ids
from carlasc.viewing.finding import (
    FoundSequence,
    RemappedSequence,
    SceneSource,
    choose_grid,
    common_table,
    describe_frames,
    find_sequence,
    find_truth,
    frames_with,
    list_fields,
    table_of,
)
from carlasc.viewing.photos import Photo, photos_of

CONTENTS = ("grid", "scan", "flow", "truth", "errors")
"""The contents of a frame that a picture can show."""


@dataclass(frozen=True)
class Scene:
    """The frames of a sequence to show, and the classes and colours. Nothing is read before `open`.

    Attributes:
        source: a path or URL that `carlasc.open` takes, a grid's folder, the file of one frame, a
            Source or a Sequence.
        sequence: path or name of the sequence, if the source has several. None: the first.
        frames: range of frame numbers; None takes all.
        every: show only every N-th frame.
        grid: name of the grid. None: evaluation, or the first grid.
        truth: ground truth of the source, which is then shown as a prediction with its errors. It
            may be anything that the source may be.
        truth_grid: name of the grid with the ground truth. None: as for `grid`.
        classes: class table to show, such as "carlasc11" (the paper's eleven). None: that of the
            data, or that of the ground truth if only its classes are common to both.
        source_classes: class table of the labels in the source, if its metadata do not name it:
            carla, carlasc11, and so on.
        palette: "class": the colours of the class table. "colorblind": colours for colour-blind
            readers. "height": colours by height, only for pictures.

    Raises:
        ArgumentError: an unknown class table or palette, an invalid range of frames, or `every`
            below 1.
    """

    source: SceneSource
    _: KW_ONLY
    sequence: str | None = None
    frames: Frames = None
    every: int = 1
    grid: str | None = None
    truth: SceneSource | None = None
    truth_grid: str | None = None
    classes: ClassTable | str | None = None
    source_classes: ClassTable | str | None = None
    palette: PaletteName = "class"

    def __post_init__(self) -> None:
        FrameRange.of(self.frames)
        if self.every < 1:
            raise ArgumentError("every", expected="1 or more", found=str(self.every))
        check_choice("palette", self.palette, PALETTES)
        for name, table in (("classes", self.classes), ("source_classes", self.source_classes)):
            if isinstance(table, str):
                check_choice(name, table, TABLES)

    def open(self, what: str | Iterable[str] | None = None) -> SceneReader:
        """Find the sequence, the grids, the frames and a common class table.

        Args:
            what: names from `CONTENTS`, or one string of them separated by commas; only frames that
                have all of them are taken. None takes the grid, with a ground truth also the truth
                and the errors; or the scan if there is no grid.

        Raises:
            ArgumentError: an unknown content, one that needs a ground truth, or classes that cannot
                be shown in one table.
            MissingDataError: a sequence, grid or frame does not exist.
            FormatError: the data do not have the format.
        """
        found = find_sequence(self.source, self.sequence)
        truth = None if self.truth is None else find_truth(self.truth, found.sequence)
        contents = self._default_contents(found) if what is None else self._check_contents(what)
        grid = choose_grid(found, self.grid) if {"grid", "errors"} & set(contents) else ""
        data = RemappedSequence(found.sequence, grid, stored=table_of(self.source_classes))
        reference = None
        if truth is not None:
            reference = RemappedSequence(truth.sequence, choose_grid(truth, self.truth_grid))
            if "errors" in contents:
                check_same_geometry(data.spec, reference.spec)
        table = common_table(data, reference, table_of(self.classes))
        data = replace(data, shown=table)
        reference = None if reference is None else replace(reference, shown=table)
        frames = self._choose_frames(found, frames_with(data, reference, contents))
        notes = () if found.note is None else (found.note,)
        return SceneReader(data, reference, contents, frames, self.palette, notes)

    def _default_contents(self, found: FoundSequence) -> tuple[str, ...]:
        has_grid = self.grid is not None or found.grid is not None or self.truth is not None
        has_grid = has_grid or (bool(found.sequence.grids) and not found.is_scan)
        if has_grid:
            return ("grid",) if self.truth is None else ("grid", "truth", "errors")
        if "points" in found.sequence.fields():
            return ("scan",)
        raise MissingDataError(
            found.sequence.location, expected="a grid or points", found=list_fields(found.sequence)
        )

    def _check_contents(self, what: str | Iterable[str]) -> tuple[str, ...]:
        contents = tuple(what.split(",") if isinstance(what, str) else what)
        for name in contents:
            if name not in CONTENTS:
                raise ArgumentError(
                    "what", expected=f"one or more of {', '.join(CONTENTS)}", found=repr(name)
                )
            if name in ("truth", "errors") and self.truth is None:
                raise ArgumentError(
                    "what", problem=f"{name} needs a ground truth", advice="give it with `truth`"
                )
        if not contents:
            raise ArgumentError(
                "what", expected=f"one or more of {', '.join(CONTENTS)}", found="nothing"
            )
        return contents

    def _choose_frames(self, found: FoundSequence, available: NDArray[np.int64]) -> tuple[int, ...]:
        frames = FrameRange.of(self.frames)
        if self.frames is None and found.frame is not None:
            frames = FrameRange(found.frame, found.frame + 1)
        chosen = frames.select(available)[:: self.every]
        if not len(chosen):
            raise MissingDataError(
                found.sequence.location,
                expected=f"frames {frames}",
                found=describe_frames(available),
                advice="choose others with `frames`",
            )
        return tuple(int(frame) for frame in chosen)


def as_scene(source: Scene | SceneSource) -> Scene:
    """Return a Scene as it is, and the scene of all frames of anything else."""
    return source if isinstance(source, Scene) else Scene(source)


@dataclass(frozen=True)
class GridPanel:
    """One of the grids that are shown side by side.

    Attributes:
        title: "prediction", "truth", "errors"; or the size of the grid if there is only one;
            "actors" for its voxels by actor.
        spec: geometry.
        colors: colours of its labels.
        name: "prediction", "truth", "errors"; or "grid" if there is only one; "actors".
    """

    title: str
    spec: GridSpec
    colors: ClassColors
    name: str = "grid"


@dataclass(frozen=True)
class FrameContent:
    """The contents of one frame.

    Attributes:
        grids: one for each panel of the scene. In the panel "errors", labels are outcomes
            (`carlasc.metrics.VoxelOutcome`); in the panel "actors", ids of
            `carlasc.viewing.colors.ACTORS`.
        scan: the points, with labels, flow and instances where the sequence has them; None if the
            frame has no points.
        time_s: seconds since the first frame, or None if the sequence has no times.
        boxes: tracked boxes, sensor frame; None where the frame was not annotated.
        pose: (4, 4) first_T_sensor, or None if the sequence has no poses.
    """

    grids: tuple[Grid, ...]
    scan: Scan | None
    time_s: float | None
    boxes: Boxes | None = None
    pose: Transform | None = None


@dataclass(frozen=True, eq=False)
class SceneReader:
    """Reads the frames of a scene. It holds no open files and can be sent to other processes.

    Attributes:
        data: the sequence.
        truth: the ground truth to compare its grid with, or None.
        contents: names from `CONTENTS`.
        frames: the frame numbers.
        palette: "class", "colorblind" or "height".
        notes: choices that were made for options that were not given, one sentence each.
        mirrored: whether y is mirrored (see `right_handed`).
        by_actor: whether a further panel shows the voxels of the grid by actor (see `with_actors`).
    """

    data: RemappedSequence
    truth: RemappedSequence | None
    contents: tuple[str, ...]
    frames: tuple[int, ...]
    palette: PaletteName = "class"
    notes: tuple[str, ...] = ()
    mirrored: bool = False
    by_actor: bool = False

    @property
    def name(self) -> str:
        """Name of the sequence, such as "Town01_Light", after its split if it has one."""
        sequence = self.data.sequence
        name = sequence.name or sequence.path or sequence.location
        return f"{sequence.split} / {name}" if sequence.split else name

    @property
    def path(self) -> str:
        """Path of the sequence in its source, or its location."""
        return self.data.sequence.path or self.data.sequence.location

    @property
    def axes(self) -> Axes:
        """The handedness of all data: "left" if y points to the right of the vehicle."""
        return "right" if self.mirrored else self.data.sequence.metadata.axes

    @property
    def left_handed(self) -> bool:
        """Whether y points to the right of the vehicle."""
        return self.axes == "left"

    def right_handed(self) -> SceneReader:
        """Return a reader of the same frames in right-handed axes (y to the left), for programs
        that need these.
        """
        return replace(self, mirrored=True) if self.left_handed else self

    def with_actors(self) -> SceneReader:
        """Return a reader of the same frames that also shows the voxels by actor, if the grid has
        the field `actors`.
        """
        return replace(self, by_actor=self.has(f"{self.data.grid}/instance"))

    def has(self, field: str) -> bool:
        """Whether some frame of the sequence has a field, such as "points" or "flow" (see
        `carlasc.storage.layout`).
        """
        return field in self.data.sequence.fields()

    @property
    def table(self) -> ClassTable:
        """The class table of all grids and points."""
        return self.data.shown or self.data.stored_table

    @cached_property
    def colors(self) -> ClassColors:
        """The colours of the classes."""
        return ClassColors(self.table, self.palette)

    @cached_property
    def panels(self) -> tuple[GridPanel, ...]:
        """The grids that are shown side by side; empty if only points are shown."""
        if not self.data.grid:
            return ()
        spec = mirror_spec(self.data.spec) if self.mirrored else self.data.spec
        panels = [GridPanel(str(spec), spec, self.colors)]
        if self.truth is not None:
            panels = [GridPanel(name, spec, self.colors, name) for name in ("prediction", "truth")]
            panels.append(GridPanel("errors", spec, ClassColors(ERRORS), "errors"))
        if self.by_actor:
            panels.append(GridPanel("actors", spec, ClassColors(ACTORS), "actors"))
        return tuple(panels)

    def read(self, frame: int) -> FrameContent:
        """Read a frame.

        Raises:
            FormatError: the data do not have the format.
        """
        scan = self.read_scan(frame)
        boxes = scan.boxes if scan is not None else self.data.read_boxes(frame)
        if scan is None and self.mirrored and boxes is not None:
            boxes = mirror_boxes(boxes)
        return FrameContent(
            self._read_grids(frame), scan, self.read_time(frame), boxes, self.read_pose(frame)
        )

    def read_scan(self, frame: int) -> Scan | None:
        """Read the points of a frame with all of their fields, without those that are not finite;
        None if it has no points.

        Raises:
            FormatError: the data do not have the format.
        """
        if frame not in self.data.sequence.frames("points"):
            return None
        scan = self.data.read_scan(frame)
        return mirror_scan(scan) if self.mirrored else scan

    @property
    def has_motion(self) -> bool:
        """Whether motion is known: the flow of points, or the velocity of voxels."""
        return self.has("flow") or self.has(f"{self.data.grid}/velocity")

    def read_motion(self, frame: int, scan: Scan | None) -> Scan | None:
        """Return the moving points of a frame with flow, or the centres of moving voxels if points
        have no flow; None if motion is not known.

        Raises:
            FormatError: the data do not have the format.
        """
        if scan is not None and scan.flow is not None:
            return scan.select(np.linalg.norm(scan.flow, axis=1) > 0)
        data, name = self.data, f"{self.data.grid}/velocity"
        if not data.grid or frame not in data.frames_with(name):
            return None
        moving = data.sequence.read(name, frame)
        check_velocity(
            moving, data.spec.num_voxels, f"{data.sequence.location}: {name} of frame {frame}"
        )
        points = data.spec.from_axes(data.spec.centers().reshape(-1, 3)[moving["voxel"]]).astype(
            np.float32
        )
        labels, actors = (
            a.reshape(-1)[moving["voxel"]]
            for a in (data.read_grid(frame).labels, self._instances(frame))
        )
        found = Scan(
            points, labels.astype(np.uint32), moving["velocity"].astype(np.float32), actors
        )
        return mirror_scan(found) if self.mirrored else found

    def read_time(self, frame: int) -> float | None:
        """Return the seconds since the first frame, or None if the sequence has no times."""
        try:
            return self.data.sequence.read_time(frame)
        except MissingDataError:
            return None

    def read_pose(self, frame: int) -> Transform | None:
        """Return (4, 4) first_T_sensor of a frame, or None if neither the sequence nor its ground
        truth has poses.

        Raises:
            FormatError: the frame has no line in the file of poses, or its line is not a rigid
                transform.
        """
        found = (data.read_pose(frame) for data in (self.data, self.truth) if data is not None)
        pose = next((pose for pose in found if pose is not None), None)
        return mirror_poses(pose) if self.mirrored and pose is not None else pose

    def path_of_ego(self) -> NDArray[np.float64]:
        """Return the (F, 3) positions of the sensor in all frames, metres in the frame of the first
        scan; none without poses.
        """
        poses = [pose for pose in map(self.read_pose, self.frames) if pose is not None]
        return np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3)

    def read_picture(self, frame: int) -> bytes | None:
        """Return the bird's-eye camera picture of a frame as its JPEG bytes, or None if it has
        none.

        Raises:
            FormatError: the data do not have the format.
        """
        if frame not in self.data.sequence.frames("bev"):
            return None
        return self.data.sequence.read("bev", frame).tobytes()

    def _instances(self, frame: int) -> NDArray[np.uint32]:
        """Return the number of the actor of each voxel, in the shape of the grid; 0 without one."""
        if frame not in self.data.frames_with(f"{self.data.grid}/instance"):
            return np.zeros(self.data.spec.size, np.uint32)
        return self.data.read_part("instance", frame)

    def read_photos(self, frame: int) -> tuple[Photo, ...]:
        """Read the images of a frame; cameras without one are left out."""
        return photos_of(self.data.sequence, frame, self.mirrored)

    def _read_grids(self, frame: int) -> tuple[Grid, ...]:
        if not self.data.grid:
            return ()
        grids = [self.data.read_grid(frame)]
        if self.truth is not None:
            truth = self.truth.read_grid(frame)
            grids += [truth, Grid(truth.spec, compare_grids(grids[0], truth), truth.counts)]
        if self.by_actor:
            ids = actor_ids(self._instances(frame))
            grids.append(
                replace(grids[0], labels=np.where(grids[0].labels > 0, ids, 0).astype(np.uint8))
            )
        return tuple(map(mirror_voxels, grids) if self.mirrored else grids)
