"""The class of each pixel of camera images, in the layout or in a folder of network predictions.

See `docs/howto/cameras.md`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from carlasc.core.cameras import CameraModel
from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import layout
from carlasc.storage.arrays import NUMBERS, ArrayFormat, read_npy
from carlasc.storage.camera_files import cameras_of, decode_image, image_fields, read_image
from carlasc.storage.protocol import Sequence

_SUFFIXES = (".png", ".npy")
_LAYOUT = "image_labels"


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
        known = image_fields(sequence, _LAYOUT).keys() if files is None else files.keys()
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
                root or f"{sequence.location}/{_LAYOUT}",
                expected=f"classes of pixels, such as {example}",
                found="none",
                advice=advice if root is None else "",
            )
        return cls(sequence, files)

    def read(self, camera: CameraModel, frame: int) -> NDArray[Any] | None:
        """Return (H, W) integers, class ids, or (H, W, C) floats, the probability of each id; None
        without classes of the image.

        Raises:
            FormatError: the file is damaged, or has another size than the camera's images.
        """
        if self.files is None:
            field = image_fields(self.sequence, _LAYOUT).get(camera.name)
            if field is None or frame not in self.sequence.frames(field):
                return None
            return read_image(self.sequence, camera, frame, _LAYOUT)
        path = self.files.get(camera.name, {}).get(frame)
        if path is None:
            return None
        if path.suffix == ".png":
            return decode_image(path.read_bytes(), str(path), camera, color=False)
        array = read_npy(path, ArrayFormat(NUMBERS, None))
        size, is_float = (camera.height, camera.width), array.dtype.kind == "f"
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
