"""Augmentations: every field is where an independent transform of the data puts it."""

import copy
import math
import sys

import numpy as np
import pytest
from helpers.datasets.drives import write_drive
from helpers.errors import raises
from hypothesis import given, settings
from hypothesis import strategies as st

from carlasc import Augment, Dataset, Flip, GridSpec
from carlasc.dataset.transforms import Placement, moved
from carlasc.dataset.visibility import stack_visibility
from carlasc.errors import ArgumentError, FormatError

SQUARE = GridSpec("cartesian", (12, 12, 4), (-9.0, -9.0, -2.0), (9.0, 9.0, 1.0))
RING = GridSpec("cylindrical", (8, 16, 4), (0.5, -np.pi, -2.0), (20.0, np.pi, 1.0))
FIELDS = ("occupancy", "density", "labels", "known", "counts", "points", "point_labels", "flow")
FIELDS += ("remission", "poses")
CHANGES = {
    "rotation": {"rotate_rad": math.pi},
    "chosen angles": {"rotate_rad": (0.1, 2.0)},
    "scale": {"scale": 0.3},
    "translation": {"translate_m": (2, 3, 0.5)},
    "drop": {"drop": 0.8},
    "flip": {"directions": "xy"},
    "all": {
        "directions": "xy",
        "rotate_rad": 0.8,
        "scale": 0.1,
        "translate_m": 1.5,
        "drop": 0.3,
    },
}


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    root = tmp_path_factory.mktemp("drive")
    write_drive(root / "A" / "cartesian", range(5), spec=SQUARE, seed=1)
    return root


def cells_of(points, spec):
    """Return the C-order cell of each point, by the definition of the format; -1 outside."""
    axes = np.array(points, np.float64)
    if spec.coordinates == "cylindrical":
        axes[:, 0], axes[:, 1] = np.hypot(*points[:, :2].T), np.arctan2(points[:, 1], points[:, 0])
    size = np.array(spec.size)
    cells = np.floor((axes - spec.lower) / (np.subtract(spec.upper, spec.lower) / size)).astype(int)
    inside = ((cells >= 0) & (cells < size)).all(axis=1)
    flat = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    return np.where(inside, flat, -1)


