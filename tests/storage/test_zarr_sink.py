from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.sequences import files_of, scan
from helpers.errors import raises

import carlasc
from carlasc.errors import ArgumentError, ConflictError, FormatError
from carlasc.storage import FolderSource, Sink, Source, field_files
from carlasc.storage.packed.stores import PackOptions
from carlasc.storage.packing import pack
from carlasc.storage.zarr.zarr_sink import ZarrSink
from carlasc.testing import SinkContract, SourceContract
from carlasc.testing.data import SCANS, WHOLE

zarr = pytest.importorskip("zarr")
ENDING = ".zarr"


class TestZarrSource(SourceContract):
    def build(self, published: Path, folder: Path) -> Source:
        pack(published, folder / "x.zarr")
        return carlasc.open(folder / "x.zarr")


class TestSmallZarrSource(SourceContract):
    processes = ("fork",)

    def build(self, published: Path, folder: Path) -> Source:
        pack(published, folder / "x.zarr", small=True)
        return carlasc.open(folder / "x.zarr")


class TestZippedZarrSource(SourceContract):
    processes = ("fork",)

    def build(self, published: Path, folder: Path) -> Source:
        pack(published, folder / "x.zarr")
        with zipfile.ZipFile(folder / "x.zarr.zip", "w") as archive:
            for name, data in files_of(folder / "x.zarr").items():
                archive.writestr(name, data)
        return carlasc.open(folder / "x.zarr.zip")


class TestZarrSink(SinkContract):
    rising = False

    def sink(self, out: Path) -> Sink:
        return ZarrSink(out)

    def read(self, out: Path) -> Source:
        return carlasc.open(out)


@pytest.mark.parametrize("small", [False, True])
def test_zarr_python_reads_the_same_numbers(published: Path, tmp_path: Path, small: bool) -> None:
    pack(published, tmp_path / "x.zarr", small=small)
    sequence = zarr.open_group(tmp_path / "x.zarr", mode="r")[WHOLE]
    reference = FolderSource(published).sequences()[WHOLE]
    columns = sequence["counts"].attrs["columns"]
    counts = dict(zip(sequence["frames"][:].tolist(), sequence["counts"][:].tolist(), strict=True))
    xyz, cells = sequence["scans/points/xyz"], sequence["grids/evaluation/labels/values"]
    assert ("pcodec" in str(xyz.metadata.codecs).lower()) is small
    for frame in reference.frames("points").tolist():
        count = counts[frame][columns.index("scans/points/xyz")]
        assert np.array_equal(xyz[frame, :, :count].T, reference.read("points", frame)[:, :3])
    for frame in reference.frames("evaluation/labels").tolist():
        assert np.array_equal(cells[frame], reference.read("evaluation/labels", frame))
    assert np.array_equal(sequence["poses"][:], reference.poses)
    assert np.array_equal(sequence["times"][:], reference.times)


def test_metadata_are_consolidated_and_codecs_of_the_core_specification(store: Path) -> None:
    nodes = json.loads((store / "zarr.json").read_bytes())["consolidated_metadata"]["metadata"]
    arrays = {name: node for name, node in nodes.items() if node["node_type"] == "array"}
    assert len(arrays) > 30
    for name, node in arrays.items():
        codecs = node["codecs"]
        if codecs[0]["name"] == "sharding_indexed":
            codecs = codecs[0]["configuration"]["codecs"]
        assert [codec["name"] for codec in codecs] == ["bytes", "blosc", "crc32c"], name


def test_every_node_says_type_version_dtype_and_unit(store: Path) -> None:
    nodes = json.loads((store / "zarr.json").read_bytes())["consolidated_metadata"]["metadata"]
    for name, node in nodes.items():
        if node["node_type"] == "array":
            assert {"type", "version", "dtype", "unit"} <= set(node["attributes"]), name
            assert node["attributes"]["dtype"] == node["data_type"], name


def test_types_are_fixed_and_columns_that_no_frame_needs_are_absent(store: Path) -> None:
    group = zarr.open_group(store, mode="r")[WHOLE]
    assert group["scans/labels/values"].dtype == np.uint8
    assert group["scans/instances/values"].dtype == np.uint32
    assert group["grids/evaluation/labels/values"].dtype == np.uint8
    assert group["grids/evaluation/counts/values"].dtype == np.uint16
    assert group["grids/evaluation_8x4x3/counts/values_wide"].dtype == np.float32
    assert "values" not in group["grids/evaluation_8x4x3/counts"]
    assert "fourth" not in group["scans/points"]


