"""A road with two blocks on it, as grids and as points, for tests of what a viewer draws."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from helpers.readers.pixels import BLUE, RED, grid_with

from carlasc.core.geometry import rotation_z, translation
from carlasc.core.grids import GridSpec, VoxelFlag
from carlasc.storage import layout
from carlasc.storage.field_files import VELOCITY_DTYPE
from carlasc.storage.files import to_json
from carlasc.storage.folder import FolderSink

ROAD = 7


def write_blocks(
    folder: Path,
    frames: int = 3,
    spec: GridSpec | None = None,
    metadata: dict[str, Any] | None = None,
    shift: float = 0.0,
    points: bool = True,
) -> Path:
    """Write a road with a red block ahead on the side of +y, which moves forward by 1 m per frame,
    and a blue block that does not move.
    """
    # few voxels: browsers in tests have no GPU
    spec = spec or GridSpec.published().with_size((64, 64, 4))
    writer = FolderSink(folder.parent).sequence(folder.name)
    writer.write_document(layout.params_file(layout.EVALUATION), to_json(spec.to_params()))
    if metadata:
        writer.write_document(layout.METADATA, to_json(metadata))
    rng = np.random.default_rng(0)
    for frame in range(frames):
        grid = grid_with({(10 + frame + shift, 5, 0): RED, (-8, -6, 0): BLUE}, spec, size_m=2.0)
        labels, counts = grid.labels.copy(), np.asarray(grid.counts).copy()
        labels[:, :, 0] = ROAD
        counts[labels > 0] = 7
        counts[0] = 0
        labels[0] = 0
        writer.write("evaluation/labels", frame, labels)
        writer.write("evaluation/counts", frame, counts)
        if points:
            ground = np.column_stack([rng.uniform(-30, 30, (3000, 2)), np.full(3000, -1.8)])
            block = np.array([10 + frame, 5, 0]) + rng.uniform(-1, 1, (400, 3))
            cloud = np.concatenate([ground, block, [[10 + frame, 5, 0]]]).astype(np.float32)
            moving = np.arange(len(cloud)) >= len(ground)
            writer.write(
                "points", frame, np.column_stack([cloud, np.zeros(len(cloud), np.float32)])
            )
            writer.write("labels", frame, np.where(moving, RED, ROAD).astype(np.uint32))
            writer.write(
                "flow", frame, (moving[:, None] * np.array([10.0, 0, 0])).astype(np.float32)
            )
    if points:
        writer.write_document(layout.TIMES, layout.encode_times(np.arange(frames) * 0.1))
    return folder


def add_evidence(folder: Path, frames: int = 3) -> None:
    """Write how certain each voxel of `write_blocks` is: the red block was inferred, the blue one
    is in an actor, the road was seen.
    """
    writer = FolderSink(folder.parent).sequence(folder.name)
    for frame in range(frames):
        labels = np.fromfile(folder / f"evaluation/{frame:06d}.label", np.uint32).reshape(64, 64, 4)
        kinds = [labels == RED, labels == BLUE, labels == ROAD]
        flags = np.select(
            kinds,
            [VoxelFlag.INFERRED, VoxelFlag.IN_ACTOR | VoxelFlag.SEEN_NOW, VoxelFlag.SEEN_NOW],
            0,
        )
        writer.write("evaluation/flags", frame, flags.astype(np.uint8))
        writer.write(
            "evaluation/occupied", frame, np.select(kinds, [0.6, 0.8, 1.0], 0.0).astype(np.float16)
        )
        writer.write("evaluation/views", frame, np.select(kinds, [0, 3, 40], 0).astype(np.uint16))


def add_actors(folder: Path, frames: int = 3, number: int = 70_003, speed_m_s: float = 3.0) -> None:
    """Write who is in each voxel of `write_blocks`: the red block is an actor that moves ahead, the
    blue one is actor 6 and stands.
    """
    writer = FolderSink(folder.parent).sequence(folder.name)
    for frame in range(frames):
        labels = np.fromfile(folder / f"evaluation/{frame:06d}.label", np.uint32)
        instance = np.select([labels == RED, labels == BLUE], [number, 6], 0).astype(np.uint32)
        velocity = np.zeros(np.count_nonzero(labels == RED), VELOCITY_DTYPE)
        velocity["voxel"], velocity["velocity"] = np.flatnonzero(labels == RED), (speed_m_s, 0, 0)
        writer.write("evaluation/instance", frame, instance.reshape(64, 64, 4))
        writer.write("evaluation/velocity", frame, velocity)


def add_poses(folder: Path, yaws_rad: list[float], step_m: float = 5.0) -> None:
    """Write poses of a vehicle that drives `step_m` between two frames, in the direction that it
    has in the first of them.
    """
    writer = FolderSink(folder.parent).sequence(folder.name)
    pose, place = [], np.zeros(3)
    for yaw in yaws_rad:
        pose.append(translation(place) @ rotation_z(yaw))
        place = place + step_m * np.array([np.cos(yaw), np.sin(yaw), 0])
    writer.write_document(layout.POSES, layout.encode_poses(np.stack(pose)))
