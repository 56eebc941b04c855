import io
import zipfile

import numpy as np
import pytest
from carlasc_converters.npz import read_arrays

from carlasc.errors import FormatError, MissingDataError


def write(path):
    np.savez_compressed(path, data=np.arange(500, dtype=np.uint16) ** 2, other=np.zeros(3))
    return path


def test_arrays_are_read_in_the_order_of_their_names(tmp_path):
    other, data = read_arrays(write(tmp_path / "a.npz"), ("other", "data"), "copy it again")
    assert other.tolist() == [0, 0, 0]
    np.testing.assert_array_equal(data, np.arange(500, dtype=np.uint16) ** 2)


def test_an_array_file_is_no_archive(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros(3))
    (tmp_path / "a.npy").rename(tmp_path / "a.npz")
    with pytest.raises(
        FormatError, match=r"a\.npz: expected an \.npz file with data, found a file that is incomplete or no"
    ):
        read_arrays(tmp_path / "a.npz", ("data",), "copy it again")


def test_a_missing_file_and_a_missing_array_are_named(tmp_path):
    with pytest.raises(
        MissingDataError, match=r"b\.npz: expected an \.npz file with data, found nothing: unpack it again"
    ):
        read_arrays(tmp_path / "b.npz", ("data",), "unpack it again")
    with pytest.raises(FormatError, match=r"expected an \.npz file with data, labels, found data, other"):
        read_arrays(write(tmp_path / "a.npz"), ("data", "labels"), "copy it again")


def test_pickled_arrays_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", data=np.array([{"a": 1}], object))
    with pytest.raises(FormatError, match="allow_pickle=False"):
        read_arrays(tmp_path / "a.npz", ("data",), "copy it again")


@pytest.mark.parametrize("seed", range(4))
def test_damage_anywhere_gives_an_error_of_one_line_or_changes_nothing_that_can_be_told(tmp_path, seed):
    rng, good = np.random.default_rng(seed), write(tmp_path / "a.npz").read_bytes()
    refused = 0
    for _ in range(60):
        damaged = bytearray(good)
        for place in rng.integers(0, len(good), 3):
            damaged[place] ^= int(rng.integers(1, 256))
        (tmp_path / "a.npz").write_bytes(damaged)
        try:
            read_arrays(tmp_path / "a.npz", ("data",), "copy it again")
        except FormatError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 20


def test_a_version_of_zip_that_nobody_knows_is_damage(tmp_path):
    data = bytearray(write(tmp_path / "a.npz").read_bytes())
    entry = data.index(zipfile.stringCentralDir)
    data[entry + 6] = 210  # the version that is needed to extract, times 10
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(NotImplementedError):
        zipfile.ZipFile(io.BytesIO(data))
    with pytest.raises(FormatError, match="found a damaged one .*copy it again"):
        read_arrays(tmp_path / "a.npz", ("data",), "copy it again")
