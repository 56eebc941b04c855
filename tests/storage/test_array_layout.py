"""What zarr and HDF5 stores share: chunks, types, leftovers of interrupted runs.

HDF5 stands for both where they do the same.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.sequences import files_of

import carlasc
from carlasc.errors import FormatError
from carlasc.storage import Sequence
from carlasc.storage.opening import open_sink
from carlasc.storage.packed.output import TABLES_MARK
from carlasc.storage.packed.stores import PackOptions
from carlasc.storage.parquet.parquet_sink import ParquetSink
from carlasc.testing.data import SCANS, WHOLE

h5py = pytest.importorskip("h5py")
pytest.importorskip("hdf5plugin")


def points_of(count: int, seed: int = 0) -> np.ndarray:
    points = np.zeros((count, 4), np.float32)
    points[:, :3] = np.random.default_rng(seed).normal(size=(count, 3))
    return points


def write(
    path: Path, scans: list[np.ndarray], options: PackOptions | None = None, field: str = "points"
) -> Sequence:
    with open_sink(path, options or PackOptions(), False) as sink, sink.sequence(SCANS) as writer:
        for frame, array in enumerate(scans):
            writer.write(field, frame, array)
    return carlasc.open(path).sequences()[SCANS]


def test_memory_is_used_again_only_where_shape_and_type_are_the_same(tmp_path: Path) -> None:
    scans = [points_of(300), points_of(40_000), points_of(17)]
    exact = write(tmp_path / "exact.h5", scans)
    rounded = write(tmp_path / "rounded.h5", scans, PackOptions(lossy_mm=1))
    spare: list[np.ndarray] = []
    for frame in (0, 1, 0, 2, 1):
        for sequence, tolerance in ((exact, 0.0), (rounded, 0.00051)):
            spare = sequence.read_xyz([frame], spare)
            assert spare[0].dtype == np.float32
            assert np.abs(spare[0] - scans[frame][:, :3]).max() <= tolerance
    first = exact.read_xyz([0])
    memory = first[0].base
    assert exact.read_xyz([2], first)[0].base is memory


@pytest.mark.parametrize(
    "bits", [0x80000000, 0x7FC00123, 0x3F800000], ids=["-0.0", "a NaN with a payload", "1.0"]
)
def test_a_4th_column_comes_back_bit_for_bit(tmp_path: Path, bits: int) -> None:
    points = points_of(50)
    points.view(np.uint32)[7, 3] = bits
    sequence = write(tmp_path / "x.h5", [points_of(50), points])
    assert sequence.read("points", 0).tobytes() == points_of(50).tobytes()
    assert sequence.read("points", 1).tobytes() == points.tobytes()


@pytest.mark.parametrize(("count", "chunk"), [(1, 16_384), (14_600, 16_640), (40_000, 45_056)])
def test_a_chunk_has_nine_eighths_of_the_first_scan_in_whole_pages(
    tmp_path: Path, count: int, chunk: int
) -> None:
    write(tmp_path / "x.h5", [points_of(0), points_of(count), points_of(3)])
    with h5py.File(tmp_path / "x.h5") as file:
        assert file[SCANS]["scans/points/xyz"].chunks == (1, 3, chunk)


def test_a_grid_of_another_size_than_the_first_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        FormatError, match=r"frame 1: its array: expected shape \(2, 3, 4\).*found \(2, 3, 5\)"
    ):
        write(
            tmp_path / "x.h5",
            [np.zeros((2, 3, 4), np.uint8), np.zeros((2, 3, 5), np.uint8)],
            None,
            "fine/labels",
        )


def test_text_files_that_are_not_numbers_are_kept_without_arrays_of_them(tmp_path: Path) -> None:
    with open_sink(tmp_path / "x.h5", PackOptions(), False) as sink, sink.sequence(SCANS) as writer:
        writer.write_document("poses.txt", b"not numbers")
        writer.write_document("times.txt", b"0\n1\n")
    assert (
        carlasc.open(tmp_path / "x.h5").sequences()[SCANS].read_document("poses.txt")
        == b"not numbers"
    )
    with h5py.File(tmp_path / "x.h5") as file:
        assert set(file[SCANS]) == {"documents", "times", "frames", "counts"}


@pytest.mark.parametrize(("kind", "package"), [("h5", "hdf5plugin"), ("parquet", "pyarrow")])
def test_a_sequence_that_is_started_again_and_not_finished_is_not_listed(
    tmp_path: Path, kind: str, package: str
) -> None:
    pytest.importorskip(package)
    with open_sink(tmp_path / f"x.{kind}", PackOptions(), False) as sink:
        for path in (SCANS, WHOLE):
            with sink.sequence(path) as writer:
                writer.write("labels", 0, np.arange(3, dtype=np.uint32))
        sink.sequence(SCANS)
    assert list(carlasc.open(tmp_path / f"x.{kind}").sequences()) == [WHOLE]


def test_what_an_interrupted_run_left_of_a_sequence_of_tables_is_removed(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    labels = np.arange(3, dtype=np.uint32)
    interrupted = ParquetSink(tmp_path / "x.parquet").sequence(SCANS)
    interrupted.write("instances", 0, labels)
    for writer in interrupted.writers.values():
        writer.close()  # the field is whole, its sequence is not
    assert any("instances" in name for name in files_of(tmp_path))
    write(tmp_path / "x.parquet", [labels], None, "labels")
    assert not any("instances" in name for name in files_of(tmp_path))


def test_what_a_run_left_that_was_killed_while_it_finished_a_store_of_tables_is_removed(
    tmp_path: Path,
) -> None:
    pytest.importorskip("pyarrow")
    code = (
        "import os, sys; from carlasc.storage import files; from pathlib import Path\n"
        "files.write_atomic(Path(sys.argv[1]), lambda file: os.kill(os.getpid(), 9))"
    )
    ParquetSink(tmp_path / "x.parquet")
    subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "x.parquet.part" / TABLES_MARK)], check=False
    )
    assert len(list((tmp_path / "x.parquet.part").glob(".*.part"))) == 1
    write(tmp_path / "x.parquet", [np.arange(3, dtype=np.uint32)], None, "labels")
    assert not list(tmp_path.rglob(".*.part"))


@pytest.mark.parametrize(
    ("name", "opened"),
    [
        ("x.zarr", "x.zarr"),
        ("x.h5", "x.h5"),
        ("x.h5", "x.h5.part"),
        ("x.hdf5", "x.hdf5.part"),
        ("x.parquet", "x.parquet"),
        ("x.parquet", "x.parquet.part"),
    ],
)
def test_an_unfinished_store_of_any_format_says_the_same(
    tmp_path: Path, name: str, opened: str
) -> None:
    pytest.importorskip("pyarrow")
    sink = open_sink(tmp_path / name, PackOptions(), False)
    with sink.sequence(SCANS) as writer:
        writer.write("points", 0, points_of(5))
    with pytest.raises(FormatError) as error:
        carlasc.open(tmp_path / opened)
    assert str(error.value) == (
        f"{tmp_path / opened}: expected a finished store, found an unfinished one: a run is "
        f"writing it, or was interrupted: "
        "run the same command again to finish it (`carlasc finish` if all parts of a .zarr store "
        "are written)"
    )


def test_a_folder_with_the_ending_of_unfinished_stores_is_opened(tmp_path: Path) -> None:
    (tmp_path / "drives.part" / "cartesian" / "velodyne").mkdir(parents=True)
    assert carlasc.open(tmp_path / "drives.part").sequences()


@pytest.mark.parametrize(("kind", "package"), [("h5", "hdf5plugin"), ("parquet", "pyarrow")])
def test_a_frame_is_written_once(tmp_path: Path, kind: str, package: str) -> None:
    pytest.importorskip(package)
    writer = open_sink(tmp_path / f"x.{kind}", PackOptions(), False).sequence(SCANS)
    writer.write("labels", 3, np.arange(3, dtype=np.uint32))
    with pytest.raises(
        FormatError, match="frame 3: its number: expected frames in rising order, above 3, found 3"
    ):
        writer.write("labels", 3, np.arange(3, dtype=np.uint32))
