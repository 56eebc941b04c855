"""The published layout as one table: field, file name, type, shape, unit. No other module contains file names.

    <split>/<sequence>/<coordinates>/velodyne/000000.bin, ...: see the format page, `docs/format.md#layout`

Field names are flat: `points`, `labels`, ... for scans, `<grid>/labels`, `<grid>/counts`, ... for the grid in the folder `<grid>`. `poses` and `times` are in text files with one line per frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from carlasc.core.boxes import BOXES_DTYPE
from carlasc.core.grids import GridSpec
from carlasc.errors import FormatError
from carlasc.storage.arrays import ArrayFormat, npz_bytes, open_npz

SPLITS = ("Train", "Val", "Test")
COORDINATES = ("cartesian", "cylindrical")
EVALUATION = "evaluation"  # the folder of the published grid

POSES = "poses.txt"
TIMES = "times.txt"
METADATA = "carlasc.json"
PARAMS = "params.json"
REPORT = "carlasc-report.json"
DERIVED = ".carlasc"  # the folder of what is derived of a sequence: no field, never packed, safe to delete

FRAME_PERIOD_S = 0.1  # scans are recorded at 10 Hz
VOTES_DTYPE = np.dtype([("voxel", "<i4"), ("label", "u1"), ("votes", "<u2")])
WIDE_VOTES_DTYPE = np.dtype([("voxel", "<i4"), ("label", "<u2"), ("votes", "<u2")])
# Level 6, zlib's own, takes 6 times as long, and saves 3 %: voxels are in order, so what repeats is always four bytes back.
_VOTES_LEVELS = {"voxel": 1, "label": 4, "votes": 4}
_MOST_CLASSES = 256
CERTAIN = (
    65535  # the number that means a probability of 1, in the column `votes` of `<grid>/classes` and in `probabilities`
)


Per = Literal["point", "voxel", "vote", "box", "scan"]
Kind = Literal[
    "position", "vector", "class", "pairs", "id", "value", "count", "probability", "flags", "votes", "boxes", "picture"
]


@dataclass(frozen=True, kw_only=True)
class Field:
    """The content of one file per frame.

    Stores, packing, converting, `info` and `validate` use `per` and `kind` to decide how to handle a field, not its name.

    Attributes:
        name: name of the field in a Source and a Sink.
        folder: folder under `<coordinates>/`.
        suffix: ending of the file name.
        per: what one row of the file belongs to: "point" (one row per point of the scan), "voxel" (one value per voxel of the grid),
            "vote" (one row per vote), "box" (one row per box), or "scan" (the whole file belongs to the scan).
        kind: what the values are: "position" and "vector" (these change with the axes), "class" (ids of the class table), "pairs" (of a class
            and its probability), "id" (unsigned whole numbers, such as actors), "value" (any number), "count", "probability" (0 to 1),
            "flags" (bits), "votes" and "boxes" (tables), "picture" (the bytes of a file).
        dtype: NumPy type on disk, little-endian; "" for tables, whose columns have types of their own.
        names: name of each value of a row.
        unit: unit of the values.
        meaning: one line for the documentation.
        published: whether the published download contains the field.
    """

    name: str
    folder: str
    suffix: str
    per: Per
    kind: Kind
    dtype: str
    names: tuple[str, ...]
    unit: str
    meaning: str
    published: bool = True

    @property
    def columns(self) -> int | None:
        """Number of values per row; None for a flat array."""
        return len(self.names) if self.kind in ("position", "vector", "pairs") else None

    def file(self, frame: int) -> str:
        """Return the path of a frame's file under `<coordinates>/`."""
        return f"{self.folder}/{frame:06d}{self.suffix}"

    def decode(self, data: bytes | memoryview, where: str, shape: tuple[int, ...] | None = None) -> NDArray[Any]:
        """Return the content of a file as an array, without a copy if the type allows it.

        Args:
            data: the whole file.
            where: the file, for errors.
            shape: shape of the grid, for its fields; None computes the number of rows from the size of the file.

        Raises:
            FormatError: the size of the file does not match.
        """
        if self.kind == "votes":
            return _decode_votes(data, where, shape)
        if self.kind == "boxes":
            return _decode_boxes(data, where)
        dtype, row = np.dtype(self.dtype), np.dtype(self.dtype).itemsize * (self.columns or 1)
        size = len(data)
        if shape is not None and size != self.size_of(shape):
            expected = f"{self.size_of(shape)} bytes ({' x '.join(map(str, shape))} {dtype.name})"
            raise FormatError(
                where, expected=expected, found=str(size), advice="the file is cut short, or belongs to another grid"
            )
        if size % row:
            raise FormatError(
                where,
                expected=f"a multiple of {row} bytes ({self.columns or 1} {dtype.name} per row)",
                found=str(size),
                advice="the file may be cut short",
            )
        array = np.frombuffer(data, dtype)
        if shape is not None:
            return array.reshape(shape)
        return array if self.columns is None else array.reshape(-1, self.columns)

    def size_of(self, shape: tuple[int, ...] | None) -> int | None:
        """Return the bytes of a file of a grid of some shape; None where they are not known before it is read."""
        return None if shape is None or self.per != "voxel" else np.dtype(self.dtype).itemsize * math.prod(shape)

    def encode(self, array: NDArray[Any], where: str) -> bytes | memoryview:
        """Return the bytes of a frame's file.

        Raises:
            FormatError: the shape or the type of the array does not match the field.
        """
        self.check(array, where)
        if self.kind == "votes":
            return _encode_votes(array)
        if self.kind == "boxes":
            return array.tobytes()
        return np.ascontiguousarray(array, np.dtype(self.dtype)).reshape(-1).view(np.uint8).data

    def check(self, array: NDArray[Any], where: str) -> None:
        """Check that an array has the shape and the type of a frame of the field.

        Raises:
            FormatError: the shape or the type does not match; the message names the file `where`.
        """
        if self.kind == "votes":
            if array.dtype not in (VOTES_DTYPE, WIDE_VOTES_DTYPE):
                raise FormatError(where, expected="a table of voxel, label and votes", found=str(array.dtype))
            return
        if self.kind == "boxes":
            if array.dtype != BOXES_DTYPE or array.ndim != 1:
                raise FormatError(where, expected="a table of boxes", found=f"{array.dtype}, shape {array.shape}")
            return
        if self.columns is not None and (array.ndim != 2 or array.shape[1] != self.columns):
            raise FormatError(where, expected=f"shape (N, {self.columns})", found=f"{array.shape}")
        dtype = np.dtype(self.dtype)
        if dtype.kind == "u" and array.dtype.kind not in "ub":
            raise FormatError(where, expected="unsigned integers", found=str(array.dtype))
        if dtype.kind == "u" and array.dtype.itemsize > dtype.itemsize:
            raise FormatError(where, expected=f"at most {dtype.name}", found=str(array.dtype))


