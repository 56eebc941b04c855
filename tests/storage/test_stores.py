"""Packed stores that are damaged, and names in them that lead elsewhere."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets.parquet_tables import seal_tables
from helpers.datasets.sequences import files_of, write_dataset
from helpers.errors import raises

import carlasc
from carlasc.errors import FormatError
from carlasc.storage import FolderSource, Sequence, Source, pack, unpack
from carlasc.storage.opening import open_sink
from carlasc.storage.packed.chunks import Encoding
from carlasc.storage.packed.stores import PackOptions
from carlasc.testing.data import SCANS, WHOLE

PACKAGES = {"zarr": "zarr", "h5": "hdf5plugin", "parquet": "pyarrow"}
KINDS = [
    pytest.param(
        kind, marks=pytest.mark.skipif(find_spec(name) is None, reason=f"{name} is not installed")
    )
    for kind, name in PACKAGES.items()
]
OUTSIDE = [
    "../victim",
    "Train/../../victim",
    "/victim",
    "C:victim",
    "Train\\..\\..\\victim",
    "Train/a\0b",
]


class Renamed(Source):
    """A source of one sequence under a name of the test's choice."""

    def __init__(self, published: Path, name: str) -> None:
        self.location = str(published)
        self.name = name

    def sequences(self) -> dict[str, Sequence]:
        return {self.name: FolderSource(self.location).sequences()[SCANS]}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("published") / "data")


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("kind", KINDS)
def test_a_sequence_whose_path_leads_elsewhere_is_not_packed(
    data: Path, tmp_path: Path, kind: str, name: str
) -> None:
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim" / "diary.txt").write_text("mine")
    with pytest.raises(FormatError, match="leads out of the store"):
        pack(Renamed(data, name), tmp_path / f"x.{kind}")
    assert files_of(tmp_path / "victim") == {"diary.txt": b"mine"}
    assert not (tmp_path / f"x.{kind}").exists()


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_sequence_whose_path_leads_elsewhere_is_not_unpacked(
    data: Path, tmp_path: Path, name: str
) -> None:
    with pytest.raises(FormatError, match="leads out of it"):
        unpack(Renamed(data, name), tmp_path / "files")
    assert not files_of(tmp_path)


@pytest.mark.parametrize("kind", KINDS)
def test_fields_and_text_files_whose_names_lead_elsewhere_are_not_written(
    tmp_path: Path, kind: str
) -> None:
    writer = open_sink(tmp_path / f"x.{kind}", PackOptions(), False).sequence(SCANS)
    with pytest.raises(FormatError, match="leads out of the store"):
        writer.write("../../../../victim/labels", 0, np.zeros((2, 2, 2), np.uint32))
    with pytest.raises(FormatError, match="leads out of the store"):
        writer.write_document("../../../../victim.txt", b"1")
    assert not list(tmp_path.rglob("victim*"))


