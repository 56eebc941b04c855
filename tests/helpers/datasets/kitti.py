"""Small SemanticKITTI data sets made of a simulated drive: right-handed, camera-frame poses, moving
classes, instances, voxels.

Nothing here uses the converter: files are written as the format page describes them
(docs/format.md#semantickitti).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from carlasc_recorders import TownDrive
from numpy.typing import NDArray

from carlasc.captures import Lidar
from carlasc.core.geometry import rotation_z, translation
from carlasc.core.tables import REMAPS

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
SMALL_LIDAR = Lidar(channels=32, points=16_000)
MOVING_CLASS = {10: 252, 30: 254}

# made up, but like the real one: x right, y down, z forward
CAMERA_T_LIDAR = (
    translation((0.06, -0.08, -0.27))
    @ np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    @ rotation_z(0.01)
)


@dataclass(frozen=True)
class KittiTruth:
    """The truth of a written sequence.

    Attributes:
        folder: the sequence's folder.
        frames: its frame numbers, from 0 for the first frame of the drive.
        poses: (F, 4, 4) first_T_lidar, right-handed, by frame number.
        flow: (N, 3) m/s of each point by frame, right-handed sensor frame, zero for actors that
            never move.
    """

    folder: Path
    frames: tuple[int, ...]
    poses: NDArray[np.float64]
    flow: dict[int, NDArray[np.float32]]


def write_kitti(
    root: Path,
    drive: TownDrive,
    frames: Sequence[int],
    sequence: str = "00",
    *,
    labels: bool = True,
    voxels_every: int = 5,
    odometry: bool = False,
) -> KittiTruth:
    """Write one sequence below `root/sequences`.

    Args:
        root: the data set.
        drive: what is scanned.
        frames: frames of the drive; they are renumbered from 0.
        sequence: its number.
        labels: whether labels and voxels are written.
        voxels_every: every N-th frame gets voxels; 0 for none.
        odometry: poses go to `root/poses/<sequence>.txt`, as in KITTI odometry.
    """
    folder = root / "sequences" / sequence
    (folder / "velodyne").mkdir(parents=True)
    recordings = [drive.record(frame) for frame in frames]
    world = np.stack([recording.world_T_sensor for recording in recordings])
    poses = MIRROR @ np.linalg.inv(world[0]) @ world @ MIRROR
    moving = _movers(drive, frames)
    flow = {}
    rng = np.random.default_rng(1)
    for number, recording in enumerate(recordings):
        points = recording.scan.points * np.array([1, -1, 1], np.float32)
        remission = rng.uniform(0, 1, len(points)).astype(np.float32)
        np.column_stack([points, remission]).tofile(folder / "velodyne" / f"{number:06d}.bin")
        actors = recording.scan.instances
        moves = np.isin(actors, sorted(moving))
        flow[number] = np.where(moves[:, None], recording.flow(), 0).astype(np.float32) * np.array(
            [1, -1, 1], np.float32
        )
        if labels:
            classes = kitti_classes(recording.scan.labels, moves)
            (folder / "labels").mkdir(exist_ok=True)
            (classes | (actors.astype(np.uint32) << 16)).astype("<u4").tofile(
                folder / "labels" / f"{number:06d}.label"
            )
            if voxels_every and number % voxels_every == 0:
                write_voxels(folder, number, points, classes)
    numbers = tuple(range(len(recordings)))
    path = root / "poses" / f"{sequence}.txt" if odometry else folder / "poses.txt"
    write_poses(path, poses)
    write_calibration(folder / "calib.txt")
    np.savetxt(folder / "times.txt", np.array(numbers) * 0.1, "%.6e")
    return KittiTruth(folder, numbers, poses, flow)


def kitti_classes(
    labels: NDArray[np.unsignedinteger], moves: NDArray[np.bool_]
) -> NDArray[np.uint32]:
    """Return SemanticKITTI's classes for CARLA's; points of moving actors get a moving class."""
    classes = REMAPS["carla_to_semantickitti"](labels).astype(np.uint32)
    for standing, moving in MOVING_CLASS.items():
        classes[(classes == standing) & moves] = moving
    return classes


def write_poses(path: Path, first_T_lidar: NDArray[np.float64]) -> None:
    """Write poses of the left camera."""
    camera = CAMERA_T_LIDAR @ first_T_lidar @ np.linalg.inv(CAMERA_T_LIDAR)
    path.parent.mkdir(exist_ok=True)
    np.savetxt(path, camera[:, :3].reshape(-1, 12), "%.15e")


def write_calibration(path: Path, lines: Iterable[str] = ()) -> None:
    """Write calib.txt: four cameras, Tr, and more lines if given."""
    rows = [f"P{i}: 707.0 0 601.9 {-40.0 * i} 0 707.0 183.1 0 0 0 1 0" for i in range(4)]
    rows.append("Tr: " + " ".join(f"{value:.15e}" for value in CAMERA_T_LIDAR[:3].ravel()))
    path.write_text("\n".join([*rows, *lines]) + "\n")


def write_voxels(
    folder: Path, frame: int, points: NDArray[np.float32], classes: NDArray[np.uint32]
) -> None:
    """Write voxels of one scan, with masks that mean little but differ from each other."""
    (folder / "voxels").mkdir(exist_ok=True)
    cells = np.floor((points - np.float32([0, -25.6, -2])) / np.float32(0.2)).astype(int)
    inside = ((cells >= 0) & (cells < (256, 256, 32))).all(axis=1)
    labels = np.zeros((256, 256, 32), "<u2")
    labels[tuple(cells[inside].T)] = classes[inside]
    rng = np.random.default_rng(frame)
    masks = {
        "bin": labels > 0,
        "invalid": (labels == 0) & (rng.random(labels.shape) < 0.3),
        "occluded": rng.random(labels.shape) < 0.5,
    }
    labels.tofile(folder / "voxels" / f"{frame:06d}.label")
    for name, mask in masks.items():
        np.packbits(mask).tofile(folder / "voxels" / f"{frame:06d}.{name}")


def _movers(drive: TownDrive, frames: Sequence[int]) -> set[int]:
    """Return the actors that move at some time of the drive: they have a moving class in all
    frames.
    """
    return {
        actor.id
        for frame in frames
        for actor in drive.actors(frame)
        if float(np.square(actor.velocity).sum()) > 0.1**2
    }
