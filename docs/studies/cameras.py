"""How right are `seen`, and the classes that images give to points?

`python docs/studies/cameras.py [WORK] [--seeds 23 51] [--size tiny] [--real KITTI]`.

Each seed is a drive of the simulated town with six cameras, whose images of depth and of class say
what is true. Prints the rows of the tables of docs/howto/cameras.md. Constants of `carlasc label
--from images` were chosen on seeds 11 and 37. WORK keeps the drives and what is made of them.
"""

from __future__ import annotations

import argparse
import os
import shutil
import time
from pathlib import Path

import numpy as np
from carlasc_converters.kitti_tracking import KittiTracking, TrackingSequence
from numpy.typing import NDArray

import carlasc
from carlasc import FromScans, GridSpec, Run, Voting
from carlasc.core import CameraModel, invert, transform_points
from carlasc.core.cameras import Lens
from carlasc.groundtruth.seen import see_voxels
from carlasc.inspection.image_alignment import compare_images
from carlasc.storage import cameras_of, read_image, scan_T_camera
from carlasc.storage.camera_files import cameras_to_json, encode_image
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
# a point is on the surface that a pixel shows if it is so near, and this share of its depth
SURFACE_M, SURFACE_SHARE = (
    0.1,
    0.02,
)
SQUARE_PX, WRONG = 24, 0.1  # wrong pixels are half in squares, half alone
SAMPLED = 15  # one voxel of so many is compared
DEPTH_STEP_M = 1 / 256  # of the images of depth
SHIFT_PX, TIME_S = 3.0, 0.03  # within these, the shift and the time of images are told right
LENSES: dict[Lens, tuple[float, ...]] = {  # as strong as those of cars
    "pinhole": (),
    "radial-tangential": (-0.3, 0.1, 0.001, -0.001, -0.01),
    "fisheye": (0.02, -0.005, 0.001, -0.0002),
}
ONE = Run(workers=1)


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path, nargs="?", default=Path("build/cameras"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[23, 51])
    parser.add_argument("--size", choices=tuple(FRAMES), default="whole")
    parser.add_argument(
        "--real", type=Path, help="KITTI's tracking benchmark, with the folder training/"
    )
    given = parser.parse_args()
    print(
        "| seed | points that a camera sees, labelled | of these right | of all these right | "
        "voxels right, 90% |"
    )
    for seed in given.seeds:
        folder = _drive(given.work / f"{given.size}{seed}", seed, FRAMES[given.size])
        print(
            f"| {seed} | {' | '.join(f'{100 * share:.1f}%' for share in labels_of(folder, seed))} "
            f"|",
            flush=True,
        )
    print(
        "| seed | grid | right | hidden, said | seen, said | occupied ones: right | whole | share "
        "| by centre |"
    )
    for seed in given.seeds:
        for name in GRIDS:
            shares = seen_of(given.work / f"{given.size}{seed}", name, JUDGED[given.size])
            print(
                f"| {seed} | {name} | {' | '.join(f'{share:.2f}%' for share in shares)} |",
                flush=True,
            )
    plain_measures(folder / "drive")
    if given.real is not None:
        tracked_boxes(given.real)
    for seed in given.seeds if given.size == "whole" else ():
        agreement_of(given.work / f"{given.size}{seed}")


