"""The cameras of a sequence: cameras.json, images, and the pose of each camera in a frame."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray, LabelArray, Uint8Array
from carlasc.core.cameras import CameraModel
from carlasc.core.choices import Axes
from carlasc.core.geometry import Transform, invert, slerp
from carlasc.errors import FormatError, MissingDataError, import_extra, reading
from carlasc.storage import layout
from carlasc.storage.files import parse_json, to_json
from carlasc.storage.protocol import Sequence

_FORMAT = 1
_SAME_TIME_S = 1e-6


def cameras_to_json(cameras: Iterable[CameraModel]) -> bytes:
    """Return the bytes of cameras.json."""
    return to_json({"format": _FORMAT, "cameras": [camera.to_dict() for camera in cameras]})


def cameras_of(sequence: Sequence) -> dict[str, CameraModel]:
    """Return the cameras of a sequence by name, in the order of cameras.json; empty if the file
    does not exist.

    Raises:
        FormatError: the file is damaged, two cameras have the same name, or the pose of a camera
            does not fit the axes of the scans.
    """
    if layout.CAMERAS not in sequence.documents():
        return {}
    where = f"{sequence.location}/{layout.CAMERAS}"
    return cameras_from_json(sequence.read_document(layout.CAMERAS), where, sequence.metadata.axes)


def cameras_from_json(data: bytes, where: str, axes: Axes) -> dict[str, CameraModel]:
    """Return the cameras of cameras.json by name.

    Args:
        data: the bytes of the file.
        where: the file, for errors.
        axes: handedness of the scans.

    Raises:
        FormatError: the file is damaged, two cameras have the same name, or the pose of a camera
            does not fit the axes of the scans.
    """
    values = parse_json(data, where)
    layout.check_format(values.get("format", 1), where)
    listed = values.get("cameras")
    if not isinstance(listed, list):
        raise FormatError(where, expected="a list of cameras", found=type(listed).__name__)
    cameras: dict[str, CameraModel] = {}
    for about in listed:
        camera = CameraModel.from_dict(about, where)
        if camera.name in cameras:
            raise FormatError(
                where, expected="a different name for each camera", found=f"two named {camera.name}"
            )
        kinds = {"right": "a rotation", "left": "a reflection"}
        found = kinds["right" if np.linalg.det(camera.sensor_T_camera[:3, :3]) > 0 else "left"]
        if found != kinds[axes]:
            advice = f"convert sensor_T_camera to the {axes}-handed axes of the scans"
            raise FormatError(
                f"{where}: {camera.name}: sensor_T_camera",
                expected=kinds[axes],
                found=found,
                advice=advice,
            )
        cameras[camera.name] = camera
    return cameras


def camera_named(sequence: Sequence, name: str) -> CameraModel:
    """Return a camera of a sequence.

    Raises:
        MissingDataError: the sequence has no such camera.
    """
    cameras = cameras_of(sequence)
    if name not in cameras:
        found = ", ".join(cameras) or f"no {layout.CAMERAS}"
        raise MissingDataError(sequence.location, expected=f"the camera {name}", found=found)
    return cameras[name]


def scan_T_camera(sequence: Sequence, camera: CameraModel, frame: int) -> Transform | None:
    """Return (4, 4) scan_T_camera, where camera is its pose at the time of the image of a frame;
    None if it took no image.

    The ego motion between the image and the scan is interpolated from poses.txt.

    Args:
        sequence: the sequence, with poses and times.
        camera: one of its cameras.
        frame: frame number.

    Raises:
        FormatError: image and scan are more than one frame apart.
    """
    documents = sequence.documents()
    if camera.times is None or not {layout.TIMES, layout.POSES} <= set(documents):
        return camera.sensor_T_camera
    times = sequence.times
    poses = sequence.poses
    line = sequence.line_of(frame, len(times), layout.TIMES)
    where = f"{sequence.location}/{layout.CAMERAS}: {camera.name}, frame {frame}"
    if len(camera.times) != len(times):
        raise FormatError(
            where,
            expected=f"{len(times)} times, as in times.txt",
            found=f"{len(camera.times)} times",
        )
    seconds = float(camera.times[line])
    if np.isnan(seconds):
        return None
    period = float(np.median(np.diff(times))) if len(times) > 1 else layout.FRAME_PERIOD_S
    if not abs(seconds - times[line]) <= period:
        found = f"{seconds - times[line]:+.3f} s"
        raise FormatError(
            where, expected=f"an image within a frame ({period:.3f} s) of the scan", found=found
        )
    if abs(seconds - times[line]) < _SAME_TIME_S or len(poses) != len(times):
        return camera.sensor_T_camera
    near = slice(max(0, line - 1), line + 2)
    first_T_then = slerp(poses[near], times[near], np.array([seconds]))[0]
    return np.asarray(invert(sequence.read_pose(frame)) @ first_T_then @ camera.sensor_T_camera)


def image_fields(sequence: Sequence, folder: str = "images") -> dict[str, str]:
    """Return the field of each camera's images, by the name of the camera.

    Args:
        sequence: the sequence.
        folder: one of `carlasc.storage.layout.IMAGE_FOLDERS`.
    """
    names = sorted(name for name in sequence.fields() if name.startswith(f"{folder}."))
    return {name.partition(".")[2].rpartition(".")[0]: name for name in names}


def has_image(sequence: Sequence, camera: CameraModel, frame: int) -> bool:
    """Whether an image of a frame exists, in its folder or where cameras.json refers to."""
    field = image_fields(sequence).get(camera.name)
    return bool(camera.images and _reference(sequence, camera, frame)) or (
        field is not None and frame in sequence.frames(field)
    )


def read_image(
    sequence: Sequence, camera: CameraModel, frame: int, folder: str = "images"
) -> AnyArray:
    """Return the image of a frame: (H, W, 3) uint8 RGB, or (H, W) integers: classes, instances or
    depths.

    Args:
        sequence: the sequence.
        camera: one of its cameras.
        frame: the frame.
        folder: one of `carlasc.storage.layout.IMAGE_FOLDERS`.

    Raises:
        MissingDataError: the image does not exist.
        FormatError: the image is cut short or damaged, or has another size than the camera's
            calibration.
        DependencyError: Pillow is not installed.
    """
    data, where = image_bytes(sequence, camera, frame, folder)
    return decode_image(data, where, camera, color=folder == "images")


def image_bytes(
    sequence: Sequence, camera: CameraModel, frame: int, folder: str = "images"
) -> tuple[bytes, str]:
    """Return the bytes of an image file, and its name for errors.

    Takes the arguments of `read_image`.

    Raises:
        MissingDataError: the image does not exist.
    """
    field = image_fields(sequence, folder).get(camera.name)
    if field is not None and frame in sequence.frames(field):
        where = f"{sequence.location}/{layout.field_named(field).file(frame)}"
        return sequence.read(field, frame).tobytes(), where
    if folder == "images" and (reference := _reference(sequence, camera, frame)):
        path = Path(sequence.location) / reference
        where = str(path)
        if not path.is_file():
            raise MissingDataError(
                where, expected=f"an image of the camera {camera.name}", found="no file"
            )
        with reading(where, "an image"):
            return path.read_bytes(), where
    raise MissingDataError(
        sequence.location,
        expected=f"{folder}/{camera.name}/{frame:06d}.jpg or .png",
        found="none",
        advice="convert with --images copy or link",
    )


@contextmanager
def opened_image(data: bytes, where: str) -> Iterator[Any]:
    """Open the bytes of a JPEG or PNG file as an image of Pillow.

    Raises:
        DependencyError: Pillow is not installed.
        FormatError: the image is damaged or far too large, or the block raised such an error.
    """
    with reading(where, "a whole JPEG or PNG"):
        image = import_extra("PIL.Image", "render")
        # Pillow gives other formats, such as PostScript, to other programs
        with image.open(io.BytesIO(data), formats=("JPEG", "PNG")) as picture:
            yield picture


def decode_image(data: bytes, where: str, camera: CameraModel, *, color: bool) -> AnyArray:
    """Return the pixels of a JPEG or PNG file of a camera, as `read_image` does.

    With `color`, they are (H, W, 3) RGB, otherwise (H, W).

    Raises:
        FormatError: the image is cut short or damaged, or has another size than the camera's
            calibration.
    """
    with opened_image(data, where) as picture:
        if picture.size != (camera.width, camera.height):
            size = f"{camera.width} x {camera.height}"
            expected = f"{size} pixels, as camera {camera.name} is calibrated"
            raise FormatError(
                where, expected=expected, found=f"{picture.size[0]} x {picture.size[1]}"
            )
        pixels = np.asarray(picture.convert("RGB") if color else picture)
    if not color and (pixels.ndim != 2 or pixels.dtype.kind not in "iu"):
        raise FormatError(
            where, expected="a PNG with one integer per pixel", found=f"shape {pixels.shape}"
        )
    return pixels


def encode_image(pixels: LabelArray, kind: str, quality: int = 90) -> Uint8Array:
    """Return an image as the bytes of a file: "JPEG" of (H, W, 3) uint8, or "PNG" of (H, W, 3)
    uint8 or (H, W) uint8 or uint16.

    Raises:
        DependencyError: Pillow is not installed.
    """
    buffer = io.BytesIO()
    options: Mapping[str, Any] = {"quality": quality} if kind == "JPEG" else {"compress_level": 1}
    import_extra("PIL.Image", "render").fromarray(pixels).save(buffer, kind, **options)
    return np.frombuffer(buffer.getvalue(), np.uint8)


def _reference(sequence: Sequence, camera: CameraModel, frame: int) -> str:
    if camera.images is None:
        return ""
    return camera.images[sequence.line_of(frame, len(camera.images), layout.CAMERAS)]
