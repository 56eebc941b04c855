"""A simulated drive as a sequence of CarlaOcc."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import invert, transform_points
from carlasc.core.grids import GridSpec
from carlasc.testing.drives import KINDS, SimulatedDrive, world_T_sensor

TAGS = {
    "none": 0, "road": 1, "building": 3, "vegetation": 9, "pole": 6, "car": 14, "van": 15, "pedestrian": 12, "cyclist": 13,
}  # fmt: skip
TAG_OF_KIND = np.array([TAGS[kind] for kind in KINDS], np.uint32)
SURROUND = GridSpec(
    "cartesian", (128, 128, 16), (-25.6, -25.6, -2.4), (25.6, 25.6, 4.0)
).with_bounds((-25.6, -25.6, -2.4), (25.6, 25.6, 4.0))
FIRST_ACTOR = 100
"""What is added to the number of a track to make an ObjIdx."""


def write_carlaocc(
    root: Path,
    drive: SimulatedDrive,
    name: str = "Town01_Opt_Seq07",
    *,
    grids: dict[str, GridSpec] | None = None,
    factor: int = 2048,
) -> Path:
    """Write a drive as a sequence and return its folder; `factor` is 1000 or 2048: how labels of
    voxels hold class and instance.
    """
    folder = root / name
    for part in ("semantic_lidar", "poses"):
        (folder / part).mkdir(parents=True)
    poses = []
    for frame in range(drive.frames):
        scan = drive.scan(frame)
        tags = TAG_OF_KIND[scan.kinds]
        actors = np.where(scan.instances > 0, scan.instances + FIRST_ACTOR, 0)
        actors[tags == TAGS["pole"]] = 7  # poles are actors too
        header = (
            f"ply\nformat ascii 1.0\nelement vertex {len(tags)}\nproperty float x\nproperty float "
            f"y\nproperty float z\n"
            "property float CosAngle\nproperty int ObjIdx\nproperty int ObjTag\nend_header"
        )
        rows = np.column_stack([scan.points[:, :3], np.ones(len(tags)), actors, tags])
        path = folder / "semantic_lidar" / f"{frame:04d}.ply"
        np.savetxt(path, rows, "%.4f %.4f %.4f %.4f %d %d", header=header, comments="")
        pose = world_T_sensor(drive, frame).ravel()
        poses.append(f"{frame:04d} " + " ".join(f"{value:.6f}" for value in pose) + "\n")
    (folder / "poses" / "lidar.txt").write_text("".join(poses))
    for grid, spec in ({"vs_0_4_surround_view": SURROUND} if grids is None else grids).items():
        (folder / "occupancy" / grid).mkdir(parents=True)
        for frame in range(0, drive.frames, 2):
            write_grid(folder / "occupancy" / grid / f"{frame:04d}.npz", drive, frame, spec, factor)
    return folder


def write_grid(path: Path, drive: SimulatedDrive, frame: int, spec: GridSpec, factor: int) -> None:
    """Write the grid of a frame as rows of the occupied voxels."""
    tags, tracks = mesh_voxels(drive, frame, spec)
    cells = np.argwhere(tags > 0)
    codes = tags[tags > 0] * factor + tracks[tags > 0] % 1000
    np.savez_compressed(
        path,
        occupancy=np.column_stack([cells, codes]).astype(np.uint16),
        voxel_size=float(spec.voxel_size[0]),
        voxel_origin=np.array(spec.lower, np.float32),
        volume_size=np.array(spec.size, np.int32),
    )


def mesh_voxels(
    drive: SimulatedDrive, frame: int, spec: GridSpec
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return (X, Y, Z) tags and tracks of the voxels that something fills or touches, 0 elsewhere,
    in the frame of the LiDAR.
    """
    pose = world_T_sensor(drive, frame)
    centers = spec.centers()
    height = transform_points(pose, centers)[..., 2]
    tags = np.where((height < 0) & (height > -0.5), TAGS["road"], 0)
    tracks = np.zeros(spec.size, np.int64)
    track = FIRST_ACTOR
    for thing in drive.things:
        moves = TAGS[thing.kind] >= TAGS["pedestrian"]
        track += moves
        lidar_T_box = invert(pose) @ thing.world_T_box(frame * drive.period_s)
        if np.linalg.norm(lidar_T_box[:3, 3]) > np.linalg.norm(spec.upper) + np.linalg.norm(
            thing.size
        ):
            continue  # outside of the grid
        own = transform_points(invert(lidar_T_box), centers)
        inside = (np.abs(own) < (np.array(thing.size) + spec.voxel_size) / 2).all(axis=-1)
        tags[inside], tracks[inside] = TAGS[thing.kind], track if moves else 0
    return tags, tracks
