"""From a simulated drive or capture through the layout to other data sets."""

import re
import shlex
import tarfile

import numpy as np
import pytest
from carlasc_converters.exporters.classes import KINDS, mapping_of
from carlasc_converters.exporters.kitti import TO_RAW
from carlasc_converters.exporters.opensceneflow import CATEGORIES
from helpers.converters.drive_converter import DriveConverter
from helpers.datasets.exported import occ3d_cell, read_occ3d
from typer.testing import CliRunner

import carlasc
from carlasc import Run
from carlasc.captures import Lidar, simulate
from carlasc.cli import app
from carlasc.converting import (
    LayoutOptions,
    convert,
    converter_names,
    export,
    load_converter,
    remaps_to_carla,
)
from carlasc.core.benchmarks import TO_OCC3D
from carlasc.core.geometry import invert, transform_points
from carlasc.testing.drives import MOVABLE, SimulatedDrive, world_T_sensor

runner = CliRunner()


class Boxed(DriveConverter):
    drive = SimulatedDrive(frames=6)
    gives = frozenset({"boxes", "poses", "times"})


@pytest.fixture
def installed(monkeypatch):
    """Install the converter of drives."""
    monkeypatch.setattr("carlasc.converting.registry.load_converter", lambda name: Boxed)


def test_boxes_become_flow_in_the_frame_of_the_next_scan(tmp_path):
    h5py = pytest.importorskip("h5py")
    (tmp_path / "in").mkdir()
    convert(Boxed, tmp_path / "in", tmp_path / "layout", grids=None, run=Run(workers=1))
    result = export("opensceneflow", tmp_path / "layout", tmp_path / "out", run=Run(workers=1))
    assert (result.made, result.failures) == (6, ())
    drive = Boxed.drive
    tracks = dict(enumerate((thing for thing in drive.things if thing.kind in MOVABLE), 1))
    with h5py.File(tmp_path / "out" / "train" / "DRIVE_0.h5") as log:
        assert len(log) == 6
        for frame, time in enumerate(sorted(log, key=int)[:-1]):
            group, scan = log[time], drive.scan(frame)
            points = group["lidar"][()]
            assert np.abs(points - scan.deskewed[:, :3]).max() < 1e-5
            world = transform_points(world_T_sensor(drive, frame), points)
            for track, thing in tracks.items():
                on_it = scan.instances == track
                now, later = (
                    thing.world_T_box(drive.times[number]) for number in (frame, frame + 1)
                )
                world[on_it] = transform_points(later @ invert(now), world[on_it])
            truth = transform_points(invert(world_T_sensor(drive, frame + 1)), world) - points
            wrong = np.linalg.norm(group["flow"][()] - truth, axis=1)
            assert wrong[group["flow_is_valid"][()]].mean() < 0.01
            assert np.quantile(wrong, 0.99) < 0.15
            assert group["flow_is_valid"][()].mean() > 0.95


@pytest.mark.slow
def test_classes_of_a_converter_go_by_way_of_those_of_carlasc(installed, tmp_path):
    (tmp_path / "in").mkdir()
    convert(
        Boxed,
        tmp_path / "in",
        tmp_path / "layout",
        layout=LayoutOptions(classes="drive"),
        grids=None,
        run=Run(workers=1),
    )
    (sequence,) = carlasc.open(tmp_path / "layout").sequences().values()
    assert sequence.metadata.classes.name == "drive"
    (remap,) = remaps_to_carla(sequence.metadata.classes)
    assert remap.name == "drive_to_carla"
    h5py = pytest.importorskip("h5py")
    export("opensceneflow", tmp_path / "layout", tmp_path / "out", run=Run(workers=1))
    with h5py.File(tmp_path / "out" / "train" / "DRIVE_0.h5") as log:
        found = set(np.unique(log[min(log)]["flow_category_indices"][()]))
    assert 19 in found and found <= {0, 17, 19}


@pytest.mark.slow
@pytest.mark.parametrize("name", converter_names())
def test_every_converter_of_ours_has_classes_that_can_be_exported(name):
    converter = load_converter(name)
    remaps = remaps_to_carla(converter.classes)
    assert remaps is not None
    labels = np.array(sorted(converter.classes.names))
    for remap in remaps:
        labels = remap(labels)
    assert set(labels.tolist()) <= set(TO_OCC3D["carla"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "classes"),
    [
        (
            "nuscenes",
            {
                "vehicle.bus.rigid": (3, 13, 7),
                "movable_object.trafficcone": (8, 99, 9),
                "flat.other": (12, 49, 0),
            },
        ),
        (
            "nuscenes",
            {
                "vehicle.car": (4, 10, 19),
                "flat.terrain": (14, 72, 0),
                "static.vegetation": (16, 70, 0),
            },
        ),
        (
            "carlaocc",
            {
                "Truck": (10, 18, 25),
                "Train": (9, 16, 18),
                "Rider": (7, 30, 17),
                "Rock": (14, 72, 0),
            },
        ),
        (
            "kitti360",
            {
                "caravan": (9, 20, 27),
                "bicycle": (2, 11, 3),
                "parking": (11, 44, 0),
                "wall": (15, 52, 0),
            },
        ),
        (
            "argoverse2",
            {"SCHOOL_BUS": (3, 13, 20), "REGULAR_VEHICLE": (4, 10, 19), "DOG": (0, 99, 10)},
        ),
        ("kitti-raw", {"Tram": (9, 16, 18), "Van": (4, 10, 19), "Cyclist": (7, 30, 17)}),
    ],
)
def test_classes_that_carlasc_does_not_have_keep_their_kind(name, classes):
    table = load_converter(name).classes
    for label, expected in classes.items():
        found = [
            mapping_of(maps, kind, table, "test")[table.id_of(label)]
            for maps, kind in ((TO_OCC3D, "occ3d"), (TO_RAW, "raw"), (CATEGORIES, "category"))
        ]
        assert tuple(found) == expected, label


