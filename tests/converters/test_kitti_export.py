"""SemanticKITTI into the layout, and back again."""

import numpy as np
import pytest
from carlasc_converters.kitti import SemanticKitti
from carlasc_converters.kitti_voxels import unpack_bits
from helpers.datasets.tiny_kitti import write_tiny_kitti

import carlasc
from carlasc.converting import LayoutOptions, convert, export
from carlasc.running import Run

SEQUENCE = "Train/KITTI_00/cartesian"


def frame_files(folder, name, suffix):
    return {path.name: path.read_bytes() for path in sorted((folder / name).glob(f"*{suffix}"))}


@pytest.fixture(scope="module")
def there_and_back(simulated, tmp_path_factory):
    middle, back = tmp_path_factory.mktemp("middle"), tmp_path_factory.mktemp("back")
    convert(
        "kitti",
        simulated[0],
        middle,
        layout=LayoutOptions(classes="semantickitti", axes="right", flow="none"),
        grids="voxels",
        run=Run(workers=1),
    )
    result = export("kitti", middle, back, run=Run(workers=1))
    assert (result.made, result.failures, result.sequences) == (24, (), {SEQUENCE: "sequences/00"})
    return simulated[1].folder, back / "sequences" / "00"


@pytest.mark.parametrize(
    ("name", "suffix"),
    [("velodyne", ".bin"), *(("voxels", s) for s in (".bin", ".label", ".invalid", ".occluded"))],
)
def test_scans_and_voxels_come_back_as_they_were(there_and_back, name, suffix):
    before, after = (frame_files(folder, name, suffix) for folder in there_and_back)
    assert before
    assert before == after


def test_classes_and_instances_come_back_as_they_were(there_and_back):
    before, after = (frame_files(folder, "labels", ".label") for folder in there_and_back)
    assert before == after
    assert sum((np.frombuffer(data, "<u4") >> 16).any() for data in before.values()) > 5


def test_poses_come_back(there_and_back):
    before, after = (
        SemanticKitti(folder).sequences()[0].poses().world_T_vehicle for folder in there_and_back
    )
    assert np.abs(np.linalg.inv(before[0]) @ before - after).max() < 1e-9


def test_the_mirrored_frame_comes_back_too(simulated, tmp_path):
    convert(
        "kitti",
        simulated[0],
        tmp_path / "middle",
        layout=LayoutOptions(classes="semantickitti", flow="none"),
        grids="voxels",
        run=Run(workers=1),
    )
    export("kitti", tmp_path / "middle", tmp_path / "back", run=Run(workers=1))
    before, after = simulated[1].folder, tmp_path / "back" / "sequences" / "00"
    assert frame_files(before, "velodyne", ".bin") == frame_files(after, "velodyne", ".bin")
    assert frame_files(before, "labels", ".label") == frame_files(after, "labels", ".label")
    assert frame_files(before, "voxels", ".label") == frame_files(after, "voxels", ".label")
    poses = SemanticKitti(after).sequences()[0].poses().world_T_vehicle
    assert np.abs(simulated[1].poses - poses).max() < 1e-6


@pytest.mark.slow
def test_tiny_round_trip_of_several_sequences(tmp_path):
    for number in ("00", "08"):
        write_tiny_kitti(tmp_path / "in", number, voxels=True)
    options = {
        "layout": LayoutOptions("semantickitti", "right", flow="none"),
        "grids": "voxels",
        "run": Run(workers=2),
    }
    convert("kitti", tmp_path / "in", tmp_path / "middle", **options)
    export("kitti", tmp_path / "middle", tmp_path / "out", run=Run(workers=2))
    for number in ("00", "08"):
        for name, suffix in (("velodyne", ".bin"), ("voxels", ".occluded")):
            before, after = (
                frame_files(tmp_path / side / "sequences" / number, name, suffix)
                for side in ("in", "out")
            )
            assert before == after
    assert carlasc.open(tmp_path / "middle").sequences().keys() == {
        SEQUENCE,
        "Val/KITTI_08/cartesian",
    }


def test_a_grid_that_is_named_is_exported_instead_of_the_original_voxels(tmp_path):
    write_tiny_kitti(tmp_path / "in", frames=1, voxels=True)
    options = {
        "layout": LayoutOptions("semantickitti", "right", flow="none"),
        "grids": "voxels",
        "run": Run(workers=1),
    }
    convert("kitti", tmp_path / "in", tmp_path / "middle", **options)
    export(
        "kitti",
        tmp_path / "middle",
        tmp_path / "out",
        options={"grid": "evaluation_256x256x32"},
        run=Run(workers=1),
    )
    before, after = (tmp_path / side / "sequences" / "00" / "voxels" for side in ("in", "out"))
    size = (256, 256, 32)
    labels = np.fromfile(after / "000000.label", "<u2").reshape(size)
    occluded = unpack_bits((after / "000000.occluded").read_bytes(), size, "occluded")
    assert occluded[labels > 0].all()
    assert (before / "000000.occluded").read_bytes() != (after / "000000.occluded").read_bytes()
