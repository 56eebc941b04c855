"""A small data set with difficult cases for stores, and simulated errors of labels and poses.

The data set has gaps in the frames, empty scans, missing fields, and grids of several shapes.
Errors of labels are like those of a network, errors of poses like those of an odometry or a
satellite receiver.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from carlasc.core.arrays import AnyArray, AnyFloatArray, FloatArray, LabelArray, Uint8Array
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import invert, multiply, rotations_of
from carlasc.errors import ArgumentError
from carlasc.storage import field_files, layout
from carlasc.storage.folder import FolderSink
from carlasc.storage.protocol import SequenceWriter

FRAMES = (0, 1, 2, 5)
"""Frames of the sequence WHOLE."""
SIZE, SECOND = (4, 6, 2), (8, 4, 3)
"""Sizes of the two grids."""
FIRST_GRID = "evaluation"
SECOND_GRID = "evaluation_8x4x3"

WHOLE = "Train/Town01_Light/cartesian"
SCANS = "Val/Town07_Heavy/cartesian"
GRIDS = "Test/Town10_Medium/cylindrical"
"""Paths of the three sequences: every field; scans without poses; grids without scans."""


def params(size: tuple[int, int, int], coordinates: str = "cartesian") -> bytes:
    """Return the bytes of the params.json of a grid."""
    bounds = {
        "min_bound": [0.0 if coordinates == "cylindrical" else -25.6, -3.0, -2.0],
        "max_bound": [25.6, 3.0, 1.0],
    }
    grid_size = [float(n) for n in size]
    settings = {"grid_size": grid_size, **bounds, "num_channels": 25, "coordinates": coordinates}
    return json.dumps(settings).encode()


def scan(rng: np.random.Generator, count: int) -> dict[str, AnyArray]:
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
    """Return random boxes, some of them interpolated."""
    rotations = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    rotations[np.linalg.det(rotations) < 0, :, 0] *= -1
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = rng.normal(scale=10, size=(count, 3))
    tracks = rng.permutation(1000)[:count].astype(np.uint32) + np.uint32(1)
    labels = rng.integers(1, 23, count).astype(np.uint32)
    sizes = rng.uniform(0.3, 5, (count, 3))
    return Boxes.from_poses(tracks, labels, poses, sizes, rng.random(count) < 0.7)


def grid(
    rng: np.random.Generator, size: tuple[int, int, int], whole: bool = True
) -> dict[str, AnyArray]:
    """Return the labels and counts of a random grid; `whole` counts are integers."""
    counts = rng.integers(0, 40, size).astype(np.float32)
    return {
        "labels": rng.integers(0, 23, size).astype(np.uint32),
        "counts": counts if whole else counts / 3,
    }


def evidence(
    rng: np.random.Generator, size: tuple[int, int, int], wide: bool = False
) -> dict[str, AnyArray]:
    """Return the evidence fields of a random grid; `wide` class ids have two bytes."""
    voxels = int(np.prod(size))
    classes = np.zeros(
        2 * voxels, field_files.WIDE_VOTES_DTYPE if wide else field_files.VOTES_DTYPE
    )
    classes["voxel"] = np.repeat(np.arange(voxels), 2)
    classes["label"] = np.tile([1, 10], voxels)
    shares = rng.integers(1, layout.CERTAIN, voxels)
    classes["votes"] = np.column_stack([shares, layout.CERTAIN - shares]).reshape(-1)
    return {
        "occupied": rng.random(size).astype(np.float16),
        "classes": classes,
        "flags": rng.integers(0, 16, size).astype(np.uint8),
        "views": rng.choice([0, 1, 61, 300, 65535], size).astype(np.uint16),
    }


def actors(rng: np.random.Generator, size: tuple[int, int, int], count: int) -> dict[str, AnyArray]:
    """Return the instance and velocity of a random grid with `count` moving voxels."""
    velocity = np.zeros(count, field_files.VELOCITY_DTYPE)
    velocity["voxel"] = np.sort(rng.permutation(int(np.prod(size)))[:count])
    velocity["velocity"] = rng.normal(scale=5, size=(count, 3))
    return {
        "instance": rng.choice([0, 1, 2, 300, 70_000], size).astype(np.uint32),
        "velocity": velocity,
    }


def lines(count: int) -> tuple[bytes, bytes]:
    """Return the bytes of poses.txt and times.txt of a straight drive."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count) * 0.7
    return layout.encode_poses(poses), layout.encode_times(
        np.arange(count, dtype=np.float64) * layout.FRAME_PERIOD_S
    )


