"""Voxel files as other programs write them, written from the facts of their formats in plain NumPy,
without the package that reads them.

Each writer takes (X, Y, Z) names of classes, and returns the folder to open. `street` builds a scene
in the bounds of a grid.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

NUSCENES = (
    "barrier bicycle bus car construction-vehicle motorcycle pedestrian traffic-cone trailer truck "
    "driveable-surface other-flat sidewalk terrain manmade vegetation"
).split()
OCCNET = (
    "car truck trailer bus construction-vehicle bicycle motorcycle pedestrian traffic-cone barrier "
    "driveable-surface other-flat sidewalk terrain manmade vegetation"
).split()
KITTI19 = (
    "car bicycle motorcycle truck other-vehicle person bicyclist motorcyclist road parking sidewalk "
    "other-ground building fence vegetation trunk terrain pole traffic-sign"
).split()
KITTI_RAW = dict(
    zip(
        KITTI19,
        (10, 11, 15, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 70, 71, 72, 80, 81),
        strict=True,
    )
)
SSC18 = (
    "car bicycle motorcycle truck other-vehicle person road parking sidewalk other-ground building "
    "fence vegetation terrain pole traffic-sign other-structure other-object"
).split()
CARLASC11 = (
    "Free Building Barrier Other Pedestrian Pole Road Ground Sidewalk Vegetation Vehicles"
).split()

# what the street has -> classes of each benchmark
TO_NUSCENES = {
    "road": "driveable-surface", "sidewalk": "sidewalk", "terrain": "terrain", "car": "car",
    "building": "manmade", "tree": "vegetation", "person": "pedestrian", "bus": "bus",
}  # fmt: skip
TO_KITTI = {
    "road": "road", "sidewalk": "sidewalk", "terrain": "terrain", "car": "car",
    "building": "building", "tree": "vegetation", "person": "person", "bus": "other-vehicle",
}  # fmt: skip
TO_CARLASC = {
    "road": "Road", "sidewalk": "Sidewalk", "terrain": "Ground", "car": "Vehicles",
    "building": "Building", "tree": "Vegetation", "person": "Pedestrian", "bus": "Vehicles",
}  # fmt: skip
KINDS = ("free", *TO_NUSCENES)


def street(lower, upper, size, *, forward="x", ground=-1.8, seed=0):
    """Return (X, Y, Z) uint8 indices into KINDS: a street along the forward axis."""
    steps = (np.array(upper) - lower) / size
    x, y, z = np.meshgrid(
        *(np.array(lower)[i] + (np.arange(size[i]) + 0.5) * steps[i] for i in range(3)),
        indexing="ij",
        sparse=True,
    )
    ahead, left = (x, y) if forward == "x" else (y, -x)
    up = z - ground
    grid = np.zeros(size, np.uint8)
    floor = (up >= -steps[2]) & (up < 0)
    np.copyto(grid, KINDS.index("terrain"), where=floor & (ahead < np.inf))
    np.copyto(grid, KINDS.index("sidewalk"), where=floor & (np.abs(left) < 11))
    np.copyto(grid, KINDS.index("road"), where=floor & (np.abs(left) < 7))
    rng = np.random.default_rng(seed)

    def box(kind, at, side, length, width, height, base=0.0):
        inside = (np.abs(ahead - at) < length / 2) & (np.abs(left - side) < width / 2)
        np.copyto(grid, KINDS.index(kind), where=inside & (up >= base) & (up < base + height))

    for at in range(-48, 60, 12):
        for side in (-18, 18):
            box("building", at, side, rng.uniform(7, 10), 9, rng.uniform(2.5, 4.5))
        for side in (-9, 9):
            box("tree", at + 6, side, 2.4, 2.4, 2.0, 1.2)
            box("tree", at + 6, side, 0.6, 0.6, 1.4)
    for at, side in ((8, -2), (20, 2.5), (32, -2), (-14, 2.5), (44, 2.5)):
        box("car", at, side, 4.4, 1.9, 1.5)
    box("bus", -30, -2.5, 10, 2.6, 2.8)
    for at in (12, 26, -8):
        box("person", at, 8.6, 0.7, 0.7, 1.7)
    return grid


def ids(grid, names, to, *, free, first):
    """Return the ids of a street in a benchmark whose class `names[0]` has the id `first`."""
    table = [free] + [first + names.index(to[kind]) for kind in KINDS[1:]]
    return np.array(table)[grid]


def noisy(labels, free, seed):
    """Return a prediction: a tenth of the occupied voxels is free, and 3% have another class."""
    rng, pred = np.random.default_rng(seed), labels.copy()
    chance = np.where(labels == free, 1.0, rng.random(labels.shape))
    pred[chance < 0.13] = rng.choice(np.unique(labels[labels != free]))
    pred[chance < 0.1] = free
    return pred


KITTI = ((0, -25.6, -2), (51.2, 25.6, 4.4), (256, 256, 32))
OCC3D = ((-40, -40, -1), (40, 40, 5.4), (200, 200, 16))
OPENOCCUPANCY = ((-51.2, -51.2, -5), (51.2, 51.2, 3), (512, 512, 40))
SURROUNDOCC = ((-50, -50, -5), (50, 50, 3), (200, 200, 16))
CARLASC = ((-25.6, -25.6, -2), (25.6, 25.6, 1), (128, 128, 8))


def write_semantickitti(root: Path) -> Path:
    raw = np.array([0, *(KITTI_RAW[TO_KITTI[kind]] for kind in KINDS[1:])])[street(*KITTI)]
    folder = root / "sequences/08/voxels"
    folder.mkdir(parents=True)
    raw.astype("<u2").tofile(folder / "000000.label")
    invalid = np.zeros(KITTI[2], bool)
    invalid[:, :, 20:] = True
    np.packbits(invalid.reshape(-1)).tofile(folder / "000000.invalid")
    return root


def write_sscbench(root: Path) -> Path:
    raw = np.array([0, *(KITTI_RAW[TO_KITTI[kind]] for kind in KINDS[1:])])[street(*KITTI)]
    folder = root / "data_2d_raw/2013_05_28_drive_0009_sync/voxels"
    folder.mkdir(parents=True)
    raw.astype("<u2").tofile(folder / "000005.label")
    np.zeros(KITTI[2], np.uint8).tofile(folder / "000005.invalid")
    return root


def write_preprocessed(root: Path) -> Path:
    labels = ids(street(*KITTI), KITTI19, TO_KITTI, free=0, first=1)
    labels[:, :, 20:] = 255
    (root / "labels/08").mkdir(parents=True)
    np.save(root / "labels/08/000000_1_1.npy", labels.astype(np.float32))
    np.save(root / "labels/08/000000_1_8.npy", labels[::8, ::8, ::8].astype(np.float32))
    return root


def write_sscbench_preprocessed(root: Path) -> Path:
    labels = ids(street(*KITTI), SSC18, TO_KITTI, free=0, first=1)
    folder = root / "preprocess/labels/2013_05_28_drive_0009_sync"
    folder.mkdir(parents=True)
    np.save(folder / "000005_1_1.npy", labels.astype(np.uint8))
    return root


def occ3d_labels():
    grid = street(*OCC3D, ground=0.0)
    return ids(grid, ["others", *NUSCENES], TO_NUSCENES, free=17, first=0).astype(np.uint8)


def write_occ3d(root: Path, tokens=("aa0", "bb1")) -> Path:
    labels = occ3d_labels()
    x, y = np.meshgrid(np.arange(200) - 100, np.arange(200) - 100, indexing="ij")
    camera = np.broadcast_to(np.hypot(x, y)[..., None] < 70, labels.shape)
    lidar = np.broadcast_to(np.hypot(x, y)[..., None] < 90, labels.shape)
    for token in tokens:
        folder = root / "gts/scene-0001" / token
        folder.mkdir(parents=True)
        masks = {"mask_lidar": lidar.astype(np.uint8), "mask_camera": camera.astype(np.uint8)}
        np.savez_compressed(folder / "labels.npz", semantics=labels, **masks)
    return root


def write_challenge(root: Path, tokens=("aa0", "bb1")) -> Path:
    root.mkdir(parents=True)
    for seed, token in enumerate(tokens):
        np.savez_compressed(root / token, noisy(occ3d_labels(), 17, seed))
    return root


def write_flashocc(root: Path, tokens=("aa0", "bb1")) -> Path:
    for seed, token in enumerate(tokens):
        folder = root / "scene-0001" / token
        folder.mkdir(parents=True)
        pred = noisy(occ3d_labels(), 17, seed)
        np.savez_compressed(folder / "pred.npz", pred=pred, gt=occ3d_labels(), sample_token=token)
    return root


def write_openoccupancy(root: Path) -> Path:
    grid = street(*OPENOCCUPANCY, forward="y")
    labels = ids(grid, NUSCENES, TO_NUSCENES, free=0, first=1)
    x, y, z = np.nonzero(labels)
    rows = np.column_stack([z, y, x, labels[x, y, z]]).astype(np.uint16)
    noise = np.array([[39, 5, 5, 0]], np.uint16)
    folder = root / "scene_0a1b/occupancy"
    folder.mkdir(parents=True)
    np.save(folder / "9f8e.npy", np.concatenate([rows, noise]))
    return root


def write_surroundocc(root: Path) -> Path:
    labels = ids(street(*SURROUNDOCC, forward="y"), NUSCENES, TO_NUSCENES, free=0, first=1)
    x, y, z = np.nonzero(labels)
    rows = np.concatenate([np.column_stack([x, y, z, labels[x, y, z]]), [[5, 5, 15, 0]]])
    root.mkdir(parents=True)
    np.save(root / "n015-2018__LIDAR_TOP__1533.pcd.bin.npy", rows.astype(np.int64))
    return root


def write_occnet(root: Path) -> Path:
    grid = street(*SURROUNDOCC, forward="y")
    labels = ids(grid, OCCNET, TO_NUSCENES, free=16, first=0).transpose(2, 1, 0).reshape(-1)
    (index,) = np.nonzero(labels != 16)
    root.mkdir(parents=True)
    np.save(root / "000.npy", np.column_stack([index, labels[index]]).astype(np.int32))
    return root


def write_carlasc_predictions(root: Path) -> Path:
    labels = ids(street(*CARLASC, ground=-1.6), CARLASC11, TO_CARLASC, free=0, first=0)
    folder = root / "Test/Town10_Heavy/cartesian/MotionSC_11_T1"
    folder.mkdir(parents=True)
    labels.astype("<u4").tofile(folder / "000000.label")
    return root


WRITERS: dict[str, Callable[[Path], Path]] = {
    name.removeprefix("write_"): writer
    for name, writer in list(globals().items())
    if name.startswith("write_")
}


def write_all(root: Path) -> None:
    """Write a folder of each format."""
    for name, writer in WRITERS.items():
        if not (root / name).exists():
            writer(root / name)
