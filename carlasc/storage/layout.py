"""The published layout as one table (field, file name, type, shape, unit), and carlasc.json.

No other module contains file names.

    <split>/<sequence>/<coordinates>/velodyne/000000.bin, ...: see the format page,
    `docs/format.md#layout`

Field names are flat: `points`, `labels`, ... for scans, `<grid>/labels`, `<grid>/counts`, ... for
the grid in the folder `<grid>`. `poses` and `times` are in text files with one line per frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from typing import Any, cast, get_args

import numpy as np

from carlasc.core.arrays import FloatArray
from carlasc.core.boxes import BOXES_DTYPE
from carlasc.core.choices import Axes as Axes  # noqa: PLC0414 (public in this room)
from carlasc.core.choices import Coordinates
from carlasc.core.classes import ClassTable
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA, table_from_json, table_to_json
from carlasc.errors import FormatError
from carlasc.storage.field_files import Field
from carlasc.storage.files import parse_json, to_json

SPLITS = ("Train", "Val", "Test")
COORDINATES = ("cartesian", "cylindrical")
EVALUATION = "evaluation"  # the folder of the published grid

POSES = "poses.txt"
TIMES = "times.txt"
METADATA = "carlasc.json"
FORMAT = 2
"""Version of carlasc.json.

Version 1 had no key `format`, and `frame` ("carlasc" or "kitti") where version 2 has `axes`.
"""
PREDICTED = "predicted by "
"""Prefix of the key `labels` of carlasc.json for predicted labels; the name of the network follows.
"""
_AXES: dict[str, Axes] = {"carlasc": "left", "kitti": "right"}  # by the `frame` of version 1
CAMERAS = "cameras.json"
PARAMS = "params.json"
REPORT = "carlasc-report.json"
DERIVED = (
    ".carlasc"  # folder of data derived from a sequence: not a field, never packed, safe to delete
)

FRAME_PERIOD_S = 0.1  # scans are recorded at 10 Hz; fact: frame-period
# value for a probability of 1, in the column `votes` of `<grid>/classes` and in `probabilities`
CERTAIN = 65535


def _table(*fields: Field) -> dict[str, Field]:
    return {field.name: field for field in fields}


# The values of a row are, in this order: name, folder, suffix, per, kind, type, names of the values
# of a row, unit, meaning (see `Field`).
SCAN_FIELDS = _table(
    Field("points", "velodyne", ".bin", "point", "position", "<f4", ("x", "y", "z", "fourth"),
          "m", "x, y, z in the sensor frame; 4th column a zero placeholder (KITTI: remission)",
          published=True),
    Field("labels", "labels", ".label", "point", "class", "<u4", ("label",),
          "class", "class of each point; 0 is unlabelled", published=True),
    Field("probabilities", "probabilities", ".bin", "point", "pairs", "<u2",
          ("class1", "share1", "class2", "share2", "class3", "share3"),
          "class, 1/65535", "the likeliest classes of each point, the first first: class and "
          "probability in 1/65535; 0 and 0 where there is none"),
    Field("flow", "predictions", ".bin", "point", "vector", "<f4", ("vx", "vy", "vz"),
          "m/s", "velocity of the actor hit, sensor frame, ego motion removed", published=True),
    Field("instances", "instances", ".label", "point", "id", "<u4", ("actor",),
          "actor", "actor of each point, 0 none, consistent over a sequence"),
    Field("seconds", "seconds", ".bin", "point", "value", "<f4", ("seconds",),
          "s", "time of each point after the time of the frame"),
    Field("sensor", "sensor", ".bin", "point", "id", "u1", ("sensor",),
          "sensor", "which of the sensors in carlasc.json took the point, from 0"),
    Field("origins", "origins", ".bin", "point", "vector", "<f4", ("x", "y", "z"),
          "m", "where the ray of each point began, sensor frame; absent: at the origin"),
    Field("boxes", "boxes", ".bin", "box", "boxes", "", BOXES_DTYPE.names or (),
          "m", "tracked boxes: track, class, pose, size, whether annotated in this frame"),
    Field("bev", "bev", ".jpg", "scan", "picture", "u1", ("jpeg",),
          "bytes", "bird's-eye camera picture, as its JPEG bytes", published=True),
)  # fmt: skip
_GRID_FIELDS = _table(
    Field("labels", "", ".label", "voxel", "class", "<u4", ("label",),
          "class", "class of each voxel; 0 is free, also where unknown", published=True),
    Field("counts", "", ".bin", "voxel", "count", "<f4", ("votes",),
          "votes", "votes of each voxel; 0 means unknown: never evaluated", published=True),
    Field("votes", "", ".votes.npz", "vote", "votes", "", ("voxel", "label", "votes"),
          "votes", "votes by class: voxel (flat index), label, votes; only non-zero ones"),
    Field("occupied", "", ".occupied.bin", "voxel", "probability", "<f2", ("occupied",),
          "probability", "probability that the voxel is occupied; 0.5 where nothing is known"),
    Field("classes", "", ".classes.npz", "vote", "votes", "", ("voxel", "label", "votes"),
          "1/65535", "probability of each class of a voxel if it is occupied, in 1/65535: "
          "voxel, label, votes; only non-zero ones"),
    Field("flags", "", ".flags.bin", "voxel", "flags", "u1", ("flags",),
          "bits", "what else is known of the voxel: 1 inferred, 2 contested, 4 seen now, 8 in "
          "an actor"),
    Field("views", "", ".views.bin", "voxel", "count", "<u2", ("views",),
          "scans", "number of scans that saw the voxel"),
    Field("instance", "", ".instance", "voxel", "id", "<u4", ("actor",),
          "actor", "actor that the voxel belongs to, 0 none, consistent over a sequence"),
    Field("velocity", "", ".velocity.npz", "moving voxel", "velocities", "",
          ("voxel", "velocity"),
          "m/s", "velocity of each voxel that moves: voxel (flat index), velocity; sensor "
          "frame, ego motion removed"),
    Field("seen", "", ".seen", "voxel", "flags", "u1", ("seen",),
          "bits", "which cameras see the voxel: bit i for camera i of cameras.json"),
)  # fmt: skip
IMAGE_FOLDERS = {
    "images": "image of a camera, as its JPEG or PNG bytes",
    "image_labels": "class of each pixel of a camera's image, as the bytes of an 8-bit or 16-bit "
    "PNG",
    "image_instances": "actor of each pixel, 0 none, as the bytes of a 16-bit PNG",
    "image_depths": "depth of each pixel along the camera's axis in 1/256 m, 0 none, as the bytes "
    "of a 16-bit PNG",
}
"""Folders with one subfolder per camera, and their content.