def write_dataset(root: Path, seed: int = 0) -> Path:
    """Write the sequences WHOLE, SCANS and GRIDS as published files.

    Args:
        root: folder to write to.
        seed: seed of the random numbers.

    Returns:
        `root`.
    """
    rng = np.random.default_rng(seed)
    sink = FolderSink(root)
    whole = sink.sequence(WHOLE)
    for name, data in zip(("poses.txt", "times.txt"), lines(FRAMES[-1] + 1), strict=True):
        whole.write_document(name, data)
    whole.write_document("carlasc.json", b'{"format": 2, "axes": "right",  "sensor": "a"}\n')
    whole.write_document(f"{FIRST_GRID}/params.json", params(SIZE))
    whole.write_document(f"{SECOND_GRID}/params.json", params(SECOND))
    for frame, count in zip(FRAMES, (0, 1, 777, 1001), strict=True):
        _write_all(whole, frame, scan(rng, count))
        if frame != 1:  # a frame without grids
            _write_all(whole, frame, grid(rng, SIZE), FIRST_GRID)
        _write_all(whole, frame, grid(rng, SECOND, whole=False), SECOND_GRID)
        if frame != 2:  # frame 2 is not annotated; the first frame has no objects
            whole.write("boxes", frame, boxes(rng, frame).to_table())
        whole.write("bev", frame, _bytes(rng, 300 + frame))
    whole.write_document("cameras.json", b'{"format": 1,  "cameras": []}\n')
    for frame in FRAMES[1:]:  # each camera has one kind of images
        for number, field in enumerate(
            ("images.front.jpg", "images.left-1.png", "image_depths.front.png")
        ):
            whole.write(field, frame, _bytes(rng, 200 + 10 * frame + number))
        whole.write(f"{SECOND_GRID}/seen", frame, _bytes(rng, SECOND))
    scans = sink.sequence(SCANS)
    for frame in range(3):
        count = 50 + frame
        fields = scan(rng, count)
        del fields["flow"], fields["instances"]
        places = rng.normal(size=(3, 3)).astype(np.float32)
        fields["seconds"] = rng.normal(scale=0.05, size=count).astype(np.float32)
        fields["sensor"] = rng.integers(0, 3, count).astype(np.uint8)
        _write_all(scans, frame, fields | {"origins": places[rng.integers(0, 3, count)]})
    grids = sink.sequence(GRIDS)
    grids.write_document(f"{FIRST_GRID}/params.json", params(SIZE, "cylindrical"))
    for frame in (3, 4):
        _write_all(grids, frame, grid(rng, SIZE), FIRST_GRID)
    votes = np.zeros(5, field_files.VOTES_DTYPE)
    votes["voxel"] = [0, 1, 7, 20, 47]
    votes["label"] = [1, 2, 3, 22, 0]
    votes["votes"] = [1, 300, 65535, 2, 1]
    _write_all(grids, 4, {"votes": votes} | evidence(rng, SIZE), FIRST_GRID)
    for frame in FRAMES:
        fields = evidence(rng, SECOND, wide=True)
        if frame == FRAMES[0]:  # integers first, because stores often keep them in another type
            fields["occupied"] = np.round(fields["occupied"])
        _write_all(whole, frame, fields, SECOND_GRID)
    for frame, count in zip(FRAMES, (0, 1, 17, 33), strict=True):
        _write_all(whole, frame, actors(rng, SECOND, count), SECOND_GRID)
    for frame, count in zip(FRAMES, (0, 1, 777, 1001), strict=True):
        whole.write("probabilities", frame, rng.integers(0, 65536, (count, 6)).astype(np.uint16))
    return root


def _write_all(
    writer: SequenceWriter, frame: int, fields: Mapping[str, AnyArray], grid: str = ""
) -> None:
    """Write fields of a frame; with `grid`, the fields of a grid."""
    for name, array in fields.items():
        writer.write(f"{grid}/{name}" if grid else name, frame, array)


def _bytes(rng: np.random.Generator, shape: int | tuple[int, ...]) -> Uint8Array:
    return rng.integers(0, 256, shape).astype(np.uint8)


def published_bytes(field: str, array: AnyArray) -> bytes:
    """Return the bytes of the published file of an array of any shape.

    They do not depend on the type in which a store keeps the array.
    """
    return bytes(layout.field_named(field).encode(array, field))