def edit_zarr(store: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """Change the root's metadata of a zarr store, which hold those of all nodes."""
    root = json.loads((store / "zarr.json").read_bytes())
    change(root)
    (store / "zarr.json").write_text(json.dumps(root))
    return store


def node(root: dict[str, Any], name: str) -> dict[str, Any]:
    return root["consolidated_metadata"]["metadata"][name]


@pytest.mark.parametrize("entry", ["group", "field", "document"])
def test_a_store_with_names_that_lead_elsewhere_is_not_read(
    data: Path, tmp_path: Path, entry: str
) -> None:
    pytest.importorskip("zarr")

    def change(root: dict[str, Any]) -> None:
        if entry == "group":
            root["attributes"]["sequences"] = {SCANS: "../victim"}
        elif entry == "field":
            node(root, SCANS)["attributes"]["fields"] += ["../../victim/labels"]
        else:
            node(root, SCANS)["attributes"]["documents"] += ["../victim.txt"]

    store = edit_zarr(pack(data, tmp_path / "x.zarr").out, change)
    with pytest.raises(FormatError, match="leads out of the store"):
        carlasc.open(store).sequences()


@pytest.fixture(scope="module")
def zarr_store(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("zarr")
    return pack(data, tmp_path_factory.mktemp("zarr") / "x.zarr").out


def take_completeness(root: dict[str, Any]) -> None:
    del root["attributes"]["complete"]


def change_type(root: dict[str, Any]) -> None:
    node(root, WHOLE)["attributes"]["type"] = "carlasc.field"


def remove_split(root: dict[str, Any]) -> None:
    del node(root, WHOLE)["attributes"]["split"]


def change_kind(root: dict[str, Any]) -> None:
    node(root, f"{WHOLE}/scans/points")["attributes"]["kind"] = "values"


def make_big_endian(root: dict[str, Any]) -> None:
    codecs = node(root, f"{WHOLE}/counts")["codecs"]
    codecs[0]["configuration"] = {"endian": "big"}


def change_codec(root: dict[str, Any]) -> None:
    node(root, f"{WHOLE}/counts")["codecs"][1]["name"] = "gzip"


def remove_array(root: dict[str, Any]) -> None:
    del root["consolidated_metadata"]["metadata"][f"{WHOLE}/counts"]


def remove_field(root: dict[str, Any]) -> None:
    del root["consolidated_metadata"]["metadata"][f"{WHOLE}/scans/points"]


def remove_chunk(root: dict[str, Any]) -> None:
    del node(root, f"{WHOLE}/scans/points")["attributes"]["chunk"]


def forget_columns(root: dict[str, Any]) -> None:
    del node(root, f"{WHOLE}/counts")["attributes"]["columns"]


def shorten(root: dict[str, Any]) -> None:
    node(root, f"{WHOLE}/scans/points/xyz")["shape"][0] = 5


def flatten(root: dict[str, Any]) -> None:
    xyz = node(root, f"{WHOLE}/scans/points/xyz")
    xyz["shape"][1] = xyz["chunk_grid"]["configuration"]["chunk_shape"][1] = 2
    xyz["codecs"][0]["configuration"]["chunk_shape"][1] = 2


def widen(root: dict[str, Any]) -> None:
    node(root, f"{WHOLE}/scans/points/xyz")["data_type"] = "float64"


def make_larger(root: dict[str, Any]) -> None:
    xyz = node(root, f"{WHOLE}/scans/points/xyz")
    xyz["codecs"][0]["configuration"]["chunk_shape"][2] = 1 << 15


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (remove_chunk, "expected a chunk size above 0, found None: the store is damaged"),
        (
            forget_columns,
            r"expected \(4, 0\) numbers of elements, with ascending frame numbers, found other "
            r"values",
        ),
        (shorten, r"xyz: expected <f4 with room for frame 5, found <f4 of shape \(5, 3, 262144\)"),
        (flatten, r"expected <f4 with room for frame 5, found <f4 of shape \(16, 2, "),
        (widen, r"expected <f4 with room for frame 5, found <f8"),
        (make_larger, "the checksum does not match|found none: the store is damaged"),
        (
            take_completeness,
            "expected a finished store, found an unfinished one: a run is writing it, or was "
            "interrupted",
        ),
        (change_type, "expected the sequence that the store lists"),
        (remove_split, "expected the attribute split, found none: the store is damaged"),
        (change_kind, "expected a field of kind points, found 'values'"),
        (
            make_big_endian,
            r"expected the codecs and chunks that carlasc writes, found something else \(codecs",
        ),
        (change_codec, r"found something else \(codecs bytes, gzip, crc32c\)"),
        (remove_array, "expected an array, found none"),
        (remove_field, "expected the field that the sequence lists, found none"),
    ],
)
def test_wrong_metadata_are_one_clear_error(
    zarr_store: Path, change: Callable[[dict[str, Any]], None], message: str
) -> None:
    before = (zarr_store / "zarr.json").read_bytes()
    try:
        edit_zarr(zarr_store, change)
        with pytest.raises(FormatError, match=message):
            carlasc.open(zarr_store).sequences()[WHOLE].read("points", 5)
    finally:
        (zarr_store / "zarr.json").write_bytes(before)


@pytest.fixture
def hdf5_store(data: Path, tmp_path: Path) -> Path:
    pytest.importorskip("hdf5plugin")
    return pack(data / "Train", tmp_path / "x.h5").out


def edit_hdf5(store: Path, name: str, values: Any, **options: Any) -> None:
    """Replace a data set of one chunk, as another program might."""
    import h5py

    with h5py.File(store, "r+") as file:
        attributes = dict(file[name].attrs)
        del file[name]
        file.create_dataset(name, data=values, **options).attrs.update(attributes)


LABELS = "Town01_Light/cartesian/scans/labels/values"


