"""Data with a class table of their own, as a converter of a third party writes them, in every
command.
"""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import carlasc
from carlasc.cli import app
from carlasc.core.geometry import invert, transform_points, translation

CODE = Path(__file__).parents[1] / "helpers/converters/lab_converter.py"
PATH = "Train/LAB_monday/cartesian"
NAMES = {0: "unlabelled", 1: "road", 2: "car", 3: "building"}


def run(*arguments):
    result = CliRunner().invoke(app, [*map(str, arguments)])
    assert result.exit_code == 0, (arguments, result.output, result.stderr)
    return result.stdout


def write_drive(folder, frames=6):
    """Write a straight drive between walls, on a road, behind a car that drives as fast."""
    rng = np.random.default_rng(0)
    road = np.column_stack(
        [rng.uniform(-12, 16, 3000), rng.uniform(-5, 5, 3000), np.full(3000, -1.8)]
    )
    walls = rng.uniform((-12, 0, -1.8), (16, 0.2, 1.0), (3000, 3))
    walls[:, 1] += np.where(rng.random(3000) < 0.5, 6, -6)
    blocks = rng.uniform((-1, -1, -1.8), (1, 1, 1), (1200, 3)) + rng.choice(
        [(-8, 4, 0), (3, -4, 0), (11, 4, 0)], 1200
    )
    static = np.concatenate([road, walls, blocks])
    labels = np.repeat([1, 3, 3], [len(road), len(walls), len(blocks)]).astype(np.uint8)
    car = rng.uniform((5, -1, -1.7), (9, 1, -0.3), (500, 3))
    folder.mkdir(parents=True)
    poses = np.stack([translation((0.5 * frame, 0, 0)) for frame in range(frames)])
    for frame, pose in enumerate(poses):
        xyz = np.concatenate([transform_points(invert(pose), static), car]).astype(np.float32)
        np.savez(
            folder / f"{frame}.npz",
            points=np.column_stack([xyz, np.zeros(len(xyz), np.float32)]),
            labels=np.concatenate([labels, np.full(len(car), 2, np.uint8)]),
            actors=np.repeat([0, 7], [len(static), len(car)]).astype(np.uint32),
        )
    np.save(folder / "poses.npy", poses)


@pytest.fixture(scope="module")
def converted(tmp_path_factory):
    """Install the converter as pip would, and convert with the data set's own labels and with
    CarlaSC's.
    """
    site, root = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("lab")
    code = CODE.read_text()
    (site / "lab_converter.py").write_text(code)
    info = site / "lab-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lab\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[carlasc.converters]\nlab = lab_converter:Lab\n")
    write_drive(root / "in/monday")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(site))
        for name, labels in (("own", "lab"), ("carla", "carla")):
            options = ("--classes", labels, "--workers", 1, "--res", "0.8")
            run("convert", "lab", root / "in", root / name, *options)
    sys.modules.pop("lab_converter", None)
    return root


def test_the_table_stands_whole_in_the_data(converted):
    (sequence,) = carlasc.open(converted / "own").sequences().values()
    values = json.loads((converted / "own" / PATH / "carlasc.json").read_text())
    assert (values["format"], values["axes"]) == (2, "left")
    assert values["classes"]["names"] == {str(index): name for index, name in NAMES.items()}
    classes = sequence.metadata.classes
    assert (classes.names, classes.movable, classes.ground) == (NAMES, {2}, {1})
    assert set(np.unique(sequence.read("labels", 0))) == {1, 2, 3}
    (grid,) = sequence.grids
    assert set(np.unique(sequence.grid(grid, 0).labels)) == {0, 1, 2, 3}


def test_info_stats_and_validate_know_the_classes(converted):
    overview = json.loads(run("info", converted / "own", "--json"))
    assert overview["sequences"][0]["classes"] == "lab"
    counted = json.loads(run("stats", converted / "own", "--json"))["total"]
    assert counted["points"]["road"] == 6 * 3000 and counted["points"]["car"] == 6 * 500
    report = json.loads(run("validate", converted / "own", "--json"))
    assert not [finding for finding in report["findings"] if finding["severity"] == "error"]