def wrong_labels(
    labels: LabelArray,
    points: AnyFloatArray,
    share: float,
    *,
    clump_m: float | None = None,
    classes: Iterable[int] | None = None,
    seed: int = 0,
) -> LabelArray:
    """Return a copy of labels in which a share is wrong. Points with class 0 are unchanged.

    Clumps are cubes. The wrong clumps and their classes depend on their position and on `seed`.
    With points in the world frame and equal seeds, several scans have wrong labels at the same
    positions, like a network that cannot recognise an object. With another seed for each scan, or
    with points in the sensor frame, the positions differ.

    Args:
        labels: (N,) class ids.
        points: (N, 3) or more columns; the first three are x, y, z in metres.
        share: share of the labelled points that get another class, 0 to 1; with clumps, the nearest
            share of whole clumps.
        clump_m: edge length of a clump, metres; None for random single points.
        classes: at least two ids for wrong labels; None for the ids in `labels`.
        seed: seed of the random numbers.

    Returns:
        (N,) class ids of the type of `labels`.

    Raises:
        ArgumentError: `share` or `clump_m` is not in its range, or there are fewer than two
            classes.
    """
    if not 0 <= share <= 1:
        raise ArgumentError("share", expected="a number from 0 to 1", found=share)
    if clump_m is not None and not clump_m > 0:
        raise ArgumentError("clump_m", expected="a length above 0", found=clump_m)
    result = labels.copy()
    places = np.flatnonzero(labels)
    others = np.unique(labels[places] if classes is None else list(classes)).astype(labels.dtype)
    if not len(places) or not share:
        return result
    if len(others) < 2:
        raise ArgumentError("classes", expected="two classes or more", found=others.tolist())
    if clump_m is None:
        rng = np.random.default_rng(seed)
        wrong = rng.permutation(places)[: round(share * len(places))]
        drawn = rng.integers(0, len(others), len(wrong))
    else:
        cubes = np.floor(points[places, :3].astype(np.float64) / clump_m).astype(np.int64)
        cubes, clump, counts = np.unique(cubes, axis=0, return_inverse=True, return_counts=True)
        rngs = [np.random.default_rng([seed, *cube]) for cube in (cubes & 0xFFFFFFFF).tolist()]
        order = np.argsort([rng.random() for rng in rngs])
        wanted = share * len(places)
        # clumps of which more than half is within the share
        above = np.cumsum(counts[order]) - counts[order] / 2 < wanted
        chosen = np.zeros(len(cubes), np.bool_)
        chosen[order[above]] = True
        classes_of = np.array([rng.integers(0, len(others)) for rng in rngs])
        clump = clump.reshape(-1)
        wrong = places[chosen[clump]]
        drawn = classes_of[clump[chosen[clump]]]
    same = others[drawn] == labels[wrong]
    result[wrong] = others[(drawn + same) % len(others)]
    return result


def wrong_poses(
    poses: FloatArray,
    *,
    jitter_m: float = 0.0,
    jitter_rad: float = 0.0,
    drift_m: float = 0.0,
    drift_rad: float = 0.0,
    height_drift_m: float = 0.0,
    seed: int = 0,
) -> FloatArray:
    """Return poses with errors. Equal arguments give equal poses.

    Args:
        poses: (F, 4, 4) world_T_sensor in order of time.
        jitter_m: standard deviation of an independent error of each position, along each axis of
            the world.
        jitter_rad: standard deviation of an independent error of each rotation, about each axis of
            the sensor.
        drift_m: standard deviation of an error of each motion between two poses, along each axis of
            the sensor; these errors add up.
        drift_rad: standard deviation of an error of each rotation between two poses; these errors
            add up.
        height_drift_m: standard deviation of the steps of a random walk of the height.
        seed: seed of the random numbers.

    Returns:
        (F, 4, 4) world_T_sensor. Drift does not change the first pose.

    Raises:
        ArgumentError: a standard deviation is negative or not a number.
    """
    deviations = {
        "jitter_m": jitter_m,
        "jitter_rad": jitter_rad,
        "drift_m": drift_m,
        "drift_rad": drift_rad,
        "height_drift_m": height_drift_m,
    }
    for name, value in deviations.items():
        if not 0 <= value < np.inf:
            raise ArgumentError(name, expected="a standard deviation, 0 or more", found=value)
    rng = np.random.default_rng(seed)
    wrong = np.array(poses, np.float64)
    motions = multiply(invert(wrong[:-1]), wrong[1:])
    motions = multiply(motions, _turns(rng, len(motions), drift_rad))
    motions[:, :3, 3] += rng.normal(0.0, drift_m, (len(motions), 3))
    if drift_m or drift_rad:
        for row, motion in enumerate(motions):
            wrong[row + 1] = multiply(wrong[row], motion)
    wrong = multiply(wrong, _turns(rng, len(wrong), jitter_rad))
    wrong[:, :3, 3] += rng.normal(0.0, jitter_m, (len(wrong), 3))
    wrong[1:, 2, 3] += np.cumsum(rng.normal(0.0, height_drift_m, max(len(wrong) - 1, 0)))
    return wrong


def _turns(rng: np.random.Generator, count: int, deviation_rad: float) -> FloatArray:
    """Return (count, 4, 4) small rotations."""
    turns = np.tile(np.eye(4), (count, 1, 1))
    half = rng.normal(0.0, deviation_rad, (count, 3)) / 2
    turns[:, :3, :3] = rotations_of(np.column_stack([np.ones(count), half]))
    return turns
