"""A conversion after a change of its data set gives what a conversion into an empty folder gives."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.kitti import write_poses
from helpers.datasets.tiny_kitti import write_labels, write_tiny_kitti

from carlasc import FromScans, GridSpec, Run
from carlasc.converting import convert
from carlasc.core.geometry import translation
from carlasc.groundtruth import GridOptions
from carlasc.motion import PoseOptions

FRAMES = 6
SPEC = GridSpec("cartesian", (32, 32, 8), (-12.8, -12.8, -2.0), (12.8, 12.8, 1.2))
GRIDS = GridOptions(SPEC, FromScans(window=(-1, 1)), follow_ground=False)
POSES = PoseOptions(refine="never", force=True)


def write_scan(folder: Path, frame: int) -> None:
    """Write a car that drives ahead of a wall, on a road."""
    rng = np.random.default_rng(frame)
    car = rng.uniform(-0.5, 0.5, (200, 3)) * (4.0, 1.8, 1.5) + (6 + 0.7 * frame, 1.0, -0.9)
    road = np.column_stack([rng.uniform(-12, 12, (400, 2)), np.full(400, -1.8)])
    wall = np.column_stack([rng.uniform(-12, 12, 300), np.full(300, -6.0), rng.uniform(-2, 1, 300)])
    points = np.concatenate([car, road, wall]) - (0.5 * frame, 0, 0)
    path = folder / "velodyne" / f"{frame:06d}.bin"
    np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(path)
    write_labels(folder, frame, np.repeat([252 | 5 << 16, 40, 50], [200, 400, 300]))


def write_drive(root: Path, frames: int = FRAMES) -> Path:
    folder = write_tiny_kitti(root, frames=frames)
    for frame in range(frames):
        write_scan(folder, frame)
    write_poses(
        folder / "poses.txt", np.stack([translation((0.5 * i, 0, 0)) for i in range(frames)])
    )
    return folder


def files(out: Path) -> dict[str, bytes]:
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and ".carlasc" not in path.parts
    }


def run(root: Path, out: Path, name="kitti", **options):
    return convert(name, root, out, **{"grids": GRIDS, "poses": POSES, "run": Run(1)} | options)


def check(root: Path, out: Path, name="kitti", **options):
    """Run a conversion again after a change; compare it with one into an empty folder."""
    again = run(root, out, name, **options)
    fresh = run(root, out.with_name("fresh"), name, **options)
    assert not again.failures
    assert files(out) == files(out.with_name("fresh"))
    unchanged = run(root, out, name, **options)
    assert (unchanged.made, unchanged.skipped) == (0, fresh.made)
    assert not any("made again" in note for note in unchanged.notes)
    return again


def cut(path: Path) -> bytes:
    whole = path.read_bytes()
    path.write_bytes(whole[:-7])
    return whole


@pytest.mark.parametrize(
    "field", ["labels/000002.label", pytest.param("velodyne/000003.bin", marks=pytest.mark.slow)]
)
def test_a_damaged_file_that_is_repaired(tmp_path, field):
    folder = write_drive(tmp_path / "in")
    whole = cut(folder / field)
    first = run(tmp_path / "in", tmp_path / "out")
    assert first.failures
    (folder / field).write_bytes(whole)
    again = check(tmp_path / "in", tmp_path / "out")
    assert again.made > 1


def change_labels(folder: Path) -> None:
    labels = np.fromfile(folder / "labels" / "000001.label", "<u4")
    np.where(labels == 50, 51, labels).astype("<u4").tofile(folder / "labels" / "000001.label")


def change_points(folder: Path) -> None:
    points = np.fromfile(folder / "velodyne" / "000004.bin", "<f4").reshape(-1, 4)
    points[:200, 0] += 0.4
    points.tofile(folder / "velodyne" / "000004.bin")


def remove_labels(folder: Path) -> None:
    shutil.rmtree(folder / "labels")


def grow(folder: Path) -> None:
    longer = write_drive(folder.parents[1].with_name("longer"), FRAMES + 3)
    shutil.copytree(longer, folder, dirs_exist_ok=True)


@pytest.mark.parametrize(
    "change",
    [
        change_labels,
        remove_labels,
        *(pytest.param(change, marks=pytest.mark.slow) for change in (change_points, grow)),
    ],
)
def test_a_changed_data_set(tmp_path, change):
    folder = write_drive(tmp_path / "in")
    grids = None if change is remove_labels else GRIDS  # these would have another source of motion
    assert not run(tmp_path / "in", tmp_path / "out", grids=grids).failures
    change(folder)
    again = check(tmp_path / "in", tmp_path / "out", grids=grids)
    assert any("made again" in note for note in again.notes)


def test_a_copy_with_other_times_is_compared_and_kept(tmp_path):
    folder = write_drive(tmp_path / "in")
    run(tmp_path / "in", tmp_path / "out")
    for path in folder.rglob("*"):
        path.touch()
    again = check(tmp_path / "in", tmp_path / "out")
    assert (again.made, again.skipped) == (0, FRAMES)


@pytest.mark.slow
def test_frames_without_a_record_are_compared_once(tmp_path):
    folder = write_drive(tmp_path / "in")
    run(tmp_path / "in", tmp_path / "out")
    for record in (tmp_path / "out").rglob(".carlasc/conversion.json"):
        record.unlink()
    again = check(tmp_path / "in", tmp_path / "out")
    assert again.made == 0 and any("no record" in note for note in again.notes)
    for record in (tmp_path / "out").rglob(".carlasc/conversion.json"):
        record.unlink()
    shutil.rmtree(tmp_path / "fresh")
    change_labels(folder)
    assert check(tmp_path / "in", tmp_path / "out").made > 0
