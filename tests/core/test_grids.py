import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import carlasc
from carlasc.core import VoxelFlag
from carlasc.core.grids import Grid, GridSpec, is_confident
from carlasc.errors import ArgumentError, FormatError
from carlasc.storage.files import parse_json, to_json

PI32 = float(np.float32(np.pi))
PUBLISHED = ["coarse", "fine", "cylindrical"]

sizes = st.tuples(*[st.integers(1, 40)] * 3)
widths = st.tuples(*[st.floats(0.5, 60, width=32)] * 3)
lowers = st.tuples(*[st.floats(-50, 50, width=32)] * 3)


@st.composite
def specs(draw):
    size, lower, width = draw(sizes), draw(lowers), draw(widths)
    if draw(st.booleans()):
        return GridSpec(
            "cartesian",
            size,
            lower,
            tuple(float(np.float32(a + w)) for a, w in zip(lower, width, strict=True)),
        )
    radius = abs(lower[0])
    start = draw(st.floats(-PI32, 0, width=32))
    return GridSpec(
        "cylindrical",
        size,
        (radius, start, -2.0),
        (radius + 1 + width[0], min(start + width[1], start + 2 * math.pi), 1.0),
    )


@pytest.mark.parametrize("name", PUBLISHED)
def test_params_go_in_and_out_with_their_numbers_untouched(name):
    spec = GridSpec.published(name)
    assert GridSpec.from_params(parse_json(to_json(spec.to_params()), "x")) == spec


def test_the_golden_params_are_those_of_the_presets(golden_capture):
    for folder, name in (
        ("cartesian", "coarse"),
        ("cartesian_fine", "fine"),
        ("cylindrical", "cylindrical"),
    ):
        params = parse_json(
            (golden_capture / folder / "evaluation" / "params.json").read_bytes(), folder
        )
        assert GridSpec.from_params(params) == GridSpec.published(name)
        assert GridSpec.published(name).to_params() == params


@given(specs())
def test_the_centre_of_each_cell_is_in_that_cell(spec):
    centers = spec.centers().reshape(-1, 3)
    cells, inside = spec.index(centers)
    assert inside.all()
    assert (np.ravel_multi_index(tuple(cells.T), spec.size) == np.arange(spec.num_voxels)).all()


@given(specs(), st.integers(0, 2**32 - 1))
def test_a_point_lies_between_the_edges_of_its_cell(spec, seed):
    points = np.random.default_rng(seed).uniform(-60, 60, (200, 3))
    axes = spec.to_axes(points)
    cells, inside = spec.index(axes)
    flat = spec.flat_index(points)
    assert ((flat >= 0) == inside).all()
    for axis in range(3):
        edges, where = spec.edges(axis), cells[inside, axis]
        assert (axes[inside, axis] >= edges[where] - 1e-9).all()
        assert (axes[inside, axis] <= edges[where + 1] + 1e-9).all()


@given(specs())
def test_from_axes_undoes_to_axes(spec):
    centers = spec.centers().reshape(-1, 3)
    assert np.allclose(spec.to_axes(spec.from_axes(centers)), centers, atol=1e-9)


def test_bounds_are_half_open():
    spec = GridSpec("cartesian", (2, 1, 1), (0, 0, 0), (2, 1, 1))
    cells, inside = spec.index(
        np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [-1e-12, 0, 0], [np.nan, 0, 0]])
    )
    assert inside.tolist() == [True, True, False, False, False]
    assert cells[:2, 0].tolist() == [0, 1]


def test_an_azimuth_of_pi_is_the_last_published_cell_and_the_first_of_exact_bounds():
    backwards = np.array([[-1.0, 0.0, 0.0]])
    published = GridSpec.published("cylindrical")
    exact = GridSpec("cylindrical", (128, 128, 8), (0, -math.pi, -2), (30, math.pi, 1))
    assert published.index(published.to_axes(backwards))[0][0, 1] == 127
    cells, inside = exact.index(exact.to_axes(backwards))
    assert inside.all()
    assert cells[0, 1] == 0


def test_an_azimuth_comes_round_in_a_grid_from_0_to_2_pi():
    spec = GridSpec("cylindrical", (1, 4, 1), (0, 0, -1), (2, 2 * math.pi, 1))
    points = np.array([[1, 0.1, 0], [-0.1, 1, 0], [-1, -0.1, 0], [0.1, -1, 0]])
    assert spec.index(spec.to_axes(points))[0][:, 1].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("resolution", "size", "z"),
    [
        (0.2, (256, 256, 15), (-2, 1)),
        (0.4, (128, 128, 8), (-2, 1.2)),
        (0.1, (512, 512, 30), (-2, 1)),
        ((0.4, 0.4, 0.375), (128, 128, 8), (-2, 1)),
    ],
)
def test_a_resolution_gives_cubic_voxels(resolution, size, z):
    spec = GridSpec.published().with_resolution(resolution)
    assert spec.size == size
    assert np.allclose([spec.lower[2], spec.upper[2]], z)
    assert np.allclose(spec.voxel_size, resolution, rtol=1e-6)
    assert all(v == float(np.float32(v)) for v in (*spec.lower, *spec.upper))


