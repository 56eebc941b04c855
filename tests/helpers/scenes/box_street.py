"""A street of boxes, seen by a LiDAR on a drive: small, exact scenes whose every fault is known, in
plain NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import invert, relative_to, transform_points
from carlasc.core.grids import GridSpec
from carlasc.storage import layout
from carlasc.storage.files import write_json
from carlasc.storage.folder import FolderSink
from carlasc.storage.layout import Metadata

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
SENSOR_HEIGHT_M = 1.8
BUILDING, FENCE, POLE, ROAD, SIDEWALK, VEHICLE, SKY, TERRAIN = 1, 2, 5, 7, 8, 10, 13, 22


@dataclass(frozen=True)
class Street:
    """Axis-aligned boxes on level ground (z = 0), left-handed world like CARLA's.

    Attributes:
        lower: (B, 3) float64 metres.
        upper: (B, 3) float64 metres.
        labels: (B,) classes.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    labels: NDArray[np.uint32]

    @classmethod
    def random(cls, seed: int = 0) -> Street:
        """Two streets that cross at the origin, along x and along y, with houses, fences, poles and
        parked cars.
        """
        rng = np.random.default_rng(seed)
        boxes: list[tuple[list[float], list[float], int]] = []
        for along in (0, 1):
            for side in (-1.0, 1.0):
                s = 10.0 if along else -40.0
                while s < 70:
                    length, gap, setback = rng.uniform(5, 14), rng.uniform(2, 6), rng.uniform(9, 14)
                    _add(
                        boxes,
                        along,
                        (s, s + length),
                        side,
                        (setback, setback + 6),
                        rng.uniform(3, 8),
                        BUILDING,
                    )
                    _add(
                        boxes,
                        along,
                        (s + length, s + length + gap),
                        side,
                        (setback, setback + 0.2),
                        1.2,
                        FENCE,
                    )
                    pole = s + rng.uniform(0, length)
                    _add(boxes, along, (pole, pole + 0.3), side, (6.0, 6.3), 5.0, POLE)
                    if rng.random() < 0.5:
                        _add(boxes, along, (s + 1, s + 5.2), side, (4.0, 5.8), 1.5, VEHICLE)
                    s += length + gap
        return cls(*(np.array(column) for column in zip(*boxes, strict=True)))  # type: ignore[arg-type]

    def scan(
        self,
        world_T_sensor: NDArray[np.float64],
        rng: np.random.Generator,
        channels: int = 24,
        columns: int = 240,
    ) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """Cast a LiDAR's rays: +2 to -25 degrees, 50 m, noise of 2 cm.

        Returns:
            (N, 3) float32 points in the sensor's frame, and their (N,) uint32 classes.
        """
        elevation, azimuth = np.meshgrid(
            np.deg2rad(np.linspace(2, -25, channels)),
            np.linspace(-np.pi, np.pi, columns, endpoint=False),
            indexing="ij",
        )
        rays = np.stack(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ],
            axis=-1,
        ).reshape(-1, 3)
        directions, origin = rays @ world_T_sensor[:3, :3].T, world_T_sensor[:3, 3]
        distance, labels = self._cast(origin, directions)
        hit = distance < 50.0
        noise = rng.uniform(-0.02, 0.02, (int(hit.sum()), 3))
        return (rays[hit] * distance[hit, None] + noise).astype(np.float32), labels[hit]

    def _cast(
        self, origin: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
        enter = np.full((len(directions), len(self.lower)), -np.inf)
        leave = np.full_like(enter, np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            ground = np.where(directions[:, 2] < 0, -origin[2] / directions[:, 2], np.inf)
            for axis in range(3):
                inverse = 1 / directions[:, axis, None]
                a, b = (
                    (self.lower[:, axis] - origin[axis]) * inverse,
                    (self.upper[:, axis] - origin[axis]) * inverse,
                )
                np.maximum(enter, np.fmin(a, b), out=enter)
                np.minimum(leave, np.fmax(a, b), out=leave)
        enter = np.where((enter < leave) & (enter > 0), enter, np.inf)
        nearest = enter.argmin(axis=1)
        distance = np.minimum(enter[np.arange(len(enter)), nearest], ground)
        place = np.abs(
            origin[:2] + np.where(np.isfinite(distance), distance, 0)[:, None] * directions[:, :2]
        ).min(axis=1)
        surface = np.where(place < 4.0, ROAD, np.where(place < 7.0, SIDEWALK, TERRAIN))
        return distance, np.where(distance < ground, self.labels[nearest], surface).astype(
            np.uint32
        )


def drive(
    frames: int,
    *,
    speed_m: float = 1.0,
    turn_rad: float = 0.0,
    start: tuple[float, float] = (-20.0, 0.0),
) -> NDArray[np.float64]:
    """Return (F, 4, 4) world_T_sensor of a drive that goes `speed_m` and turns `turn_rad` a frame."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    position, yaw = np.array([*start, SENSOR_HEIGHT_M]), 0.0
    for frame in range(frames):
        cos, sin = np.cos(yaw), np.sin(yaw)
        poses[frame, :2, :2] = [[cos, -sin], [sin, cos]]
        poses[frame, :3, 3] = position
        position = position + speed_m * np.array([cos, sin, 0.0])
        yaw += turn_rad
    return poses


def write_drive(
    folder: Path,
    world_T_sensor: NDArray[np.float64],
    *,
    frame: str = "carlasc",
    spec: GridSpec | None = None,
    grid_every: int = 1,
    labelled: bool = True,
    seed: int = 0,
) -> Path:
    """Write a drive as a sequence of the layout, with grids voted from the scan and three more
    sensors around it.

    Args:
        folder: the `<coordinates>` folder.
        world_T_sensor: (F, 4, 4) poses, left-handed.
        frame: "carlasc", or "kitti" to write it mirrored into the right-handed frame.
        spec: the grid; None writes no grids.
        grid_every: a grid every so many frames.
        labelled: whether points have labels.
        seed: of the street and of the noise.
    """
    street, rng = Street.random(seed), np.random.default_rng(seed)
    mirror = MIRROR if frame == "kitti" else np.eye(4)
    flip = np.float32(np.diag(mirror)[:3])
    writer = FolderSink(folder.parent).sequence(folder.name)
    for number, pose in enumerate(world_T_sensor):
        points, labels = street.scan(pose, rng)
        writer.write(
            "points", number, np.column_stack([points * flip, np.zeros(len(points), np.float32)])
        )
        if labelled:
            writer.write("labels", number, labels)
            writer.write("flow", number, np.zeros((len(points), 3), np.float32))
        if spec is not None and number % grid_every == 0:
            grid, counts = vote(street, pose, points, labels, spec, flip, rng)
            writer.write("evaluation/labels", number, grid)
            writer.write("evaluation/counts", number, counts)
    poses = mirror @ relative_to(world_T_sensor[0], world_T_sensor) @ mirror
    writer.write_document(layout.POSES, layout.encode_poses(poses))
    writer.write_document(
        layout.TIMES, layout.encode_times(np.arange(len(poses)) * layout.FRAME_PERIOD_S)
    )
    if frame != "carlasc":
        writer.write_document(
            layout.METADATA, Metadata("right" if frame == "kitti" else "left").to_json()
        )
    if spec is not None:
        write_json(folder / "evaluation" / layout.PARAMS, spec.to_params())
    return folder


def vote(
    street: Street,
    pose: NDArray[np.float64],
    points: NDArray[np.float32],
    labels: NDArray[np.uint32],
    spec: GridSpec,
    flip: NDArray[np.float32],
    rng: np.random.Generator,
) -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
    """Vote a grid from a scan and three more sensors beside it: a vote a point, a free one every 3
    m of its ray.
    """
    votes = np.zeros(spec.num_voxels * 25, np.int64)
    for offset in ((0.0, 0.0, 0.0), (12.0, 2.0, 1.0), (-9.0, -3.0, 2.0), (3.0, 5.0, 1.5)):
        other = pose.copy()
        other[:3, 3] = transform_points(pose, np.array(offset))
        seen, classes = (points, labels) if not any(offset) else street.scan(other, rng)
        origin = np.array(offset)
        samples, ids = [seen + origin], [classes]
        distance = np.linalg.norm(seen, axis=1)
        for step in range(1, int(50 / 3)):
            share = (distance - 3.0 * step) / np.maximum(distance, 1e-6)
            samples.append(seen[share > 0] * share[share > 0, None] + origin)
            ids.append(np.zeros(int((share > 0).sum()), np.uint32))
        voxels = spec.flat_index(np.concatenate(samples) * flip)
        inside = voxels >= 0
        votes += np.bincount(
            voxels[inside] * 25 + np.concatenate(ids)[inside], minlength=len(votes)
        )
    table = votes.reshape(-1, 25)
    return (
        table.argmax(axis=1).astype(np.uint32).reshape(spec.size),
        table.sum(axis=1).astype(np.float32).reshape(spec.size),
    )


def cast_image(
    street: Street, world_T_sensor: NDArray[np.float64], camera: CameraModel
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return (H, W) what a camera on the sensor sees of a street: classes, 13 for the sky, and
    distances along its rays, metres.
    """
    rows, columns = np.mgrid[: camera.height, : camera.width].reshape(2, -1)
    world_T_camera = world_T_sensor @ camera.sensor_T_camera
    rays = camera.unproject(np.stack([columns, rows], axis=1)) @ world_T_camera[:3, :3].T
    distances, labels = street._cast(world_T_camera[:3, 3], rays)
    labels[~(distances < 200)] = SKY
    shape = camera.height, camera.width
    return labels.reshape(shape).astype(np.uint8), distances.reshape(shape)


def camera_poses(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses of a camera (x right, y down, z forward) on the LiDAR, in a right-handed
    frame, as KITTI's file has them.
    """
    camera_T_lidar = np.array(
        [[0.0, -1, 0, 0.01], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]]
    )
    return camera_T_lidar @ poses @ invert(camera_T_lidar)


def _add(
    boxes: list[tuple[list[float], list[float], int]],
    along: int,
    stretch: tuple[float, float],
    side: float,
    depth: tuple[float, float],
    height: float,
    label: int,
) -> None:
    across = sorted((side * depth[0], side * depth[1]))
    x, y = (stretch, across) if along == 0 else (across, stretch)
    boxes.append(([x[0], y[0], 0.0], [x[1], y[1], height], label))