def plain_measures(drive: Path, spec: GridSpec = COARSE) -> None:
    """Print the processor time of `seen` for six large images, and how exact the models of lenses
    are.
    """
    given, rng = _only(drive), np.random.default_rng(0)
    views = [
        (camera.resized(1600, 900), camera.sensor_T_camera) for camera in cameras_of(given).values()
    ]
    boxes = np.sort(rng.integers(0, 256, (spec.num_voxels, 2, 3), np.uint8), axis=1).reshape(-1, 6)
    occupied, taken = (
        _only(drive.parent / "coarse_one_LiDAR").grid("evaluation", 0).labels > 0,
        list[float](),
    )
    for _ in range(6):
        began = time.process_time()
        see_voxels(occupied, spec, views, boxes)
        taken.append(time.process_time() - began)
    print(f"seen, 6 cameras of 1600 x 900, {spec}: {min(taken):.3f} s of a core")
    matrix, pose = views[0][0].matrix, np.eye(4)
    pixels = rng.uniform(0, [1600, 900], (10000, 2))
    for model, lens in LENSES.items():
        camera = CameraModel(
            name="a",
            width=1600,
            height=900,
            matrix=matrix,
            sensor_T_camera=pose,
            model=model,
            distortion=lens,
        )
        off = np.abs(camera.project(camera.unproject(pixels)) - pixels).max()
        print(f"there and back, {model}: {off:.1e} pixels at most")


def tracked_boxes(real: Path) -> None:
    """Print by how many pixels KITTI's fully visible boxes in space lie beside those in its images,
    for each track of the part of drive 0000.
    """
    (recording,) = KittiTracking(real).sequences()
    assert isinstance(recording, TrackingSequence)
    (camera,) = (one for one in recording.cameras() if one.name == "image_02")
    boxes, errors = recording.boxes(), dict[str, list[NDArray[np.float64]]]()
    assert boxes is not None
    corners = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    for line in (Path(recording.folder) / "label_02/0000.txt").read_text().splitlines():
        row = line.split()
        frame, track, own = int(row[0]), int(row[1]) + 1, np.array(row[6:10], float)
        touches = own.min() < 1 or own[2] > camera.width - 2 or own[3] > camera.height - 2
        if (
            frame in boxes
            and row[2] != "DontCare"
            and not (float(row[3]) or int(row[4]) or touches)
        ):
            (i,) = np.flatnonzero(boxes[frame].tracks == track)
            camera_T_box = invert(camera.sensor_T_camera) @ boxes[frame].sensor_T_box[i]
            pixels = camera.project(transform_points(camera_T_box, corners * boxes[frame].sizes[i]))
            off = np.abs(np.array([*pixels.min(axis=0), *pixels.max(axis=0)]) - own)
            errors.setdefault(f"{row[2]} {row[1]}", []).append(off)
    for name, found in errors.items():
        off = np.array(found).max(axis=1)
        print(f"| {name} | {len(off)} | {100 * (off < 2).mean():.0f}% | {off.max():.1f} |")


def agreement_of(folder: Path) -> None:
    """Print what is said of images as they are, of images shifted by 7 pixels, and of images of the
    next frame: right, undetermined, wrong.
    """
    given = folder / "drive/cartesian"
    for change, (shift, late) in {"none": (0.0, 0), "shift": (7.0, 0), "next": (0.0, 1)}.items():
        copy = folder / change / "cartesian"
        shutil.rmtree(copy.parent, ignore_errors=True)
        skipped = ("images", "image_*", "predictions", "first")
        shutil.copytree(given, copy, ignore=shutil.ignore_patterns(*skipped), copy_function=os.link)
        cameras = list(cameras_of(_only(folder / "drive")).values())
        for i, camera in enumerate(cameras):
            (copy / "images" / camera.name).mkdir(parents=True)
            for file in (given / "images" / camera.name).iterdir():
                if int(file.stem) >= late:
                    os.link(
                        file,
                        copy / "images" / camera.name / f"{int(file.stem) - late:06d}{file.suffix}",
                    )
            # as if the image were shifted to the right
            matrix = camera.matrix - np.outer([shift, 0, 0], [0, 0, 1])
            cameras[i] = camera.replaced(matrix=matrix)
        (copy / "cameras.json").unlink()
        (copy / "cameras.json").write_bytes(cameras_to_json(cameras))
        found = compare_images(_only(copy))
        off = (
            [one.late_s and one.late_s - 0.1 for one in found]
            if late
            else [one.shift_px for one in found]
        )
        if not late:
            off = [None if one is None else one - shift for one in off]
        near = TIME_S if late else SHIFT_PX
        right, said = (
            sum(one is not None and abs(one) <= most for one in off) for most in (near, np.inf)
        )
        print(
            f"| {folder.name} | {change} | {right} | {len(off) - said} | {said - right} |",
            flush=True,
        )