The field of images/front/000000.jpg is `images.front.jpg`.
"""
IMAGE_SUFFIXES = ("jpg", "png")
GRID_FIELDS = tuple(_GRID_FIELDS)
ACTOR_FIELDS = ("instance", "velocity")  # fields that `carlasc regrid --keep-actors` adds to a grid
# fields that `carlasc regrid --keep-evidence` adds to a grid
EVIDENCE_FIELDS = (
    "occupied",
    "classes",
    "flags",
    "views",
)
LINE_FIELDS = ("poses", "times")


def identity_of(path: str) -> tuple[str | None, str, Coordinates]:
    """Return the split, the name and the coordinates of a sequence from its path.

    The path is that of the `<coordinates>` folder, absolute or relative; leading parts may be
    missing. If the last part is not a name of coordinates, it is the name of the sequence, and the
    coordinates are Cartesian.
    """
    parts = [
        part for part in PurePosixPath(path.replace("\\", "/")).parts if part not in ("/", ".")
    ]
    coordinates = parts.pop() if parts and parts[-1] in COORDINATES else "cartesian"
    name = parts.pop() if parts else ""
    split = next((split for split in SPLITS if parts and parts[-1].lower() == split.lower()), None)
    return split, name, cast(Coordinates, coordinates)


def place_of(path: str) -> str:
    """Return the path of a sequence without its `<coordinates>`."""
    head, _, last = path.rpartition("/")
    return head if last in COORDINATES else path


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
    folder, _, rest = name.partition(".")
    camera, _, suffix = rest.rpartition(".")
    if folder in IMAGE_FOLDERS and camera and suffix in IMAGE_SUFFIXES and "/" not in name:
        return Field(
            name, f"{folder}/{camera}", f".{suffix}", "scan", "picture", "u1", (suffix,),
            "bytes", IMAGE_FOLDERS[folder],
        )  # fmt: skip
    raise FormatError(
        f"field {name!r}",
        expected=f"one of {', '.join(SCAN_FIELDS)}, "
        f"or <grid>/ and one of {', '.join(_GRID_FIELDS)}",
        found="none of them",
    )


def point_fields() -> tuple[str, ...]:
    """Return the names of the fields with one row per point, except `points`."""
    return tuple(
        name
        for name, field in SCAN_FIELDS.items()
        if field.per == "point" and field.kind != "position"
    )


def scan_folders() -> frozenset[str]:
    """Return the folders of the fields of scans, under `<coordinates>/`."""
    return frozenset(field.folder for field in SCAN_FIELDS.values())


def params_file(grid: str) -> str:
    """Return the path of a grid's params.json under `<coordinates>/`."""
    return f"{grid}/{PARAMS}"


