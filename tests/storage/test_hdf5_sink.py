from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.sequences import scan
from helpers.errors import raises

import carlasc
from carlasc.errors import ArgumentError, ConflictError, FormatError
from carlasc.storage import FolderSource, Sink, Source
from carlasc.storage.hdf5.hdf5_sink import HDF5Sink
from carlasc.storage.packed.stores import PackOptions
from carlasc.storage.packing import pack
from carlasc.testing import SinkContract, SourceContract
from carlasc.testing.data import SCANS, WHOLE

h5py = pytest.importorskip("h5py")
pytest.importorskip("hdf5plugin")
ENDING = ".h5"


class TestHDF5Source(SourceContract):
    def build(self, published: Path, folder: Path) -> Source:
        pack(published, folder / "x.h5")
        return carlasc.open(folder / "x.h5")


class TestHDF5Sink(SinkContract):
    def sink(self, out: Path) -> Sink:
        return HDF5Sink(out)

    def read(self, out: Path) -> Source:
        return carlasc.open(out)


@pytest.mark.slow
def test_h5py_with_hdf5plugin_reads_the_same_numbers_as_the_page_says(
    published: Path, store: Path, tmp_path: Path
) -> None:
    page = (Path(__file__).parents[2] / "docs/packed-format.md").read_text()
    code = next(
        block
        for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL)
        if "import h5py" in block
    )
    reference = FolderSource(published).sequences()[WHOLE]
    frames = {*reference.frames("points").tolist()} & {
        *reference.frames("evaluation/labels").tolist()
    }
    assert 5 in frames
    for frame in sorted(frames):
        found = run_page(code, store, frame, tmp_path)
        assert np.array_equal(found["points"], reference.read("points", frame)[:, :3])
        assert np.array_equal(found["labels"], reference.read("evaluation/labels", frame))
    with h5py.File(store) as file:
        assert np.array_equal(file[WHOLE]["times"][:], reference.times)
        assert np.array_equal(file[WHOLE]["poses"][:], reference.poses)


def run_page(code: str, store: Path, frame: int, folder: Path) -> dict[str, np.ndarray]:
    """Run the code of the page in a process that cannot import carlasc."""
    assert code.count('"carlasc.h5"') == 1 and code.count("frame = 17") == 1
    code = code.replace('"carlasc.h5"', repr(str(store))).replace("frame = 17", f"frame = {frame}")
    code = (
        "import sys\nsys.modules['carlasc'] = None\n"
        + code
        + "\nimport numpy\nnumpy.savez('x', points=points, labels=labels)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=folder)
    with np.load(folder / "x.npz") as arrays:
        return dict(arrays)


def test_a_scan_of_more_than_sixteen_times_the_room_of_others_is_kept(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scans = [scan(rng, count)["points"] for count in (300, 20 * 16384, 300)]
    with HDF5Sink(tmp_path / "x.h5") as sink, sink.sequence(SCANS) as writer:
        for frame, points in enumerate(scans):
            writer.write("points", frame, points)
    sequence = carlasc.open(tmp_path / "x.h5").sequences()[SCANS]
    for points, found in zip(scans, sequence.read_many("points", range(3)), strict=True):
        assert np.array_equal(points, found)


def test_nothing_is_in_a_global_heap_which_has_no_checksum(store: Path) -> None:
    assert b"GCOL" not in store.read_bytes()


def test_every_data_set_says_type_version_dtype_and_unit(store: Path) -> None:
    found = []

    def look(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            found.append(name)
            assert {"type", "version", "dtype", "unit"} <= set(item.attrs), name
            assert item.attrs["dtype"].decode() == item.dtype.name, name

    with h5py.File(store) as file:
        file.visititems(look)
    assert len(found) > 30


def test_frames_that_do_not_fit_the_type_go_to_a_second_column(tmp_path: Path) -> None:
    values = [np.arange(20), np.array([256, 3]), np.array([2]), np.array([70000, 0])]
    with HDF5Sink(tmp_path / "x.h5") as sink, sink.sequence(SCANS) as writer:
        for frame, labels in enumerate(values):
            writer.write("labels", frame, labels.astype(np.uint32))
    sequence = carlasc.open(tmp_path / "x.h5").sequences()[SCANS]
    for frame, labels in enumerate(values):
        assert sequence.read("labels", frame).tolist() == labels.tolist()


def test_a_scan_larger_than_the_first_takes_several_chunks(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scans = [scan(rng, count)["points"] for count in (300, 40000, 300)]
    with HDF5Sink(tmp_path / "x.h5") as sink, sink.sequence(SCANS) as writer:
        for frame, points in enumerate(scans):
            writer.write("points", frame, points)
    sequence = carlasc.open(tmp_path / "x.h5").sequences()[SCANS]
    for points, found in zip(scans, sequence.read_many("points", range(3)), strict=True):
        assert np.array_equal(points, found)


def test_a_corrupted_chunk_names_field_and_frame(store: Path) -> None:
    with h5py.File(store) as file:
        # frame 0 is empty, the others take one each
        info = file[WHOLE]["scans/points/xyz"].id.get_chunk_info(2)
    data = bytearray(store.read_bytes())
    data[info.byte_offset + info.size // 2] ^= 1
    store.write_bytes(data)
    sequence = carlasc.open(store).sequences()[WHOLE]
    with pytest.raises(FormatError, match="field points, frame 5.*checksum"):
        sequence.read("points", 5)
    assert len(sequence.read("points", 2)) == 777


def test_a_truncated_file_is_one_clear_error(store: Path) -> None:
    store.write_bytes(store.read_bytes()[: store.stat().st_size // 2])
    with raises(FormatError, where=r"x\.h5", expected="an HDF5 file", advice="truncated"):
        carlasc.open(store)


@pytest.mark.parametrize(
    ("version", "message"),
    [
        (7, "found version 7: upgrade carlasc"),
        (
            1,
            "expected a store of version 3, found version 1: it was packed by an earlier, "
            "unreleased version of carlasc",
        ),
    ],
)
def test_a_store_of_another_version_says_so(store: Path, version: int, message: str) -> None:
    with h5py.File(store, "r+") as file:
        file.attrs["version"] = version
    with pytest.raises(FormatError, match=message):
        carlasc.open(store)


def test_another_hdf5_file_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["data"] = np.arange(3)
    with raises(FormatError, expected="a store packed by carlasc"):
        carlasc.open(tmp_path / "x.h5")


def test_an_unfinished_store_is_refused(tmp_path: Path) -> None:
    sink = HDF5Sink(tmp_path / "x.h5")
    sink.sequence(SCANS).close()
    assert not (tmp_path / "x.h5").exists()
    with pytest.raises(FormatError):
        carlasc.open(tmp_path / "x.h5.part")
    with HDF5Sink(tmp_path / "x.h5"):  # a second run starts again
        pass
    assert not carlasc.open(tmp_path / "x.h5").sequences()


def test_pcodec_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"\.zarr"):
        HDF5Sink(tmp_path / "x.h5", PackOptions(small=True))


def test_another_file_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "x.h5").write_bytes(b"diary")
    with pytest.raises(ConflictError, match="packed store"):
        HDF5Sink(tmp_path / "x.h5", overwrite=True)
