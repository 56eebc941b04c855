"""A tiny data set for the example networks: random scans, and grids made from them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from carlasc import GridSpec
from carlasc.storage import FolderSink, field_files, layout

SPEC = GridSpec("cartesian", (16, 16, 8), (-8.0, -8.0, -2.0), (8.0, 8.0, 1.0))
CLASSES = (1, 7, 8, 10)  # CARLA: building, road, sidewalk, vehicle


def write_split(
    root: Path,
    split: str,
    sequences: list[str],
    frames: int,
    seed: int = 0,
    classes=CLASSES,
    table="carla",
    certainty: float | None = None,
    remission: float = 0.0,
) -> None:
    """Write sequences.

    A voxel with a point has the class of its quarter of the grid; all others are free.

    With `certainty`, the grid also says that each voxel's label has this probability.
    """
    rng = np.random.default_rng(seed)
    quarter = np.array(classes)[2 * (np.arange(16) >= 8)[:, None] + (np.arange(16) >= 8)[None, :]]
    for name in sequences:
        writer = FolderSink(root).sequence(f"{split}/{name}/cartesian")
        writer.write_document(
            layout.params_file("evaluation"), json.dumps(SPEC.to_params()).encode()
        )
        writer.write_document(layout.METADATA, json.dumps({"classes": table}).encode())
        writer.write_document(layout.POSES, layout.encode_poses(np.tile(np.eye(4), (frames, 1, 1))))
        for frame in range(frames):
            points = rng.uniform(SPEC.lower, SPEC.upper, (400, 3)).astype(np.float32)
            occupied = np.zeros(SPEC.size, bool)
            occupied.reshape(-1)[SPEC.flat_index(points)] = True
            writer.write(
                "points",
                frame,
                np.column_stack([points, np.full(len(points), remission, np.float32)]),
            )
            labels = np.where(occupied, quarter[..., None], 0).astype(np.uint32)
            writer.write("evaluation/labels", frame, labels)
            writer.write("labels", frame, labels.reshape(-1)[SPEC.flat_index(points)])
            writer.write(
                "evaluation/counts", frame, (rng.random(SPEC.size) < 0.8).astype(np.float32)
            )
            if certainty is not None:
                shares = np.zeros(occupied.size, field_files.VOTES_DTYPE)
                shares["voxel"], shares["votes"] = np.arange(occupied.size), layout.CERTAIN
                shares["label"] = np.where(labels, labels, classes[0]).reshape(-1)
                writer.write(
                    "evaluation/occupied", frame, np.where(occupied, certainty, 1 - certainty)
                )
                writer.write("evaluation/classes", frame, shares)
