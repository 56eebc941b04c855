"""The cameras of a bag: projections from CameraInfo, and images from Image or CompressedImage in
the same namespace.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core import CameraModel
from carlasc.core.cameras import Lens
from carlasc.core.geometry import Transform
from carlasc.errors import FormatError, reading
from carlasc.storage.camera_files import encode_image
from carlasc_converters.bag_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGES,
    decode,
    read_stamp,
)
from carlasc_converters.bag_topics import BagFiles, MessagePlace, Topic
from carlasc_converters.image_files import nearest_rows

_MODELS: dict[str, tuple[Lens, tuple[int, ...]]] = {
    "plumb_bob": ("radial-tangential", (4, 5)),
    "rational_polynomial": ("radial-tangential", (8,)),
    "equidistant": ("fisheye", (4,)),
}
_CHANNELS = {
    "mono8": (0,),
    "rgb8": (0, 1, 2),
    "bgr8": (2, 1, 0),
    "rgba8": (0, 1, 2),
    "bgra8": (2, 1, 0),
}
_WIDTHS = {"mono8": 1, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
_ENDINGS = {b"\xff\xd8": "jpg", b"\x89PNG"[:2]: "png"}


@dataclass(frozen=True)
class BagCamera:
    """A camera of a bag.

    Attributes:
        info: position of its first CameraInfo.
        topic: topic of its images; None without one.
    """

    info: MessagePlace
    topic: Topic | None

    @property
    def name(self) -> str:
        """The namespace of its topics, with "-" between the parts."""
        return "-".join(filter(None, self.info.channel.topic.split("/")[:-1])) or "camera"

    @cached_property
    def message(self) -> Any:
        """The first CameraInfo."""
        return decode(self.info.read(), self.info.channel, str(self.info))

    @property
    def frame(self) -> str:
        """Its frame: x to the right, y down, z ahead (REP 103)."""
        return str(self.message.header.frame_id).removeprefix("/")

    @cached_property
    def images(self) -> tuple[NDArray[np.int64], list[MessagePlace]]:
        """(N,) increasing times of the images, nanoseconds, and their positions."""
        places = [] if self.topic is None else list(self.topic.places())
        stamps = np.array(
            [read_stamp(place.read(), place.channel, str(place)) for place in places], np.int64
        )
        times, first = np.unique(stamps, return_index=True)
        return times, [places[row] for row in first.tolist()]

    def nearest(self, frames: NDArray[np.int64]) -> list[int | None]:
        """Return the row of the image nearest to each of (F,) times, nanoseconds; None if it is
        nearer to another frame.
        """
        times, _ = self.images
        if not len(times):
            return [None] * len(frames)
        period = float(np.median(np.diff(frames))) if len(frames) > 1 else np.inf
        rows = nearest_rows(times, frames)
        near = np.abs(times[rows] - frames) <= period / 2
        return [row if ok else None for row, ok in zip(rows.tolist(), near.tolist(), strict=True)]

    def model(self, vehicle_T_camera: Transform, times: NDArray[np.float64] | None) -> CameraModel:
        """Return the camera; images that the topic calls rectified have no distortion.

        Raises:
            FormatError: the model of its distortion is unknown, or numbers do not fit it.
        """
        info, where = self.message, str(self.info)
        with reading(where, "a message of type CameraInfo"):
            given = {
                key: np.array(getattr(info, key.lower(), getattr(info, key, ())), np.float64)
                for key in "DKP"
            }
            kind, distortion = str(info.distortion_model), given["D"]
            width, height = int(info.width), int(info.height)
            rectified = (
                self.topic is not None
                and "rect"
                in self.topic.channel.topic.removesuffix("/compressed").rpartition("/")[2]
            )
            matrix = given["P"].reshape(3, 4)[:, :3] if rectified else given["K"].reshape(3, 3)
        model: Lens = "pinhole"
        if not rectified and distortion.any():
            model, counts = _MODELS.get(kind, ("pinhole", ()))
            if len(distortion) not in counts:
                expected = "one of the models " + ", ".join(
                    f"{name} ({n[-1]})" for name, (_, n) in _MODELS.items()
                )
                raise FormatError(
                    where, expected=expected, found=f"{kind!r} with {len(distortion)} coefficients"
                )
        coefficients = tuple(distortion.tolist()) if model != "pinhole" else ()
        return CameraModel(
            name=self.name,
            width=width,
            height=height,
            model=model,
            matrix=matrix,
            distortion=coefficients,
            sensor_T_camera=vehicle_T_camera,
            times=times,
        )

    def read(self, row: int) -> tuple[str, bytes]:
        """Return the ending and the bytes of a file of an image.

        Raises:
            FormatError: the image is cut short, or its encoding is not supported.
        """
        place = self.images[1][row]
        message, where = decode(place.read(), place.channel, str(place)), str(place)
        with reading(where, "an image"):
            data = np.asarray(message.data, np.uint8)
            if place.channel.type == COMPRESSED_IMAGE:
                if (ending := _ENDINGS.get(data[:2].tobytes())) is None:
                    raise FormatError(where, expected="a JPEG or PNG", found=str(message.format))
                return ending, data.tobytes()
            if message.encoding not in _CHANNELS:
                raise FormatError(
                    where, expected=f"one of {', '.join(_CHANNELS)}", found=repr(message.encoding)
                )
            rows = data[: message.height * message.step].reshape(message.height, message.step)
            wide = _WIDTHS[message.encoding]
            pixels = rows[:, : message.width * wide].reshape(message.height, message.width, wide)
            chosen = np.ascontiguousarray(pixels[..., list(_CHANNELS[message.encoding])])
            return "png", encode_image(chosen[..., 0] if wide == 1 else chosen, "PNG").tobytes()


def find_cameras(files: BagFiles) -> list[BagCamera]:
    """Return the cameras of a bag, by the name of their topics; of several topics of images, the
    compressed one is read, because its messages are files.
    """
    images, found = files.of_types(IMAGES), []
    for topic in files.of_types((CAMERA_INFO,)):
        space = topic.channel.topic.rpartition("/")[0] + "/"
        own = [one for one in images if one.channel.topic.startswith(space)]
        own.sort(key=lambda one: (one.channel.type != COMPRESSED_IMAGE, one.channel.topic))
        found.append(BagCamera(next(topic.places()), own[0] if own else None))
    return found