def test_a_resolution_that_does_not_divide_covers_more():
    spec = GridSpec.published().with_resolution(0.3)
    assert spec.size == (171, 171, 10)
    assert np.allclose((spec.lower[0], spec.upper[0]), (-25.65, 25.65))


def test_a_cylindrical_resolution_keeps_the_published_proportion():
    spec = GridSpec.published("cylindrical").with_resolution(0.2)
    assert spec.size == (150, 150, 15)
    assert (spec.lower[1], spec.upper[1]) == (-PI32, PI32)
    one_a_degree = GridSpec.published("cylindrical").with_resolution((0.5, math.radians(1), 0.5))
    assert one_a_degree.size == (60, 360, 6)
    assert GridSpec.published("cylindrical").with_resolution(0.7).lower[0] == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ("polar", (1, 1, 1), (0, 0, 0), (1, 1, 1)),
        ("cartesian", (0, 1, 1), (0, 0, 0), (1, 1, 1)),
        ("cartesian", (1, 1, 1), (0, 0, 1), (1, 1, 0)),
        ("cartesian", (1, 1, 1), (0, 0, math.nan), (1, 1, 1)),
        ("cartesian", (1, 1, 1), (0, 0, -math.inf), (1, 1, 1)),
        ("cartesian", (2**11, 2**11, 2**11), (0, 0, 0), (1, 1, 1)),
        ("cylindrical", (1, 1, 1), (-1, 0, 0), (1, 1, 1)),
        ("cylindrical", (1, 1, 1), (0, -4, 0), (1, 4, 1)),
    ],
)
def test_what_makes_no_grid_is_refused(arguments):
    with pytest.raises(ArgumentError):
        GridSpec(*arguments)


@pytest.mark.parametrize("resolution", [0, -1, math.nan, math.inf, (1, 1), (1, 1, 0)])
def test_a_senseless_resolution_is_refused(resolution):
    with pytest.raises(ArgumentError) as error:
        GridSpec.published().with_resolution(resolution)
    assert error.value.where == "resolution"


def test_broken_params_name_the_file():
    good = GridSpec.published().to_params()
    with pytest.raises(FormatError) as error:
        GridSpec.from_params({k: v for k, v in good.items() if k != "min_bound"}, "p.json")
    assert error.value.where == "p.json" and "min_bound" in error.value.expected
    for key, value in {
        "grid_size": [1.5, 1, 1],
        "max_bound": [-30, 1, 1],
        "coordinates": "polar",
        "min_bound": None,
    }.items():
        with pytest.raises(FormatError) as error:
            GridSpec.from_params(good | {key: value}, "p.json")
        assert error.value.where.startswith("p.json")


def test_a_grid_must_have_the_shape_of_its_spec():
    spec = GridSpec("cartesian", (2, 3, 4), (0, 0, 0), (1, 1, 1))
    counts = np.zeros((2, 3, 4), np.float32)
    counts[0, 0, 0] = 2
    grid = Grid(spec, np.zeros((2, 3, 4), np.uint8), counts)
    assert grid.known.sum() == 1
    with pytest.raises(FormatError) as error:
        Grid(spec, np.zeros((2, 3, 4), np.uint8), np.zeros((4, 3, 2)))
    assert error.value.where == "grid counts" and error.value.found == "(4, 3, 2)"


def test_a_spec_pickles():
    spec = GridSpec.published()
    assert pickle.loads(pickle.dumps(spec)) == spec


def test_the_bits_are_those_of_the_format():
    assert [(flag.name, flag.value) for flag in VoxelFlag] == [
        ("INFERRED", 1),
        ("CONTESTED", 2),
        ("SEEN_NOW", 4),
        ("IN_ACTOR", 8),
    ]
    flags = np.array([0, 1, 5, 14, 15], np.uint8)
    assert (flags & carlasc.VoxelFlag.INFERRED != 0).tolist() == [False, True, True, False, True]


@pytest.mark.parametrize(
    ("min_confidence", "expected"),
    [(0, [1, 1, 1, 1, 1]), (0.5, [1, 1, 1, 1, 1]), (0.75, [1, 1, 0, 0, 1]), (0.9, [1, 0, 0, 0, 1])],
)
def test_a_voxel_is_confident_if_it_is_free_or_occupied_with_some_probability(
    min_confidence, expected
):
    occupied = np.array([0.05, 0.25, 0.5, 0.7, 1.0])
    assert is_confident(occupied, min_confidence).tolist() == [bool(value) for value in expected]


def test_confidence_is_that_of_the_file_and_not_a_number_is_none():
    p = np.array([[0.8, np.nan]])
    assert float(np.float16(0.8)) < 0.8
    assert (
        is_confident(p, 0.8).tolist()
        == is_confident(p.astype(np.float16), 0.8).tolist()
        == [[True, False]]
    )