SCAN_FIELDS: dict[str, Field] = {
    field.name: field
    for field in (
        Field(
            name="points", folder="velodyne", suffix=".bin", per="point", kind="position",
            dtype="<f4", names=("x", "y", "z", "fourth"), unit="m",
            meaning="x, y, z in the sensor frame; 4th column a zero placeholder (KITTI: remission)",
        ),
        Field(
            name="labels", folder="labels", suffix=".label", per="point", kind="class",
            dtype="<u4", names=("label",), unit="class",
            meaning="class of each point; 0 is unlabelled",
        ),
        Field(
            name="probabilities", folder="probabilities", suffix=".bin", per="point", kind="pairs",
            dtype="<u2", names=("class1", "share1", "class2", "share2", "class3", "share3"), unit="class, 1/65535",
            meaning="the likeliest classes of each point, the first first: class and probability in 1/65535; 0 and 0 where there is none",
            published=False,
        ),
        Field(
            name="flow", folder="predictions", suffix=".bin", per="point", kind="vector",
            dtype="<f4", names=("vx", "vy", "vz"), unit="m/s",
            meaning="velocity of the actor hit, sensor frame, ego motion removed",
        ),
        Field(
            name="instances", folder="instances", suffix=".label", per="point", kind="id",
            dtype="<u4", names=("actor",), unit="actor",
            meaning="actor of each point, 0 none, consistent over a sequence", published=False,
        ),
        Field(
            name="seconds", folder="seconds", suffix=".bin", per="point", kind="value",
            dtype="<f4", names=("seconds",), unit="s",
            meaning="time of each point after the time of the frame", published=False,
        ),
        Field(
            name="sensor", folder="sensor", suffix=".bin", per="point", kind="id",
            dtype="u1", names=("sensor",), unit="sensor",
            meaning="which of the sensors in carlasc.json took the point, from 0", published=False,
        ),
        Field(
            name="origins", folder="origins", suffix=".bin", per="point", kind="vector",
            dtype="<f4", names=("x", "y", "z"), unit="m",
            meaning="where the ray of each point began, sensor frame; absent: at the origin", published=False,
        ),
        Field(
            name="boxes", folder="boxes", suffix=".bin", per="box", kind="boxes",
            dtype="", names=BOXES_DTYPE.names or (), unit="m",
            meaning="tracked boxes: track, class, pose, size, whether annotated in this frame", published=False,
        ),
        Field(
            name="bev", folder="bev", suffix=".jpg", per="scan", kind="picture",
            dtype="u1", names=("jpeg",), unit="bytes",
            meaning="bird's-eye camera picture, as its JPEG bytes",
        ),
    )
}  # fmt: skip
_GRID_FIELDS: dict[str, Field] = {
    field.name: field
    for field in (
        Field(
            name="labels", folder="", suffix=".label", per="voxel", kind="class",
            dtype="<u4", names=("label",), unit="class",
            meaning="class of each voxel; 0 is free, also where unknown",
        ),
        Field(
            name="counts", folder="", suffix=".bin", per="voxel", kind="count",
            dtype="<f4", names=("votes",), unit="votes",
            meaning="votes of each voxel; 0 means unknown: never evaluated",
        ),
        Field(
            name="votes", folder="", suffix=".votes.npz", per="vote", kind="votes",
            dtype="", names=("voxel", "label", "votes"), unit="votes",
            meaning="votes by class: voxel (flat index), label, votes; only non-zero ones", published=False,
        ),
        Field(
            name="occupied", folder="", suffix=".occupied.bin", per="voxel", kind="probability",
            dtype="<f2", names=("occupied",), unit="probability",
            meaning="probability that the voxel is occupied; 0.5 where nothing is known", published=False,
        ),
        Field(
            name="classes", folder="", suffix=".classes.npz", per="vote", kind="votes",
            dtype="", names=("voxel", "label", "votes"), unit="1/65535",
            meaning="probability of each class of a voxel if it is occupied, in 1/65535: voxel, label, votes; only non-zero ones",
            published=False,
        ),
        Field(
            name="flags", folder="", suffix=".flags.bin", per="voxel", kind="flags",
            dtype="u1", names=("flags",), unit="bits",
            meaning="what else is known of the voxel: 1 inferred, 2 contested, 4 seen now, 8 in an actor", published=False,
        ),
        Field(
            name="views", folder="", suffix=".views.bin", per="voxel", kind="count",
            dtype="<u2", names=("views",), unit="scans",
            meaning="number of scans that saw the voxel", published=False,
        ),
    )
}  # fmt: skip
GRID_FIELDS = tuple(_GRID_FIELDS)
EVIDENCE_FIELDS = ("occupied", "classes", "flags", "views")  # what `carlasc regrid --keep-evidence` adds to a grid
LINE_FIELDS = ("poses", "times")


