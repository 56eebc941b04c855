from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.sequences import files_of, scan

import carlasc
from carlasc.errors import ArgumentError, ConflictError, FormatError
from carlasc.storage import FolderSource, Sink, Source, layout
from carlasc.storage.packed.arrays.zarr_store import ZarrSink
from carlasc.storage.packed.protocol import Options
from carlasc.storage.packing import pack
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
    def sink(self, out: Path) -> Sink:
        return ZarrSink(out)

    def read(self, out: Path) -> Source:
        return carlasc.open(out)


@pytest.mark.parametrize("small", [False, True])
def test_zarr_python_reads_the_same_numbers(published: Path, tmp_path: Path, small: bool) -> None:
    pack(published, tmp_path / "x.zarr", small=small)
    sequence = zarr.open_group(tmp_path / "x.zarr", mode="r")[WHOLE]
    reference = FolderSource(published).sequences()[WHOLE]
    points = sequence["scans/points"]
    for frame, (start, end) in zip(points["frames"][:], points["xyz_offsets"][:], strict=True):
        assert np.array_equal(points["xyz"][:, start:end].T, reference.read("points", int(frame))[:, :3])
    cells = sequence["grids/evaluation/labels"]
    for position, frame in enumerate(cells["frames"][:]):
        assert np.array_equal(cells["values"][position], reference.read("evaluation/labels", int(frame)))
    assert np.array_equal(sequence["poses"][:], reference.poses)
    assert bytes(sequence["documents/poses.txt"][:]) == reference.read_document("poses.txt")


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


def test_labels_and_counts_shrink_to_a_byte_and_other_counts_stay(store: Path) -> None:
    group = zarr.open_group(store, mode="r")[WHOLE]
    assert group["scans/labels/values"].dtype == np.uint8
    assert group["grids/evaluation/labels/values"].dtype == np.uint8
    assert group["grids/evaluation/counts/values"].dtype == np.uint8
    assert group["grids/evaluation_8x4x3/counts/values"].dtype == np.float32
    assert "fourth" not in group["scans/points"]


def test_types_widen_when_a_later_frame_needs_it(tmp_path: Path) -> None:
    values = [np.array([1, 255]), np.array([256, 3]), np.array([2]), np.array([70000, 0]), np.array([4, 5])]
    with ZarrSink(tmp_path / "x.zarr") as sink, sink.sequence(SCANS) as writer:
        for frame, labels in enumerate(values):
            writer.write("labels", frame, labels.astype(np.uint32))
    sequence = carlasc.open(tmp_path / "x.zarr").sequences()[SCANS]
    for frame, labels in enumerate(values):
        assert sequence.read("labels", frame).tolist() == labels.tolist()
    assert sequence.read("labels", 0).dtype == np.uint32
    assert not [name for name in files_of(tmp_path / "x.zarr") if "uint" in name]


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
    return max((store / WHOLE / field / "c").rglob("*"), key=lambda file: file.stat().st_size if file.is_file() else -1)


@pytest.mark.parametrize(
    ("node", "field"), [("scans/points/xyz", "points"), ("grids/evaluation/labels/values", "evaluation/labels")]
)
def test_a_corrupted_chunk_names_field_and_frame(store: Path, node: str, field: str) -> None:
    file = shard_of(store, node)
    data = bytearray(file.read_bytes())
    data[len(data) // 8 if field == "points" else 20] ^= 1
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

    file = shard_of(store, "scans/points/xyz")
    per_shard = json.loads((store / WHOLE / "scans/points/xyz/zarr.json").read_bytes())["chunk_grid"]["configuration"]
    chunk = json.loads((store / WHOLE / "scans/points/xyz/zarr.json").read_bytes())["codecs"][0]["configuration"]
    size = 16 * (per_shard["chunk_shape"][1] // chunk["chunk_shape"][1])
    data = bytearray(file.read_bytes())
    data[-4 - size + 32 : -4 - size + 48] = b"\xff" * 16  # of chunk 2, which is frame 5
    data[-4:] = google_crc32c.value(bytes(data[-4 - size : -4])).to_bytes(4, "little")
    file.write_bytes(data)
    sequence = carlasc.open(store).sequences()[WHOLE]
    with pytest.raises(FormatError, match="field points, frame 5.*expected chunk 2, found none: the store is damaged"):
        sequence.read("points", 5)
    assert len(sequence.read("points", 2)) == 777


def test_a_store_of_a_newer_version_says_so(store: Path) -> None:
    root = json.loads((store / "zarr.json").read_bytes())
    root["attributes"]["version"] = 2
    (store / "zarr.json").write_text(json.dumps(root))
    with pytest.raises(FormatError, match="found version 2: upgrade carlasc"):
        carlasc.open(store)


def test_another_zarr_store_is_refused(tmp_path: Path) -> None:
    zarr.create_group(tmp_path / "x.zarr")
    with pytest.raises(FormatError, match="expected a store packed by carlasc"):
        carlasc.open(tmp_path / "x.zarr")


def test_an_unfinished_store_is_refused_under_either_name(published: Path, tmp_path: Path) -> None:
    sink = ZarrSink(tmp_path / "x.zarr")
    sink.sequence(SCANS).close()
    assert not (tmp_path / "x.zarr").exists()
    with pytest.raises(carlasc.errors.MissingDataError, match=r"x\.zarr\.part: run the same command again"):
        carlasc.open(tmp_path / "x.zarr")
    with pytest.raises(FormatError):
        carlasc.open(tmp_path / "x.zarr.part")


def test_a_second_run_keeps_finished_sequences_unless_it_packs_differently(tmp_path: Path) -> None:
    points = np.ones((3, 4), np.float32)
    with ZarrSink(tmp_path / "x.zarr").sequence(SCANS) as writer:
        writer.write("points", 0, points)
    assert ZarrSink(tmp_path / "x.zarr").finished(SCANS)
    assert not ZarrSink(tmp_path / "x.zarr").finished(WHOLE)
    assert not ZarrSink(tmp_path / "x.zarr", Options(lossy_mm=1)).finished(SCANS)


def test_overwrite_replaces_a_store_but_no_other_folder(store: Path, tmp_path: Path) -> None:
    with pytest.raises(ConflictError, match=r"give `overwrite=True`"):
        ZarrSink(store)
    with ZarrSink(store, overwrite=True):
        assert carlasc.open(store).sequences()  # the old one stands until the new one is finished
    assert not carlasc.open(store).sequences()
    (tmp_path / "photos.zarr").mkdir()
    with pytest.raises(ConflictError, match="packed store to overwrite"):
        ZarrSink(tmp_path / "photos.zarr", overwrite=True)


@pytest.mark.parametrize("millimetres", [0, -1, float("nan"), 2000])
def test_senseless_quantisation_is_refused(millimetres: float) -> None:
    with pytest.raises(ArgumentError):
        Options(lossy_mm=millimetres)


def test_votes_keep_the_width_of_their_labels(tmp_path: Path) -> None:
    wide = np.zeros(2, layout.WIDE_VOTES_DTYPE)
    wide["label"] = [3, 300]
    with ZarrSink(tmp_path / "x.zarr") as sink, sink.sequence(SCANS) as writer:
        writer.write("evaluation/votes", 0, wide)
    votes = carlasc.open(tmp_path / "x.zarr").sequences()[SCANS].read("evaluation/votes", 0)
    assert votes.dtype == layout.WIDE_VOTES_DTYPE
    assert np.array_equal(votes, wide)
