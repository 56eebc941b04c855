from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.sequences import files_of, write_dataset
from helpers.errors import raises

import carlasc
from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import Source
from carlasc.storage.transport.trees import LocalTree
from carlasc.storage.transport.zipped import ZipTree
from carlasc.testing import SourceContract
from carlasc.testing.data import WHOLE


def write_zip(
    files: dict[str, bytes], path: Path, method: int = zipfile.ZIP_STORED, **flags: bool
) -> Path:
    with zipfile.ZipFile(path, "w", method, **flags) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


class TestStoredZip(SourceContract):
    def build(self, published: Path, folder: Path) -> Source:
        return carlasc.open(write_zip(files_of(published), folder / "data.zip"))


class TestDeflatedZip(SourceContract):
    processes = ("fork",)

    def build(self, published: Path, folder: Path) -> Source:
        # by its signature
        return carlasc.open(write_zip(files_of(published), folder / "data", zipfile.ZIP_DEFLATED))


class TestZipWithAFolderAroundAndFolderEntries(SourceContract):
    processes = ("fork",)

    def build(self, published: Path, folder: Path) -> Source:
        files = {f"Cartesian/{name}": data for name, data in files_of(published).items()}
        folders = {f"{Path(name).parent.as_posix()}/": b"" for name in files}
        source = carlasc.open(write_zip(folders | files, folder / "data.zip", zipfile.ZIP_DEFLATED))
        return _Inside(source)


