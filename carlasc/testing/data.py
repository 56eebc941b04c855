"""A small data set with what stores get wrong: gaps in the frames, empty scans, missing fields, grids of several shapes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.boxes import Boxes
from carlasc.storage import field_files, layout
from carlasc.storage.folder import FolderSink

FRAMES = (0, 1, 2, 5)
"""Frames of the sequence WHOLE."""
SIZE, SECOND = (4, 6, 2), (8, 4, 3)
"""Sizes of the two grids."""

WHOLE = "Train/Town01_Light/cartesian"
SCANS = "Val/Town07_Heavy/cartesian"
GRIDS = "Test/Town10_Medium/cylindrical"
"""Paths of the three sequences: one with every field, one of scans without poses, one of grids without scans."""


def params(size: tuple[int, int, int], coordinates: str = "cartesian") -> bytes:
    """Return the bytes of the params.json of a grid."""
    bounds = {"min_bound": [0.0 if coordinates == "cylindrical" else -25.6, -3.0, -2.0], "max_bound": [25.6, 3.0, 1.0]}
    return json.dumps(
        {"grid_size": [float(n) for n in size], **bounds, "num_channels": 25, "coordinates": coordinates}
    ).encode()


def scan(rng: np.random.Generator, count: int) -> dict[str, NDArray[Any]]:
    """Return the fields of a random scan: points, labels, flow and instances."""
    points = np.zeros((count, 4), np.float32)
    points[:, :3] = rng.normal(scale=10, size=(count, 3))
    velocities = np.concatenate([np.zeros((1, 3)), rng.normal(size=(3, 3))]).astype(np.float32)
    actors = rng.integers(0, 4, count)
    return {
        "points": points,
        "labels": rng.integers(0, 23, count).astype(np.uint32),
        "flow": velocities[actors],
        "instances": actors.astype(np.uint32),
    }


def boxes(rng: np.random.Generator, count: int) -> Boxes:
    """Return random boxes, some of them filled in."""
    rotations = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    rotations[np.linalg.det(rotations) < 0, :, 0] *= -1
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, rng.normal(scale=10, size=(count, 3))
    tracks = rng.permutation(1000)[:count].astype(np.uint32) + np.uint32(1)
    labels, sizes = rng.integers(1, 23, count).astype(np.uint32), rng.uniform(0.3, 5, (count, 3))
    return Boxes.from_poses(tracks, labels, poses, sizes, rng.random(count) < 0.7)


def grid(rng: np.random.Generator, size: tuple[int, int, int], whole: bool = True) -> dict[str, NDArray[Any]]:
    """Return the labels and counts of a random grid; counts are whole numbers, or not."""
    counts = rng.integers(0, 40, size).astype(np.float32)
    return {"labels": rng.integers(0, 23, size).astype(np.uint32), "counts": counts if whole else counts / 3}


def evidence(rng: np.random.Generator, size: tuple[int, int, int], wide: bool = False) -> dict[str, NDArray[Any]]:
    """Return the fields of a random grid that say how certain it is; `wide` class ids have two bytes."""
    voxels = int(np.prod(size))
    classes = np.zeros(2 * voxels, field_files.WIDE_VOTES_DTYPE if wide else field_files.VOTES_DTYPE)
    classes["voxel"], classes["label"] = np.repeat(np.arange(voxels), 2), np.tile([1, 10], voxels)
    shares = rng.integers(1, layout.CERTAIN, voxels)
    classes["votes"] = np.column_stack([shares, layout.CERTAIN - shares]).reshape(-1)
    return {
        "occupied": rng.random(size).astype(np.float16),
        "classes": classes,
        "flags": rng.integers(0, 16, size).astype(np.uint8),
        "views": rng.choice([0, 1, 61, 300, 65535], size).astype(np.uint16),
    }


def actors(rng: np.random.Generator, size: tuple[int, int, int], count: int) -> dict[str, NDArray[Any]]:
    """Return the fields of a random grid that say which actor a voxel belongs to, and how it moves, of `count` voxels that move."""
    velocity = np.zeros(count, field_files.VELOCITY_DTYPE)
    velocity["voxel"] = np.sort(rng.permutation(int(np.prod(size)))[:count])
    velocity["velocity"] = rng.normal(scale=5, size=(count, 3))
    return {"instance": rng.choice([0, 1, 2, 300, 70_000], size).astype(np.uint32), "velocity": velocity}


def lines(count: int) -> tuple[bytes, bytes]:
    """Return the bytes of poses.txt and times.txt of a straight drive."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count) * 0.7
    return layout.encode_poses(poses), layout.encode_times(np.arange(count, dtype=np.float64) * layout.FRAME_PERIOD_S)


