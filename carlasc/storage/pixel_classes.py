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
        if root is None:
            found = cls(sequence, None)
            known = set(image_fields(sequence, _LAYOUT))
        else:
            found = cls(sequence, _files(sequence, root))
            known = set(found.files or ())
        if lost := sorted(known - set(cameras)):
            expected = f"cameras of {layout.CAMERAS}: {', '.join(cameras)}"
            raise FormatError(
                root or sequence.location,
                expected=expected,
                found=f"{lost[0]}, which has no calibration",
            )
        if not known:
            expected = (
                f"classes of pixels, such as {sequence.name}/{next(iter(cameras))}/000000.png"
            )
            advice = (
                "give the folder of a network's predictions as `pixels`" if root is None else ""
            )
            raise MissingDataError(
                root or f"{sequence.location}/{_LAYOUT}",
                expected=expected,
                found="none",
                advice=advice,
            )
        return found

    def has(self, camera: str, frame: int) -> bool:
        """Whether the classes of pixels exist for a camera and a frame."""
        if self.files is not None:
            return frame in self.files.get(camera, {})
        field = image_fields(self.sequence, _LAYOUT).get(camera)
        return field is not None and frame in self.sequence.frames(field)

    def read(self, camera: CameraModel, frame: int) -> NDArray[Any]:
        """Return (H, W) integers, class ids, or (H, W, C) floats, the probability of each id.

        Raises:
            FormatError: the file is damaged, or has another size than the camera's images.
        """
        if self.files is None:
            return read_image(self.sequence, camera, frame, _LAYOUT)
        path = self.files[camera.name][frame]
        if path.suffix == ".png":
            return decode_image(path.read_bytes(), str(path), camera, color=False)
        array = read_npy(path, ArrayFormat(NUMBERS, None))
        size, is_float = (camera.height, camera.width), array.dtype.kind == "f"
        if array.ndim != 2 + is_float or array.shape[:2] != size:
            name = camera.name
            expected = (
                f"{size} integers, or {size} floats per class, as camera {name} is calibrated"
            )
            raise FormatError(
                path, expected=expected, found=f"{array.dtype.name} of shape {array.shape}"
            )
        return array

    def stamps(self) -> list[tuple[str, int, int]]:
        """Return names, sizes and modification times of the files; empty for files of the layout,
        which belong to the source.
        """
        paths = [path for files in (self.files or {}).values() for path in files.values()]
        return [
            (str(path), found.st_size, found.st_mtime_ns)
            for path in sorted(paths)
            for found in (path.stat(),)
        ]


def _files(sequence: Sequence, root: Path) -> dict[str, dict[int, Path]]:
    # key: whether the path contains the name of the sequence
    named: dict[bool, dict[str, dict[int, Path]]] = {
        True: {},
        False: {},
    }
    for folder, _, names in os.walk(root):
        paths = {
            frame: Path(folder, name)
            for name in names
            for suffix in _SUFFIXES
            if (frame := layout.frame_of(name, suffix)) is not None
        }
        parts = Path(folder).relative_to(root).parts
        if not paths or not parts:
            continue
        mine = named[sequence.name in parts[:-1]]
        if parts[-1] in mine and (sequence.name in parts[:-1] or len(parts) == 1):
            raise FormatError(folder, expected=f"one folder of camera {parts[-1]}", found="two")
        if sequence.name in parts[:-1] or len(parts) == 1:
            mine[parts[-1]] = paths
    return named[True] or named[False]