SEQUENCE = "Town01_Light/cartesian"


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("frames", [0, 1, 2, 2], "expected ascending frame numbers"),
        ("frames", [-1, 1, 2, 5], "expected ascending frame numbers"),
        ("frames", [0, 1, 2, 6], "expected u1 with room for frame 6"),
        ("frames", [0, 1, 2, 2**62], f"expected u1 with room for frame {2**62}"),
        (
            "frames",
            [0, 1, 2],
            r"expected \(3, [0-9]+\) numbers of elements, with ascending frame numbers, found "
            r"other values",
        ),
        ("counts", [0, 1, 777, 2**40], "expected u1 with room for frame 5"),
        (
            "counts",
            [1, 1, 777, 1001],
            r"frame 0.*expected chunk 0 of .*values, found none: the store is damaged",
        ),
        (
            "counts",
            [0, 1, 777, 16385],
            r"frame 5.*expected chunk 81 of .*values, found none: the store is damaged",
        ),
    ],
)
def test_wrong_frames_and_counts_are_one_clear_error(
    hdf5_store: Path, name: str, values: list[int], message: str
) -> None:
    import h5py

    with h5py.File(hdf5_store) as file:
        assert file[LABELS].shape == (6, 16 * 16384)
        assert file[SEQUENCE]["frames"][:].tolist() == [0, 1, 2, 5]
        columns = json.loads(file[SEQUENCE]["counts"].attrs["columns:json"])
        counts, place = file[SEQUENCE]["counts"][:], columns.index("scans/labels/values")
    assert counts[:, place].tolist() == [0, 1, 777, 1001]
    wrong = np.array(values, np.int64)
    if name == "counts":
        counts[:, place] = wrong
        wrong = counts
    edit_hdf5(hdf5_store, f"{SEQUENCE}/{name}", wrong)
    sequence = carlasc.open(hdf5_store).sequences()[SEQUENCE]
    with pytest.raises(FormatError, match=message):
        sequence.read_many("labels", sequence.frames("labels"))


def test_an_index_beyond_the_palette_is_one_clear_error(hdf5_store: Path) -> None:
    import h5py

    with h5py.File(hdf5_store) as file:
        columns = json.loads(file[SEQUENCE]["counts"].attrs["columns:json"])
        counts, place = file[SEQUENCE]["counts"][:], columns.index("scans/flow/palette")
    assert counts[3, place] == 4  # frame 5 has four distinct vectors
    counts[3, place] -= 1
    edit_hdf5(hdf5_store, f"{SEQUENCE}/counts", counts)
    sequence = carlasc.open(hdf5_store).sequences()[SEQUENCE]
    with raises(FormatError, where="field flow, frame 5", expected="indices below 3", found="3"):
        sequence.read("flow", 5)
    assert len(sequence.read("flow", 2)) == 777


def test_chunks_that_are_missing_are_one_clear_error(hdf5_store: Path) -> None:
    import h5py

    with h5py.File(hdf5_store) as file:
        checksums = file[f"{LABELS}_crc32c"][:]
    for wrong in (checksums[:-1], np.append(checksums, checksums[:1])):
        edit_hdf5(hdf5_store, f"{LABELS}_crc32c", wrong)
        with pytest.raises(FormatError, match=rf"expected {len(wrong)} chunks, found 3"):
            carlasc.open(hdf5_store).sequences()[SEQUENCE].read("labels", 2)


def test_bytes_that_cannot_be_decoded_name_field_and_frame(hdf5_store: Path) -> None:
    import google_crc32c
    import h5py

    with h5py.File(hdf5_store) as file:
        info = file[LABELS].id.get_chunk_info(1)
        checksums = file[f"{LABELS}_crc32c"][:]
    content = bytearray(hdf5_store.read_bytes())
    content[info.byte_offset : info.byte_offset + 16] = b"\xff" * 16
    checksums[1] = google_crc32c.value(
        bytes(content[info.byte_offset : info.byte_offset + info.size])
    )
    hdf5_store.write_bytes(content)
    edit_hdf5(hdf5_store, f"{LABELS}_crc32c", checksums)
    sequence = carlasc.open(hdf5_store).sequences()["Town01_Light/cartesian"]
    with pytest.raises(FormatError, match="field labels, frame 2: its bytes: cannot be decoded"):
        sequence.read("labels", 2)


@pytest.mark.parametrize(
    "options", [{}, {"chunks": (10,)}, {"chunks": (10,), "compression": "gzip"}], ids=str
)
def test_a_data_set_without_the_filter_is_one_clear_error(
    hdf5_store: Path, options: dict[str, Any]
) -> None:
    edit_hdf5(hdf5_store, LABELS, np.zeros(30, np.uint8), **options)
    with raises(FormatError, expected="a chunked data set with the Blosc filter"):
        carlasc.open(hdf5_store).sequences()["Town01_Light/cartesian"].read("labels", 2)


