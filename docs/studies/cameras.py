"""How right are `seen`, and the classes that images give to points? `python docs/studies/cameras.py [WORK] [--seeds 23 51] [--size tiny]`.

Each seed is a drive of the simulated town with six cameras, whose images of depth and of class say what is true. Prints the rows of both tables of
docs/howto/cameras.md. Constants of `carlasc label --from images` were chosen on seeds 11 and 37. WORK keeps the drives and what is made of them.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import carlasc
from carlasc import FromScans, GridSpec, Run, Voting
from carlasc.core import CameraModel, invert, transform_points
from carlasc.storage import cameras_of, read_image, scan_T_camera
from carlasc.storage.camera_files import encode_image
from carlasc.storage.protocol import Sequence

CAMERAS = ("front", "front_left", "front_right", "back", "back_left", "back_right")
COARSE, FINE = GridSpec.published(), GridSpec.published("fine")
GRIDS = {  # name -> geometry, and what sees it: one LiDAR over time, or twelve at once
    "coarse, one LiDAR": (COARSE, FromScans()),
    "coarse, twelve LiDARs": (COARSE, None),
    "0.2 m, twelve LiDARs": (FINE, None),
}
FRAMES = {"tiny": 2, "whole": 24}
JUDGED = {"tiny": 1, "whole": 2}  # frames in which `seen` is compared
SURFACE_M, SURFACE_SHARE = (
    0.1,
    0.02,
)  # a point is on the surface that a pixel shows if it is so near, and this share of its depth
SQUARE_PX, WRONG = 24, 0.1  # wrong pixels are half in squares, half alone
SAMPLED = 15  # one voxel of so many is compared
ONE = Run(workers=1)


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path, nargs="?", default=Path("build/cameras"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[23, 51])
    parser.add_argument("--size", choices=tuple(FRAMES), default="whole")
    given = parser.parse_args()
    print("| seed | points that a camera sees, labelled | of these right | of all these right | voxels right, 90 % |")
    for seed in given.seeds:
        drive = _drive(given.work / f"{given.size}{seed}", seed, FRAMES[given.size])
        print(f"| {seed} | {' | '.join(f'{100 * share:.1f} %' for share in labels_of(drive, seed))} |", flush=True)
    print(
        "| seed | grid | voxels that no edge cuts: right | of all known ones in view, no edge cuts | all, by their centre: right |"
    )
    for seed in given.seeds:
        for name in GRIDS:
            shares = seen_of(given.work / f"{given.size}{seed}", name, JUDGED[given.size])
            print(f"| {seed} | {name} | {' | '.join(f'{100 * share:.1f} %' for share in shares)} |", flush=True)


def _drive(folder: Path, seed: int, frames: int) -> Path:
    if not folder.exists():
        carlasc.simulate(folder / "drive", count=frames, sensors=12, seed=seed, bev=False, cameras=CAMERAS, run=ONE)
        carlasc.regrid(folder / "drive", COARSE, name="first", run=ONE)  # writes the scans of the first LiDAR too
    return folder


def labels_of(folder: Path, seed: int) -> tuple[float, float, float, float]:
    """Return the shares of the first table: of points from exact pixels, and of voxels from pixels of which a tenth is wrong."""
    given = _only(folder / "drive")
    exact = folder / "exact"
    if not exact.exists():
        carlasc.label_images(folder / "drive", exact, run=ONE)
    found, counts = _only(exact), np.zeros(3, np.int64)
    for frame in given.frames("points").tolist():
        visible = np.zeros(len(given.scan(frame)), np.bool_)
        for camera in cameras_of(given).values():
            depth, inside, here = _pixels(given, camera, frame, given.scan(frame).points)
            visible[inside] |= np.abs(depth - here) < SURFACE_M + SURFACE_SHARE * here
        certain = found.read("probabilities", frame)[:, 1] >= 6554  # a tenth: points that no image shows have less
        right = found.read("labels", frame) == given.read("labels", frame)
        counts += [visible.sum(), (visible & certain).sum(), (visible & certain & right).sum()]
    _spoil(given, folder / "pixels", np.random.default_rng(seed))
    shutil.rmtree(folder / "wrong", ignore_errors=True)
    carlasc.label_images(folder / "drive", folder / "wrong", pixels=folder / "pixels", run=ONE)
    grids = list[NDArray[np.integer]]()
    for source in (_only(folder / "drive"), _only(folder / "wrong")):
        out = folder / f"grids{len(grids)}"
        shutil.rmtree(out, ignore_errors=True)
        carlasc.regrid(source.location, COARSE, out, observe=FromScans(), name="evaluation", run=ONE)
        made = _only(out)
        grids.append(np.stack([made.grid("evaluation", frame).labels for frame in made.frames("points").tolist()]))
    truth, labelled = grids
    occupied = (truth > 0) & (labelled > 0)
    seen, sure, right = counts.tolist()
    return sure / seen, right / sure, right / seen, float((truth == labelled)[occupied].mean())


def seen_of(folder: Path, name: str, frames: int) -> tuple[float, float, float]:
    """Return the shares of the second table, of voxels and cameras in whose images they are, by the images of depth."""
    (spec, observe), out = GRIDS[name], folder / name.replace(", ", "_").replace(" ", "_")
    if not out.exists():
        source = folder / "drive" if observe is None else _only(folder / "drive").location
        voting = Voting(keep_seen=True)
        carlasc.regrid(source, spec, out, observe=observe, voting=voting, name="evaluation", run=ONE)
    made, given, answers = _only(out), _only(folder / "drive"), list[NDArray[np.bool_]]()
    for frame in np.linspace(0, len(given.frames("points")) - 1, frames).astype(int).tolist():
        known = np.flatnonzero(made.grid("evaluation", frame).known.reshape(-1))[::SAMPLED]
        seen = made.read("evaluation/seen", frame).reshape(-1)[known]
        for bit, camera in enumerate(cameras_of(given).values()):
            answers.append(_compare(given, camera, frame, spec, known, (seen >> bit) & 1 > 0))
    uncut, right, by_centre = np.concatenate(answers).T
    return float(right[uncut].mean()), float(uncut.mean()), float(by_centre.mean())


def _compare(
    given: Sequence, camera: CameraModel, frame: int, spec: GridSpec, voxels: NDArray[np.int64], seen: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return (N, 3) for each voxel whose centre is in the image: whether no edge cuts it, whether `seen` is right, and whether it is by its centre.

    A voxel is really seen if no pixel of the rectangle around its projection shows something before it, and really hidden if all do.
    """
    edge = np.asarray(spec.voxel_size)
    centres = np.asarray(spec.lower) + (np.stack(np.unravel_index(voxels, spec.size), 1) + 0.5) * edge
    corners = centres[:, None] + (np.stack(list(np.ndindex(2, 2, 2))) - 0.5) * edge
    place = scan_T_camera(given, camera, frame)
    assert place is not None
    local = transform_points(invert(place), corners.reshape(-1, 3))
    pixels = camera.project(local).reshape(-1, 8, 2)
    nearest = local[:, 2].reshape(-1, 8).min(axis=1)
    middle = transform_points(invert(place), centres)
    at = camera.project(middle)
    depths = read_image(given, camera, frame, "image_depths") / 256.0
    rows = list[tuple[bool, bool, bool]]()
    for i in np.flatnonzero(camera.contains(np.nan_to_num(at, nan=-9.0))).tolist():
        (left, top), (right, bottom) = np.floor(pixels[i].min(0) + 0.5), np.floor(pixels[i].max(0) + 0.5) + 1
        whole = nearest[i] > 0.5 and left >= 0 and top >= 0 and right <= camera.width and bottom <= camera.height
        shown = depths[int(np.rint(at[i, 1])), int(np.rint(at[i, 0]))] >= middle[i, 2] - edge.max() / 2
        hidden = False
        if whole:
            before = depths[int(top) : int(bottom), int(left) : int(right)] < nearest[i]
            whole, hidden = bool(before.all() or not before.any()), bool(before.all())
        rows.append((bool(whole), bool(seen[i]) != hidden, bool(seen[i]) == bool(shown)))
    return np.array(rows, np.bool_).reshape(-1, 3)