def test_kinds_are_named_as_in_their_tables():
    tables = {
        load_converter(name).classes.name: load_converter(name).classes
        for name in converter_names()
    }
    for table, kinds in KINDS.items():
        assert set(kinds) <= set(tables[table].names.values())


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture") / "Val" / "Town07_Light"
    simulate(
        folder,
        count=2,
        sensors=3,
        lidar=Lidar(channels=16, points=8_000),
        bev=False,
        run=Run(workers=1),
    )
    return folder


def test_the_command_that_is_advised_makes_the_exact_grid(capture, tmp_path):
    root = capture.parents[1]
    assert (
        runner.invoke(app, ["regrid", str(root), "--preset", "coarse", "--workers", "1"]).exit_code
        == 0
    )
    first = export("occ3d", root, tmp_path / "first", run=Run(workers=1))
    (advice,) = (note for note in first.notes if "carlasc regrid" in note)
    command = shlex.split(re.search(r"`carlasc (.*?)`", advice)[1])
    command = [str(root) if word == "SOURCE" else word for word in command]
    command[command.index("scans")] = "capture"
    ran = runner.invoke(app, [*command, "--workers", "1"])
    assert ran.exit_code == 0, ran.output
    second = export("occ3d", root, tmp_path / "second", run=Run(workers=1))
    assert [note for note in second.notes if "mask_camera" not in note] == []
    (sequence,) = carlasc.open(root).sequences().values()
    _, arrays = read_occ3d(tmp_path / "second", "Town07_Light")
    for frame, array in zip((0, 1), arrays.values(), strict=True):
        grid = sequence.grid("occ3d", frame)
        expected = np.vectorize(TO_OCC3D["carla"].get)(grid.labels)[:, ::-1]
        assert np.array_equal(array["mask_lidar"], grid.known[:, ::-1])
        assert np.array_equal(array["semantics"], expected)
    coarse = next(iter(read_occ3d(tmp_path / "first", "Town07_Light")[1].values()))
    fine = next(iter(arrays.values()))
    both = (coarse["mask_lidar"] == 1) & (fine["mask_lidar"] == 1)
    assert both.sum() > 1000
    # other voxels, the same places
    assert (coarse["semantics"] == fine["semantics"])[both].mean() > 0.9
    assert fine["semantics"][occ3d_cell(6, 0, 0.1)] in (11, 17)


@pytest.mark.needs("pyarrow", "h5py")
@pytest.mark.slow
def test_flow_of_a_real_sample_is_that_of_its_data_set(real, tmp_path):
    import h5py
    from pyarrow import feather

    archive = real / "av2.tar.xz"
    if not archive.is_file():
        pytest.skip(f"{archive} is not there")
    with tarfile.open(archive) as file:
        file.extractall(tmp_path, filter="data")
    convert(
        "argoverse2", tmp_path / "av2" / "val", tmp_path / "layout", grids=None, run=Run(workers=1)
    )
    export("opensceneflow", tmp_path / "layout", tmp_path / "out", run=Run(workers=1))
    (log,) = (tmp_path / "av2" / "val").iterdir()
    truth = feather.read_table(log / "flow_labels.feather")
    lasers = feather.read_table(sorted(log.glob("sensors/lidar/*"))[0])["laser_number"].to_numpy()
    order = np.argsort(lasers >= 32, kind="stable")  # sensor by sensor, as in the layout
    flow = np.column_stack([truth[f"flow_t{axis}_m"].to_numpy() for axis in "xyz"])[order]
    moving, ground = (
        truth[name].to_numpy().astype(bool)[order] for name in ("dynamic", "is_ground_0")
    )
    with h5py.File(next((tmp_path / "out").rglob("*.h5"))) as file:
        group = {name: array[()] for name, array in file[min(file, key=int)].items()}
    error = np.linalg.norm(group["flow"] - flow, axis=1)
    assert moving.sum() > 2000
    assert (error < 0.005).mean() > 0.998
    assert np.median(error[moving]) < 0.001
    assert (error[moving] < 0.005).mean() > 0.95  # boxes are larger there by some centimetres
    assert (group["ground_mask"] == ground).mean() > 0.95