def field_named(name: str) -> Field:
    """Return the field with a flat name such as `points` or `evaluation/labels`.

    Raises:
        FormatError: the layout has no such field.
    """
    if name in SCAN_FIELDS:
        return SCAN_FIELDS[name]
    grid, _, part = name.rpartition("/")
    if grid and part in _GRID_FIELDS:
        return replace(_GRID_FIELDS[part], name=name, folder=grid)
    raise FormatError(
        f"field {name!r}",
        expected=f"one of {', '.join(SCAN_FIELDS)}, or <grid>/ and one of {', '.join(_GRID_FIELDS)}",
        found="none of them",
    )


def point_fields() -> tuple[str, ...]:
    """Return the names of the fields with one row per point, except `points`."""
    return tuple(name for name, field in SCAN_FIELDS.items() if field.per == "point" and field.kind != "position")


def scan_folders() -> frozenset[str]:
    """Return the folders of the scans' fields, under `<coordinates>/`."""
    return frozenset(field.folder for field in SCAN_FIELDS.values())


def params_file(grid: str) -> str:
    """Return the path of a grid's params.json under `<coordinates>/`."""
    return f"{grid}/{PARAMS}"


def derived(name: str, digest: str) -> str:
    """Return the path of a file that is derived of a sequence, such as its tracks, by the digest of what it is made from."""
    return f"{DERIVED}/{name}-{digest[:16]}.npz"