def parts_of(matrix):
    """Return the linear part and the shift of a placement, which is a similarity about z."""
    linear, shift = matrix[:3, :3], matrix[:3, 3]
    factor = abs(np.linalg.det(linear)) ** (1 / 3)
    np.testing.assert_allclose(linear @ linear.T, factor**2 * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(linear[2], [0, 0, factor], atol=1e-12)
    return linear, shift, factor


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("seed", range(3))
def test_every_field_is_where_the_change_puts_it(drive, change, seed):
    plain = Dataset(drive, history=3, fields=FIELDS)
    augment = Augment(**CHANGES[change], probability=0.7, seed=seed)
    after = Dataset(drive, history=3, fields=FIELDS, transform=augment)[3]
    before, placement = plain[3], augment.place("A", 3, SQUARE)
    linear, shift, factor = parts_of(placement.new_T_old)

    kept = [placement.kept(300, age) for age in (2, 1, 0)]
    share = 1 - np.mean(kept)
    assert abs(share - placement.drop) < 0.1 and placement.drop <= CHANGES[change].get("drop", 0)
    own = kept[-1]
    points = before["points"].astype(np.float64)[own] @ linear.T + shift
    np.testing.assert_allclose(after["points"], points, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(after["flow"], before["flow"][own] @ linear.T, rtol=1e-5, atol=1e-5)
    for name in ("point_labels", "remission"):
        np.testing.assert_array_equal(after[name], before[name][own])

    for past, pose in enumerate(before["poses"]):  # scans, binned by hand
        scan = plain[1 + past]["points"].astype(np.float64)[kept[past]]
        cells = cells_of((scan @ pose[:3, :3].T + pose[:3, 3]) @ linear.T + shift, SQUARE)
        counts = np.bincount(cells[cells >= 0], minlength=SQUARE.num_voxels).reshape(SQUARE.size)
        np.testing.assert_array_equal(after["density"][past], counts)
        np.testing.assert_array_equal(after["occupancy"][past], counts > 0)
        moved_scan = scan @ linear.T + shift  # poses bring moved scans together
        pose_after = after["poses"][past]
        np.testing.assert_allclose(
            moved_scan @ pose_after[:3, :3].T + pose_after[:3, 3],
            (scan @ pose[:3, :3].T + pose[:3, 3]) @ linear.T + shift,
            atol=1e-9,
        )

    centres = SQUARE.centers().reshape(-1, 3)
    old = cells_of((centres - shift) @ linear / factor**2, SQUARE)
    for name in ("labels", "known", "counts"):
        expected = np.where(old >= 0, before[name].reshape(-1)[old], 0)
        np.testing.assert_array_equal(after[name].reshape(-1), expected)
        assert after[name].dtype == before[name].dtype
    assert not after["known"].reshape(-1)[old < 0].any()


@pytest.mark.parametrize("turns", range(4))
def test_quarter_turns_of_a_square_grid_are_exact(drive, turns):
    plain = Dataset(drive, fields=("labels", "known", "counts"))
    augment = Augment(rotate_rad=(turns * math.pi / 2,), seed=0)
    sample = Dataset(drive, fields=plain.fields, transform=augment)[0]
    for name in plain.fields:
        np.testing.assert_array_equal(sample[name], np.rot90(plain[0][name], turns))


@given(cells=st.integers(-16, 16), mirrored=st.booleans())
@settings(deadline=None)
def test_a_cylindrical_grid_rotates_exactly_by_whole_cells(cells, mirrored):
    labels = np.random.default_rng(0).integers(0, 9, RING.size)
    angle = cells * 2 * math.pi / 16
    matrix = np.eye(4)
    matrix[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    expected = labels
    if mirrored:
        matrix = matrix @ np.diag([1.0, -1, 1, 1])
        expected = labels[:, ::-1]
    turned = moved({"labels": labels}, Placement(matrix), RING)["labels"]
    np.testing.assert_array_equal(turned, np.roll(expected, cells, axis=1))


@pytest.mark.parametrize("spec", [SQUARE, RING])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_fields_of_actors_and_of_evidence_move_with_their_voxels(spec, seed):
    rng = np.random.default_rng(seed)
    sample = {
        "instances": rng.integers(0, 99, spec.size),
        "occupied": rng.random(spec.size, np.float32),
        "posterior": rng.random((3, *spec.size), np.float32),
        "voxel_flow": rng.normal(0, 5, (*spec.size, 3)).astype(np.float32),
        "visibility": rng.integers(0, 3, (2, *spec.size)).astype(np.uint8),
        "sequence": "A",
        "frame": 0,
    }
    before = copy.deepcopy(sample)
    augment = Augment(spec, "y", rotate_rad=3, scale=0.2, translate_m=1, seed=seed)
    after = augment(sample)
    linear, shift, factor = parts_of(augment.place("A", 0, spec).new_T_old)
    centres = spec.from_axes(spec.centers()).reshape(-1, 3)
    old = cells_of((centres - shift) @ linear / factor**2, spec)
    outside = old < 0
    flat = {
        name: np.reshape(value, (-1, spec.num_voxels))
        for name, value in sample.items()
        if name not in ("voxel_flow", "sequence", "frame")
    }
    for name, values in flat.items():
        made = np.reshape(after[name], values.shape)
        np.testing.assert_array_equal(made[:, ~outside], values[:, old[~outside]])
        assert (made[:, outside] == (0.5 if name == "occupied" else 0)).all()
    flow = np.where(outside[:, None], 0, sample["voxel_flow"].reshape(-1, 3)[old] @ linear.T)
    np.testing.assert_allclose(after["voxel_flow"].reshape(-1, 3), flow, atol=1e-4)
    for name, value in before.items():
        np.testing.assert_array_equal(sample[name], value)  # the input is unchanged


def test_rays_are_traced_from_the_moved_sensor():
    rng = np.random.default_rng(0)
    points = rng.normal(0, (5, 5, 1), (500, 3)).astype(np.float32)
    turn = np.eye(4)
    turn[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    turn[:3, 3] = 1, -2, 0.2
    stretch = np.diag([1.2, -1.2, 1.2, 1.0])
    made = stack_visibility([points], (turn @ stretch)[None], SQUARE)
    by_hand = stack_visibility([points * np.float32([1.2, -1.2, 1.2])], turn[None], SQUARE)
    assert (made != by_hand).mean() < 1e-3 and len(np.unique(made)) == 3


def test_grids_that_do_not_fit_are_refused(drive):
    dataset = Dataset(drive)
    for flip in (Flip(), Flip(None)):
        with raises(ArgumentError, where="^spec$", expected="the grid of the samples"):
            [flip(dataset[i]) for i in range(5)]
        dataset.transform = flip  # a Dataset knows its grid
        assert len(list(dataset)) == 5
    dataset.transform = Flip(RING)
    with raises(ArgumentError, where="^spec$", expected="cartesian", found="cylindrical"):
        dataset[0]
    dataset.transform = None
    with raises(ArgumentError, where="^spec$", expected="12, 12, 4"):
        Flip(RING, probability=1)(dataset[0])
    with raises(ArgumentError, where="^drop$", found="occupancy"):
        Augment(SQUARE, drop=0.5)(dataset[0])


WRONG = [
    {"spec": 0},
    {"directions": 1},
    {"directions": "z"},
    {"probability": "often"},
    {"rotate_rad": "pi"},
    {"rotate_rad": ()},
    {"scale": 2},
    {"scale": -0.1},
    {"translate_m": (1, 2)},
    {"translate_m": math.nan},
    {"drop": 1.5},
    {"seed": 0.5},
]


@pytest.mark.parametrize("wrong", WRONG, ids=str)
def test_wrong_arguments_are_named(wrong):
    with raises(ArgumentError, where=f"^{next(iter(wrong))}$", expected=".", found="."):
        Augment(**wrong)


def changes(augment):
    return [augment.place("A", frame, None).new_T_old.tolist() for frame in range(20)]


def test_without_a_seed_the_generator_of_numpy_decides_if_torch_is_not_imported(monkeypatch):
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    drawn = []
    for seed in (0, 0, 1):
        np.random.seed(seed)
        drawn.append(changes(Augment(rotate_rad=1)))
    assert drawn[0] == drawn[1] != drawn[2]


def test_without_a_seed_the_generator_of_torch_decides():
    torch = pytest.importorskip("torch")
    drawn = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        drawn.append(changes(Flip()))
    assert drawn[0] == drawn[1] != drawn[2]


def test_axes_are_mirrored_if_they_are_asked_for(tmp_path):
    for name, axes in (("A", "left"), ("B", "right")):
        about = {"axes": axes}
        write_drive(tmp_path / name / "cartesian", range(3), spec=SQUARE, metadata=about, seed=3)
    with raises(FormatError, found="right", advice="`axes`"):
        Dataset(tmp_path)
    data = [Dataset(tmp_path / name, history=2, fields=FIELDS) for name in "AB"]
    assert [one.axes for one in data] == ["left", "right"]
    data[1].axes = "left"
    left, right = data[0][2], data[1][2]  # equal files
    np.testing.assert_array_equal(right["points"], left["points"] * np.float32([1, -1, 1]))
    for name in ("labels", "known", "counts"):
        np.testing.assert_array_equal(right[name], left[name][:, ::-1])
    flipped = Flip(SQUARE, "y", probability=1)(left)
    np.testing.assert_array_equal(right["density"].sum((1, 3)), flipped["density"].sum((1, 3)))
    assert (right["density"] != flipped["density"]).mean() < 0.01  # points on faces of cells
    with raises(ArgumentError, where="^axes$"):
        data[0].axes = "up"
    with raises(ArgumentError, where="flip of y"):
        ahead = GridSpec("cartesian", (4, 4, 4), (0.0, 0.0, -2.0), (8.0, 8.0, 1.0))
        Dataset(tmp_path / "A", grid=ahead, fields=("occupancy",)).axes = "right"


def test_several_sources_are_one_data_set(tmp_path):
    places = [
        write_drive(tmp_path / name / "Train" / "T" / "cartesian", range(n), spec=SQUARE)
        for name, n in (("a", 3), ("b", 2))
    ]
    both = Dataset([tmp_path / "a", tmp_path / "b"], "train", history=2)
    assert [len(frames) for frames in both.frames] == [3, 2]
    assert [str(one.location) for one in both.sequences] == [str(place) for place in places]
    alone = Dataset(tmp_path / "b", history=2)
    np.testing.assert_array_equal(both[4]["occupancy"], alone[1]["occupancy"])
