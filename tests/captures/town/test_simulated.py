"""The simulated town as a capture that is never written."""

import io
import pickle

import numpy as np
import pytest
from helpers.datasets.captures import read_tree
from typer.testing import CliRunner

import carlasc
from carlasc import Run
from carlasc.captures import Capture, Lidar, SimulatedCapture, simulate
from carlasc.captures.town.actors import EGO_ID
from carlasc.captures.town.drive import Snapshot
from carlasc.captures.town.meshes import MeshBuilder, RayScene
from carlasc.captures.town.simulation import render_birdseye
from carlasc.cli import app
from carlasc.core.geometry import rotation_z, translation
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.groundtruth import FromScans, regrid
from carlasc.running import Part

for package in ("embreex", "trimesh", "PIL"):
    pytest.importorskip(package, reason="the simulator needs carlasc[simulate]")

SPEC = GridSpec.published().with_size((16, 16, 4))
HOW = {"count": 5, "first_frame": 3, "sensors": 3, "seed": 4, "traffic": "light", "lidar": Lidar(8, 800, 50.0)}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A capture on disk, and the grids that are made from it."""
    root = tmp_path_factory.mktemp("written")
    simulate(root / "town", **HOW, run=Run(workers=1))
    regrid(root / "town", SPEC, root / "grids", run=Run(workers=1))
    return root


def test_it_returns_what_the_capture_on_disk_holds(written):
    on_disk, simulated = Capture(written / "town"), pickle.loads(pickle.dumps(SimulatedCapture(**HOW)))
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
    with pytest.raises(MissingDataError, match="expected frame 8, found frames 3 to 7"):
        simulated.read(0, 8)


@pytest.mark.parametrize("kind", ["folder", "zarr"])
def test_grids_are_made_without_files_in_between(written, tmp_path, kind):
    out = tmp_path / ("grids" if kind == "folder" else "grids.zarr")
    for part in (2, 1):
        regrid(SimulatedCapture(**HOW), SPEC, out, run=Run(part=Part(part, 2), workers=1))
    if kind == "zarr":
        carlasc.unpack(out, tmp_path / "grids", run=Run(workers=1))
    assert read_tree(tmp_path / "grids") == read_tree(written / "grids")


def test_it_has_no_scans_to_merge_and_no_place_to_write_to(tmp_path):
    with pytest.raises(ArgumentError, match=r"observe: expected FromCapture\(\)"):
        regrid(SimulatedCapture(**HOW), SPEC, tmp_path, observe=FromScans())
    with pytest.raises(ArgumentError, match="out: expected where to write"):
        regrid(SimulatedCapture(**HOW), SPEC)


def test_the_command_writes_a_store_or_grids_if_it_is_asked_to(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = ["--count", "2", "--sensors", "2", "--points", "500", "--channels", "4", "--no-bev", "--workers", "1"]
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
    """Return which pixels of a bird's-eye picture, (1080, 1920), show a box of 4 m in the ego vehicle's frame."""
    from PIL import Image

    world_T_ego = translation((30.0, -12.0, 0.0)) @ rotation_z(1.1)
    builder = MeshBuilder()
    builder.boxes(CARLA.id_of("Vehicle"), centre, (4.0, 4.0, 0.1))
    mesh = builder.build().transformed(world_T_ego)
    scene = RayScene(mesh, world_T_ego[:3, 3])
    snapshot = Snapshot(0, world_T_ego, {}, mesh, np.full(len(mesh.faces), EGO_ID, np.uint32), scene)
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
