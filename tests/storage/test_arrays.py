import io
import struct
import time
import tracemalloc
import zipfile

import numpy as np
import pytest
from helpers.errors import raises

from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import layout
from carlasc.storage.arrays import NUMBERS, ArrayFormat, open_npz, parse_npy, read_npy

ROWS = ArrayFormat(("<f4",), (None, 3))


def npy(array):
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def with_header(text, values=b"", version=1):
    length = struct.pack("<H" if version == 1 else "<I", len(text))
    return b"\x93NUMPY" + bytes([version, 0]) + length + text + values


def npz(**arrays):
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def bomb(shape, dtype, size, name="voxel"):
    """Return an .npz whose header claims a shape, and whose member unpacks to `size` zeros after
    the header.
    """
    buffer = io.BytesIO()
    header = {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": shape}
    with (
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open(f"{name}.npy", "w", force_zip64=True) as member,
    ):
        np.lib.format.write_array_header_1_0(member, header)
        zeros = bytes(1 << 22)
        for _ in range(size // len(zeros)):
            member.write(zeros)
    return buffer.getvalue()


@pytest.mark.parametrize("order", "CF")
def test_an_array_comes_back_in_c_order(tmp_path, order):
    array = np.asarray(np.arange(12, dtype="<f4").reshape(4, 3), order=order)
    (tmp_path / "a.npy").write_bytes(npy(array))
    with open_npz(npz(a=array), "a.npz") as archive:
        for found in (
            parse_npy(npy(array), ROWS, "a"),
            read_npy(tmp_path / "a.npy", ROWS),
            archive.read("a", ROWS),
        ):
            assert found.flags.c_contiguous
            assert found.dtype == array.dtype
            assert np.array_equal(found, array)


def test_an_empty_list_counts_as_rows_and_a_single_value_as_an_array_of_any_shape():
    assert parse_npy(npy(np.empty(0, "<f4")), ROWS, "a").shape == (0, 3)
    with open_npz(npz(step=np.float64(0.2)), "a.npz") as archive:
        assert float(archive.read("step", ArrayFormat(NUMBERS, None, 3))) == 0.2


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (npy(np.zeros((2, 3))), "expected float32 values, found float64"),
        (npy(np.zeros((2, 3), ">f4")), "expected float32 values"),
        (npy(np.zeros((2, 4), "<f4")), "expected an array of N x 3 values, found 2 x 4"),
        (npy(np.zeros(3, "<f4")), "expected an array of N x 3 values, found 3"),
        (
            npy(np.zeros((2, 3), "<f4"))[:-1],
            r"expected 152 bytes \(2 x 3 float32\), found 151: the file is cut short",
        ),
        (npy(np.zeros((2, 3), "<f4")) + b"x", "expected 152 bytes"),
        (b"", "expected a .npy array, found something else"),
        (b"PK nonsense", "expected a .npy array, found something else"),
        (
            with_header(b"{'descr': '<f4', 'fortran_order': False, 'shape': (3"),
            "expected a .npy array",
        ),
        (with_header(b"{'descr': '<f4', \n'fortran_order': (", version=2), "expected a .npy array"),
        (with_header(b"(" * 9000), "expected a .npy array"),
        (with_header(b"-" * 9000 + b"1"), "expected a .npy array"),
        (with_header(b"{}" * 20_000, version=2), "expected a .npy array"),
        (
            with_header(b"{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 3)}"),
            "found -1 x 3",
        ),
        (
            with_header(b"{'descr': '<f4', 'fortran_order': False, 'shape': (10**9, 3)}"),
            "expected a .npy array",
        ),
        (
            with_header(
                b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000000, 3)}"
            ),
            "expected 1200000",
        ),
        (
            with_header(
                b"{'descr': '<f4', 'fortran_order': False, 'shape': (" + b"9" * 4000 + b", 3)}"
            ),
            "fits into memory",
        ),
        (
            with_header(
                b"{'descr': '|O', 'fortran_order': False, 'shape': (1, 3)}", b"cos\nsystem\n"
            ),
            "found object",
        ),
        (
            with_header(b"{'descr': [('a', '|O')], 'fortran_order': False, 'shape': (1, 3)}"),
            "expected float32 values",
        ),
        (
            npy(np.zeros((2, 3), "<f4"))[:6] + b"\x03\x00" + npy(np.zeros((2, 3), "<f4"))[8:],
            "version",
        ),
    ],
)
def test_another_array_or_none_is_one_clear_error(data, message):
    with pytest.raises(FormatError, match=message) as caught:
        parse_npy(data, ROWS, "a.npy")
    assert str(caught.value).startswith("a.npy: ")
    assert "\n" not in str(caught.value)


def test_a_file_that_is_missing_or_is_longer_than_its_header_says_is_not_read(tmp_path):
    with raises(MissingDataError, where=r"a\.npy", expected="a file", found="nothing"):
        read_npy(tmp_path / "a.npy", ROWS)
    (tmp_path / "a.npy").write_bytes(npy(np.zeros((2, 3), "<f4")) + bytes(9))
    with raises(FormatError, where=r"a\.npy", expected="152 bytes", found="161"):
        read_npy(tmp_path / "a.npy", ROWS)
    (tmp_path / "folder.npy").mkdir()
    with pytest.raises(FormatError, match=r"folder\.npy: cannot be read: Is a directory"):
        read_npy(tmp_path / "folder.npy", ROWS)


