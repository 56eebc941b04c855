"""A folder of scans of any LiDAR, one file each: see the page `docs/sets/scans.md`."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from carlasc.converting import Converter, FrameHandle, Recording, Sensor, Trajectory
from carlasc.core.arrays import AnyArray, FloatArray, IntArray
from carlasc.core.geometry import Transform, invert, slerp
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.motion.ground import find_ground
from carlasc_converters.calibration_file import axes_named, in_axes, read_calibration
from carlasc_converters.files import raw_advice, sequence_name
from carlasc_converters.given_classes import classes_given
from carlasc_converters.pcd import PcdHeader, read_header
from carlasc_converters.point_fields import (
    PointClock,
    TimeUnit,
    find_clock,
    named_fields,
    point_seconds,
    returns,
    unread,
)
from carlasc_converters.point_files import FORMATS, read_columns
from carlasc_converters.pose_files import (
    PoseRows,
    read_folders,
    read_poses,
    read_stamps,
    stamps_of_names,
)
from carlasc_converters.scan_files import ScanFile, ScanOptions
from carlasc_converters.transforms import are_poses, poses_of

_TABLES = (".csv", ".txt")  # suffixes of scans that files of poses and times may have, too
_LABELS = (".label", ".npy", ".txt")
_GRAPH_SLAM = "cloud.pcd"  # hdl_graph_slam: a folder for each scan, with the file `data`
_GROUND_M = 0.3  # ground must be at least this far below the sensor
_NEARER = 1.05  # points that are farther from the viewpoint than from the origin by this are not
# cosine of the tilt of poses that are right, and its difference to that of poses that are wrong
_LEVEL = 0.9
_CLEARLY = 0.1
_SLACK = 10  # numbers of scans before the first pose or after the last one that get a pose
_SLACK_NS = 10**9  # clocks of scans and poses that differ by more are others


class Scans(Converter):
    """Reads a folder of scans, in the natural order of the names of their files."""

    title: ClassVar[str] = f"a folder of scans of any LiDAR, one file each: {', '.join(FORMATS)}"
    classes = CARLA
    to_carla = None

    def __init__(
        self,
        source: Path,
        *,
        columns: Annotated[
            str | None, "Names of the columns, if files do not contain them: x,y,z,intensity."
        ] = None,
        pose_file: Annotated[
            str | None, "File of poses: TUM, KITTI, EuRoC, CSV with a header, .npy (N, 4, 4)."
        ] = None,
        pose_of: Annotated[
            Literal["auto", "sensor", "vehicle"],
            "Whose poses these are. auto: the sensor; with EuRoC, the vehicle.",
        ] = "auto",
        calibration: Annotated[
            str | None, "YAML or JSON file with the poses of the LiDARs on the vehicle."
        ] = None,
        time_file: Annotated[str | None, "File with the time of each scan, one per line."] = None,
        time_unit: Annotated[
            TimeUnit, "Unit of the times of points. auto: from the duration of a scan."
        ] = "auto",
        deskewed: Annotated[
            bool, "The points are already corrected for the motion of the vehicle."
        ] = False,
        label_dir: Annotated[
            str | None, "Folder with one .label, .npy or .txt file of classes per scan."
        ] = None,
        source_classes: Annotated[
            str | None, "Class table of the labels: a name such as semantickitti, or a JSON file."
        ] = None,
        source_axes: Annotated[
            str, "Directions of x, y and z: flu, fru (left-handed), rfu, frd, rdf, ..."
        ] = "flu",
    ) -> None:
        super().__init__(source)
        if source_classes:
            self.classes, self.to_carla = classes_given(source_classes)
        elif label_dir:
            raise ArgumentError(
                "source_classes",
                expected="the class table of the labels: a name, or a JSON file",
                found="none",
            )
        self.options = ScanOptions(
            columns=tuple(name.strip() for name in columns.split(",")) if columns else None,
            pose_file=_path(pose_file),
            pose_of=pose_of,
            calibration=_path(calibration),
            time_file=_path(time_file),
            time_unit=time_unit,
            label_dir=_path(label_dir),
            has_classes=bool(source_classes),
            axes=axes_named(source_axes),
            deskewed=deskewed,
        )

    def sequences(self) -> list[Recording]:
        """Return the recording.

        Raises:
            MissingDataError: there are no scans, or a LiDAR of the calibration has none.
            FormatError: scans have several formats, or LiDARs have different numbers of scans.
        """
        options = self.options
        lidars = dict[str, Transform]()
        if options.calibration is not None:
            lidars = read_calibration(options.calibration)
        if len(lidars) > 1:
            files = {name: self._files(self.source / name) for name in lidars}
            self._check_counts(files)
        else:
            (name,) = lidars or ("lidar",)
            nodes = sorted(path.with_name(_GRAPH_SLAM) for path in self.source.glob("*/data"))
            files = {name: nodes or self._files(self._folder())}
        return [ScanFolder(self.source, files, lidars, options)]

    def _folder(self) -> Path:
        """Return the folder of the scans: the source, or the only folder in it with scans."""
        if not self.source.is_dir():
            raise MissingDataError(
                self.source,
                expected="a folder of scans",
                found="a file" if self.source.exists() else "no such folder",
                advice=raw_advice([self.source.name]),
            )
        folders = sorted(entry.path for entry in os.scandir(self.source) if entry.is_dir())
        inner = [path for path in map(Path, folders) if self._scans_in(path)]
        own = {path.suffix.lower() for path in self._scans_in(self.source)} if inner else set()
        # tables beside folders of scans are their poses and times
        if not inner or own - set(_TABLES):
            return self.source
        if len(inner) > 1:
            raise MissingDataError(
                self.source,
                expected="scans, or one folder of scans",
                found=f"the folders {', '.join(path.name for path in inner)}",
                advice="give one of them, or the poses of several LiDARs with `calibration`",
            )
        return inner[0]

    def _scans_in(self, folder: Path) -> list[Path]:
        """Return the files of a folder that may be scans, without those of poses and times."""
        others = {
            path.resolve()
            for path in (self.options.pose_file, self.options.time_file)
            if path is not None
        }
        entries = folder.iterdir() if folder.is_dir() else iter(())
        return [
            path
            for path in entries
            if path.suffix.lower() in FORMATS and not (others and path.resolve() in others)
        ]

    def _files(self, folder: Path) -> list[Path]:
        """Return the scans of a folder in their natural order."""
        files = self._scans_in(folder)
        kinds = Counter(path.suffix.lower() for path in files)
        scans = {kind: count for kind, count in kinds.items() if kind not in _TABLES} or dict(kinds)
        if not scans:
            names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
            raise MissingDataError(
                folder,
                expected=f"scans: files with the suffix {', '.join(FORMATS)}",
                found="none",
                advice=raw_advice(names) or "give the folder of the scans",
            )
        if len(scans) > 1:
            counts = ", ".join(f"{count} {kind}" for kind, count in sorted(scans.items()))
            raise FormatError(
                folder, expected="scans of one format", found=counts, advice="move the others away"
            )
        chosen = sorted((path for path in files if path.suffix.lower() in scans), key=_natural)
        numbers = dict[str, set[tuple[str, ...]]]()  # by the other parts of names
        for path in chosen:
            name = re.sub(r"\d+", "#", path.stem)
            numbers.setdefault(name, set()).add(tuple(re.findall(r"\d+", path.stem)))
        if len(numbers) > 1 and set.intersection(*numbers.values()) - {()}:
            raise FormatError(
                folder,
                expected="the scans of one LiDAR",
                found=f"several of the same numbers: {', '.join(sorted(numbers))}",
                advice="put those of each LiDAR into a folder, and give one of these, or the poses "
                "of the LiDARs with `calibration`",
            )
        return chosen

    def _check_counts(self, files: dict[str, list[Path]]) -> None:
        if len({len(paths) for paths in files.values()}) > 1:
            counts = ", ".join(f"{len(paths)} of {name}" for name, paths in files.items())
            raise FormatError(
                self.source, expected="the same number of scans of each LiDAR", found=counts
            )


class ScanFolder(Recording):
    """The scans of a folder, or of a folder for each LiDAR."""

    split = "Train"

    def __init__(
        self,
        source: Path,
        files: dict[str, list[Path]],
        rig: dict[str, Transform],
        options: ScanOptions,
    ) -> None:
        self.location = str(source)
        self.name = sequence_name(source.resolve().name)
        self._files = files
        self._rig = rig
        self._options = options
        self.has_labels = options.label_dir is not None or (
            options.has_classes and "label" in self._first
        )
        self.has_instances = self.has_labels and "instance" in self._first

    @cached_property
    def _paths(self) -> list[Path]:
        return next(iter(self._files.values()))

    @cached_property
    def _samples(self) -> list[tuple[Path, dict[str, AnyArray]]]:
        """The first and the last scan that can be read, and their columns.

        Raises:
            FormatError: no scan can be read.
        """
        samples = list[tuple[Path, dict[str, AnyArray]]]()
        problem = None
        for paths in (self._paths, reversed(self._paths)):
            for path in paths:
                try:
                    samples.append((path, read_columns(path, self._options.columns)))
                    break
                except FormatError as error:
                    problem = problem or error
        if problem is not None and not samples:
            raise problem
        return samples

    @cached_property
    def _first(self) -> dict[str, AnyArray]:
        """The fields of the first scan."""
        path, columns = self._samples[0]
        return named_fields(columns, str(path), self._clock)

    @cached_property
    def _clock(self) -> PointClock | None:
        """How the times of points are found; None if they have none."""
        path = str(self._samples[0][0])
        options = self._options
        scans = [(columns, None) for _, columns in self._samples]
        return find_clock(scans, options.time_unit, path, needed=not options.deskewed)

    @cached_property
    def _viewpoints(self) -> FloatArray | None:
        """(F, 4, 4) poses of the scans in the headers of PCD files; None if they have none, or all
        the same.
        """
        if self._paths[0].suffix.lower() != ".pcd" or len(self._files) > 1:
            return None
        found = [PcdHeader.viewpoint]
        for path in self._paths:
            try:
                found.append(_header_of(path, _state(path)).viewpoint)
            except FormatError:
                found.append(found[-1])  # reading its scan reports the error
        rows = np.array(found[1:], np.float64)
        if np.ptp(rows, axis=0).max() == 0 or not are_poses(rows).all():
            return None
        return poses_of(rows[:, 3:], rows[:, :3], self.location)

    @cached_property
    def _in_world(self) -> bool:
        """Whether the points of scans are in the frame of the viewpoints: nearer to these than to
        the origin.
        """
        if self._viewpoints is None:
            return False
        row = int(np.argmax(np.abs(self._viewpoints[:, :3, 3]).max(axis=1)))
        columns = read_columns(self._paths[row], None)
        points = named_fields(columns, str(self._paths[row]))["points"][returns(columns), :3]
        place = self._viewpoints[row, :3, 3]
        near, far = (np.linalg.norm(points - origin, axis=1) for origin in (place, np.zeros(3)))
        return bool(np.median(near) <= _NEARER * np.median(far))

    @cached_property
    def _poses(self) -> PoseRows | None:
        file = self._options.pose_file
        if file is None and self._paths[0].name == _GRAPH_SLAM:
            return read_folders([path.parent for path in self._paths])
        if file is None and self._viewpoints is not None:
            return PoseRows(self._viewpoints, None, "sensor")
        if file is None:
            return None
        rows = read_poses(file)
        up = self._up if rows.other is not None else None
        if rows.other is None or up is None:
            return rows
        level, other = (up * poses[:, 2, 2].mean() for poses in (rows.world_T_body, rows.other))
        if other < max(_LEVEL, level + _CLEARLY):
            return rows  # if the scans do not overlap, the other order is tried
        said = f"{file}: quaternions are w, x, y, z, because otherwise the ground is not below"
        return replace(rows, world_T_body=rows.other, other=None, notes=(*rows.notes, said))

    @cached_property
    def _up(self) -> int | None:
        """1 if the ground is below the sensor in its own axes, -1 if it is above; None if it is not
        found.
        """
        points = self._first["points"][:, :3]
        for sign in (1, -1):
            ground = find_ground([points * np.array([1, 1, sign], np.float32)])
            if ground is not None and ground.below_m > _GROUND_M:
                return sign
        return None

    @cached_property
    def _stamps(self) -> tuple[IntArray | None, str]:
        """The (F,) nanoseconds of the scans, and their source."""
        count = len(self._paths)
        if self._options.time_file is not None:
            stamps = read_stamps(self._options.time_file)
            if len(stamps) != count:
                raise FormatError(
                    self._options.time_file,
                    expected=f"a time for each of {count} scans",
                    found=f"{len(stamps)} times",
                )
            return stamps, str(self._options.time_file)
        rows = None if self._poses is None else self._poses.stamps
        given = []
        if self._clock is not None and self._clock.absolute:
            given.append((self._starts(self._clock), "the times of points"))
        if (names := stamps_of_names([path.stem for path in self._paths])) is not None:
            given.append((names, "the names of the files"))
        for stamps, source in given:
            if rows is None or _together(stamps, rows):
                return stamps, source
        if rows is not None and len(rows) == count:
            return (
                rows,
                f"{self._options.pose_file or 'data'}, whose lines go by the order of the scans",
            )
        return given[0] if given else (None, "")

    def _starts(self, clock: PointClock) -> IntArray:
        """Return the (F,) nanoseconds of the first point of each scan; between those of the others
        where a scan cannot be read.
        """
        found = dict[int, int]()
        for row, path in enumerate(self._paths):
            start = _start_of(path, _state(path), self._options.columns, clock)
            found |= {} if start is None else {row: start}
        first = next(iter(found.values()))
        rows = np.arange(len(self._paths))
        known = list(found)
        after = np.interp(rows, known, [start - first for start in found.values()])
        period = after[known[-1]] / max(1, known[-1] - known[0])
        after += period * (rows - rows.clip(known[0], known[-1]))
        return first + np.round(after).astype(np.int64)

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The scans, by their order."""
        stamps, _ = self._stamps
        labels = self._labels
        return [
            ScanFile(
                number,
                tuple(str(files[number]) for files in self._files.values()),
                None if labels is None or labels[number] is None else str(labels[number]),
                tuple(self._first),
                self._options,
                self._clock,
                None if stamps is None else int(stamps[number]),
                self._viewpoints[number]
                if self._in_world and self._viewpoints is not None
                else None,
            )
            for number in range(len(self._paths))
        ]

    @cached_property
    def _labels(self) -> list[Path | None] | None:
        """The file of labels of each scan of the first LiDAR, None for those without one."""
        folder = self._options.label_dir
        if folder is None:
            return None
        labels = (
            {path.stem: path for path in sorted(folder.iterdir()) if path.suffix in _LABELS}
            if folder.is_dir()
            else {}
        )
        found = [labels.get(path.stem) for path in self._paths]
        if not any(found):
            raise MissingDataError(
                folder,
                expected=f"a file {', '.join(_LABELS)} for each scan",
                found="none for any scan",
            )
        return found

    @cached_property
    def sensors(self) -> Sequence[Sensor]:  # type: ignore[override]
        """The LiDARs, with their poses from the calibration; without one, the frame of the LiDAR is
        that of the vehicle.
        """
        deskewed = self._options.deskewed or self._clock is None or self._in_world
        return [
            Sensor(
                name,
                in_axes(self._options.axes, self._rig.get(name, np.eye(4))),
                deskewed=deskewed,
                calibrated=name in self._rig,
            )
            for name in self._files
        ]

    def times(self) -> FloatArray | None:
        """Return seconds after the first scan; None if the times of scans are not known."""
        stamps, _ = self._stamps
        return None if stamps is None else (stamps - stamps[0]) / 1e9

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return the poses of the file, by their times if scans have times, otherwise by their
        order; None without a file.

        Raises:
            MissingDataError: they are poses of the vehicle, and no calibration has the pose of the
                sensor on it.
            FormatError: the numbers of poses and scans differ, or they were recorded at different
                times.
        """
        rows = self._poses
        if rows is None:
            return None
        of = rows.of if self._options.pose_of == "auto" else self._options.pose_of
        if of == "vehicle" and not self._rig and not force:
            raise MissingDataError(
                str(self._options.pose_file),
                expected="`calibration`, because these are poses of the vehicle",
                found="none",
                advice='give it, or `pose_of="sensor"` if they are those of the sensor',
            )
        vehicle_T_sensor = self.sensors[0].vehicle_T_sensor
        body_T_vehicle = np.eye(4) if of == "vehicle" else invert(vehicle_T_sensor)
        world_T_vehicle, other = (
            None if poses is None else in_axes(self._options.axes, poses) @ body_T_vehicle
            for poses in (rows.world_T_body, rows.other)
        )
        assert world_T_vehicle is not None
        stamps = self._stamps[0]
        where = str(self._options.pose_file or self.location)
        if rows.numbers is not None:
            return Trajectory(self._by_number(rows.numbers, world_T_vehicle), where=where)
        if rows.stamps is None or stamps is None:
            if len(world_T_vehicle) != len(self._paths):
                raise FormatError(
                    where,
                    expected=f"a pose for each of {len(self._paths)} scans",
                    found=f"{len(world_T_vehicle)} poses",
                    advice="give `time_file`, and poses with times: without times, poses are "
                    "matched by their order",
                )
            return Trajectory(world_T_vehicle, where=where, other=other)
        if not _together(stamps, rows.stamps):
            raise FormatError(
                where,
                expected=f"poses over the time of the scans, {_span(stamps)}",
                found=f"poses over {_span(rows.stamps)}",
                advice="check that both use the same clock",
            )
        return Trajectory(world_T_vehicle, (rows.stamps - stamps[0]) / 1e9, where, other)

    def _by_number(self, numbers: IntArray, poses: FloatArray) -> FloatArray:
        """Return the poses of the scans, interpolated by the numbers in the names of their files.

        Raises:
            FormatError: names have no numbers, or there are no poses near these.
        """
        own = [int((re.findall(r"\d+", path.stem) or [-_SLACK])[-1]) for path in self._paths]
        if min(own) < numbers[0] - _SLACK or max(own) > numbers[-1] + _SLACK:
            raise FormatError(
                str(self._options.pose_file),
                expected=f"poses of the scans {min(own)} to {max(own)}, by their names",
                found=f"poses of {numbers[0]} to {numbers[-1]}",
                advice="leave out the scans without poses",
            )
        return slerp(poses, numbers.astype(np.float64), np.array(own, np.float64))

    @property
    def _others(self) -> list[str]:
        """The names of the files beside the scans that are not read."""
        options = self._options
        folders = {Path(self.location), *(paths[0].parent for paths in self._files.values())}
        given = {options.pose_file, options.time_file, options.calibration, *(self._labels or ())}
        read = {path.resolve() for path in given if path is not None}
        read |= {path.resolve() for paths in self._files.values() for path in paths}
        return sorted(
            path.name
            for folder in folders
            for path in folder.iterdir()
            if path.is_file() and path.resolve() not in read
        )

    def notes(self) -> list[str]:
        """Return notes on what was found and assumed, and on what is not read."""
        options = self._options
        notes = list(self._poses.notes if self._poses else ())
        if left := unread(self._samples[0][1], self._clock, classes=True):
            notes.append(f"the columns {', '.join(left)} of points were not read")
        if self._others:
            notes.append(f"the files {', '.join(self._others)} were not read")
        if self._viewpoints is not None and options.pose_file is None:
            notes.append("poses are the VIEWPOINT of the scans")
        if self._in_world:
            notes.append(
                "points are in the world frame, as the VIEWPOINT of their files says: they were "
                "moved to the frame of the sensor"
            )
        if self._stamps[0] is not None and options.time_file is None:
            notes.append(f"the times of scans are from {self._stamps[1]}")
        if self._clock and options.time_unit == "auto":
            notes.append(
                f"the times of points are in {self._clock.unit}, because scans then have a usual "
                f"duration"
            )
        if missing := (self._labels or []).count(None):
            notes.append(
                f"{missing} of {len(self._paths)} scans have no file of labels: their points are "
                f"unlabelled"
            )
        if not self.sensors[0].deskewed:
            notes.append(
                "points have times, so that they were corrected for the motion of the vehicle; "
                "give `deskewed=True` to keep them"
            )
        if "label" in self._first and not options.has_classes:
            notes.append(
                "points have a field of classes, which was not read: give `source_classes` to read "
                "it"
            )
        return notes


def _together(stamps: IntArray, poses: IntArray) -> bool:
    """Whether scans and poses were recorded at the same time."""
    return bool(poses[0] - _SLACK_NS <= stamps[-1] and stamps[0] <= poses[-1] + _SLACK_NS)


def _path(name: str | None) -> Path | None:
    return Path(name) if name else None


def _state(path: Path) -> tuple[int, int]:
    about = path.stat()
    return about.st_size, about.st_mtime_ns


# A growing folder is looked at again and again: the files that it had before are not read again.
_remembered = lru_cache(maxsize=1 << 16)


@_remembered
def _header_of(path: Path, _: tuple[int, int]) -> PcdHeader:
    return read_header(path)


@_remembered
def _start_of(
    path: Path, _: tuple[int, int], names: tuple[str, ...] | None, clock: PointClock
) -> int | None:
    with suppress(FormatError):
        columns = read_columns(path, names)
        if (times := clock.of(columns)) is not None:
            seen = returns(columns)
            return point_seconds(times, clock.unit, str(path), seen, absolute=True)[1]
    return None


def _natural(path: Path) -> list[Any]:
    """Return a key for natural sorting: scan2 before scan10."""
    return [int(part) if part.isdigit() else part.lower() for part in re.split(r"(\d+)", path.name)]


def _span(stamps: IntArray) -> str:
    return f"{stamps[0] / 1e9:.3f} to {stamps[-1] / 1e9:.3f} s"
