"""One table of the boxes of tracked objects over time, and its files."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from math import isnan
from pathlib import Path
from typing import Any, Self

import numpy as np

from carlasc.core.arrays import FloatArray, IntArray
from carlasc.core.geometry import Transform, rotate_vectors, transform_points
from carlasc.errors import (
    ArgumentError,
    FormatError,
    MissingDataError,
    check_types,
    import_extra,
    reading,
    within,
)
from carlasc.motion.tracks import Track
from carlasc.storage.files import AnyPath, csv_text, to_json, write_output

ONE_FRAME = "one sequence, as a table of boxes has one frame"
"""What is expected of the source, or of the output, of a table."""
BOX_ENDINGS = (".csv", ".json", ".parquet")
"""Endings of the files of a `BoxTable`."""

_INTERVAL = [f"{size}_{end}" for end in ("min", "max") for size in ("length", "width", "height")]
_NUMBERS = [*"x y z length width height heading vx vy vz confidence".split(), *_INTERVAL]
_COLUMNS = ("time", "number", "class", *_NUMBERS)
_OPTIONAL = ("vx", "vy", "vz", *_INTERVAL)  # NaN where not known
_DEFAULTS = {**dict.fromkeys(_OPTIONAL, np.nan), "confidence": 1.0}  # of absent columns
_APART_S = 0.05  # boxes that are farther from the time of a frame are not of it
_FARTHEST_M = 500.0  # boxes farther from the sensor are of another drive


@dataclass(frozen=True)
class BoxTable:
    """The boxes of tracked objects over time, upright, in one right-handed frame: x ahead, y to the
    left, z up.

    Attributes:
        times: (R,) float64 seconds since the first frame.
        numbers: (R,) int64 number of the object of each box.
        classes: (R,) names of the classes.
        values: (R, 17) float64: middle x, y, z, length, width and height, metres; heading, radians,
            anticlockwise from x; velocity x, y and z, m/s; confidence, 0 to 1; least, then greatest
            length, width and height, metres. Velocities and intervals are NaN where not known.

    Raises:
        FormatError: a number is not finite, a size is not positive, or an object has two boxes at
            one time.
    """

    times: FloatArray
    numbers: IntArray
    classes: tuple[str, ...]
    values: FloatArray

    def __post_init__(self) -> None:
        check_types(BoxTable, vars(self))
        known = self.values[:, [column not in _OPTIONAL for column in _NUMBERS]]
        whole = np.isfinite(np.column_stack([self.times, known])).all(axis=1)
        first = np.zeros(len(self.times), np.bool_)
        keys = np.column_stack([self.times, self.numbers])
        first[np.unique(keys, axis=0, return_index=True)[1]] = True
        for valid, expected in (
            (whole, "finite numbers, but of velocities and intervals"),
            ((self.values[:, 3:6] > 0).all(axis=1), "a length, width and height above 0 metres"),
            (first, "one box per time and number"),
        ):
            if not valid.all():
                row = int(valid.argmin())
                found = f"{[*keys[row].tolist(), *self.values[row].tolist()]}"
                raise FormatError(
                    f"row {row + 1}", expected=expected, found=found, advice="remove it, or mend it"
                )

    @classmethod
    def of_tracks(
        cls,
        tracks: Mapping[int, Track],
        frames: Mapping[int, tuple[float, Transform]],
        names: Mapping[int, str],
        *,
        left: bool,
        numbers: Mapping[int, int] = {},
    ) -> Self:
        """Return the boxes of tracks, in order of the tracks, then of time.

        Args:
            tracks: the tracks by number.
            frames: seconds, and (4, 4) table_T_world, by frame.
            names: names of the classes.
            left: whether the axes of the tracks are left-handed.
            numbers: other numbers of the tracks, by number; empty for the same. Of two boxes of one
                number in a frame, the one with points is kept.
        """
        signs = (1, -1, 1) if left else (1, 1, 1)
        rows = dict[tuple[int, int], tuple[Any, ...]]()
        for number, track in tracks.items():
            for frame, (seconds, table_T_world) in frames.items():
                pose, velocity = track.pose(frame), track.velocity_at(frame)
                key = (numbers[number] if numbers else number, frame)
                if pose is None or velocity is None or (key in rows and frame not in track.members):
                    continue
                pose = table_T_world @ pose
                velocity = rotate_vectors(table_T_world, velocity)
                middle = transform_points(pose, (track.lower + track.upper) / 2) * signs
                ahead = pose[:3, 0] * signs
                last = [track.confidence, *track.interval().flat]
                heading = [np.arctan2(ahead[1], ahead[0])]
                own = np.concatenate([middle, track.size, heading, velocity * signs, last])
                rows[key] = (round(seconds, 6), key[0], names[track.label], *own.round(4))
        return cls._of([*rows.values()])

    @classmethod
    def _of(cls, rows: list[tuple[Any, ...]]) -> Self:
        """Return the table of rows with a value per column, numbers or text."""
        return cls(
            np.array([row[0] for row in rows], np.float64),
            np.array([int(float(row[1])) for row in rows], np.int64),
            tuple(str(row[2]) for row in rows),
            np.array([row[3:] for row in rows], np.float64).reshape(-1, len(_NUMBERS)),
        )

    @classmethod
    def read(cls, path: AnyPath) -> Self:
        """Read a file that `write` has written, or another one with its columns; those of velocity,
        confidence and intervals may be absent.

        Raises:
            ArgumentError: the ending is not known.
            MissingDataError: there is no such file.
            FormatError: a column is absent, or a value is not valid; see the class.
            DependencyError: pyarrow is needed and not installed.
        """
        path = Path(path)
        check_box_file("boxes", path)
        if not path.is_file():
            raise MissingDataError(path, expected="a table of boxes", found="no file")
        needed = [name for name in _COLUMNS if name not in _DEFAULTS]
        with reading(path, f"a table with the columns {', '.join(_COLUMNS)}"):
            rows = _rows_of(path)
            absent = [name for name in needed if any(row.get(name) is None for row in rows)]
        if absent or not rows:
            found = f"{', '.join(absent)} absent" if rows else "no box"
            raise FormatError(
                path,
                expected=f"boxes with the columns {', '.join(needed)}",
                found=found,
                advice="write it with `--boxes-out` of `carlasc label` or `carlasc regrid`",
            )
        with reading(path, "numbers in all columns but class"), within(path):
            # what is empty in a file is absent
            given = [{k: v for k, v in row.items() if v not in (None, "")} for row in rows]
            return cls._of([tuple((_DEFAULTS | row)[name] for name in _COLUMNS) for row in given])

    def frames_of(
        self, times: FloatArray, poses: FloatArray | None, where: str, drive: str
    ) -> IntArray:
        """Return (R,) the index of the frame of each box: the nearest in time, -1 without one
        within 0.05 s. Of several boxes of an object, only the nearest in time is of a frame.

        Args:
            times: (F,) seconds of the frames, increasing.
            poses: (F, 4, 4) world_T_sensor, in the frame of the table; None if not known yet, so
                that only times are checked.
            where: the file of the table, for errors.
            drive: the sequence, for errors.

        Raises:
            FormatError: no box is at the time of a frame, or none is within 500 m of the sensor.
        """
        index = np.searchsorted((times[1:] + times[:-1]) / 2, self.times)
        apart = np.abs(times[index] - self.times)
        late = np.argsort(-apart, kind="stable").tolist()  # the nearest last, which is kept
        kept = np.array([*{(index[row], self.numbers[row]): row for row in late}.values()])
        kept = kept[apart[kept] <= _APART_S]
        sensors = self.values[kept, :3] if poses is None else poses[index[kept], :3, 3]
        away = np.linalg.norm(self.values[kept, :3] - sensors, axis=1)
        nearest = away.min(initial=np.inf)
        if nearest > _FARTHEST_M:
            far = f", the nearest {nearest:.0f} m away" if len(kept) else ""
            raise FormatError(
                where,
                expected=f"boxes at {times[0]:g} to {times[-1]:g} s, within {_FARTHEST_M:g} m of "
                f"the sensor of {drive}",
                found=f"boxes at {self.times.min():g} to {self.times.max():g} s{far}",
                advice="give the boxes of this sequence, in the frame of its poses, and seconds "
                "since its first frame",
            )
        frames = np.full(len(index), -1)
        frames[kept] = index[kept]
        return frames

    def write(self, path: AnyPath) -> None:
        """Write the table; an existing file is replaced.

        Raises:
            ArgumentError: the ending is not known.
            DependencyError: pyarrow is needed and not installed.
            StorageError: the file cannot be written.
        """
        path = Path(path)
        check_box_file("boxes_out", path)
        values = [[None if isnan(v) else v for v in row] for row in self.values.T.tolist()]
        own = (self.times.tolist(), self.numbers.tolist(), self.classes, *values)
        columns = dict(zip(_COLUMNS, own, strict=True))
        rows = zip(*own, strict=True)
        match path.suffix.lower():
            case ".json":
                data = to_json([dict(zip(_COLUMNS, row, strict=True)) for row in rows])
            case ".csv":
                data = csv_text([_COLUMNS, *rows]).encode()
            case _:
                made = io.BytesIO()
                table = import_extra("pyarrow", "parquet").table(columns)
                import_extra("pyarrow.parquet", "parquet").write_table(table, made)
                data = made.getvalue()
        write_output(path, data)


def _rows_of(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file, as they are."""
    match path.suffix.lower():
        case ".json":
            return list(json.loads(path.read_bytes()))
        case ".csv":
            with path.open(newline="") as file:
                return list(csv.DictReader(file))
    rows: list[dict[str, Any]] = (
        import_extra("pyarrow.parquet", "parquet").read_table(path).to_pylist()
    )
    return rows


def check_box_file(argument: str, path: Path) -> None:
    """Check, before hours of work, the ending of a file of boxes, and that pyarrow is installed if
    it is needed; `argument` is named in errors.
    """
    if path.suffix.lower() not in BOX_ENDINGS:
        expected = f"a file that ends in {', '.join(BOX_ENDINGS)}"
        raise ArgumentError(argument, expected=expected, found=path)
    if path.suffix.lower() == ".parquet":
        import_extra("pyarrow.parquet", "parquet")
