"""The classes of KITTI's tracked boxes, in its raw data and its tracking benchmark.

Points have no labels there.
"""

from __future__ import annotations

import numpy as np

from carlasc.core.arrays import FloatArray
from carlasc.core.boxes import Boxes
from carlasc.errors import FormatError
from carlasc_converters.class_rows import class_rows, tables_of

# name, colour, class of CARLA; ids in order; `Misc` are mostly trailers
_CLASSES = class_rows("""
    unlabeled 255 255 255 Free
    ground 128 64 128 Ground
    geometry 110 190 160 Other
    Car 0 0 142 Vehicle
    Van 60 90 230 Vehicle
    Truck 0 0 70 Vehicle
    Pedestrian 220 20 60 Pedestrian
    Person_sitting 150 20 90 Pedestrian
    Cyclist 240 70 190 Pedestrian
    Tram 0 80 100 Vehicle
    Misc 170 120 50 Vehicle
""")
KITTI, KITTI_TO_CARLA = tables_of(
    "kitti",
    _CLASSES,
    movable=frozenset(range(3, len(_CLASSES))),
    deformable=frozenset({6, 7}),
    ground=frozenset({1}),
    geometry_only=2,
)

ONLY_IN_VIEW = "boxes exist only in the view of the front camera: elsewhere, objects have no boxes"
_OTHER_NAMES = {"Person": "Person_sitting", "Person (sitting)": "Person_sitting"}
_TYPES = {name: index for index, name in KITTI.names.items() if index in KITTI.movable}


def class_of(kind: str, where: str) -> int:
    """Return the id of a type of object, as KITTI's files write it; `where` is the file and the
    place named in errors.

    Raises:
        FormatError: KITTI has no such type.
    """
    name = _OTHER_NAMES.get(kind, kind)
    if name not in _TYPES:
        raise FormatError(
            where, expected=f"a type of object: one of {', '.join(_TYPES)}", found=repr(kind)
        )
    return _TYPES[name]


class BoxRows:
    """Collects the boxes of the frames of a recording, in the frame of the LiDAR.

    Args:
        where: the file, for errors.
        frames: numbers of the frames that were annotated and have a scan.
    """

    def __init__(self, where: str, frames: list[int]) -> None:
        self._where = where
        self._rows: dict[int, list[tuple[int, int, FloatArray, FloatArray, bool]]]
        self._rows = {frame: [] for frame in frames}

    def add(
        self,
        frame: int,
        track: int,
        label: int,
        lidar_T_box: FloatArray,
        size: FloatArray,
        *,
        annotated: bool = True,
    ) -> None:
        """Add a box, if its frame has a scan: its track, its class, the (4, 4) pose of its centre,
        and length, width, height.
        """
        if frame in self._rows:
            self._rows[frame].append((track, label, lidar_T_box, size, annotated))

    def boxes(self) -> dict[int, Boxes]:
        """Return the boxes by frame.

        Raises:
            FormatError: a box has no valid size or position, or a track has two boxes in a frame.
        """
        return {frame: self._of_frame(frame) for frame in self._rows}

    def _of_frame(self, frame: int) -> Boxes:
        rows = self._rows[frame]
        try:
            return Boxes.from_poses(
                np.array([row[0] for row in rows], np.uint32),
                np.array([row[1] for row in rows], np.uint32),
                np.array([row[2] for row in rows]).reshape(-1, 4, 4),
                np.array([row[3] for row in rows]).reshape(-1, 3),
                np.array([row[4] for row in rows], np.bool_),
            )
        except FormatError as error:
            raise error.within(f"{self._where}: frame {frame}") from error
