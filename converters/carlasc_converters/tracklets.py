"""tracklet_labels.xml of KITTI's raw data: the tracked boxes of a drive, as boost's serialisation
writes them.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from carlasc.core.boxes import Boxes
from carlasc.core.geometry import rotation_z, translation
from carlasc.errors import FormatError
from carlasc_converters.files import read_bytes
from carlasc_converters.kitti_boxes import BoxRows, class_of

MAX_BYTES = 256 << 20  # the files of KITTI have at most some ten megabytes
_INTERPOLATED = (
    1  # the state of a box that was interpolated between two others; 2 means that it was drawn
)


def read_tracklets(path: Path, frames: list[int]) -> dict[int, Boxes]:
    """Read the boxes of some frames, in the frame of the LiDAR: x forward, y left, z up.

    Tracks count from 1, in the order of the file.

    Boxes that the annotation tool interpolated between two others are marked as not annotated.

    Raises:
        FormatError: the file is damaged or too large, or names a type of object that KITTI does not
            have.
    """
    items = _items(path)
    rows = BoxRows(str(path), frames)
    for track, item in enumerate(items, 1):
        where = f"{path}: tracklet {track}"
        label = class_of(_text(item, "objectType", where), where)
        size = np.array([_number(item, name, where) for name in ("l", "w", "h")])
        first = _text(item, "first_frame", where)
        if not (first.isascii() and first.isdigit()):
            raise FormatError(where, expected="a frame number for first_frame", found=repr(first))
        poses = item.find("poses")
        if poses is None:
            raise FormatError(where, expected="poses", found="none", advice="copy the file again")
        for frame, pose in enumerate(poses.findall("item"), int(first)):
            # of the middle of the underside
            x, y, z = (_number(pose, name, where) for name in ("tx", "ty", "tz"))
            lidar_T_box = translation((x, y, z + size[2] / 2)) @ rotation_z(
                _number(pose, "rz", where)
            )
            drawn = pose.findtext("state", "").strip() != str(_INTERPOLATED)
            rows.add(frame, track, label, lidar_T_box, size, annotated=drawn)
    return rows.boxes()


def _items(path: Path) -> list[ElementTree.Element]:
    """Return the elements of the tracklets."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise FormatError(path, expected=f"at most {MAX_BYTES} bytes", found=size)
    data = read_bytes(path)
    # entities can make a small file very large, and other encodings can hide them
    if b"<!ENTITY" in data or b"\0" in data:
        found = "an entity" if b"<!ENTITY" in data else "another encoding"
        raise FormatError(
            path,
            expected="XML in UTF-8 without entities",
            found=found,
            advice="copy the file again",
        )
    try:
        root = ElementTree.fromstring(data)
    except (
        ElementTree.ParseError,
        LookupError,
        ValueError,
    ) as error:  # LookupError: an unknown encoding
        raise FormatError(
            path, expected="XML", found=f"damage: {error}", advice="copy the file again"
        ) from error
    tracklets = root.find("tracklets")
    if tracklets is None:
        raise FormatError(
            path, expected="tracklets in boost_serialization", found=f"<{root.tag}> without them"
        )
    items = tracklets.findall("item")
    if tracklets.findtext("count", "").strip() not in ("", str(len(items))):
        count = tracklets.findtext("count", "").strip()
        raise FormatError(
            path, expected=f"{count} tracklets", found=len(items), advice="copy the file again"
        )
    return items


def _text(element: ElementTree.Element, name: str, where: str) -> str:
    text = element.findtext(name)
    if text is None:
        raise FormatError(where, expected=name, found="none", advice="copy the file again")
    return text.strip()


def _number(element: ElementTree.Element, name: str, where: str) -> float:
    text = _text(element, name, where)
    try:
        return float(text)
    except ValueError:
        raise FormatError(where, expected=f"a number for {name}", found=repr(text)) from None