def test_frames_that_do_not_fit_the_type_go_to_a_second_column(tmp_path: Path) -> None:
    values = [
        np.array([1, 255]),
        np.array([256, 3]),
        np.array([2]),
        np.array([70000, 0]),
        np.array([4, 5]),
    ]
    with ZarrSink(tmp_path / "x.zarr") as sink, sink.sequence(SCANS) as writer:
        for frame, labels in enumerate(values):
            writer.write("labels", frame, labels.astype(np.uint32))
    sequence = carlasc.open(tmp_path / "x.zarr").sequences()[SCANS]
    for frame, labels in enumerate(values):
        assert sequence.read("labels", frame).tolist() == labels.tolist()
    assert [sequence.read("labels", frame).dtype.itemsize for frame in range(5)] == [1, 4, 1, 4, 1]


def test_a_scan_larger_than_the_first_takes_several_chunks(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scans = [scan(rng, count) for count in (300, 1000, 40000, 300)]
    with ZarrSink(tmp_path / "x.zarr") as sink, sink.sequence(SCANS) as writer:
        for frame, arrays in enumerate(scans):
            for name, array in arrays.items():
                writer.write(name, frame, array)
    sequence = carlasc.open(tmp_path / "x.zarr").sequences()[SCANS]
    for name in scans[0]:
        for arrays, array in zip(scans, sequence.read_many(name, range(4)), strict=True):
            assert np.array_equal(array, arrays[name])


def shard_of(store: Path, field: str) -> Path:
    return max(
        (store / WHOLE / field / "c").rglob("*"),
        key=lambda file: file.stat().st_size if file.is_file() else -1,
    )


@pytest.mark.parametrize(
    ("node", "field"),
    [("scans/points/xyz", "points"), ("grids/evaluation/labels/values", "evaluation/labels")],
)
def test_a_corrupted_chunk_names_field_and_frame(store: Path, node: str, field: str) -> None:
    file = shard_of(store, node)
    data = bytearray(file.read_bytes())
    index = 16 * 16 * (16 if field == "points" else 1) + 4
    data[index + (len(data) - index) // 2] ^= 1
    file.write_bytes(data)
    sequence = carlasc.open(store).sequences()[WHOLE]
    failures = []
    for frame in sequence.frames(field).tolist():
        try:
            sequence.read(field, frame)
        except FormatError as error:
            failures.append(frame)
            assert f"field {field}, frame {frame}" in str(error)
            assert "checksum" in str(error)
    assert len(failures) == 1


def test_a_truncated_shard_names_field_and_frame(store: Path) -> None:
    file = shard_of(store, "scans/points/xyz")
    file.write_bytes(file.read_bytes()[:-7])
    with pytest.raises(FormatError, match="field points, frame 5"):
        carlasc.open(store).sequences()[WHOLE].read("points", 5)


def test_a_missing_shard_is_damage_and_no_zeros(store: Path) -> None:
    shard_of(store, "scans/points/xyz").unlink()
    with pytest.raises(FormatError, match="field points, frame 5.*damaged"):
        carlasc.open(store).sequences()[WHOLE].read("points", 5)


def test_a_chunk_that_the_index_does_not_have_is_damage_and_no_zeros(store: Path) -> None:
    import google_crc32c

    file = store / WHOLE / "scans/points/xyz/c/0/0/0"
    # 16 bytes per slot, 16 slots per frame
    data, size, slot = (
        bytearray(file.read_bytes()),
        16 * 16 * 16,
        16 * 16 * 5,
    )
    data[slot : slot + 16] = b"\xff" * 16  # the first chunk of frame 5
    data[size : size + 4] = google_crc32c.value(bytes(data[:size])).to_bytes(4, "little")
    file.write_bytes(data)
    sequence = carlasc.open(store).sequences()[WHOLE]
    with pytest.raises(
        FormatError,
        match="field points, frame 5.*expected chunk 80, found none: the store is damaged",
    ):
        sequence.read("points", 5)
    assert len(sequence.read("points", 2)) == 777


@pytest.mark.parametrize(
    ("version", "message"),
    [
        (7, "found version 7: upgrade carlasc"),
        (
            2,
            "expected a store of version 3, found version 2: it was packed by an earlier, "
            "unreleased version of carlasc",
        ),
    ],
)
def test_a_store_of_another_version_says_so(store: Path, version: int, message: str) -> None:
    root = json.loads((store / "zarr.json").read_bytes())
    root["attributes"]["version"] = version
    (store / "zarr.json").write_text(json.dumps(root))
    with pytest.raises(FormatError, match=message):
        carlasc.open(store)


def test_another_zarr_store_is_refused(tmp_path: Path) -> None:
    zarr.create_group(tmp_path / "x.zarr")
    with raises(FormatError, expected="a store packed by carlasc"):
        carlasc.open(tmp_path / "x.zarr")


def test_an_unfinished_store_is_refused(tmp_path: Path) -> None:
    ZarrSink(tmp_path / "x.zarr").sequence(SCANS).close()
    with pytest.raises(
        FormatError,
        match="a run is writing it, or was interrupted: run the same command again.*carlasc finish",
    ):
        carlasc.open(tmp_path / "x.zarr")


def test_a_second_run_finds_what_exists_and_other_options_are_a_conflict(tmp_path: Path) -> None:
    points = np.ones((3, 4), np.float32)
    with ZarrSink(tmp_path / "x.zarr").sequence(SCANS) as writer:
        writer.write("points", 0, points)
    again = ZarrSink(tmp_path / "x.zarr").sequence(SCANS)
    assert again.has("points", 0) and not again.has("points", 1) and not again.has("labels", 0)
    assert np.array_equal(again.read("points", 0), points)
    with pytest.raises(
        ConflictError, match=r"same options, found one with lossy_mm None.*overwrite=True"
    ):
        ZarrSink(tmp_path / "x.zarr", PackOptions(lossy_mm=1))
    assert (
        not ZarrSink(tmp_path / "x.zarr", PackOptions(lossy_mm=1), overwrite=True)
        .sequence(SCANS)
        .has("points", 0)
    )


def test_more_is_added_to_a_finished_store_and_seen_when_it_is_finished_again(store: Path) -> None:
    points = np.ones((3, 4), np.float32)
    before = carlasc.open(store).sequences()[WHOLE]
    old = before.read("points", 5)
    sink = ZarrSink(store)
    assert sink.is_finished
    with sink.sequence(WHOLE) as writer:
        assert writer.has("points", 5) and not writer.has("points", 20)
        writer.write("points", 20, points)
        writer.write("instances", 3, np.arange(4, dtype=np.uint32))
    assert np.array_equal(carlasc.open(store).sequences()[WHOLE].read("points", 5), old)
    assert carlasc.open(store).sequences()[WHOLE].frames("points").tolist() == [0, 1, 2, 5]
    sink.finish()
    after = carlasc.open(store).sequences()[WHOLE]
    assert after.frames("points").tolist() == [0, 1, 2, 5, 20]
    assert after.frames("instances").tolist() == [0, 1, 2, 3, 5]
    assert np.array_equal(after.read("points", 20), points)
    assert np.array_equal(after.read("instances", 5), before.read("instances", 5))


def test_overwrite_keeps_the_old_store_until_the_new_one_is_finished(
    store: Path, tmp_path: Path
) -> None:
    before = files_of(store)
    sink = ZarrSink(store, overwrite=True)
    sink.sequence(SCANS).close()
    assert files_of(store.with_name("x.zarr.replaced")) == before
    joined = ZarrSink(store, overwrite=True)  # a second process of the same run, or the run again
    assert not joined.is_finished
    joined.finish()
    assert list(carlasc.open(store).sequences()) == [SCANS]
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.zarr"]


def test_a_run_that_ends_between_the_old_store_and_the_new_one_leaves_nothing_in_the_end(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(*_: object, **__: object) -> bool:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("carlasc.storage.transport.trees.LocalTarget.put", end)
        with pytest.raises(KeyboardInterrupt):
            ZarrSink(store, overwrite=True)
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.zarr.replaced"]
    sink = ZarrSink(store, overwrite=True)
    sink.sequence(SCANS).close()
    sink.finish()
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.zarr"]


def test_a_folder_that_only_has_the_name_of_an_old_store_stays(store: Path, tmp_path: Path) -> None:
    mine = store.rename(tmp_path / "x.zarr.old")
    sink = ZarrSink(store)
    sink.sequence(SCANS).close()
    sink.finish()
    assert list(carlasc.open(mine).sequences()) != []


@pytest.mark.parametrize("overwrite", [False, True])
def test_nothing_but_a_store_is_written_to(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "photos.zarr").mkdir()
    (tmp_path / "photos.zarr" / "a.jpg").write_bytes(b"1")
    (tmp_path / "file.zarr").write_bytes(b"1")
    zarr.create_group(tmp_path / "other.zarr")
    before = files_of(tmp_path)
    for name in ("photos", "file", "other"):
        with pytest.raises(ConflictError, match=f"{name}.zarr: expected"):
            ZarrSink(tmp_path / f"{name}.zarr", overwrite=overwrite)
    assert files_of(tmp_path) == before


@pytest.mark.parametrize("millimetres", [0, -1, float("nan"), 2000])
def test_senseless_quantisation_is_refused(millimetres: float) -> None:
    with pytest.raises(ArgumentError):
        PackOptions(lossy_mm=millimetres)


def test_votes_keep_the_width_of_their_labels(tmp_path: Path) -> None:
    wide = np.zeros(2, field_files.WIDE_VOTES_DTYPE)
    wide["label"] = [3, 300]
    with ZarrSink(tmp_path / "x.zarr") as sink, sink.sequence(SCANS) as writer:
        writer.write("evaluation/votes", 0, wide)
    votes = carlasc.open(tmp_path / "x.zarr").sequences()[SCANS].read("evaluation/votes", 0)
    assert votes.dtype == field_files.WIDE_VOTES_DTYPE
    assert np.array_equal(votes, wide)
