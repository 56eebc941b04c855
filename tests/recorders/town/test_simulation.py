from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from carlasc_recorders import SimulatedCapture, TownDrive
from carlasc_recorders.town.actors import EGO_ID
from carlasc_recorders.town.drive import Snapshot
from carlasc_recorders.town.meshes import MeshBuilder, RayScene
from carlasc_recorders.town.simulation import render_birdseye
from helpers.datasets.captures import read_tree
from helpers.errors import raises
from typer.testing import CliRunner

import carlasc
from carlasc import Run
from carlasc.captures import Capture, Lidar, simulate
from carlasc.cli import app
from carlasc.core.geometry import rotation_z, translation
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA
from carlasc.demo import demonstrate
from carlasc.errors import ArgumentError, ConflictError, DependencyError, MissingDataError
from carlasc.groundtruth import FromScans, regrid
from carlasc.running import Part

for package in ("embreex", "trimesh", "PIL"):
    pytest.importorskip(package, reason="the simulator needs carlasc[simulate]")

LIDAR = Lidar(channels=8, points=800)
SMALL: dict[str, Any] = {"count": 3, "sensors": 2, "seed": 4, "traffic": "light", "lidar": LIDAR}


def digests(root: Path) -> dict[str, str]:
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files
    }


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recorded")
    simulate(out, **SMALL, run=Run(workers=1))
    return out


def test_the_capture_holds_what_the_drive_records(recorded: Path) -> None:
    capture = Capture(recorded)
    drive = TownDrive(SMALL["seed"], SMALL["traffic"], LIDAR)
    assert capture.sensors == (0, 1)
    assert capture.frames.tolist() == [0, 1, 2]
    for sensor in capture.sensors:
        read, seen = capture.read(sensor, 2), drive.record(2, sensor)
        np.testing.assert_array_equal(read.scan.points, seen.scan.points)
        assert read.scan.labels is not None and seen.scan.labels is not None
        np.testing.assert_array_equal(read.scan.labels, seen.scan.labels)
        np.testing.assert_array_equal(read.velocities, seen.velocities)
        np.testing.assert_array_equal(read.world_T_sensor, seen.world_T_sensor)
        assert capture.read_time(2, sensor) == pytest.approx(0.2)


def test_the_birds_eye_picture_has_the_published_size_and_shows_the_road_in_the_middle(
    recorded: Path,
) -> None:
    data = Capture(recorded).read_bev(0)
    assert data is not None
    from PIL import Image

    picture = Image.open(io.BytesIO(data))
    assert picture.size == (1920, 1080)
    pixels = np.asarray(picture, np.int64)
    assert pixels.std() > 10
    assert np.abs(pixels[540, 960] - (0, 0, 142)).max() < 70  # the ego vehicle, from above


@pytest.mark.slow
def test_another_process_with_two_workers_and_another_hash_seed_writes_the_same_bytes(
    recorded: Path, tmp_path: Path
) -> None:
    script = (
        "from carlasc import Run\nfrom carlasc.captures import Lidar, simulate\n"
        f"if __name__ == '__main__':\n    simulate({str(tmp_path / 'two')!r}, **{SMALL!r}, "
        f"run=Run(workers=2))\n"
    )
    (tmp_path / "run.py").write_text(script)
    subprocess.run(
        [sys.executable, str(tmp_path / "run.py")],
        check=True,
        env={**os.environ, "PYTHONHASHSEED": "77"},
    )
    assert digests(tmp_path / "two") == digests(recorded)


def test_frames_do_not_depend_on_those_recorded_before(recorded: Path, tmp_path: Path) -> None:
    simulate(tmp_path, **{**SMALL, "count": 1}, first_frame=2, run=Run(workers=1))
    alone, whole = digests(tmp_path / "raw"), digests(recorded / "raw")
    frames = {name for name in alone if name.endswith(("/2.npy", "/2.jpg"))}
    assert len(frames) == 11
    assert all(alone[name] == whole[name] for name in frames)


@pytest.mark.slow
def test_a_second_run_goes_on_and_ends_with_the_same_bytes(recorded: Path, tmp_path: Path) -> None:
    first = simulate(tmp_path, **{**SMALL, "count": 2}, run=Run(workers=1))
    (tmp_path / "raw" / "labels1" / "1.npy").unlink()
    second = simulate(tmp_path, **SMALL, run=Run(executor=ThreadPoolExecutor(1)))
    assert (first.written, second.written, second.count) == (2, 2, 3)
    assert simulate(tmp_path, **SMALL, run=Run(workers=1)).written == 0
    ours, theirs = digests(tmp_path), digests(recorded)
    assert {k: v for k, v in ours.items() if "times" not in k} == {
        k: v for k, v in theirs.items() if "times" not in k
    }
    assert Capture(tmp_path).read_time(1, 1) == pytest.approx(0.1)


