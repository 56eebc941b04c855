"""Tracked boxes as the files of KITTI's tracking benchmark: see the page
`docs/commands/export.md#boxes`.
"""

from __future__ import annotations

import re

import numpy as np

from carlasc import storage
from carlasc.core.arrays import FloatArray
from carlasc.core.boxes import Boxes
from carlasc.core.cameras import CameraModel
from carlasc_converters.exporters.box_exporter import BoxExporter, names_of
from carlasc_converters.exporters.kitti import (
    calibration_of,
    cameras_by_number,
    encode_calibration,
)

# x to the right, y down, z ahead: the axes of a camera that looks ahead from the LiDAR
_AHEAD_T_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
_NEAREST_M = 0.1  # what is nearer to the plane of the camera is not projected
# points of a box, as shares of its size
_GRID = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 9)] * 3), axis=-1).reshape(-1, 3)


class KittiTrackingExporter(BoxExporter):
    """Writes boxes in the rectified frame of the first camera, and the calibration."""

    title = "KITTI tracking: training/label_02/NNNN.txt and training/calib/NNNN.txt"

    def file(self, sequence: storage.Sequence) -> str:
        """Return training/label_02/NNNN.txt."""
        return _place(sequence, "label_02")

    def documents(self, sequence: storage.Sequence) -> dict[str, bytes]:
        """Return the calibration, in which the LiDAR is related to the rectified camera."""
        found = calibration_of(sequence, _AHEAD_T_LIDAR)
        kept = {f"P{number}": found[f"P{number}"] for number in cameras_by_number(sequence)}
        kept |= {"R0_rect": np.eye(3), "Tr_velo_to_cam": found["Tr"]}
        return {_place(sequence, "calib"): encode_calibration(kept)}

    def encode(self, sequence: storage.Sequence) -> tuple[bytes, list[str]]:
        """Return a line per box; and a note if the camera is assumed."""
        frames, notes = self.read(sequence)
        cameras = cameras_by_number(sequence)
        table = sequence.metadata.classes
        calibration = calibration_of(sequence, _AHEAD_T_LIDAR)
        lines = list[str]()
        if not cameras:
            notes.append(
                f"{sequence.location} has no camera image_00: boxes are in the frame of a camera "
                f"at the LiDAR that looks ahead, and have no place in an image"
            )
        for frame in frames:
            boxes = frame.boxes.transform(calibration["Tr"])
            (x, y, z), sizes = boxes.centers.T, boxes.sizes
            turn = np.arctan2(-boxes.sensor_T_box[:, 2, 0], boxes.sensor_T_box[:, 0, 0])
            alpha = (turn - np.arctan2(x, z) + np.pi) % (2 * np.pi) - np.pi
            place = _places(boxes, calibration["P2"], cameras.get(2))
            ground = y + sizes[:, 2] / 2  # y is down
            columns = [alpha, place, sizes[:, ::-1], x, ground, z, turn, frame.values[:, 3]]
            for row, values in enumerate(np.column_stack(columns)):
                name, _ = names_of(table, int(boxes.labels[row]))
                own = values if self.boxes is not None else values[:-1]
                line = f"{frame.number} {boxes.tracks[row] - 1} {name} -1 -1 "
                lines.append(line + " ".join(f"{value:.6f}" for value in own) + "\n")
        return "".join(lines).encode(), notes


def _places(boxes: Boxes, projection: FloatArray, camera: CameraModel | None) -> FloatArray:
    """Return (N, 4) left, top, right and bottom of boxes in an image, pixels; -1 where they are not
    in it, or without a camera.

    Args:
        boxes: rectified frame of the first camera.
        projection: (3, 4).
        camera: the camera of the image.
    """
    if camera is None:
        return np.full((len(boxes), 4), -1.0)
    turned = (_GRID * boxes.sizes[:, None]) @ boxes.sensor_T_box[:, :3, :3].transpose(0, 2, 1)
    seen = (turned + boxes.centers[:, None]) @ projection[:, :3].T + projection[:, 3]
    seen[seen[:, :, 2] < _NEAREST_M] = np.nan
    pixels = seen[:, :, :2] / seen[:, :, 2:]
    edge = (camera.width - 1, camera.height - 1)
    lower, upper = (np.clip(f.reduce(pixels, axis=1), 0, edge) for f in (np.fmin, np.fmax))
    inside = (upper > lower).all(axis=1, keepdims=True)
    return np.where(inside, np.hstack([lower, upper]), -1.0)


def _place(sequence: storage.Sequence, kind: str) -> str:
    """Return the path of a file of a sequence: that of KITTI's number, if its name ends in one."""
    part = "testing" if sequence.split == "Test" else "training"
    number = re.search(r"KITTI_tracking_(?:test)?(\d{4})$", sequence.name)
    return f"{part}/{kind}/{number[1] if number else sequence.name or 'sequence'}.txt"
