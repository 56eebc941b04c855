import numpy as np
import pytest
from carlasc_converters.files import read_arrays

from carlasc.errors import FormatError, MissingDataError
from carlasc.storage.arrays import NUMBERS, ArrayFormat

DATA, OTHER = ArrayFormat(("<u2",), (None,)), ArrayFormat(NUMBERS, (3,))


def write(path):
    np.savez_compressed(path, data=np.arange(500, dtype=np.uint16) ** 2, other=np.zeros(3))
    return path


def test_arrays_are_read_in_the_order_of_their_names(tmp_path):
    other, data = read_arrays(
        write(tmp_path / "a.npz"), {"other": OTHER, "data": DATA}, "copy it again"
    )
    assert other.tolist() == [0, 0, 0]
    np.testing.assert_array_equal(data, np.arange(500, dtype=np.uint16) ** 2)


def test_a_missing_file_and_a_missing_array_are_named_with_advice(tmp_path):
    with pytest.raises(
        MissingDataError, match=r"b\.npz: expected a file, found nothing: unpack it again"
    ):
        read_arrays(tmp_path / "b.npz", {"data": DATA}, "unpack it again")
    with pytest.raises(
        FormatError, match=r"a\.npz: expected an array labels, found data, other: copy it again"
    ):
        read_arrays(write(tmp_path / "a.npz"), {"data": DATA, "labels": DATA}, "copy it again")
