"""A run after a change of its inputs gives what a run into an empty folder gives."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.captures import write_capture
from helpers.scenes.passing_car import write_sequence

from carlasc import FromCapture, FromGrid, FromScans, GridSpec, Run, regrid
from carlasc.groundtruth import Voting
from carlasc.motion import PoseOptions
from carlasc.storage import FolderSource

SPEC = GridSpec("cartesian", (32, 32, 8), (-12.8, -12.8, -2.0), (12.8, 12.8, 1.2))
FRAMES = 9
ALONE = Run(workers=1)
OBSERVE = FromScans(window=(-2, 2), poses=PoseOptions("file"))
STILL = FromScans(window=(-2, 2), dynamic="tube", poses=PoseOptions("file", "never"))


def outputs(folder: Path) -> dict[str, bytes]:
    """Return all files below a folder, without records."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and ".carlasc" not in path.parts
    }


def scans(folder: Path) -> Path:
    return folder / "Val" / "Street" / "cartesian"


def change_points(folder: Path, rng: np.random.Generator) -> None:
    path = scans(folder) / f"velodyne/{rng.integers(FRAMES):06d}.bin"
    points = np.fromfile(path, np.float32).reshape(-1, 4)
    points[:, 2] += np.float32(0.3)
    points.tofile(path)


def change_labels(folder: Path, rng: np.random.Generator) -> None:
    path = scans(folder) / f"labels/{rng.integers(FRAMES):06d}.label"
    labels = np.fromfile(path, np.uint32)
    np.where(labels == 1, np.uint32(2), labels).tofile(path)


def shorten(folder: Path, rng: np.random.Generator) -> None:
    number = rng.integers(FRAMES)
    for field, size in (("velodyne", 16), ("labels", 4), ("predictions", 12)):
        (path,) = (scans(folder) / field).glob(f"{number:06d}.*")
        path.write_bytes(path.read_bytes()[: 500 * size])


def move_pose(folder: Path, rng: np.random.Generator) -> None:
    path = scans(folder) / "poses.txt"
    rows = np.loadtxt(path)
    rows[rng.integers(1, FRAMES), 3] += 0.2
    np.savetxt(path, rows)


def delay(folder: Path, rng: np.random.Generator) -> None:
    path = scans(folder) / "times.txt"
    times = np.loadtxt(path)
    times[rng.integers(1, FRAMES) :] += 0.02
    np.savetxt(path, times)


def remove(folder: Path, rng: np.random.Generator) -> None:
    number = rng.integers(1, FRAMES - 1)
    for field in ("velodyne", "labels", "predictions"):
        (path,) = (scans(folder) / field).glob(f"{number:06d}.*")
        path.unlink()


def grow(folder: Path, rng: np.random.Generator) -> None:
    longer = folder.with_name(f"{folder.name}-longer")
    write_sequence(longer, frames=FRAMES + 3)
    shutil.copytree(scans(longer), scans(folder), dirs_exist_ok=True)
    shutil.rmtree(longer)


CHANGES = [change_points, change_labels, shorten, move_pose, delay, remove, grow]


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("drive") / "data"
    write_sequence(folder, frames=FRAMES)
    return folder


def copy(source: Path, target: Path) -> Path:
    return Path(shutil.copytree(source, target))


def compare(source: Path, out: Path, fresh: Path, observe, **options) -> tuple:
    """Make grids again after a change, and compare them with those of a run into a new place."""
    again = regrid(source, SPEC, out, observe=observe, run=ALONE, **options)
    assert not again.failures
    unchanged = regrid(source, SPEC, out, observe=observe, run=ALONE, **options)
    assert unchanged.made == 0
    assert not any("again" in note for note in unchanged.notes)
    regrid(fresh, SPEC, fresh, observe=observe, run=ALONE, **options)
    ours = outputs(source if out is None else Path(out))
    assert ours == outputs(fresh)
    return again


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(i, marks=pytest.mark.slow) for i in range(1, 6))]
)
def test_a_changed_input_is_seen_and_what_depends_on_it_made_again(drive, tmp_path, change, seed):
    source = copy(drive, tmp_path / "data")
    regrid(source, SPEC, observe=STILL, run=ALONE)
    change(source, np.random.default_rng(seed))
    fresh = tmp_path / "fresh"
    shutil.copytree(source, fresh, ignore=shutil.ignore_patterns("evaluation*", ".carlasc"))
    again = compare(source, None, fresh, STILL)
    assert 0 < again.made < FRAMES + 3
    assert sum("made again" in note for note in again.notes) == 1


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
@pytest.mark.parametrize("seed", range(3))
def test_tracks_and_refined_poses_are_found_again(drive, tmp_path, change, seed):
    source = copy(drive, tmp_path / "data")
    observe = FromScans(window=(-2, 2), poses=PoseOptions("file", "always"))
    regrid(source, SPEC, observe=observe, run=ALONE)
    change(source, np.random.default_rng(seed))
    fresh = tmp_path / "fresh"
    shutil.copytree(source, fresh, ignore=shutil.ignore_patterns("evaluation*", ".carlasc"))
    compare(source, None, fresh, observe)