@pytest.mark.parametrize("rows", [[0, 1, 776, 1002], [1, 1, 776, 1001]])
def test_a_table_whose_footer_counts_other_rows_is_one_clear_error(
    data: Path, tmp_path: Path, rows: list[int]
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    pack(data, tmp_path / "x.parquet")
    path = tmp_path / "x.parquet" / WHOLE / "labels.parquet"
    table = parquet.ParquetFile(path)
    about = json.loads(table.metadata.metadata[b"carlasc"]) | {"rows": rows}
    groups = [table.read_row_group(number) for number in range(table.num_row_groups)]
    with parquet.ParquetWriter(path, table.schema_arrow) as writer:
        for group in groups:
            writer.write_table(group)
        writer.add_key_value_metadata({"carlasc": json.dumps(about)})
    seal_tables(path.parent)
    with pytest.raises(FormatError, match="frame 2.*expected 776 rows, found"):
        carlasc.open(tmp_path / "x.parquet").sequences()[WHOLE].read("labels", 2)


def blosc_header(**changes: int) -> bytes:
    """Return a chunk of 100 zeros with other numbers in its header."""
    blosc = pytest.importorskip("numcodecs.blosc")
    data = bytes(blosc.compress(np.zeros(100, "u1"), b"zstd", 5, 0))
    names = ("version", "codec", "flags", "type", "decoded", "block", "encoded")
    values = dict(zip(names, struct.unpack_from("<4B3I", data), strict=True)) | changes
    return struct.pack("<4B3I", *values.values()) + data[16:]


def refuse_chunk(data: bytes) -> None:
    out = np.full(100, 7, np.uint8)
    with pytest.raises(FormatError, match="its bytes: cannot be decoded"):
        Encoding().decode(data, out)
    assert (out == 7).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [("decoded", 99), ("decoded", 101), ("encoded", 2**32 - 1), ("block", 0), ("block", 2**31)],
)
def test_what_the_header_of_a_chunk_says_is_not_believed(name: str, value: int) -> None:
    # of 99 bytes, Blosc would leave the last one as it is
    refuse_chunk(blosc_header(**{name: value}))


def test_a_chunk_that_is_cut_short_is_refused() -> None:
    whole = blosc_header()
    for size in (0, 15, len(whole) - 1):
        refuse_chunk(whole[:size])
    out = np.full(100, 7, np.uint8)
    Encoding().decode(whole, out)
    assert not out.any()


def test_fewer_numbers_than_a_chunk_has_are_not_taken_for_all() -> None:
    pytest.importorskip("pcodec")
    encoding = Encoding("pcodec", 8)
    data = encoding.encode(np.arange(50, dtype="<i4"))
    for count in (49, 51):
        with pytest.raises(
            FormatError, match=r"its bytes: cannot be decoded: \d+ elements instead of"
        ):
            encoding.decode(data, np.empty(count, "<i4"))


def test_an_hdf5_store_shows_no_other_file(hdf5_store: Path, tmp_path: Path) -> None:
    import h5py

    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["secret"] = np.frombuffer(b"secret", "u1")
    (tmp_path / "secret.bin").write_bytes(b"secret")
    name = "Town01_Light/cartesian/documents/poses.txt"
    plan = h5py.VirtualLayout((6,), "u1")
    plan[:] = h5py.VirtualSource(tmp_path / "other.h5", "secret", (6,))
    makers: dict[str, Callable[[Any], object]] = {
        "a link to another file": lambda file: file.__setitem__(
            name, h5py.ExternalLink(tmp_path / "other.h5", "secret")
        ),
        "values in other files": lambda file: file.create_virtual_dataset(name, plan),
        "found values in other": lambda file: file.create_dataset(
            name, (6,), "u1", external=[(str(tmp_path / "secret.bin"), 0, 6)]
        ),
        "a symbolic link": lambda file: file.__setitem__(name, h5py.SoftLink("/elsewhere")),
    }
    for message, make in makers.items():
        with h5py.File(hdf5_store, "r+") as file:
            del file[name]
            make(file)
        with pytest.raises(FormatError, match=message):
            carlasc.open(hdf5_store).sequences()["Town01_Light/cartesian"].read_document(
                "poses.txt"
            )


def test_a_chunk_of_an_hdf5_store_that_unpacks_to_more_than_its_array_is_refused(
    hdf5_store: Path,
) -> None:
    import h5py

    name = f"{SEQUENCE}/frames"
    with h5py.File(hdf5_store, "r+") as file:
        attributes = dict(file[name].attrs)
        del file[name]
        frames = file.create_dataset(name, (4,), "<i8", chunks=(4,), compression="gzip")
        frames.attrs.update(attributes)
        # Level 9 gives 16 kB: HDF5 1.14 takes at most 64 kB for a chunk as small as this one.
        frames.id.write_direct_chunk((0,), zlib.compress(bytes(1 << 24), 9))
    with pytest.raises(
        FormatError,
        match=f"{name}: expected 32 bytes, found another size: carlasc did not write this",
    ):
        carlasc.open(hdf5_store).sequences()["Town01_Light/cartesian"].frames("labels")
