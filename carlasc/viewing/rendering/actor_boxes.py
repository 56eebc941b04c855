"""Boxes around actors: the annotated boxes of a frame, or the tightest boxes around the points of
actors; and their drawings.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from carlasc.core.arrays import FloatArray
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import Transform, rotation_z
from carlasc.core.scans import Scan
from carlasc.errors import MissingDataError
from carlasc.viewing import colors as palette
from carlasc.viewing.actor_lines import edges_of
from carlasc.viewing.colors import AFTER_CLASSES, Entry
from carlasc.viewing.rendering.drawings import Drawing
from carlasc.viewing.rendering.meshes import QuadMesh, box, join
from carlasc.viewing.scene import RemappedSequence, list_fields

BOX = Entry("box, with a bar to its front", palette.ARROW, AFTER_CLASSES + 10)
"""The entry of a legend for boxes."""

_BAR_M = 0.08  # width of the edges of a box
_MIN_SPEED_M_S = 0.5  # a slower motion may be noise of the points
_LEAST_SIZE_M = 0.1
_FEWEST_POINTS = 5
_CLOSE_M = 0.05  # nearer points count as on the side
_ANGLES = np.deg2rad(np.arange(0, 90, 2.0))


def check_boxes(data: RemappedSequence) -> None:
    """Check that a sequence has boxes, or actors to put boxes around.

    Raises:
        MissingDataError: it has neither.
    """
    if not data.has("boxes") and not data.has("points", "instances"):
        raise MissingDataError(
            data.sequence.location,
            expected="the field boxes, or points with instances",
            found=list_fields(data.sequence),
            advice="leave out `boxes`",
        )


def boxes_in(data: RemappedSequence, frame: int) -> Boxes:
    """Return the boxes of a frame: those of the field `boxes`, or else the tightest ones around the
    points of each actor.

    Raises:
        FormatError: the boxes or the scan do not have the format.
    """
    if (annotated := data.read_boxes(frame)) is not None:
        return annotated
    numbered = not data.has("boxes") and frame in data.frames_with("points", "instances")
    return tight_boxes(data.read_scan(frame) if numbered else Scan(np.empty((0, 3), np.float32)))


def tight_boxes(scan: Scan) -> Boxes:
    """Return the tightest upright box around the points of each numbered actor that has at least
    five.

    A box points in the direction of motion of its actor. The box of a static actor points along the
    longer side of the rectangle whose sides are closest to the points, to one of its two ends.

    Args:
        scan: with instances; with flow, boxes of moving actors have the right direction.
    """
    tracks = list[int]()
    labels = list[int]()
    sizes = list[Any]()
    poses = list[Transform]()
    instances = np.zeros(len(scan), np.uint32) if scan.instances is None else scan.instances
    for actor in np.unique(instances[instances > 0]).tolist():
        members = np.flatnonzero(instances == actor)
        if len(members) < _FEWEST_POINTS:
            continue
        points = scan.points[members].astype(np.float64)
        velocity = (
            np.zeros(3) if scan.flow is None else scan.flow[members].astype(np.float64).mean(axis=0)
        )
        sensor_T_box = rotation_z(_direction(points[:, :2], velocity))
        turned = points @ sensor_T_box[:3, :3]
        lower = turned.min(axis=0)
        upper = turned.max(axis=0)
        sensor_T_box[:3, 3] = sensor_T_box[:3, :3] @ ((lower + upper) / 2)
        tracks.append(actor)
        labels.append(0 if scan.labels is None else int(np.bincount(scan.labels[members]).argmax()))
        sizes.append(np.maximum(upper - lower, _LEAST_SIZE_M))
        poses.append(sensor_T_box)
    return Boxes.from_poses(
        np.array(tracks, np.uint32),
        np.array(labels, np.uint32),
        np.array(poses).reshape(-1, 4, 4),
        np.array(sizes).reshape(-1, 3),
        np.zeros(len(tracks), np.bool_),
    )


def with_boxes(drawing: Drawing, boxes: Boxes) -> Drawing:
    """Return a drawing with the edges of boxes, and a bar on the floor of each from its middle to
    its front.
    """
    return drawing.with_mesh(box_edges(boxes), BOX) if len(boxes.tracks) else drawing


def box_edges(boxes: Boxes) -> QuadMesh:
    """Return the edges of boxes as bars."""
    bars = []
    for sensor_T_box, size in zip(boxes.sensor_T_box, boxes.sizes, strict=True):
        for start, end in edges_of(size):
            lower = np.minimum(start, end) - _BAR_M / 2
            upper = np.maximum(start, end) + _BAR_M / 2
            bar = box(lower, upper, palette.ARROW)
            rotation = sensor_T_box[:3, :3]
            bars.append(
                replace(
                    bar,
                    corners=(bar.corners @ rotation.T + sensor_T_box[:3, 3]).astype(np.float32),
                    normals=(bar.normals @ rotation.T).astype(np.float32),
                    edges=np.zeros_like(bar.edges),
                )
            )
    return join(bars)


def _direction(points: FloatArray, velocity: FloatArray) -> float:
    """Return the yaw of an actor, in radians: that of its velocity, or of the rectangle whose sides
    are closest to its points.

    A LiDAR sees one or two sides of a vehicle. The smallest rectangle around them is often tilted;
    the closest one is not (Zhang, Xu, Dong and Dolan, "Efficient L-shape fitting for vehicle
    detection using laser scanners", 2017).
    """
    if np.linalg.norm(velocity[:2]) > _MIN_SPEED_M_S:
        return float(np.arctan2(velocity[1], velocity[0]))
    best = 0.0
    longest = True
    most = -1.0
    for angle in _ANGLES:
        cos = np.cos(angle)
        sin = np.sin(angle)
        rectangle = points @ np.array([[cos, -sin], [sin, cos]])
        lower = rectangle.min(axis=0)
        upper = rectangle.max(axis=0)
        to_side = np.minimum(rectangle - lower, upper - rectangle).min(axis=1)
        closeness = float((1 / np.maximum(to_side, _CLOSE_M)).sum())
        if closeness > most:
            best = float(angle)
            longest = bool(upper[0] - lower[0] >= upper[1] - lower[1])
            most = closeness
    return best if longest else best + float(np.pi / 2)
