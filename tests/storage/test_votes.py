"""Files of votes: read by NumPy, the same bytes each time, and hardly larger than NumPy's own."""

import io
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from carlasc.storage import field_files, layout
from carlasc.storage.arrays import ArrayFormat, npz_bytes, open_npz

FIELD = layout.field_named("evaluation/votes")


def by_numpy(votes):
    buffer = io.BytesIO()
    np.savez_compressed(buffer, voxel=votes["voxel"], label=votes["label"], votes=votes["votes"])
    return buffer.getvalue()


def votes_of_a_street(seed=0):
    """Return votes as common as at 0.1 m: columns of free voxels above a road, of one vote to
    eight, a class in every seventh.
    """
    rng = np.random.default_rng(seed)
    free = np.flatnonzero(
        np.repeat(rng.random(20_000) < 0.6, 30) & (np.arange(600_000) % 30 > rng.integers(3, 12))
    )
    hit = rng.choice(600_000, len(free) // 7, replace=False)
    votes = np.empty(len(free) + len(hit), field_files.VOTES_DTYPE)
    votes["voxel"] = np.concatenate([free, hit])
    votes["label"] = np.concatenate(
        [np.zeros(len(free)), rng.choice([1, 6, 7, 9], len(hit), p=(0.3, 0.1, 0.5, 0.1))]
    )
    votes["votes"] = np.minimum(rng.geometric(0.5, len(votes)), 20)
    return votes[np.lexsort((votes["label"], votes["voxel"]))]


@pytest.mark.parametrize("dtype", [field_files.VOTES_DTYPE, field_files.WIDE_VOTES_DTYPE])
@pytest.mark.parametrize("count", [0, 1, 5000])
def test_numpy_reads_the_columns_and_their_types(dtype, count):
    votes = votes_of_a_street()[:count].astype(dtype)
    with np.load(io.BytesIO(FIELD.encode(votes, "x")), allow_pickle=False) as file:
        assert file.files == ["voxel", "label", "votes"]
        for name in file.files:
            assert file[name].dtype == dtype[name]
            assert np.array_equal(file[name], votes[name])


def test_the_file_is_that_of_numpy_but_for_the_level():
    votes = votes_of_a_street()
    assert npz_bytes({name: (votes[name], 6) for name in ("voxel", "label", "votes")}) == by_numpy(
        votes
    )
    with (
        zipfile.ZipFile(io.BytesIO(FIELD.encode(votes, "x"))) as ours,
        zipfile.ZipFile(io.BytesIO(by_numpy(votes))) as theirs,
    ):
        assert [ours.read(name) for name in ours.namelist()] == [
            theirs.read(name) for name in theirs.namelist()
        ]
        for mine, other in zip(ours.infolist(), theirs.infolist(), strict=True):
            assert (mine.filename, mine.date_time, mine.CRC) == (
                other.filename,
                other.date_time,
                other.CRC,
            )
            assert mine.compress_size != other.compress_size


def test_the_same_votes_are_the_same_bytes():
    votes = votes_of_a_street()
    apart = np.repeat(votes, 2)[::2]  # with gaps in memory
    assert FIELD.encode(votes, "x") == FIELD.encode(votes.copy(), "x") == FIELD.encode(apart, "x")


def test_fast_levels_cost_few_bytes():
    votes = votes_of_a_street()
    assert len(FIELD.encode(votes, "x")) < 1.06 * len(by_numpy(votes))


@given(
    arrays(st.sampled_from(["<f4", "u1", "<i4"]), array_shapes(min_dims=0, max_dims=3)),
    st.integers(1, 9),
)
@settings(deadline=None)
def test_any_array_comes_back_at_any_level(array, level):
    data = npz_bytes({"a": (array, level)})
    with open_npz(data, "a.npz") as archive:
        assert (
            archive.read("a", ArrayFormat((array.dtype.str,), array.shape)).tobytes()
            == array.tobytes()
        )
    assert np.load(io.BytesIO(data))["a"].tobytes() == array.tobytes()