def read_votes(data, shape=(128, 128, 8)):
    return layout.field_named("evaluation/votes").decode(data, "v.npz", shape)


def peak_of(call):
    """Return the greatest memory in use during a call, in bytes, and the seconds that it took."""
    tracemalloc.start()
    began = time.perf_counter()
    try:
        call()
        return tracemalloc.get_traced_memory()[1], time.perf_counter() - began
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("claimed", "message"),
    [
        (2_500_000_000, "expected at most 33554432 values, found 2500000000"),  # what it unpacks to
        (25, "found 268435"),  # less than it unpacks to
    ],
)
def test_votes_that_unpack_to_more_than_a_grid_has_cost_neither_memory_nor_time(claimed, message):
    data = bomb((claimed,), "u1", 1 << 28, "label")

    def refused():
        with pytest.raises(FormatError, match=f"v.npz: label: .*{message}"):
            read_votes(data)

    refused()
    peak, elapsed_s = peak_of(refused)
    assert peak < len(data) + (1 << 20)
    assert elapsed_s < 0.5


def test_an_array_that_is_packed_a_thousand_times_is_refused_where_nothing_else_bounds_it():
    size = 1 << 27
    with (
        open_npz(bomb((size,), "u1", size), "v.npz") as archive,
        raises(
            FormatError,
            where="v.npz: voxel",
            expected="at most 100 times the",
            advice="made to fill the memory",
        ),
    ):
        archive.read("voxel", ArrayFormat(("u1",), (None,)))
    zeros = 1 << 25  # a flow of zeros is packed as well
    with open_npz(bomb((zeros,), "u1", zeros), "v.npz") as archive:
        assert not archive.read("voxel", ArrayFormat(("u1",), (None,))).any()


def test_a_member_that_the_zip_calls_longer_than_it_is_is_refused():
    good = npz(label=np.zeros(50_000, "u1"))
    claims_more = edit(good, 24, struct.pack("<I", 60_128))
    with raises(
        FormatError, where="v.npz: label", expected=r"50128 bytes \(50000 uint8\)", found="60128"
    ):
        read_votes(claims_more)
    with zipfile.ZipFile(io.BytesIO(good)) as archive:
        packed = archive.infolist()[0].compress_size
    with pytest.raises(FormatError, match="v.npz: label: expected "):
        read_votes(edit(good, 20, struct.pack("<I", packed // 2)))


def test_columns_of_different_lengths_are_not_votes():
    table = {"label": np.zeros(3, "u1"), "voxel": np.zeros(2, "<i4"), "votes": np.zeros(3, "<u2")}
    with raises(FormatError, where="v.npz: voxel", expected="an array of 3 values", found="2"):
        read_votes(npz(**table))
    with raises(FormatError, where="v.npz", expected="an array votes", found="label, voxel"):
        read_votes(npz(label=np.zeros(3, "u1"), voxel=np.zeros(3, "<i4")))
    with raises(FormatError, where="v.npz: votes", expected="uint16 values", found="object"):
        read_votes(
            npz(label=np.zeros(1, "u1"), voxel=np.zeros(1, "<i4"), votes=np.array([{}], object))
        )


def edit(data, offset, value):
    """Change bytes of each member's header and of each record of the central directory: `offset` is
    that of the latter.
    """
    changed = bytearray(data)
    place = data.index(b"PK\x01\x02")
    while place >= 0:
        changed[place + offset : place + offset + len(value)] = value
        place = data.find(b"PK\x01\x02", place + 4)
    return bytes(changed)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "expected an .npz file"),
        (npy(np.zeros(3)), "expected an .npz file, found something else .*"),
        (npz(label=np.zeros(9, "u1"))[:-9], "expected an .npz file"),
        (
            edit(npz(label=np.zeros(9, "u1")), 8, b"\x01\x00"),
            "label: expected a stored or deflated array, found an enc",
        ),
        (edit(npz(label=np.zeros(9, "u1")), 10, b"\x0c\x00"), "label: .* found compression 12"),
        (
            edit(npz(label=np.zeros(9, "u1")), 6, b"\xd2\x00"),
            "expected an .npz file, .*zip file version 21.0",
        ),
        (edit(npz(label=np.zeros(9, "u1")), 16, b"oops"), "label: expected a .npy array.*CRC"),
        (
            edit(npz(label=np.zeros(9, "u1")), 42, b"\x09\x00"),
            "label: expected a .npy array in a whole zip",
        ),
    ],
)
def test_a_zip_that_numpy_does_not_write_is_one_clear_error(data, message):
    with pytest.raises(FormatError, match=f"v.npz: {message}") as caught:
        read_votes(data)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", range(4))
def test_damage_anywhere_gives_an_error_of_one_line_or_changes_nothing_that_can_be_told(seed):
    rng = np.random.default_rng(seed)
    good = npz(
        **{
            n: np.arange(500).astype(t)
            for n, t in (("label", "u1"), ("voxel", "<i4"), ("votes", "<u2"))
        }
    )
    refused = 0
    for _ in range(100):
        damaged = bytearray(good)
        for place in rng.integers(0, len(good), 3):
            damaged[place] ^= int(rng.integers(1, 256))
        try:
            read_votes(bytes(damaged))
        except FormatError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 30