def test_validate_finds_ids_that_the_table_lacks(converted, tmp_path):
    target = tmp_path / PATH
    (target / "labels").mkdir(parents=True)
    (target / "velodyne").mkdir()
    source = converted / "own" / PATH
    (target / "carlasc.json").write_bytes((source / "carlasc.json").read_bytes())
    (target / "velodyne/000000.bin").write_bytes((source / "velodyne/000000.bin").read_bytes())
    labels = np.fromfile(source / "labels/000000.label", "<u4")
    labels[0] = 9
    labels.tofile(target / "labels/000000.label")
    found = {finding.check: finding for finding in carlasc.validate(tmp_path).findings}
    assert "lab" in found["class-ids"].expected and "9 (1 times)" in found["class-ids"].found


@pytest.mark.needs("embreex", "PIL")
def test_it_is_drawn_in_its_own_colours(converted, tmp_path):
    pytest.importorskip("embreex")
    pytest.importorskip("PIL")
    run("render", converted / "own", "-o", tmp_path / "a.png", "--size", "320x180", "--frames", 2)
    assert (tmp_path / "a.png").stat().st_size > 5000
    run("view", converted / "own", "-o", tmp_path / "a.html", "--frames", "0:2")
    assert '"building"' in (tmp_path / "a.html").read_text()


@pytest.mark.parametrize("ending", ["zarr", "h5", "parquet"])
def test_it_is_packed_and_unpacked(converted, tmp_path, ending):
    pytest.importorskip({"zarr": "zarr", "h5": "h5py", "parquet": "pyarrow"}[ending])
    run("pack", converted / "own", tmp_path / f"a.{ending}")
    (sequence,) = carlasc.open(tmp_path / f"a.{ending}").sequences().values()
    (own,) = carlasc.open(converted / "own").sequences().values()
    assert sequence.metadata == own.metadata and sequence.metadata.classes.name == "lab"
    run("unpack", tmp_path / f"a.{ending}", tmp_path / "back")
    document = f"{PATH}/carlasc.json"
    assert (tmp_path / "back" / document).read_bytes() == (
        converted / "own" / document
    ).read_bytes()


def test_it_is_scored_by_its_own_classes(converted):
    (name,) = next(iter(carlasc.open(converted / "own").sequences().values())).grids
    options = ("--grid", name, "--json")
    scores = json.loads(run("evaluate", converted / "own", converted / "own", *options))
    assert set(NAMES.values()) - {"unlabelled"} <= set(re.findall(r'"(\w+)":', json.dumps(scores)))
    assert "Pedestrian" not in json.dumps(scores)


def test_it_is_regridded_from_its_scans(converted, tmp_path):
    run(
        "regrid",
        converted / "own",
        "-o",
        tmp_path,
        "--observe",
        "scans",
        "--res",
        "1.6",
        "--workers",
        1,
    )
    (sequence,) = carlasc.open(tmp_path).sequences().values()
    assert sequence.metadata.classes.names == NAMES
    (grid,) = sequence.grids
    assert sequence.classes_of(grid).names == NAMES
    assert set(np.unique(sequence.grid(grid, 3).labels)) <= set(NAMES)


def test_a_dataset_gives_its_ids(converted):
    (name,) = next(iter(carlasc.open(converted / "own").sequences().values())).grids
    data = carlasc.Dataset(converted / "own", "train", history=2, grid=name, remap=None)
    assert data.classes.names == NAMES
    assert set(np.unique(data[3]["labels"])) <= set(NAMES) and (data[3]["labels"] == 3).any()


def test_the_remap_of_the_converter_gives_the_same_grids_in_carlas_classes(converted):
    own, carla = (
        next(iter(carlasc.open(converted / name).sequences().values())) for name in ("own", "carla")
    )
    mapping = np.array([0, 7, 10, 1])
    assert np.array_equal(mapping[own.read("labels", 2)], carla.read("labels", 2))
    (name,) = own.grids
    assert carla.metadata.classes.name == "carla"
    assert np.array_equal(own.grid(name, 2).counts > 0, carla.grid(name, 2).counts > 0)