def derived(name: str, digest: str) -> str:
    """Return the path of a file derived from a sequence, such as its tracks.

    `digest` identifies its input and settings.
    """
    return f"{DERIVED}/{name}-{digest[:16]}.npz"


def record_file(name: str) -> str:
    """Return the path of a table of `carlasc.storage.inputs` under `<coordinates>/`."""
    return f"{DERIVED}/{name}.json"


COPIED = record_file("copied-").removesuffix(".json")
"""Beginning of the records of what a copy was made from; they are not listed in a store."""


def report_file(grid: str) -> str:
    """Return the path of a grid's carlasc-report.json under `<coordinates>/`."""
    return f"{grid}/{REPORT}"


def grid_folder(spec: GridSpec) -> str:
    """Return the name of a grid's folder: `evaluation` for the published grid of its coordinates;
    otherwise it contains the size.
    """
    return (
        EVALUATION
        if spec == GridSpec.published(spec.coordinates)
        else f"{EVALUATION}_{'x'.join(map(str, spec.size))}"
    )


def frame_of(file_name: str, suffix: str) -> int | None:
    """Return the frame number of a file name such as `000012.label`; None if it is not the name of
    a frame with that suffix.
    """
    if not file_name.endswith(suffix):
        return None
    stem = file_name[: len(file_name) - len(suffix)]
    # 18 digits fit into an int64
    return int(stem) if 6 <= len(stem) <= 18 and stem.isascii() and stem.isdigit() else None


def encode_poses(poses: FloatArray) -> bytes:
    """Return the text of poses.txt for (F, 4, 4) transforms: the first three rows of each,
    row-major, '%.18e'.
    """
    return _encode_lines(poses[:, :3, :].reshape(-1, 12))


def decode_poses(data: bytes, where: str) -> FloatArray:
    """Read poses.txt as (F, 4, 4) float64.

    Raises:
        FormatError: a line does not have 12 numbers.
    """
    rows = _decode_lines(data, 12, where)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :] = rows.reshape(-1, 3, 4)
    return poses


def encode_times(times: FloatArray) -> bytes:
    """Return the text of times.txt for (F,) seconds: one number per line, '%.18e'."""
    return _encode_lines(np.asarray(times, np.float64).reshape(-1, 1))


def decode_times(data: bytes, where: str) -> FloatArray:
    """Read times.txt as (F,) float64 seconds.

    Raises:
        FormatError: a line is not a number.
    """
    return _decode_lines(data, 1, where)[:, 0]


def _encode_lines(rows: FloatArray) -> bytes:
    return "".join(
        " ".join(f"{value:.18e}" for value in row) + "\n" for row in rows.tolist()
    ).encode()


def _decode_lines(data: bytes, columns: int, where: str) -> FloatArray:
    try:
        rows = [
            list(map(float, line.split())) for line in data.decode().splitlines() if line.strip()
        ]
    except (UnicodeDecodeError, ValueError) as error:
        raise FormatError(
            where, expected=f"{columns} numbers per line", found="something else", advice=str(error)
        ) from error
    for number, row in enumerate(rows, 1):
        if len(row) != columns:
            raise FormatError(
                where, expected=f"{columns} numbers per line", found=f"{len(row)} in line {number}"
            )
    return np.array(rows, np.float64).reshape(-1, columns)