def _drive(folder: Path, seed: int, frames: int) -> Path:
    if not (folder / "drive/cartesian").exists():
        carlasc.simulate(
            folder / "drive",
            count=frames,
            sensors=12,
            seed=seed,
            bev=False,
            cameras=CAMERAS,
            run=ONE,
        )
        # writes the scans of the first LiDAR too
        carlasc.regrid(folder / "drive", COARSE, name="first", run=ONE)
    return folder


def labels_of(folder: Path, seed: int) -> tuple[float, float, float, float]:
    """Return the shares of the first table: of points from exact pixels, and of voxels from pixels
    of which a tenth is wrong.
    """
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
        # a tenth: points that no image shows have less
        certain = found.read("probabilities", frame)[:, 1] >= 6554
        right = found.read("labels", frame) == given.read("labels", frame)
        counts += [visible.sum(), (visible & certain).sum(), (visible & certain & right).sum()]
    _spoil(given, folder / "pixels", np.random.default_rng(seed))
    shutil.rmtree(folder / "wrong", ignore_errors=True)
    carlasc.label_images(folder / "drive", folder / "wrong", pixels=folder / "pixels", run=ONE)
    grids = list[NDArray[np.integer]]()
    for source in (_only(folder / "drive"), _only(folder / "wrong")):
        out = folder / f"grids{len(grids)}"
        shutil.rmtree(out, ignore_errors=True)
        carlasc.regrid(
            source.location, COARSE, out, observe=FromScans(), name="evaluation", run=ONE
        )
        made = _only(out)
        grids.append(
            np.stack(
                [made.grid("evaluation", frame).labels for frame in made.frames("points").tolist()]
            )
        )
    truth, labelled = grids
    occupied = (truth > 0) & (labelled > 0)
    seen, sure, right = counts.tolist()
    return sure / seen, right / sure, right / seen, float((truth == labelled)[occupied].mean())


def seen_of(folder: Path, name: str, frames: int) -> NDArray[np.float64]:
    """Return the shares of the second table, of voxels and cameras in whose images they are, by the
    images of depth.
    """
    (spec, observe), out = GRIDS[name], folder / name.replace(", ", "_").replace(" ", "_")
    source = folder / "drive" if observe is None else _only(folder / "drive").location
    carlasc.regrid(
        source,
        spec,
        out,
        observe=observe,
        voting=Voting(keep_seen=True),
        name="evaluation",
        run=ONE,
    )
    made, given, answers = _only(out), _only(folder / "drive"), list[NDArray[np.bool_]]()
    for frame in np.linspace(0, len(given.frames("points")) - 1, frames).astype(int).tolist():
        grid = made.grid("evaluation", frame)
        cameras = cameras_of(given).values()
        views = [(camera, scan_T_camera(given, camera, frame)) for camera in cameras]
        known = np.flatnonzero(grid.known.reshape(-1))[::SAMPLED]
        ours, plain = made.read("evaluation/seen", frame), see_voxels(grid.labels > 0, spec, views)
        said = [seen.reshape(-1)[known] for seen in (ours, plain)]
        for bit, camera in enumerate(cameras_of(given).values()):
            by_bit = np.stack([(seen >> bit) & 1 > 0 for seen in said], 1)
            found = _compare(given, camera, frame, spec, known, by_bit)
            answers.append(
                np.column_stack([found, grid.labels.reshape(-1)[known[found[:, 0]]] > 0])
            )
    _, whole, hidden, shown, seen, plain, occupied = np.concatenate(answers).astype(bool).T
    wrong = whole & (seen == hidden)
    of_whole = 100 / whole.sum()
    right, by_rule = 100 - of_whole * wrong.sum(), of_whole * (whole & (plain != hidden)).sum()
    filled = 100 * (seen != hidden)[whole & occupied].mean()
    late, early = of_whole * (wrong & ~hidden).sum(), of_whole * (wrong & hidden).sum()
    return np.array(
        [right, late, early, filled, by_rule, 100 * whole.mean(), 100 * (seen == shown).mean()]
    )


