import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from carlasc import Run
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError
from carlasc.groundtruth import FromGrid, regrid, resample
from carlasc.groundtruth.from_grid import _boxes
from carlasc.storage import FolderSink, layout
from carlasc.storage.files import to_json


def random_grid(seed, size=(8, 8, 4)):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 4, size).astype(np.uint8)
    counts = rng.integers(0, 3, size).astype(np.float32)
    spec = GridSpec("cartesian", size, (0, 0, 0), (8, 8, 4))
    return Grid(spec, np.where(counts > 0, labels, 0).astype(np.uint8), counts)


@given(st.integers(0, 1000))
def test_where_sizes_divide_it_is_the_exact_majority_of_the_known_cells(seed):
    fine = random_grid(seed)
    coarse = resample(fine, fine.spec.with_size((4, 4, 2)), CARLA)
    for cell in np.ndindex(4, 4, 2):
        block = tuple(slice(2 * i, 2 * i + 2) for i in cell)
        known = fine.counts[block] > 0
        labels = fine.labels[block][known]
        assert coarse.counts[cell] == fine.counts[block].sum()
        assert coarse.labels[cell] == (np.bincount(labels).argmax() if len(labels) else 0)


def test_sizes_that_do_not_divide_go_by_the_centres_of_cells():
    fine = random_grid(1)
    coarse = resample(fine, fine.spec.with_size((3, 8, 4)), CARLA)
    assert coarse.counts.sum() == fine.counts.sum()


def test_cylindrical_grids_resample_too():
    spec = GridSpec.published("cylindrical")
    fine = Grid(
        spec.with_size((16, 16, 4)),
        np.full((16, 16, 4), 7, np.uint8),
        np.ones((16, 16, 4), np.float32),
    )
    coarse = resample(fine, spec.with_size((8, 8, 2)), CARLA)
    assert (coarse.labels == 7).all()
    assert (coarse.counts == 8).all()


def test_what_hides_in_a_coarse_voxel_are_its_occupied_fine_cells():
    fine = random_grid(2)
    labels = np.zeros_like(fine.labels)
    labels[1, 0, 1] = labels[2, 0, 0] = 7
    coarse = fine.spec.with_size(tuple(size // 2 for size in fine.spec.size))
    found = _boxes(Grid(fine.spec, labels, fine.counts), coarse)
    filled = np.flatnonzero(found[:, 0] <= found[:, 3])
    assert filled.tolist() == [0, coarse.size[1] * coarse.size[2]]
    assert found[filled].tolist() == [[128, 0, 128, 255, 127, 255], [0, 0, 0, 127, 127, 127]]


def test_a_finer_or_larger_grid_is_refused():
    fine = random_grid(2)
    with pytest.raises(
        ArgumentError,
        match="expected voxels of at least 1 x 1 x 1.*found 0.5 x 1 x 1.*new measurements",
    ):
        resample(fine, fine.spec.with_size((16, 8, 4)), CARLA)
    with pytest.raises(ArgumentError) as error:
        resample(fine, GridSpec("cylindrical", (2, 2, 2), (0, -math.pi, 0), (8, math.pi, 4)), CARLA)
    assert error.value.where == "resampling" and error.value.found == "a cylindrical one"
    with pytest.raises(ArgumentError) as error:
        resample(fine, GridSpec("cartesian", (4, 4, 2), (-8, 0, 0), (8, 8, 4)), CARLA)
    assert error.value.where == "resampling"


def test_the_finest_grid_of_the_same_coordinates_is_resampled_unless_another_is_named(tmp_path):
    writer = FolderSink(tmp_path).sequence("Val/Street/cartesian")
    writer.write("points", 0, np.ones((1, 4), np.float32))
    for seed, (name, size) in enumerate(
        {"middle": (8, 8, 4), "fine": (16, 16, 8), "last": (8, 8, 4)}.items()
    ):
        grid = random_grid(seed, size)
        writer.write_document(layout.params_file(name), to_json(grid.spec.to_params()))
        writer.write(f"{name}/labels", 0, grid.labels.astype(np.uint32))
        writer.write(f"{name}/counts", 0, grid.counts)
    for observe, chosen in ((FromGrid(), "fine"), (FromGrid("last"), "last")):
        regrid(
            tmp_path,
            random_grid(0).spec.with_size((4, 4, 2)),
            observe=observe,
            name=f"of_{chosen}",
            run=Run(workers=1),
        )
        params = json.loads(
            (tmp_path / f"Val/Street/cartesian/of_{chosen}/params.json").read_bytes()
        )
        assert params["carlasc"]["grid"] == chosen