@pytest.mark.slow
def test_an_interrupted_run_leaves_whole_files_and_is_finished_by_the_next(
    recorded: Path, tmp_path: Path
) -> None:
    def interrupt(done: int, total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(tmp_path, **SMALL, run=Run(workers=1, progress=interrupt))
    simulate(tmp_path, **SMALL, run=Run(workers=1))
    assert digests(tmp_path) == digests(recorded)


def test_a_capture_of_other_settings_is_refused_and_left_alone(recorded: Path) -> None:
    before = digests(recorded)
    for change in (
        {"seed": 5},
        {"traffic": "heavy"},
        {"sensors": 3},
        {"lidar": Lidar(4, 800)},
        {"bev": False},
    ):
        with raises(ConflictError, expected=str(next(iter(change)))):
            simulate(recorded, **{**SMALL, **change}, run=Run(workers=1))
    assert digests(recorded) == before


def test_a_capture_without_settings_is_refused(tmp_path: Path) -> None:
    (tmp_path / "raw" / "velodyne0").mkdir(parents=True)
    with raises(ConflictError, found=r"simulation\.json"):
        simulate(tmp_path, **SMALL)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"count": 0}, "at least 1"),
        ({"sensors": 0}, "at least 1"),
        ({"traffic": "none"}, "light, medium, heavy"),
        ({"seed": -1}, "at least 0"),
        ({"first_frame": -1}, "at least 0"),
    ],
)
def test_arguments_out_of_range_are_refused_before_anything_is_written(
    tmp_path: Path, change: dict[str, Any], expected: str
) -> None:
    with raises(ArgumentError, where=f"^{next(iter(change))}$", expected=expected):
        simulate(tmp_path / "out", **{**SMALL, **change})
    assert not (tmp_path / "out").exists()