def _compare(
    given: Sequence,
    camera: CameraModel,
    frame: int,
    spec: GridSpec,
    voxels: NDArray[np.int64],
    seen: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Return (N, 4 + K) for each voxel whose centre is in the image: its row, whether nothing cuts
    it, whether it is hidden, whether its centre is shown, and `seen`.

    Each pixel whose ray goes through a voxel shows something before it, or not. Nothing cuts a
    voxel that is whole in the image if all of its pixels agree. A pixel without depth shows the
    sky, which hides nothing.
    """
    edge = np.asarray(spec.voxel_size)
    place = scan_T_camera(given, camera, frame)
    assert place is not None
    lower = np.asarray(spec.lower) + np.stack(np.unravel_index(voxels, spec.size), 1) * edge
    corners = lower[:, None] + np.stack(list(np.ndindex(2, 2, 2))) * edge
    local = transform_points(invert(place), corners.reshape(-1, 3)).reshape(-1, 8, 3)
    pixels, middle = camera.project(local.reshape(-1, 3)).reshape(-1, 8, 2), local.mean(axis=1)
    at = camera.project(middle)
    depths = read_image(given, camera, frame, "image_depths") / 256.0
    depths[depths == 0] = np.inf
    looks = camera.unproject(np.mgrid[: camera.width, : camera.height].reshape(2, -1).T)
    looks = (
        ((looks / looks[:, 2:]) @ place[:3, :3].T)
        .reshape(camera.width, camera.height, 3)
        .swapaxes(0, 1)
    )
    rows = list[list[int]]()
    for i in np.flatnonzero(camera.contains(np.nan_to_num(at, nan=-9.0))).tolist():
        shown = (
            depths[int(np.rint(at[i, 1])), int(np.rint(at[i, 0]))] >= middle[i, 2] - edge.max() / 2
        )
        whole, hidden = bool(local[i, :, 2].min() > 0.1 and camera.contains(pixels[i]).all()), False
        if whole:
            (left, top), (right, bottom) = (
                np.ceil(pixels[i].min(0)).astype(int),
                np.floor(pixels[i].max(0)).astype(int),
            )
            part = slice(top, bottom + 1), slice(left, right + 1)
            low, high = ((lower[i] + side * edge - place[:3, 3]) / looks[part] for side in (0, 1))
            enter, leave = np.minimum(low, high).max(axis=2), np.maximum(low, high).min(axis=2)
            before = (depths[part] < enter - DEPTH_STEP_M)[enter < leave]
            hidden = bool(before.all())
            whole = len(before) > 0 and (hidden or not before.any())
        rows.append([i, whole, hidden, shown, *seen[i]])
    return np.array(rows, np.int64).reshape(-1, 4 + seen.shape[1])


def _pixels(
    given: Sequence, camera: CameraModel, frame: int, points: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the depth that the image shows at each point in it, which points these are, and their
    own depths, metres.
    """
    place = scan_T_camera(given, camera, frame)
    assert place is not None
    local = transform_points(invert(place), points)
    at = camera.project(local)
    inside = np.flatnonzero(camera.contains(np.nan_to_num(at, nan=-9.0)))
    column, row = np.rint(at[inside]).astype(int).T
    return (
        read_image(given, camera, frame, "image_depths")[row, column] / 256.0,
        inside,
        local[inside, 2],
    )


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
            (folder / f"{frame:06d}.png").write_bytes(
                encode_image(labels.astype(np.uint8), "PNG").tobytes()
            )


def _only(folder: Path) -> Sequence:
    (sequence,) = carlasc.open(folder).values()
    return sequence


if __name__ == "__main__":
    main()