def write_dataset(root: Path, seed: int = 0) -> Path:
    """Write the sequences WHOLE, SCANS and GRIDS as published files.

    Args:
        root: folder to write to.
        seed: of the random numbers.

    Returns:
        `root`.
    """
    rng = np.random.default_rng(seed)
    sink = FolderSink(root)
    whole = sink.sequence(WHOLE)
    for name, data in zip(("poses.txt", "times.txt"), lines(FRAMES[-1] + 1), strict=True):
        whole.write_document(name, data)
    whole.write_document("carlasc.json", b'{"format": 2, "axes": "right",  "sensor": "a"}\n')
    whole.write_document("evaluation/params.json", params(SIZE))
    whole.write_document("evaluation_8x4x3/params.json", params(SECOND))
    for frame, count in zip(FRAMES, (0, 1, 777, 1001), strict=True):
        for name, array in scan(rng, count).items():
            whole.write(name, frame, array)
        if frame != 1:  # a frame without grids
            for part, array in grid(rng, SIZE).items():
                whole.write(f"evaluation/{part}", frame, array)
        for part, array in grid(rng, SECOND, whole=False).items():
            whole.write(f"evaluation_8x4x3/{part}", frame, array)
        if frame != 2:  # a frame that was not annotated; the first one has no objects
            whole.write("boxes", frame, boxes(rng, frame).to_table())
        whole.write("bev", frame, rng.integers(0, 256, 300 + frame).astype(np.uint8))
    whole.write_document("cameras.json", b'{"format": 1,  "cameras": []}\n')
    for frame in FRAMES[1:]:  # each camera has images of one kind
        for number, field in enumerate(("images.front.jpg", "images.left-1.png", "image_depths.front.png")):
            whole.write(field, frame, rng.integers(0, 256, 200 + 10 * frame + number).astype(np.uint8))
        whole.write("evaluation_8x4x3/seen", frame, rng.integers(0, 256, SECOND).astype(np.uint8))
    scans = sink.sequence(SCANS)
    for frame in range(3):
        some = scan(rng, 50 + frame)
        scans.write("points", frame, some["points"])
        scans.write("labels", frame, some["labels"])
        places = rng.normal(size=(3, 3)).astype(np.float32)
        scans.write("seconds", frame, rng.normal(scale=0.05, size=50 + frame).astype(np.float32))
        scans.write("sensor", frame, rng.integers(0, 3, 50 + frame).astype(np.uint8))
        scans.write("origins", frame, places[rng.integers(0, 3, 50 + frame)])
    grids = sink.sequence(GRIDS)
    grids.write_document("evaluation/params.json", params(SIZE, "cylindrical"))
    for frame in (3, 4):
        for part, array in grid(rng, SIZE).items():
            grids.write(f"evaluation/{part}", frame, array)
    votes = np.zeros(5, field_files.VOTES_DTYPE)
    votes["voxel"], votes["label"], votes["votes"] = [0, 1, 7, 20, 47], [1, 2, 3, 22, 0], [1, 300, 65535, 2, 1]
    grids.write("evaluation/votes", 4, votes)
    for part, array in evidence(rng, SIZE).items():
        grids.write(f"evaluation/{part}", 4, array)
    for frame in FRAMES:
        fields = evidence(rng, SECOND, wide=True)
        if frame == FRAMES[0]:  # whole numbers, which stores often keep in another type, before others
            fields["occupied"] = np.round(fields["occupied"])
        for part, array in fields.items():
            whole.write(f"evaluation_8x4x3/{part}", frame, array)
    for frame, count in zip(FRAMES, (0, 1, 17, 33), strict=True):
        for part, array in actors(rng, SECOND, count).items():
            whole.write(f"evaluation_8x4x3/{part}", frame, array)
    for frame, count in zip(FRAMES, (0, 1, 777, 1001), strict=True):
        whole.write("probabilities", frame, rng.integers(0, 65536, (count, 6)).astype(np.uint16))
    return root


def published_bytes(field: str, array: NDArray[Any]) -> bytes:
    """Return the bytes of the published file of an array of any shape: they must be equal, whatever type a store keeps the array in."""
    return bytes(layout.field_named(field).encode(array, field))
