"""A folder of scans of any LiDAR, one file each: see the page `docs/sets/scans.md`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from carlasc.converting import Converter, FrameHandle, Recording, Sensor, Trajectory
from carlasc.core.arrays import AnyArray, FloatArray, IntArray
from carlasc.core.geometry import Transform, invert
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc_converters.calibration_file import axes_named, in_axes, read_calibration
from carlasc_converters.files import sequence_name
from carlasc_converters.given_classes import classes_given
from carlasc_converters.point_fields import TimeUnit, named_fields, point_seconds
from carlasc_converters.point_files import FORMATS, read_columns
from carlasc_converters.pose_files import PoseRows, nanoseconds, read_poses, read_stamps
from carlasc_converters.scan_files import ScanFile, ScanOptions

_TABLES = (".csv", ".txt")  # suffixes of scans that files of poses and times may have, too
_STAMPED = re.compile(r"\d{9,}(\.\d+)?|\d+\.\d{6,}")  # a file name that is the time of its scan
_LABELS = (".label", ".npy", ".txt")
_SLACK_NS = 10**9  # scans up to this time before the first pose or after the last one get a pose


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
        options, lidars = self.options, dict[str, Transform]()
        if options.calibration is not None:
            lidars = read_calibration(options.calibration)
        if len(lidars) > 1:
            files = {name: self._files(self.source / name) for name in lidars}
            self._check_counts(files)
        else:
            (name,) = lidars or ("lidar",)
            files = {name: self._files(self._folder())}
        return [ScanFolder(self.source, files, lidars, options)]

    def _folder(self) -> Path:
        """Return the folder of the scans: the source, or the only folder in it with scans."""
        if not self.source.is_dir():
            raise MissingDataError(
                self.source, expected="a folder of scans", found="no such folder"
            )
        inner = [
            path for path in sorted(self.source.iterdir()) if path.is_dir() and self._scans_in(path)
        ]
        own = {path.suffix.lower() for path in self._scans_in(self.source)}
        # tables beside folders of scans are their poses and times
        if own - set(_TABLES) or (own and not inner):
            return self.source
        if len(inner) > 1:
            raise MissingDataError(
                self.source,
                expected="scans, or one folder of scans",
                found=f"the folders {', '.join(path.name for path in inner)}",
                advice="give one of them, or the poses of several LiDARs with `calibration`",
            )
        return inner[0] if inner else self.source

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
            if path.suffix.lower() in FORMATS and path.resolve() not in others
        ]

    def _files(self, folder: Path) -> list[Path]:
        """Return the scans of a folder in their natural order."""
        files = self._scans_in(folder)
        kinds = Counter(path.suffix.lower() for path in files)
        scans = {kind: count for kind, count in kinds.items() if kind not in _TABLES} or dict(kinds)
        if not scans:
            expected, advice = (
                f"scans: files with the suffix {', '.join(FORMATS)}",
                "give the folder of the scans",
            )
            raise MissingDataError(folder, expected=expected, found="none", advice=advice)
        if len(scans) > 1:
            counts = ", ".join(f"{count} {kind}" for kind, count in sorted(scans.items()))
            raise FormatError(
                folder, expected="scans of one format", found=counts, advice="move the others away"
            )
        return sorted((path for path in files if path.suffix.lower() in scans), key=_natural)

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
        self.location, self.name = str(source), sequence_name(source.resolve().name)
        self._files, self._rig, self._options = files, rig, options
        self.has_labels = options.label_dir is not None or (
            options.has_classes and "label" in self._first
        )
        self.has_instances = self.has_labels and "instance" in self._first

    @cached_property
    def _paths(self) -> list[Path]:
        return next(iter(self._files.values()))

    @cached_property
    def _first(self) -> dict[str, AnyArray]:
        """The fields of the first scan."""
        return named_fields(
            read_columns(self._paths[0], self._options.columns), str(self._paths[0])
        )

    @cached_property
    def _clock(self) -> tuple[TimeUnit | None, int | None]:
        """The unit of the times of points, and the start of the first scan, if these are times of a
        clock.
        """
        times = self._first.get("time")
        if times is None:
            return None, None
        _, start, unit = point_seconds(times, self._options.time_unit, str(self._paths[0]))
        return unit, start

    @cached_property
    def _poses(self) -> PoseRows | None:
        return None if self._options.pose_file is None else read_poses(self._options.pose_file)

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
        if self._clock[1] is not None:
            return np.array(
                [self._start_of(path) for path in self._paths], np.int64
            ), "the times of points"
        if all(_STAMPED.fullmatch(path.stem) for path in self._paths):
            stamps = np.array([nanoseconds(path.stem) for path in self._paths], np.int64)
            if (np.diff(stamps) > 0).all():
                return stamps, "the names of the files"
        if (
            self._poses is not None
            and self._poses.stamps is not None
            and len(self._poses.stamps) == count
        ):
            return (
                self._poses.stamps,
                f"{self._options.pose_file}, whose lines go by the order of the scans",
            )
        return None, ""

    def _start_of(self, path: Path) -> int:
        times = named_fields(read_columns(path, self._options.columns), str(path)).get("time")
        unit = self._clock[0] or "auto"
        start = None if times is None else point_seconds(times, unit, str(path))[1]
        if start is None:
            raise FormatError(
                path, expected="times of points by a clock, as in the first scan", found="others"
            )
        return start

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The scans, by their order."""
        stamps, _ = self._stamps
        labels = self._labels
        return [
            ScanFile(
                number,
                tuple(str(files[number]) for files in self._files.values()),
                None if labels is None else str(labels[number]),
                tuple(self._first),
                self._options,
                self._clock[0],
                None if stamps is None or self._clock[1] is None else int(stamps[number]),
            )
            for number in range(len(self._paths))
        ]

    @cached_property
    def _labels(self) -> list[Path] | None:
        """The file of labels of each scan of the first LiDAR."""
        folder = self._options.label_dir
        if folder is None:
            return None
        labels = (
            {path.stem: path for path in sorted(folder.iterdir()) if path.suffix in _LABELS}
            if folder.is_dir()
            else {}
        )
        if missing := [path.stem for path in self._paths if path.stem not in labels]:
            raise MissingDataError(
                folder,
                expected=f"a file {', '.join(_LABELS)} for each scan",
                found=f"none for {missing[0]}"
                + (f" and {len(missing) - 1} more" if len(missing) > 1 else ""),
            )
        return [labels[path.stem] for path in self._paths]

    @cached_property
    def sensors(self) -> Sequence[Sensor]:  # type: ignore[override]
        """The LiDARs, with their poses from the calibration; without one, the frame of the LiDAR is
        that of the vehicle.
        """
        deskewed = self._options.deskewed or "time" not in self._first
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
        world_T_body = in_axes(self._options.axes, rows.world_T_body)
        vehicle_T_sensor = self.sensors[0].vehicle_T_sensor
        world_T_vehicle = (
            world_T_body if of == "vehicle" else world_T_body @ invert(vehicle_T_sensor)
        )
        stamps, where = self._stamps[0], str(self._options.pose_file)
        if rows.stamps is None or stamps is None:
            if len(world_T_vehicle) != len(self._paths):
                raise FormatError(
                    where,
                    expected=f"a pose for each of {len(self._paths)} scans",
                    found=f"{len(world_T_vehicle)} poses",
                    advice="give `time_file`, and poses with times: without times, poses are "
                    "matched by their order",
                )
            return Trajectory(world_T_vehicle, where=where)
        if stamps[0] < rows.stamps[0] - _SLACK_NS or stamps[-1] > rows.stamps[-1] + _SLACK_NS:
            raise FormatError(
                where,
                expected=f"poses over the time of the scans, {_span(stamps)}",
                found=f"poses over {_span(rows.stamps)}",
                advice="check that both use the same clock",
            )
        return Trajectory(world_T_vehicle, (rows.stamps - stamps[0]) / 1e9, where)

    def notes(self) -> list[str]:
        """Return notes on what was found and assumed."""
        options, notes = self._options, list[str]()
        if self._stamps[0] is not None and options.time_file is None:
            notes.append(f"the times of scans are from {self._stamps[1]}")
        if self._clock[0] and options.time_unit == "auto":
            notes.append(
                f"the times of points are in {self._clock[0]}, because scans then have a usual "
                f"duration"
            )
        if "time" in self._first and not options.deskewed:
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


def _path(name: str | None) -> Path | None:
    return Path(name) if name else None


def _natural(path: Path) -> list[Any]:
    """Return a key for natural sorting: scan2 before scan10."""
    return [int(part) if part.isdigit() else part.lower() for part in re.split(r"(\d+)", path.name)]


def _span(stamps: IntArray) -> str:
    return f"{stamps[0] / 1e9:.3f} to {stamps[-1] / 1e9:.3f} s"
