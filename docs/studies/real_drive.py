"""A drive of KITTI's tracking benchmark, written as a sequence of the layout: for `real.py`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from carlasc_converters.kitti_boxes import KITTI_TO_CARLA
from carlasc_converters.kitti_tracking import KittiTracking
from numpy.typing import NDArray
from study import few

from carlasc import Boxes
from carlasc.converting import Recording
from carlasc.core import CARLA
from carlasc.motion.odometry import estimate_poses
from carlasc.storage import FolderSink, Metadata, layout

RANGE_M = 50.0  # the archive's scans are cut to it
FLOOR_M = 0.15  # points below this height in a box are taken for the ground
MARGIN_M = 0.1  # boxes are tight


def write_drive(
    archive: Path, out: Path, *, labelled: bool, poses: NDArray[np.float64] | None = None
) -> None:
    """Write the drive as a sequence: right-handed axes, poses by KISS-ICP, frames with their own
    numbers.

    Args:
        archive: the folder of the unpacked archive.
        out: the sequence's folder is `out/cartesian`.
        labelled: whether boxes, and the labels and instances of the points in them, are written
            too. Other points are then of the class for geometry without labels.
        poses: (F, 4, 4) first_T_sensor, if they are known already.
    """
    scans = read_scans(archive)
    boxes = read_boxes(archive) if labelled else {}
    poses = find_poses(scans) if poses is None else poses
    with FolderSink(out).sequence("cartesian") as writer:
        writer.write_document(layout.POSES, layout.encode_poses(poses))
        writer.write_document(layout.TIMES, layout.encode_times(times_of(archive, list(scans))))
        source = f"KITTI tracking 0000, frames {min(scans)} to {max(scans)}"
        metadata = Metadata(
            "right",
            sensor=KittiTracking.sensor,
            min_range_m=KittiTracking.min_range_m,
            source=source,
        )
        writer.write_document(layout.METADATA, metadata.to_json())
        for frame, scan in scans.items():
            if labelled:
                labels, instances = label_points(scan[:, :3], boxes[frame])
                writer.write("labels", frame, labels)
                writer.write("instances", frame, instances)
                writer.write("boxes", frame, boxes[frame].to_table())
            writer.write("points", frame, scan)


def read_scans(archive: Path) -> dict[int, NDArray[np.float32]]:
    """Return (N, 4) points of each frame, as they were taken, without the one return of every scan
    that lies in the sensor.
    """
    scans = {}
    for frame in few(_recording(archive).frames, 20):
        (cloud,) = frame.read()
        scans[frame.number] = cloud.points[(cloud.points[:, :3] != 0).any(axis=1)]
    return scans


def times_of(archive: Path, frames: list[int]) -> NDArray[np.float64]:
    """Return (F,) seconds of some frames after the first of them."""
    times = _recording(archive).times()
    assert times is not None
    return times[frames] - times[frames[0]]


def find_poses(scans: Mapping[int, NDArray[np.float32]]) -> NDArray[np.float64]:
    """Return (F, 4, 4) first_T_sensor of the scans, in their order, by KISS-ICP; two runs differ by
    fractions of a millimetre.
    """
    return estimate_poses(
        (scan[:, :3] for scan in scans.values()),
        max_range_m=RANGE_M,
        min_range_m=KittiTracking.min_range_m,
    )


def read_boxes(archive: Path) -> dict[int, Boxes]:
    """Return the boxes of each frame, in the frame of the LiDAR, with CarlaSC's classes: those in
    the view of the camera.
    """
    boxes = _recording(archive).boxes() or {}
    return {
        frame: replace(found, labels=KITTI_TO_CARLA(found.labels).astype(np.uint32))
        for frame, found in boxes.items()
    }


def label_points(
    points: NDArray[np.float32], boxes: Boxes
) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return the class and the track of each point, by the box that it is in; points on the ground
    are in none.
    """
    labels = np.full(len(points), CARLA.geometry_only, np.uint32)
    instances = np.zeros(len(points), np.uint32)
    owners = boxes.owners(points, MARGIN_M)
    for row, pose in enumerate(boxes.sensor_T_box):
        own = np.flatnonzero(owners == row)
        height = (points[own] - pose[:3, 3]) @ pose[:3, 2] + boxes.sizes[row, 2] / 2
        own = own[height > FLOOR_M]
        labels[own], instances[own] = boxes.labels[row], boxes.tracks[row]
    return labels, instances


def _recording(archive: Path) -> Recording:
    (recording,) = KittiTracking(archive).sequences()
    return recording