def check_format(version: object, where: str) -> None:
    """Check that this version of carlasc reads files of a version of the format.

    Raises:
        FormatError: it is not a version, or is a newer one.
    """
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise FormatError(where, expected="an integer above 0 in format", found=repr(version))
    if version > FORMAT:
        raise FormatError(
            where,
            expected=f"format {FORMAT} or older",
            found=f"format {version}",
            advice="upgrade carlasc to read it",
        )


@dataclass(frozen=True)
class Metadata:
    """The content of carlasc.json. The defaults apply if the file does not exist.

    Attributes:
        axes: "left" (left-handed, y to the right: CarlaSC, CARLA) or "right" (right-handed, y to
            the left: SemanticKITTI, ROS).
        classes: class table of the labels.
        sensor: description of the sensor.
        min_range_m: points nearer than this are left out of grids (the roof of the ego vehicle),
            metres.
        max_range_m: points farther than this are left out of grids, metres.
        source: data that the sequence was made from.
        extra: other keys, unchanged.
    """

    axes: Axes = "left"
    classes: ClassTable = CARLA
    sensor: str | None = None
    min_range_m: float | None = None
    max_range_m: float | None = None
    source: str | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def has_rays(self) -> bool:
        """Whether points have rays from a known sensor position.

        Without rays, there is no free space.
        """
        return self.extra.get("rays") is not False

    @property
    def height_m(self) -> float | None:
        """Height of the first sensor above the ground; None if it is not known."""
        sensors = self.extra.get("sensors")
        first = sensors[0] if isinstance(sensors, list) and sensors else None
        height: Any = first.get("height_m") if isinstance(first, dict) else None
        is_number = isinstance(height, int | float) and not isinstance(height, bool)
        return float(height) if is_number else None

    @property
    def predicted(self) -> str | None:
        """The key `labels`, "predicted by ...", if labels are predicted; otherwise None."""
        labels = self.extra.get("labels")
        return labels if isinstance(labels, str) and labels.startswith(PREDICTED) else None

    @classmethod
    def from_json(cls, data: bytes, where: str) -> Metadata:
        """Read carlasc.json, of this version or an older one; `where` is the file named in errors.

        Raises:
            FormatError: it is not a JSON object, is of a newer version, or has unknown axes or an
                unknown or damaged class table.
        """
        values = parse_json(data, where)
        check_format(values.pop("format", 1), where)
        ranges: dict[str, Any] = {
            name: values.pop(name, None) for name in ("min_range_m", "max_range_m")
        }
        for name, value in ranges.items():
            if value is not None and (
                isinstance(value, bool) or not isinstance(value, int | float) or value < 0
            ):
                raise FormatError(
                    where, expected=f"a number of metres in {name}", found=repr(value)
                )
        return cls(
            _read_axes(values, where),
            table_from_json(values.pop("classes", CARLA.name), where),
            values.pop("sensor", None),
            **ranges,
            source=values.pop("source", None),
            extra=values,
        )

    def to_json(self) -> bytes:
        """Return the bytes of carlasc.json.

        A class table that is not built into carlasc is written in full.
        """
        values = {"format": FORMAT, **vars(self), "classes": table_to_json(self.classes)}
        extra = values.pop("extra")
        return to_json({key: value for key, value in values.items() if value is not None} | extra)


def _read_axes(values: dict[str, Any], where: str) -> Axes:
    """Remove `axes` from the values of carlasc.json (`frame` in version 1), and return them."""
    frame = values.pop("frame", None)
    axes = values.pop("axes", None)
    if frame is not None and frame not in _AXES:
        raise FormatError(where, expected=f"{' or '.join(_AXES)} in frame", found=repr(frame))
    if axes is not None and axes not in get_args(Axes):
        raise FormatError(
            where, expected=f"{' or '.join(get_args(Axes))} in axes", found=repr(axes)
        )
    meant: Axes | None = None if frame is None else _AXES[frame]
    if axes is not None and meant is not None and axes != meant:
        raise FormatError(where, expected=f"the axes {meant}, as frame {frame} says", found=axes)
    return axes or meant or "left"