def test_the_command_records_and_prints_its_figures_as_json(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from carlasc.cli import app

    arguments = [
        "--count",
        "1",
        "--sensors",
        "1",
        "--seed",
        "4",
        "--traffic",
        "light",
        "--channels",
        "8",
    ]
    arguments += ["--points", "800", "--workers", "1"]
    result = CliRunner().invoke(
        app, ["simulate", str(tmp_path / "out"), *arguments, "--no-bev", "--json"]
    )
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["written"] == 1
    assert figures["points"] == sum(figures["classes"].values()) > 50
    assert not Capture(tmp_path / "out").has_bev(0)
    assert CliRunner().invoke(app, ["simulate", str(tmp_path / "b"), "--count", "0"]).exit_code == 2
    assert (
        CliRunner().invoke(app, ["simulate", str(tmp_path / "b"), "--traffic", "jam"]).exit_code
        == 2
    )
    assert CliRunner().invoke(app, ["simulate", str(tmp_path / "out"), *arguments]).exit_code == 1


@pytest.mark.parametrize("package", ["embreex", "trimesh", "PIL"])
@pytest.mark.parametrize(("run", "extra"), [(simulate, "simulate"), (demonstrate, "demo")])
def test_without_a_package_of_the_extra_nothing_is_written(
    run: Callable[..., object],
    extra: str,
    package: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in [name for name in sys.modules if name.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with raises(DependencyError, where=package, advice=rf"pip install .*\[{extra}\]'"):
        run(tmp_path / "out", count=1, sensors=1)
    assert not (tmp_path / "out").exists()


def test_pictures_need_pillow_and_captures_without_pictures_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith("PIL.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "PIL", None)
    assert (
        simulate(
            tmp_path, **{**SMALL, "count": 1, "sensors": 1}, bev=False, run=Run(workers=1)
        ).written
        == 1
    )


def test_a_frame_without_its_picture_or_its_times_is_completed(
    recorded: Path, tmp_path: Path
) -> None:
    shutil.copytree(recorded, tmp_path / "copy")
    raw = tmp_path / "copy" / "raw"
    (raw / "bev" / "1.jpg").unlink()
    (raw / "times1.txt").write_text(
        "".join((raw / "times1.txt").read_text().splitlines(keepends=True)[:2])
    )
    assert simulate(tmp_path / "copy", **SMALL, run=Run(workers=1)).written == 1
    assert (raw / "bev" / "1.jpg").read_bytes() == (recorded / "raw" / "bev" / "1.jpg").read_bytes()
    assert Capture(tmp_path / "copy").read_time(2, 1) == pytest.approx(0.2)


def test_a_capture_of_another_version_of_the_town_is_refused(
    recorded: Path, tmp_path: Path
) -> None:
    (tmp_path / "raw").mkdir()
    settings = json.loads((recorded / "raw" / "simulation.json").read_text())
    assert settings["recipe"] == 1  # the name of the town's version in the file
    (tmp_path / "raw" / "simulation.json").write_text(json.dumps(settings | {"recipe": 0}))
    with raises(ConflictError, expected="recipe"):
        simulate(tmp_path, **SMALL)


def test_the_result_counts_the_points_that_were_written_by_class(tmp_path: Path) -> None:
    result = simulate(tmp_path, **{**SMALL, "count": 1}, bev=False, run=Run(workers=1))
    scans = [Capture(tmp_path).read(sensor, 0).scan for sensor in (0, 1)]
    assert result.points == sum(map(len, scans)) == sum(result.classes.values())
    labels = np.concatenate([np.asarray(scan.labels) for scan in scans])
    assert result.classes["Road"] == np.count_nonzero(labels == CARLA.id_of("Road"))


def test_the_command_names_options_in_its_errors(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from carlasc.cli import app

    for options, message in (
        (["--range", "0"], "carlasc: --range: expected more than 0"),
        (
            ["--channels", "9", "--points", "8"],
            "carlasc: --points: expected at least one per channel",
        ),
    ):
        result = CliRunner().invoke(app, ["simulate", str(tmp_path / "out"), *options])
        assert result.exit_code == 2
        assert message in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_run_that_was_killed_before_it_wrote_times_ends_with_the_same_bytes(
    recorded: Path, tmp_path: Path
) -> None:
    """What `kill -9` leaves: frames without times, here the first and the last."""
    shutil.copytree(recorded, tmp_path, dirs_exist_ok=True)
    for sensor in range(SMALL["sensors"]):
        file = tmp_path / f"raw/times{sensor}.txt"
        file.write_text(file.read_text().splitlines(keepends=True)[1])
    (tmp_path / "raw/pose0/2.npy").unlink()
    simulate(tmp_path, **SMALL, run=Run(workers=1))
    assert digests(tmp_path) == digests(recorded)


for package in ("embreex", "trimesh", "PIL"):
    pytest.importorskip(package, reason="the simulator needs carlasc[simulate]")

SPEC = GridSpec.published().with_size((16, 16, 4))
HOW = {
    "count": 5,
    "first_frame": 3,
    "sensors": 3,
    "seed": 4,
    "traffic": "light",
    "lidar": Lidar(8, 800, 50.0),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A capture on disk, and the grids that are made from it."""
    root = tmp_path_factory.mktemp("written")
    simulate(root / "town", **HOW, run=Run(workers=1))
    regrid(root / "town", SPEC, root / "grids", run=Run(workers=1))
    return root


def test_it_returns_what_the_capture_on_disk_holds(written):
    on_disk, simulated = (
        Capture(written / "town"),
        pickle.loads(pickle.dumps(SimulatedCapture(**HOW))),
    )
    assert simulated.sensors == on_disk.sensors
    assert np.array_equal(simulated.frames, on_disk.frames)
    for sensor in simulated.sensors:
        one, other = simulated.read(sensor, 5), on_disk.read(sensor, 5)
        assert np.array_equal(one.scan.points, other.scan.points)
        assert np.array_equal(one.flow(), other.flow())
        assert np.array_equal(one.world_T_sensor, other.world_T_sensor)
    assert np.array_equal(simulated.read_poses(1, [3, 4]), on_disk.read_poses(1, [3, 4]))
    assert simulated.read_times() == on_disk.read_times()
    assert simulated.read_bev(4) == on_disk.read_bev(4)
    with raises(MissingDataError, expected="frame 8", found="frames 3 to 7"):
        simulated.read(0, 8)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["folder", "zarr"])
def test_grids_are_made_without_files_in_between(written, tmp_path, kind):
    out = tmp_path / ("grids" if kind == "folder" else "grids.zarr")
    for part in (2, 1):
        regrid(SimulatedCapture(**HOW), SPEC, out, run=Run(part=Part(part, 2), workers=1))
    if kind == "zarr":
        carlasc.unpack(out, tmp_path / "grids", run=Run(workers=1))
    assert read_tree(tmp_path / "grids") == read_tree(written / "grids")


def test_it_has_no_scans_to_merge_and_no_place_to_write_to(tmp_path):
    with raises(ArgumentError, where="observe", expected=r"FromCapture\(\)"):
        regrid(SimulatedCapture(**HOW), SPEC, tmp_path, observe=FromScans())
    with raises(ArgumentError, where="out", expected="where to write"):
        regrid(SimulatedCapture(**HOW), SPEC)


@pytest.mark.slow
def test_the_command_writes_a_store_or_grids_if_it_is_asked_to(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = [
        "--count",
        "2",
        "--sensors",
        "2",
        "--points",
        "500",
        "--channels",
        "4",
        "--no-bev",
        "--workers",
        "1",
    ]
    run = CliRunner().invoke(app, ["simulate", "town.zarr", *options, "--size", "16,16,4"])
    assert run.exit_code == 0, run.output
    (sequence,) = carlasc.open("town.zarr").sequences().values()
    assert {"points", "flow", "instances", "labels"} <= sequence.fields()
    assert sequence.grids["evaluation_16x16x4"].size == (16, 16, 4)
    assert CliRunner().invoke(app, ["simulate", "town", *options, "--res", "1.6"]).exit_code == 0
    assert not (tmp_path / "town" / "raw").exists()
    again = CliRunner().invoke(app, ["simulate", "town", *options, "--res", "1.6"])
    assert "0 frames made (2 existed)" in again.output


@pytest.mark.parametrize("order", [pytest.param((1, 2, 3), marks=pytest.mark.slow), (3, 1, 2)])
def test_parts_of_a_simulation_write_the_bytes_of_one(written, tmp_path, order):
    for number in order:
        assert not (tmp_path / "raw" / "times0.txt").exists()
        result = simulate(tmp_path, **HOW, run=Run(part=Part(number, 3), workers=1))
        assert result.count == result.written
    assert read_tree(tmp_path / "raw") == read_tree(written / "town" / "raw")


def picture_of_box(centre: tuple[float, float, float]) -> np.ndarray:
    """Return which pixels of a bird's-eye picture, (1080, 1920), show a box of 4 m in the ego
    vehicle's frame.
    """
    from PIL import Image

    world_T_ego = translation((30.0, -12.0, 0.0)) @ rotation_z(1.1)
    builder = MeshBuilder()
    builder.boxes(CARLA.id_of("Vehicle"), centre, (4.0, 4.0, 0.1))
    mesh = builder.build().transformed(world_T_ego)
    scene = RayScene(mesh, world_T_ego[:3, 3])
    snapshot = Snapshot(
        0, world_T_ego, {}, mesh, np.full(len(mesh.faces), EGO_ID, np.uint32), scene
    )
    pixels = np.asarray(Image.open(io.BytesIO(render_birdseye(snapshot))), np.int64)
    shown: np.ndarray = pixels.sum(axis=2) < 500
    return shown


@pytest.mark.parametrize(
    ("centre", "row", "column"),
    [
        ((20.0, 0.0, 0.0), 540 - 384, 960),  # ahead: above the middle
        ((0.0, 20.0, 0.0), 540, 960 + 384),  # on the right
        ((-20.0, -30.0, 0.0), 540 + 384, 960 - 576),
    ],
)
def test_the_upper_edge_is_ahead_and_the_picture_is_90_degrees_wide(
    centre: tuple[float, float, float], row: int, column: int
) -> None:
    shown = picture_of_box(centre)  # at 50 m, 960 pixels are 50 m: 19.2 pixels per metre
    middle = np.argwhere(shown).mean(axis=0)
    assert np.abs(middle - (row, column)).max() < 3
    assert shown.sum() == pytest.approx((4 * 19.2) ** 2, rel=0.1)


EFFECTS = (
    "--turning --drop-outs 0.1 --range-noise 0.001 --second-returns --reflections 0.2 --rain 0.02"
)


def test_effects_change_the_scans_and_not_the_ground_truth(tmp_path: Path) -> None:
    options = (
        "--lidar vlp-16 --points 8000 --sensors 2 --count 1 --no-bev --traffic light --res 0.4"
    )
    for name, effects in (("ideal", ""), ("real", EFFECTS)):
        done = CliRunner().invoke(
            app, ["simulate", str(tmp_path / name), *options.split(), *effects.split()]
        )
        assert done.exit_code == 0, done.output
    ideal, real = (
        next(iter(carlasc.open(tmp_path / name).sequences().values())) for name in ("ideal", "real")
    )
    (name,) = ideal.grids
    grids = ideal.grid(name, 0), real.grid(name, 0)
    np.testing.assert_array_equal(grids[0].labels, grids[1].labels)
    np.testing.assert_array_equal(grids[0].counts, grids[1].counts)
    assert "seconds" not in ideal.fields()
    seconds, labels = real.read("seconds", 0), real.read("labels", 0)
    assert len(seconds) == len(labels) == len(real.read("origins", 0))
    assert seconds.min() < -0.04 < 0.04 < seconds.max()
    assert 0.02 < (labels == 0).mean() < 0.2
    assert (ideal.read("labels", 0) != 0).all()


def test_a_raw_capture_takes_no_effects(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["simulate", str(tmp_path / "raw"), "--rain", "0.1"])
    assert done.exit_code == 2
    assert "--rain" in done.output
    assert not list(tmp_path.iterdir())