class _Inside(Source):
    """A source whose paths lost the folder that the zip put around them."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.location = source.location

    def sequences(self):  # type: ignore[no-untyped-def]
        return {
            path.removeprefix("Cartesian/"): sequence
            for path, sequence in self.source.sequences().items()
        }


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return files_of(write_dataset(tmp_path_factory.mktemp("published") / "data"))


@pytest.fixture
def archive(files: dict[str, bytes], tmp_path: Path) -> Path:
    return write_zip(files, tmp_path / "data.zip")


def test_every_member_equals_what_zipfile_reads(archive: Path) -> None:
    tree = ZipTree(LocalTree(archive.parent), archive.name)
    with zipfile.ZipFile(archive) as reference:
        for name in reference.namelist():
            assert bytes(tree.read(name)) == reference.read(name)


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.98])
def test_a_truncated_zip_is_one_clear_error(archive: Path, keep: float) -> None:
    data = archive.read_bytes()
    archive.write_bytes(data[: int(len(data) * keep)])
    with pytest.raises(FormatError, match=r"data\.zip: .*truncated") as caught:
        carlasc.open(archive).sequences()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("offset", "value"),
    [(10, 3), (12, 3), (16, 7), (16, 2**31)],
    ids=["count", "directory size", "directory offset", "offset beyond the end"],
)
def test_a_wrong_end_record_is_one_clear_error(archive: Path, offset: int, value: int) -> None:
    data = bytearray(archive.read_bytes())
    end = data.rindex(b"PK\x05\x06")
    width = "<H" if offset == 10 else "<I"
    struct.pack_into(width, data, end + offset, value)
    archive.write_bytes(data)
    with raises(FormatError, where=r"data\.zip", expected="a zip's central directory"):
        carlasc.open(archive).sequences()


def test_a_damaged_record_of_the_directory_is_one_clear_error(archive: Path) -> None:
    data = bytearray(archive.read_bytes())
    (start,) = struct.unpack_from("<I", data, data.rindex(b"PK\x05\x06") + 16)
    data[data.index(b"PK\x01\x02", start + 4)] ^= 0xFF
    archive.write_bytes(data)
    with pytest.raises(FormatError, match="the record of member 1"):
        carlasc.open(archive).sequences()


def test_a_directory_that_points_elsewhere_names_the_member(
    files: dict[str, bytes], archive: Path
) -> None:
    data = bytearray(archive.read_bytes())
    name = f"{WHOLE}/velodyne/000005.bin".encode()
    record = data.index(b"PK\x01\x02", data.rindex(name) - 46)
    struct.pack_into("<I", data, record + 42, 11)
    archive.write_bytes(data)
    with raises(
        FormatError, where=r"velodyne/000005\.bin", expected="a member's header at byte 11"
    ):
        carlasc.open(archive).sequences()[WHOLE].read("points", 5)


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_flipped_bit_in_a_member_names_it(
    files: dict[str, bytes], tmp_path: Path, method: int
) -> None:
    archive = write_zip(files, tmp_path / "data.zip", method)
    name = f"{WHOLE}/velodyne/000005.bin"
    with zipfile.ZipFile(archive) as reader:
        start = reader.getinfo(name).header_offset + 30 + len(name)
    data = bytearray(archive.read_bytes())
    data[start + 1000] ^= 4
    archive.write_bytes(data)
    sequence = carlasc.open(archive).sequences()[WHOLE]
    with pytest.raises(FormatError, match=r"velodyne/000005\.bin: .*the zip is damaged"):
        sequence.read("points", 5)
    assert len(sequence.read("points", 2)) == 777


@pytest.mark.parametrize(
    "name", ["../evil.bin", "/etc/evil", "a/../../evil", "C:/evil", "a\\..\\evil", "Train\\evil"]
)
def test_names_that_lead_out_of_the_folder_are_refused(
    files: dict[str, bytes], tmp_path: Path, name: str
) -> None:
    archive = write_zip(files | {"x" * len(name): b"evil"}, tmp_path / "data.zip")
    archive.write_bytes(archive.read_bytes().replace(b"x" * len(name), name.encode()))
    with pytest.raises(FormatError, match="the name leads out of the folder"):
        carlasc.open(archive).sequences()


@pytest.mark.parametrize("name", ["a..b.txt", "Train/10:30.txt", "Übersicht.txt"])
def test_harmless_names_with_odd_signs_are_taken(
    files: dict[str, bytes], tmp_path: Path, name: str
) -> None:
    archive = write_zip(files | {name: b"1"}, tmp_path / "data.zip")
    assert len(carlasc.open(archive).sequences()) == 3


def test_compression_of_another_kind_says_to_unpack(
    files: dict[str, bytes], tmp_path: Path
) -> None:
    archive = write_zip(files, tmp_path / "data.zip", zipfile.ZIP_LZMA)
    with pytest.raises(FormatError, match="compression 14: unpack the zip"):
        carlasc.open(archive).sequences()[WHOLE].read("points", 5)


def test_64_bit_sizes_and_offsets_are_read(tmp_path: Path, files: dict[str, bytes]) -> None:
    path = tmp_path / "data.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            with archive.open(name, "w", force_zip64=True) as member:
                member.write(data)
    data = bytearray(path.read_bytes())
    name = f"{WHOLE}/velodyne/000005.bin".encode()
    # rewrite its directory record with the 64-bit extra field, as a 40 GB zip has it
    record = data.rindex(name) - 46
    packed, size = struct.unpack_from("<2I", data, record + 20)
    offset = struct.unpack_from("<I", data, record + 42)[0]
    extra = struct.pack("<2H3Q", 1, 24, size, packed, offset)
    struct.pack_into("<2I", data, record + 20, 2**32 - 1, 2**32 - 1)
    struct.pack_into("<H", data, record + 30, len(extra))
    struct.pack_into("<I", data, record + 42, 2**32 - 1)
    at = record + 46 + len(name)
    data[at:at] = extra
    end = data.rindex(b"PK\x05\x06")
    count, length, start = struct.unpack_from("<H2I", data, end + 10)
    record64 = struct.pack(
        "<4sQ2H2L4Q", b"PK\x06\x06", 44, 45, 45, 0, 0, count, count, length + len(extra), start
    )
    locator = struct.pack("<4sLQL", b"PK\x06\x07", 0, end, 1)
    struct.pack_into("<2H2I", data, end + 8, 2**16 - 1, 2**16 - 1, 2**32 - 1, 2**32 - 1)
    data[end:end] = record64 + locator
    path.write_bytes(data)
    with zipfile.ZipFile(path) as reference:
        wanted = reference.read(name.decode())
    points = carlasc.open(path).sequences()[WHOLE].read("points", 5)
    assert points.tobytes() == wanted == files[name.decode()]


def test_an_empty_zip_says_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match="velodyne"):
        carlasc.open(write_zip({}, tmp_path / "data.zip")).sequences()


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "data.zip").write_bytes(b"<html>sign in first</html>")
    with raises(FormatError, where=r"data\.zip", found="none of these"):
        carlasc.open(tmp_path / "data.zip")
    (tmp_path / "empty.zip").write_bytes(b"")
    with pytest.raises(FormatError, match=r"empty\.zip: .*cut short"):
        carlasc.open(tmp_path / "empty.zip")


def test_a_big_directory_is_opened_without_touching_its_members(tmp_path: Path) -> None:
    count = 3000
    files = {
        f"Train/Town01/cartesian/velodyne/{frame:06d}.bin": np.zeros((1, 4), "<f4").tobytes()
        for frame in range(count)
    }
    archive = write_zip(files, tmp_path / "data.zip")
    data = bytearray(archive.read_bytes())
    directory = data.index(b"PK\x01\x02")
    # local headers and members gone, but for the signature that says zip
    data[: directory - 4] = bytes(directory - 4)
    data[:4] = b"PK\x03\x04"
    archive.write_bytes(data)
    (sequence,) = carlasc.open(archive).sequences().values()
    assert len(sequence.frames("points")) == count


def tiny(tmp_path: Path, method: int = zipfile.ZIP_STORED) -> tuple[Path, bytearray, int, int]:
    """Return a zip of one scan, its bytes, where its directory starts, and where its end record
    does.
    """
    path = write_zip({"velodyne/000000.bin": bytes(range(160))}, tmp_path / "tiny.zip", method)
    data = bytearray(path.read_bytes())
    end = data.rindex(b"PK\x05\x06")
    return path, data, struct.unpack_from("<I", data, end + 16)[0], end


def read_scan(path: Path, data: bytes) -> bytes:
    path.write_bytes(data)
    return carlasc.open(path).sequences()[""].read("points", 0).tobytes()


def test_an_encrypted_member_says_to_unpack(tmp_path: Path) -> None:
    path, data, start, _ = tiny(tmp_path)
    data[start + 8] |= 1
    with raises(FormatError, found="an encrypted one", advice="unpack the zip"):
        read_scan(path, data)


def test_a_part_of_several_zips_says_to_join_them(tmp_path: Path) -> None:
    path, data, _, end = tiny(tmp_path)
    struct.pack_into("<H", data, end + 4, 1)
    with raises(FormatError, found="a part of a split zip", advice="join the parts"):
        read_scan(path, data)


@pytest.mark.parametrize("more", [10, 64, 65, 3000])
def test_a_local_header_may_be_longer_than_the_directory_says(tmp_path: Path, more: int) -> None:
    path, data, start, end = tiny(tmp_path)
    struct.pack_into("<I", data, end + 16, start + more)
    (name,) = struct.unpack_from("<H", data, 26)
    struct.pack_into("<H", data, 28, more)
    data[30 + name : 30 + name] = bytes(more)
    assert read_scan(path, data) == bytes(range(160))


@pytest.mark.parametrize("change", [-1, 1])
def test_a_size_that_is_wrong_in_the_directory_is_damage(tmp_path: Path, change: int) -> None:
    path, data, start, _ = tiny(tmp_path, zipfile.ZIP_DEFLATED)
    struct.pack_into("<I", data, start + 24, 160 + change)
    with pytest.raises(FormatError, match="the zip is damaged"):
        read_scan(path, data)


def widen(data: bytearray, start: int, end: int, extra: bytes) -> bytearray:
    """Give the one member of a zip a size of 64 bits, in this extra field."""
    (name,) = struct.unpack_from("<H", data, start + 28)
    struct.pack_into("<I", data, start + 24, 2**32 - 1)
    struct.pack_into("<H", data, start + 30, len(extra))
    struct.pack_into("<I", data, end + 12, end - start + len(extra))
    place = start + 46 + name
    return data[:place] + extra + data[place:]


@pytest.mark.parametrize(
    ("extra", "fits"),
    [
        (struct.pack("<2HQ", 1, 8, 160), True),
        (struct.pack("<2HI2HQ", 7, 4, 0, 1, 8, 160), True),  # behind a field of another kind
        (struct.pack("<2HQ", 1, 8, 2**63), False),
        (struct.pack("<2HI", 1, 4, 160), False),
        (struct.pack("<2HI", 1, 8, 160), False),
        (struct.pack("<2HQ", 2, 8, 160), False),
        (b"", False),
    ],
)
def test_a_size_of_64_bits_is_read_or_is_one_clear_error(
    tmp_path: Path, extra: bytes, fits: bool
) -> None:
    path, data, start, end = tiny(tmp_path)
    if fits:
        assert read_scan(path, widen(data, start, end, extra)) == bytes(range(160))
    else:
        with raises(FormatError, found="no 64-bit sizes of member 0"):
            read_scan(path, widen(data, start, end, extra))


@pytest.mark.parametrize("offset", [0, 2**40])
def test_a_locator_that_points_elsewhere_is_one_clear_error(tmp_path: Path, offset: int) -> None:
    path, data, _, end = tiny(tmp_path)
    data[end:end] = struct.pack("<4sLQL", b"PK\x06\x07", 0, offset, 1)
    with raises(
        FormatError,
        where=r"tiny\.zip",
        expected="a zip's central directory",
        found=".*64-bit end record",
    ):
        read_scan(path, data)


def test_a_member_beyond_the_directory_is_one_clear_error(tmp_path: Path) -> None:
    path, data, start, _ = tiny(tmp_path)
    struct.pack_into("<I", data, start + 20, 100_000)
    with raises(FormatError, found="a member beyond the directory"):
        read_scan(path, data)


def test_bytes_behind_the_last_record_of_the_directory_are_one_clear_error(tmp_path: Path) -> None:
    path, data, start, end = tiny(tmp_path)
    struct.pack_into("<I", data, end + 12, end - start + 5)
    data[end:end] = bytes(5)
    with raises(FormatError, found="1 members in"):
        read_scan(path, data)


def test_a_range_beyond_the_end_of_a_member_is_one_clear_error(tmp_path: Path) -> None:
    path, _, _, _ = tiny(tmp_path)
    tree = ZipTree(LocalTree(tmp_path), path.name)
    assert bytes(tree.read_range("velodyne/000000.bin", -10, -5)) == bytes(range(150, 155))
    assert bytes(tree.read_range("velodyne/000000.bin", 150, 160)) == bytes(range(150, 160))
    with raises(FormatError, expected="11 bytes in this range", found="10"):
        tree.read_range("velodyne/000000.bin", 150, 161)
    with raises(MissingDataError, expected="a file", found="nothing"):
        tree.read("velodyne/000001.bin")


def test_names_in_utf_8_and_in_the_old_code_page_are_read(tmp_path: Path) -> None:
    path = write_zip({"Übersicht.txt": b"1"}, tmp_path / "x.zip")
    assert set(ZipTree(LocalTree(tmp_path), "x.zip").entries()) == {"Übersicht.txt"}
    data = bytearray(path.read_bytes())
    start = data.rindex(b"PK\x01\x02")
    data[start + 9] &= ~8  # without the flag of UTF-8, the name is one of code page 437
    path.write_bytes(data)
    assert set(ZipTree(LocalTree(tmp_path), "x.zip").entries()) == {
        "Übersicht.txt".encode().decode("cp437")
    }
