"""Scenes: frames of a sequence with a grid, its ground truth, points, boxes and pose, all in one
class table.

Pictures, pages, recordings and windows take a `Scene` and read it with a `SceneReader`.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from carlasc.core.arrays import AnyArray, FloatArray, IntArray, LabelArray, Uint32Array
from carlasc.core.boxes import Boxes, mirror_boxes
from carlasc.core.choices import Axes
from carlasc.core.classes import ClassTable, TableUse
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.geometry import Transform, check_rigid, mirror_poses
from carlasc.core.grids import Grid, GridSpec, mirror_spec, mirror_voxels
from carlasc.core.scans import Scan, mirror_scan
from carlasc.core.tables import remaps_between, to_table
from carlasc.errors import (
    ArgumentError,
    FormatError,
    MissingDataError,
    check_choice,
    check_types,
    first_names,
)
from carlasc.metrics.grids import check_same_geometry, compare_grids
from carlasc.storage import Sequence, Source, as_source, layout
from carlasc.storage.class_files import read_classes
from carlasc.storage.field_files import check_velocity
from carlasc.storage.files import AnyPath
from carlasc.storage.folder import FolderSequence
from carlasc.storage.voxel_files import VoxelSequence, find_voxels
from carlasc.viewing.colors import ACTORS, ERRORS, PALETTES, ClassColors, PaletteName, actor_ids
from carlasc.viewing.photos import Photo, photos_of

SceneSource = AnyPath | Source | Sequence
"""The source of a scene: anything that `carlasc.open` takes, a grid's folder, the file of one
frame, a Source or a Sequence.
"""

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
            carla, carlasc11, and so on, or a JSON or YAML file.
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
    classes: ClassTable | AnyPath | None = None
    source_classes: ClassTable | AnyPath | None = None
    palette: PaletteName = "class"

    def __post_init__(self) -> None:
        check_types(Scene, vars(self))
        FrameRange.of(self.frames)
        if self.every < 1:
            raise ArgumentError("every", expected="1 or more", found=self.every)
        check_choice("palette", self.palette, PALETTES)
        for name, table in (("classes", self.classes), ("source_classes", self.source_classes)):
            table_of(table, name)

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
        part = find_sequence(self.source, self.sequence)
        given = table_of(self.source_classes)
        if isinstance(part.sequence, VoxelSequence) and given is not None:
            part = replace(part, sequence=part.sequence.with_classes(given))
            given = None
        truth = None if self.truth is None else find_sequence(self.truth, part.sequence)
        contents = self._default_contents(part) if what is None else self._check_contents(what)
        grid = choose_grid(part, self.grid) if {"grid", "errors"} & set(contents) else ""
        data = RemappedSequence(part.sequence, grid, stored=given)
        reference = None
        if truth is not None:
            reference = RemappedSequence(truth.sequence, choose_grid(truth, self.truth_grid))
            if isinstance(part.sequence, VoxelSequence) and grid:
                part.sequence.follow(grid, truth.sequence, reference.grid)
            if "errors" in contents:
                check_same_geometry(data.spec, reference.spec)
        table = common_table(data, reference, table_of(self.classes))
        data = replace(data, shown=table)
        reference = None if reference is None else replace(reference, shown=table)
        frames = self._choose_frames(part, frames_with(data, reference, contents))
        notes = () if part.note is None else (part.note,)
        return SceneReader(data, reference, contents, frames, self.palette, notes)

    def _default_contents(self, part: NamedPart) -> tuple[str, ...]:
        named = self.grid or part.grid or self.truth is not None
        if named or (part.sequence.grids and not part.is_scan):
            return ("grid",) if self.truth is None else ("grid", "truth", "errors")
        if "points" in part.sequence.fields():
            return ("scan",)
        raise MissingDataError(
            part.sequence.location, expected="a grid or points", found=list_fields(part.sequence)
        )

    def _check_contents(self, what: str | Iterable[str]) -> tuple[str, ...]:
        contents = tuple(what.split(",") if isinstance(what, str) else what)
        unknown = [name for name in contents if name not in CONTENTS]
        if unknown or not contents:
            raise ArgumentError(
                "what",
                expected=f"one or more of {', '.join(CONTENTS)}",
                found=repr(unknown[0]) if unknown else "nothing",
            )
        compared = [name for name in contents if name in ("truth", "errors")]
        if compared and self.truth is None:
            raise ArgumentError(
                "what",
                problem=f"{compared[0]} needs a ground truth",
                advice="give it with `truth`",
            )
        return contents

    def _choose_frames(self, part: NamedPart, available: IntArray) -> tuple[int, ...]:
        frames = FrameRange.of(self.frames)
        if self.frames is None and part.frame is not None:
            frames = FrameRange(part.frame, part.frame + 1)
        chosen = frames.select(available)[:: self.every]
        if not len(chosen):
            raise MissingDataError(
                part.sequence.location,
                expected=f"frames {frames}",
                found=describe_frames(available),
                advice="choose others with `frames`",
            )
        return tuple(int(frame) for frame in chosen)


def as_scene(source: Scene | SceneSource) -> Scene:
    """Return a Scene as it is, and the scene of all frames of anything else."""
    return source if isinstance(source, Scene) else Scene(source)


@dataclass(frozen=True, eq=False)
class NamedPart:
    """The part of a source that its path names: a sequence, and perhaps its grid or frame.

    Attributes:
        sequence: the sequence.
        grid: name of the grid, if the path is a grid's folder or a file in it.
        frame: frame number, if the path is the file of one frame.
        is_scan: whether the path is a file of a scan (points, labels, ...).
        note: the choice among several sequences, or None.
    """

    sequence: Sequence
    grid: str | None = None
    frame: int | None = None
    is_scan: bool = False
    note: str | None = None


def find_sequence(source: SceneSource, wanted: str | Sequence | None = None) -> NamedPart:
    """Find a sequence in a source.

    Args:
        source: see `SceneSource`.
        wanted: path or name of the sequence in the source; or the sequence of a prediction, whose
            ground truth is the sequence with its path, with its name, or the only one. None takes
            the first.

    Raises:
        MissingDataError: there is no sequence, or none of that name.
        FormatError: the source cannot be read.
    """
    if isinstance(source, Sequence):
        return NamedPart(source)
    if (part := _open_part(source)) is not None:
        return part
    opened = as_source(source)
    where = opened.location
    sequences = opened.sequences()
    if not sequences:
        raise MissingDataError(where, expected="a sequence", found="none")
    path, first = next(iter(sequences.items()))
    if wanted is None:
        note = f"{where}: {len(sequences)} sequences found, showing the first, {path}"
        return NamedPart(first, note=note if len(sequences) > 1 else None)
    if isinstance(wanted, Sequence):
        if len(sequences) == 1:
            return NamedPart(first)
        path = wanted.path
        name = wanted.name
        coordinates = wanted.coordinates
        expected = f"the sequence {name} ({coordinates})"
        advice = "give the folder of the sequence"
    else:
        path = wanted
        name = wanted
        coordinates = None
        expected = f"the sequence {name}"
        advice = ""
    same_name = (
        sequence
        for sequence in sequences.values()
        if sequence.name == name and coordinates in (None, sequence.coordinates)
    )
    match = sequences.get(path) or next(same_name, None)
    if match is None:
        raise MissingDataError(
            where, expected=expected, found=first_names(sequences), advice=advice
        )
    return NamedPart(match)


def _open_part(source: AnyPath | Source) -> NamedPart | None:
    """Open a grid's folder or the file of one frame, in the folder of a grid or of one of a scan's
    fields; None if the source is neither.
    """
    if isinstance(source, Source):
        return None
    path = Path(source).absolute()
    folder = path.parent
    if (path / layout.PARAMS).is_file():
        return NamedPart(FolderSequence(folder), grid=path.name)
    if not path.is_file() or path.suffix not in (".label", ".bin"):
        return None
    frame = layout.frame_of(path.name, path.suffix)
    is_scan = folder.name in layout.scan_folders()
    if frame is None or not (is_scan or (folder / layout.PARAMS).is_file()):
        if find_voxels(path) is not None:
            return None
        raise FormatError(
            path,
            expected=f"a file named by its frame number (six digits), in a folder of scans or "
            f"beside {layout.PARAMS}",
            found="another file",
            advice=f"the geometry of a grid is in its {layout.PARAMS}",
        )
    return NamedPart(
        FolderSequence(folder.parent), None if is_scan else folder.name, frame, is_scan
    )


def table_of(classes: ClassTable | AnyPath | None, name: str = "classes") -> ClassTable | None:
    """Return a class table, which may be given by its name or its file."""
    return None if classes is None else read_classes(classes, name)[0].with_free_first


def choose_grid(part: NamedPart, name: str | None) -> str:
    """Return the requested grid, the grid in the path, `evaluation`, or the first grid."""
    names = list(part.sequence.grids)
    usual = layout.EVALUATION if layout.EVALUATION in names else next(iter(names), None)
    wanted = name or part.grid or usual or layout.EVALUATION
    if wanted not in names:
        raise MissingDataError(
            part.sequence.location,
            expected=f"the grid {wanted}",
            found=", ".join(names) or "no grid",
        )
    return wanted


def common_table(
    data: RemappedSequence, truth: RemappedSequence | None, wanted: ClassTable | None
) -> ClassTable:
    """Return the class table for all labels: the requested one, that of the data, or that of the
    ground truth.
    """
    stored = [own.stored_table for own in (data, truth) if own is not None]
    *candidates, last = stored if wanted is None else [wanted]
    for target in candidates:
        with suppress(ArgumentError):  # labels of one of the tables cannot be shown in this one
            for table in stored:
                remaps_between(table, target)
            return target
    for table in stored:
        remaps_between(table, last)
    return last


def frames_with(
    data: RemappedSequence, truth: RemappedSequence | None, contents: tuple[str, ...]
) -> IntArray:
    """Return the frames that have all contents."""
    own = {"scan": ("points",), "flow": ("points", "flow"), "truth": ()}
    needed = [
        (data.sequence, name) for c in contents for name in own.get(c, (f"{data.grid}/labels",))
    ]
    if truth is not None and {"truth", "errors"} & set(contents):
        needed.append((truth.sequence, f"{truth.grid}/labels"))
    frames: IntArray | None = None
    for sequence, name in needed:
        available = sequence.frames(name)
        if not len(available):
            raise MissingDataError(
                sequence.location, expected=f"the field {name}", found=list_fields(sequence)
            )
        common = available if frames is None else np.intersect1d(frames, available)
        if frames is not None and not len(common):
            raise MissingDataError(
                sequence.location,
                expected=f"{name} of frames {describe_frames(frames)}",
                found=f"frames {describe_frames(available)}",
            )
        frames = common
    return np.empty(0, np.int64) if frames is None else frames


def list_fields(sequence: Sequence) -> str:
    """Return the names of the fields of a sequence, for a message."""
    return ", ".join(sorted(sequence.fields())) or "nothing"


def describe_frames(frames: IntArray) -> str:
    """Return the first and the last of some frames and their number, for a message."""
    return f"{frames[0]} to {frames[-1]} ({len(frames)} frames)"


@dataclass(frozen=True, eq=False)
class RemappedSequence:
    """A sequence whose labels are read as classes of another table.

    Attributes:
        sequence: where frames are read from.
        grid: name of the grid that is read; "" for none.
        stored: class table of the labels in the sequence; None takes those in the metadata of the
            grid and of the scans.
        shown: class table in which labels are returned; None leaves them as they are stored.
    """

    sequence: Sequence
    grid: str
    stored: ClassTable | None = None
    shown: ClassTable | None = None

    @property
    def spec(self) -> GridSpec:
        """Geometry of the grid."""
        return self.sequence.grids[self.grid]

    @property
    def stored_table(self) -> ClassTable:
        """Class table of the grid's labels as stored, or of the scans' if no grid is read."""
        if self.stored is not None or not self.grid:
            return self.scan_table
        return self.sequence.classes_of(self.grid)

    @property
    def scan_table(self) -> ClassTable:
        """Class table of the scans' labels as they are stored: a prediction beside them may have
        another.
        """
        return self.sequence.metadata.classes if self.stored is None else self.stored

    def read_grid(self, frame: int) -> Grid:
        """Read the grid of a frame, in the table that is shown.

        Raises:
            FormatError: the grid does not have the format, or a label is not in its class table.
        """
        grid = self.sequence.grid(self.grid, frame)
        labels = self._remap(
            grid.labels, self.stored_table, f"{self.sequence.location}: {self.grid}, frame {frame}"
        )
        return replace(grid, labels=labels)

    def read_scan(self, frame: int) -> Scan:
        """Read the scan of a frame, in the table that is shown, without points that are not finite
        and without boxes.

        Raises:
            FormatError: the scan does not have the format, or a label is not in its class table.
        """
        scan = without_invalid_points(self.sequence.scan(frame, layout.point_fields()))
        if scan.labels is None:
            return scan
        where = f"{self.sequence.location}: labels, frame {frame}"
        return replace(scan, labels=self._remap(scan.labels, self.scan_table, where))

    def read_boxes(self, frame: int) -> Boxes | None:
        """Read the tracked boxes of a frame, in the table that is shown; None where it was not
        annotated.

        Raises:
            FormatError: the boxes do not have the format, or a label is not in its class table.
        """
        boxes = self.sequence.boxes(frame)
        if boxes is None:
            return None
        where = f"{self.sequence.location}: boxes, frame {frame}"
        return replace(boxes, labels=self._remap(boxes.labels, self.scan_table, where))

    def read_pose(self, frame: int) -> Transform | None:
        """Read (4, 4) first_T_sensor of a frame; None if the sequence has no poses.

        Raises:
            FormatError: the frame has no line in the file of poses, or its line is no rigid
                transform.
        """
        try:
            pose = self.sequence.read_pose(frame)
        except MissingDataError:
            return None
        return check_rigid(pose, f"{self.sequence.location}/{layout.POSES}: frame {frame}")

    def has(self, *fields: str) -> bool:
        """Whether the sequence has all of these fields."""
        return set(fields) <= set(self.sequence.fields())

    def frames_with(self, *fields: str) -> set[int]:
        """Return the frames that have all of these fields."""
        return set.intersection(*(set(self.sequence.frames(field).tolist()) for field in fields))

    def read_part(self, part: str, frame: int) -> AnyArray:
        """Read a part of the grid of a frame, such as "posterior", in the shape of the grid.

        Raises:
            MissingDataError: the frame lacks it.
            FormatError: it does not have the format.
        """
        return self.sequence.read(f"{self.grid}/{part}", frame).reshape(self.spec.size)

    def _remap(self, labels: LabelArray, stored: ClassTable, where: str) -> LabelArray:
        target = self.shown or stored
        labels = to_table(labels, stored, target, where)
        target.check(labels, where)
        return labels


def without_invalid_points(scan: Scan) -> Scan:
    """Return a scan without the points that have a coordinate that is NaN or infinite."""
    finite = np.isfinite(scan.points)
    return scan if finite.all() else scan.select(np.asarray(finite.all(axis=1)))


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

    @property
    def shows_ego(self) -> bool:
        """Whether a plain car can be drawn at the sensor: not in grids with another frame."""
        sequence = self.data.sequence
        return not isinstance(sequence, VoxelSequence) or sequence.is_at_sensor

    @property
    def table_use(self) -> TableUse:
        """The class table of the labels as they are stored, and what named it."""
        if self.data.stored is not None:
            return TableUse(self.data.stored.name, "option")
        return self.data.sequence.table_use(self.data.grid)

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
        boxes = self.data.read_boxes(frame)
        if self.mirrored and boxes is not None:
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

    @property
    def has_cameras(self) -> bool:
        """Whether the sequence has cameras."""
        return layout.CAMERAS in self.data.sequence.documents()

    def read_motion(self, frame: int, scan: Scan | None) -> Scan | None:
        """Return the moving points of a frame with flow, or the centres of moving voxels if points
        have no flow; None if motion is not known.

        Raises:
            FormatError: the data do not have the format.
        """
        if scan is not None and scan.flow is not None:
            return scan.select(np.linalg.norm(scan.flow, axis=1) > 0)
        data = self.data
        name = f"{self.data.grid}/velocity"
        if not data.grid or frame not in data.frames_with(name):
            return None
        moving = data.sequence.read(name, frame)
        check_velocity(
            moving, data.spec.num_voxels, f"{data.sequence.location}: {name} of frame {frame}"
        )
        points = data.spec.from_axes(data.spec.centers().reshape(-1, 3)[moving["voxel"]]).astype(
            np.float32
        )
        labels = data.read_grid(frame).labels.reshape(-1)[moving["voxel"]].astype(np.uint32)
        actors = self._instances(frame).reshape(-1)[moving["voxel"]]
        centers = Scan(points, labels, moving["velocity"].astype(np.float32), actors)
        return mirror_scan(centers) if self.mirrored else centers

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
        pose = self.data.read_pose(frame)
        if pose is None and self.truth is not None:
            pose = self.truth.read_pose(frame)
        return mirror_poses(pose) if self.mirrored and pose is not None else pose

    def path_of_ego(self) -> FloatArray:
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

    def _instances(self, frame: int) -> Uint32Array:
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
