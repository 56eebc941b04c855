from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.parquet_tables import seal_tables
from helpers.datasets.sequences import FRAMES
from helpers.errors import raises

import carlasc
from carlasc.errors import ArgumentError, FormatError
from carlasc.storage import FolderSource, Sink, Source, field_files
from carlasc.storage.packed.stores import PackOptions
from carlasc.storage.packing import pack
from carlasc.storage.parquet.parquet_sink import ParquetSink
from carlasc.testing import SinkContract, SourceContract
from carlasc.testing.data import SCANS, WHOLE

parquet = pytest.importorskip("pyarrow.parquet")
ENDING = ".parquet"


class TestParquetSource(SourceContract):
    def build(self, published: Path, folder: Path) -> Source:
        pack(published, folder / "x.parquet")
        return carlasc.open(folder / "x.parquet")


class TestParquetSink(SinkContract):
    def sink(self, out: Path) -> Sink:
        return ParquetSink(out)

    def read(self, out: Path) -> Source:
        return carlasc.open(out)


def test_frames_are_rows_with_pose_time_and_statistics(published: Path, packed: Path) -> None:
    reference = FolderSource(published).sequences()[WHOLE]
    rows = parquet.read_table(packed / WHOLE / "frames.parquet").to_pylist()
    assert [row["frame"] for row in rows] == list(FRAMES)
    for row in rows:
        frame = row["frame"]
        points, flow = reference.read("points", frame), reference.read("flow", frame)
        assert row["time_s"] == reference.read_time(frame)
        assert np.array_equal(np.reshape(row["pose"], (3, 4)), reference.read_pose(frame)[:3])
        assert row["points"] == len(points)
        assert row["moving_points"] == (flow != 0).any(axis=1).sum()
        if len(points):
            assert row["farthest_m"] == pytest.approx(
                np.linalg.norm(points[:, :3], axis=1).max(), rel=1e-6
            )
        if frame in reference.frames("evaluation/labels"):
            assert (
                row["evaluation_known_voxels"]
                == (reference.read("evaluation/counts", frame) > 0).sum()
            )
            assert (
                row["evaluation_occupied_voxels"]
                == (reference.read("evaluation/labels", frame) > 0).sum()
            )
        else:
            assert row["evaluation_known_voxels"] is None


def test_any_parquet_reader_gets_points_as_columns(published: Path, packed: Path) -> None:
    reference = FolderSource(published).sequences()[WHOLE]
    table = parquet.read_table(packed / WHOLE / "points.parquet", filters=[("frame", "=", 5)])
    assert table.column_names == ["sequence", "frame", "x", "y", "z", "fourth"]
    assert np.array_equal(
        np.stack([table[axis].to_numpy() for axis in "xyz"], axis=1),
        reference.read("points", 5)[:, :3],
    )


def test_tables_of_several_sequences_are_told_apart_by_a_number(packed: Path) -> None:
    frames = [parquet.read_table(path).to_pylist() for path in packed.rglob("frames.parquet")]
    paths = {row["sequence"]: row["path"] for rows in frames for row in rows}
    assert sorted(paths.values()) == sorted(carlasc.open(packed).sequences())
    for path in packed.rglob("labels.parquet"):
        (number,) = set(parquet.read_table(path)["sequence"].to_pylist())
        assert path.relative_to(packed).as_posix().startswith(f"{paths[number]}/")


def test_a_second_run_goes_on_with_the_numbers_of_the_first(tmp_path: Path) -> None:
    labels = np.arange(3, dtype=np.uint32)
    with ParquetSink(tmp_path / "x.parquet").sequence(SCANS) as writer:
        writer.write("labels", 0, labels)
    with ParquetSink(tmp_path / "x.parquet") as sink, sink.sequence(WHOLE) as writer:
        writer.write("labels", 0, labels)
    numbers = [
        parquet.read_table(tmp_path / "x.parquet" / path / "labels.parquet")["sequence"]
        for path in (SCANS, WHOLE)
    ]
    assert [number.to_pylist() for number in numbers] == [[0] * 3, [1] * 3]


def test_a_sequence_that_is_written_again_keeps_its_number(tmp_path: Path) -> None:
    for path in (SCANS, WHOLE, SCANS):
        with ParquetSink(tmp_path / "x.parquet").sequence(path) as writer:
            writer.write("labels", 0, np.arange(3, dtype=np.uint32))
    ParquetSink(tmp_path / "x.parquet").finish()
    tables = [
        parquet.read_table(tmp_path / "x.parquet" / path / "labels.parquet")
        for path in (SCANS, WHOLE)
    ]
    assert [table["sequence"].to_pylist() for table in tables] == [[0] * 3, [1] * 3]


def test_negative_zeros_and_nan_payloads_survive(tmp_path: Path) -> None:
    flow = np.zeros((40, 3), np.float32)
    flow[::2] = -0.0
    flow.view(np.uint32)[3] = 0x7FC00123
    flow.view(np.uint32)[5] = 0x7FC00456
    with ParquetSink(tmp_path / "x.parquet") as sink, sink.sequence(SCANS) as writer:
        writer.write("flow", 0, flow)
    found = carlasc.open(tmp_path / "x.parquet").sequences()[SCANS].read("flow", 0)
    assert np.array_equal(found.view(np.uint32), flow.view(np.uint32))


