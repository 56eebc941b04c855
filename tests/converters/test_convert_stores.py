"""A conversion to a packed store: the same scans and grids as in a folder."""

import pytest
from helpers.datasets.captures import read_tree
from helpers.datasets.tiny_kitti import write_tiny_kitti

import carlasc
from carlasc import Run
from carlasc.converting import convert
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError
from carlasc.groundtruth import GridOptions
from carlasc.motion import PoseOptions

pytest.importorskip("numcodecs")

HOW = {
    "grids": GridOptions(GridSpec.published().with_size((16, 16, 4))),
    "poses": PoseOptions(force=True),
}


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    """Two recordings, one longer than a block of a store, and what they become in a folder."""
    root = tmp_path_factory.mktemp("convert")
    for name, frames in (("00", 20), ("08", 3)):
        write_tiny_kitti(root / "kitti", name, frames)
    convert("kitti", root / "kitti", root / "files", run=Run(workers=1), **HOW)
    return root


def without_derived(tree):
    """Leave out what is derived of sequences: it is never packed."""
    return {name: data for name, data in tree.items() if "/.carlasc/" not in name}


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_store_unpacks_to_the_files_of_a_folder(kitti, tmp_path, workers):
    result = convert("kitti", kitti / "kitti", tmp_path / "x.zarr", run=Run(workers=workers), **HOW)
    assert (result.made, len(result.grids)) == (23, 2)
    carlasc.unpack(tmp_path / "x.zarr", tmp_path / "x", run=Run(workers=1))
    assert without_derived(read_tree(tmp_path / "x")) == without_derived(read_tree(kitti / "files"))
    again = convert("kitti", kitti / "kitti", tmp_path / "x.zarr", run=Run(workers=1), **HOW)
    assert (again.made, again.skipped) == (0, 23)


@pytest.mark.slow
def test_a_frame_that_fails_is_added_when_it_is_corrected(kitti, tmp_path):
    write_tiny_kitti(tmp_path / "kitti", "00", 20)
    scan = tmp_path / "kitti/sequences/00/velodyne/000017.bin"
    good = scan.read_bytes()
    scan.write_bytes(good[:-3])
    result = convert("kitti", tmp_path / "kitti", tmp_path / "x.zarr", run=Run(workers=1), **HOW)
    assert result.failures[0].frame == 17  # others take motion from it, and wait
    assert all("waits" in failure.message for failure in result.failures[1:])
    (sequence,) = carlasc.open(tmp_path / "x.zarr").sequences().values()
    assert 17 not in sequence.frames("points") and len(sequence.frames("points")) == 19
    scan.write_bytes(good)
    again = convert("kitti", tmp_path / "kitti", tmp_path / "x.zarr", run=Run(workers=1), **HOW)
    assert again.failures == () and again.made >= 1
    (sequence,) = carlasc.open(tmp_path / "x.zarr").sequences().values()
    assert len(sequence.frames("points")) == len(sequence.frames("flow")) == 20


@pytest.mark.parametrize("kind", ["h5", "parquet"])
def test_stores_of_one_writer_take_scans_only(kitti, tmp_path, kind):
    with pytest.raises(ArgumentError, match="cannot be read while it is written"):
        convert("kitti", kitti / "kitti", tmp_path / f"x.{kind}", run=Run(workers=1), **HOW)