def _pixels(
    given: Sequence, camera: CameraModel, frame: int, points: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the depth that the image shows at each point in it, which points these are, and their own depths, metres."""
    place = scan_T_camera(given, camera, frame)
    assert place is not None
    local = transform_points(invert(place), points)
    at = camera.project(local)
    inside = np.flatnonzero(camera.contains(np.nan_to_num(at, nan=-9.0)))
    column, row = np.rint(at[inside]).astype(int).T
    return read_image(given, camera, frame, "image_depths")[row, column] / 256.0, inside, local[inside, 2]


def _spoil(given: Sequence, out: Path, rng: np.random.Generator) -> None:
    """Write the classes of pixels, of which a tenth is another class of the same image."""
    shutil.rmtree(out, ignore_errors=True)
    for camera in cameras_of(given).values():
        folder = out / camera.name
        folder.mkdir(parents=True)
        for frame in given.frames("points").tolist():
            labels = np.array(read_image(given, camera, frame, "image_labels"))
            classes, wrong = np.unique(labels), np.zeros(labels.shape, np.bool_)
            alone = rng.random(labels.shape) < WRONG / 2
            labels[alone] = rng.choice(classes, int(alone.sum()))
            while wrong.mean() < WRONG / 2:
                row, column = (int(rng.integers(0, size - SQUARE_PX)) for size in labels.shape)
                square = slice(row, row + SQUARE_PX), slice(column, column + SQUARE_PX)
                labels[square], wrong[square] = rng.choice(classes), True
            (folder / f"{frame:06d}.png").write_bytes(encode_image(labels.astype(np.uint8), "PNG").tobytes())


def _only(folder: Path) -> Sequence:
    (sequence,) = carlasc.open(folder).values()
    return sequence


if __name__ == "__main__":
    main()