def test_a_corrupted_page_names_field_and_frame(store: Path) -> None:
    file = store / WHOLE / "points.parquet"
    # the third scan that is not empty: frame 5
    column = parquet.ParquetFile(file).metadata.row_group(2).column(3)
    data = bytearray(file.read_bytes())
    data[column.data_page_offset + column.total_compressed_size // 2] ^= 1
    file.write_bytes(data)
    sequence = carlasc.open(store).sequences()[WHOLE]
    with pytest.raises(FormatError, match="field points, frame 5"):
        sequence.read("points", 5)
    assert len(sequence.read("points", 2)) == 777


def test_a_truncated_table_is_one_clear_error(store: Path) -> None:
    file = store / WHOLE / "points.parquet"
    file.write_bytes(file.read_bytes()[:-9])
    with raises(FormatError, where=r"points\.parquet", expected="a Parquet file"):
        carlasc.open(store).sequences()[WHOLE].read("points", 5)


def test_a_missing_table_is_damage(store: Path) -> None:
    (store / WHOLE / "points.parquet").unlink()
    with pytest.raises(FormatError, match="the store is damaged"):
        carlasc.open(store).sequences()[WHOLE].read("points", 5)


def test_a_store_of_a_newer_version_says_so(store: Path) -> None:
    mark = store / "carlasc-tables.json"
    mark.write_text(json.dumps(json.loads(mark.read_bytes()) | {"version": 7}))
    with raises(FormatError, found="version 7", advice="upgrade carlasc"):
        carlasc.open(store)


def test_one_table_alone_says_to_give_the_folder(packed: Path) -> None:
    with pytest.raises(FormatError, match="give the folder"):
        carlasc.open(packed / WHOLE / "points.parquet")


def test_a_second_run_keeps_finished_sequences(tmp_path: Path) -> None:
    with ParquetSink(tmp_path / "x.parquet").sequence(SCANS) as writer:
        writer.write("labels", 0, np.arange(3, dtype=np.uint32))
    ParquetSink(tmp_path / "x.parquet").sequence(WHOLE).write_document("times.txt", b"0\n")
    assert not (tmp_path / "x.parquet").exists()
    sink = ParquetSink(tmp_path / "x.parquet")
    assert sink.finished(SCANS)
    assert not sink.finished(WHOLE)
    assert not ParquetSink(tmp_path / "x.parquet", PackOptions(lossy_mm=2)).finished(SCANS)


def test_pcodec_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"\.zarr"):
        ParquetSink(tmp_path / "x.parquet", PackOptions(small=True))


def frames_table(store: Path) -> list[dict[str, object]]:
    return parquet.read_table(store / SCANS / "frames.parquet").to_pylist()


@pytest.mark.parametrize(
    ("lines", "times"),
    [(3, [0.0, 1.0, 2.0]), (4, [1.0, 2.0, 3.0]), (2, None), (0, None)],
    ids=["a line for each frame", "a line for each number", "too few lines", "none"],
)
def test_lines_of_text_files_are_those_of_the_frames(
    tmp_path: Path, lines: int, times: list[float] | None
) -> None:
    with ParquetSink(tmp_path / "x.parquet") as sink, sink.sequence(SCANS) as writer:
        writer.write_document("times.txt", "".join(f"{line}\n" for line in range(lines)).encode())
        for frame in (1, 2, 3):
            writer.write("labels", frame, np.zeros(2, np.uint32))
    rows = frames_table(tmp_path / "x.parquet")
    assert [row.get("time_s") for row in rows] == (times or [None] * 3)
    assert ("time_s" in rows[0]) == (times is not None)


def test_statistics_leave_points_out_that_are_not_finite(tmp_path: Path) -> None:
    points = np.zeros((4, 4), np.float32)
    points[:, 0] = [3, np.nan, np.inf, 1]
    with ParquetSink(tmp_path / "x.parquet") as sink, sink.sequence(SCANS) as writer:
        writer.write("points", 0, points)
        writer.write("points", 1, points[1:2])
    rows = frames_table(tmp_path / "x.parquet")
    assert [(row["points"], row["farthest_m"]) for row in rows] == [(4, 3.0), (1, None)]


def test_votes_of_another_width_than_the_first_frame_are_refused(tmp_path: Path) -> None:
    with ParquetSink(tmp_path / "x.parquet") as sink, sink.sequence(SCANS) as writer:
        writer.write("fine/votes", 0, np.zeros(2, field_files.VOTES_DTYPE))
        with raises(FormatError, where="frame 1: its labels", expected="1 bytes each"):
            writer.write("fine/votes", 1, np.zeros(2, field_files.WIDE_VOTES_DTYPE))


def test_a_table_of_another_size_than_the_grid_is_one_clear_error(store: Path) -> None:
    file = store / WHOLE / "documents.parquet"
    rows = parquet.read_table(file)
    data = [row["data"].replace(b"[4.0, 6.0, 2.0]", b"[4.0, 6.0, 3.0]") for row in rows.to_pylist()]
    changed = rows.set_column(1, "data", [data])
    parquet.write_table(changed.cast(rows.schema), file)
    with pytest.raises(
        FormatError, match="documents.parquet: the checksum of the footer does not match"
    ):
        carlasc.open(store).sequences()[WHOLE].read("evaluation/labels", 5)
    seal_tables(store / WHOLE)
    with raises(FormatError, where="frame 5", expected="72 voxels", found="48"):
        carlasc.open(store).sequences()[WHOLE].read("evaluation/labels", 5)