def report_file(grid: str) -> str:
    """Return the path of a grid's carlasc-report.json under `<coordinates>/`."""
    return f"{grid}/{REPORT}"


def grid_folder(spec: GridSpec) -> str:
    """Return the name of a grid's folder: `evaluation` for the published grid of its coordinates; otherwise it contains the size."""
    return (
        EVALUATION if spec == GridSpec.published(spec.coordinates) else f"{EVALUATION}_{'x'.join(map(str, spec.size))}"
    )


def frame_of(file_name: str, suffix: str) -> int | None:
    """Return the frame number of a file name such as `000012.label`; None if it is not the name of a frame with that suffix."""
    if not file_name.endswith(suffix):
        return None
    stem = file_name[: len(file_name) - len(suffix)]
    return (
        int(stem) if 6 <= len(stem) <= 18 and stem.isascii() and stem.isdigit() else None
    )  # 18 digits fit into an int64


def encode_poses(poses: NDArray[np.float64]) -> bytes:
    """Return the text of poses.txt for (F, 4, 4) transforms: the first three rows of each, row-major, '%.18e'."""
    return _encode_lines(poses[:, :3, :].reshape(-1, 12))


def decode_poses(data: bytes, where: str) -> NDArray[np.float64]:
    """Read poses.txt as (F, 4, 4) float64.

    Raises:
        FormatError: a line does not have 12 numbers.
    """
    rows = _decode_lines(data, 12, where)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :] = rows.reshape(-1, 3, 4)
    return poses


def encode_times(times: NDArray[np.float64]) -> bytes:
    """Return the text of times.txt for (F,) seconds: one number per line, '%.18e'."""
    return _encode_lines(np.asarray(times, np.float64).reshape(-1, 1))


def decode_times(data: bytes, where: str) -> NDArray[np.float64]:
    """Read times.txt as (F,) float64 seconds.

    Raises:
        FormatError: a line is not a number.
    """
    return _decode_lines(data, 1, where)[:, 0]


def _encode_lines(rows: NDArray[np.float64]) -> bytes:
    return "".join(" ".join(f"{value:.18e}" for value in row) + "\n" for row in rows.tolist()).encode()


def _decode_lines(data: bytes, columns: int, where: str) -> NDArray[np.float64]:
    try:
        rows = [list(map(float, line.split())) for line in data.decode().splitlines() if line.strip()]
    except (UnicodeDecodeError, ValueError) as error:
        raise FormatError(
            where, expected=f"{columns} numbers per line", found="something else", advice=str(error)
        ) from error
    for number, row in enumerate(rows, 1):
        if len(row) != columns:
            raise FormatError(where, expected=f"{columns} numbers per line", found=f"{len(row)} in line {number}")
    return np.array(rows, np.float64).reshape(-1, columns)


def _decode_votes(data: bytes | memoryview, where: str, shape: tuple[int, ...] | None) -> NDArray[Any]:
    # A voxel has at most one row for each class; as many for every voxel of a grid are more than any data set has classes.
    most = None if shape is None else _MOST_CLASSES * math.prod(shape)
    with open_npz(data, where) as archive:
        labels = archive.read("label", ArrayFormat(("u1", "<u2"), (None,), most))
        votes = np.empty(len(labels), VOTES_DTYPE if labels.itemsize == 1 else WIDE_VOTES_DTYPE)
        votes["label"] = labels
        for name in ("voxel", "votes"):
            votes[name] = archive.read(name, ArrayFormat((VOTES_DTYPE[name].str,), labels.shape))
    return votes


def _decode_boxes(data: bytes | memoryview, where: str) -> NDArray[Any]:
    if len(data) % BOXES_DTYPE.itemsize:
        raise FormatError(
            where,
            expected=f"a multiple of {BOXES_DTYPE.itemsize} bytes (a box each)",
            found=str(len(data)),
            advice="the file may be cut short",
        )
    return np.frombuffer(data, BOXES_DTYPE)


def _encode_votes(votes: NDArray[Any]) -> bytes:
    return npz_bytes({name: (votes[name], level) for name, level in _VOTES_LEVELS.items()})
