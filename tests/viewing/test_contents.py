import numpy as np
import pytest
from helpers.readers.page_arrays import unpack_arrays
from helpers.readers.pixels import BLUE
from helpers.scenes.road_blocks import add_actors, write_blocks
from hypothesis import given, settings
from hypothesis import strategies as st

from carlasc.core.boxes import Boxes
from carlasc.core.geometry import translation
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.scans import Scan
from carlasc.errors import FormatError
from carlasc.viewing import Scene
from carlasc.viewing.actor_lines import Trail
from carlasc.viewing.page.contents import (
    OFFSET_STEPS,
    encode_actors,
    encode_grid,
    encode_scan,
    open_content,
    pack_arrays,
)
from carlasc.viewing.rendering.drawings import evidence_drawing
from carlasc.viewing.scene import FrameContent

arrays = st.dictionaries(
    st.text(min_size=1, max_size=8),
    st.one_of(
        *(
            st.lists(st.integers(0, np.iinfo(kind).max), max_size=20).map(
                lambda v, k=kind: np.array(v, k)
            )
            for kind in (np.uint8, np.uint16, np.uint32)
        ),
        st.lists(st.floats(width=32, allow_nan=False), max_size=20).map(
            lambda v: np.array(v, np.float32)
        ),
        st.lists(st.integers(-(2**31), 2**31 - 1), max_size=20).map(
            lambda v: np.array(v, np.int32)
        ),
    ),
    max_size=4,
)


@given(arrays)
def test_packed_arrays_come_back(given_arrays):
    found = unpack_arrays(pack_arrays(given_arrays))
    assert list(found) == list(given_arrays)
    for name, array in given_arrays.items():
        assert found[name].dtype == array.dtype
        assert np.array_equal(found[name], array)


@settings(max_examples=60)
@given(
    st.integers(0, 2**31),
    st.booleans(),
    st.sampled_from([1, 200, 3000]),
    st.sampled_from([np.uint8, np.uint16]),
)
def test_a_grid_comes_back(seed, whole, most, kind):
    rng = np.random.default_rng(seed)
    spec = GridSpec("cartesian", (5, 4, 3), (0, 0, 0), (5, 4, 3))
    labels = (
        rng.integers(0, 260 if kind == np.uint16 else 20, spec.size) * (rng.random(spec.size) < 0.4)
    ).astype(kind)
    counts = (rng.integers(0, most, spec.size) * (rng.random(spec.size) < 0.7)).astype(
        np.float32
    ) / (1 if whole else 3)
    found = encode_grid(Grid(spec, labels, counts))
    index = np.cumsum(found["index"].astype(np.int64))
    again = np.zeros(spec.num_voxels, kind)
    again[index] = found["label"]
    assert np.array_equal(again.reshape(spec.size), labels)
    assert np.array_equal(found["votes"].astype(np.float32), counts.reshape(-1)[index])
    turns = np.cumsum(found["unknown"].astype(np.int64))
    unknown = np.searchsorted(turns, np.arange(spec.num_voxels), side="right") % 2 == 1
    assert np.array_equal(unknown.reshape(spec.size), counts == 0)


def test_a_grid_without_counts_has_no_votes():
    spec = GridSpec("cartesian", (2, 2, 2), (0, 0, 0), (1, 1, 1))
    assert set(encode_grid(Grid(spec, np.zeros(spec.size, np.uint8)))) == {"index", "label"}


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.integers(0, 400), st.sampled_from([0.1, 0.2, 1.0]))
def test_a_scan_comes_back_thinned_to_one_point_a_cell(seed, count, cell):
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 1.5, (count, 3)).astype(np.float32)
    labels = rng.integers(0, 23, count).astype(np.uint32)
    found = encode_scan(Scan(points, labels), cell)
    lower, size = found["box"][:3], found["box"][3:]
    cells = (
        np.stack(np.unravel_index(np.cumsum(found["index"].astype(np.int64)), size), axis=1) + lower
    )
    assert len(np.unique(cells, axis=0)) == len(cells)
    expected = np.floor(points.astype(np.float64) / cell).astype(int)
    assert set(map(tuple, cells)) == set(map(tuple, expected))
    again = (cells + (found["offset"].reshape(3, -1).T + 0.5) / OFFSET_STEPS) * cell
    # each is one of the scan's own points
    for point, label in zip(again, found["label"], strict=True):
        near = np.abs(points - point).max(axis=1) <= cell / OFFSET_STEPS / 2 + 1e-4
        assert label in labels[near]


def test_each_moving_actor_becomes_one_arrow():
    points = np.array([[1, 0, 0], [1.2, 0, 0], [20, 0, 0], [30, 0, 0]], np.float32)
    flow = np.array([[5, 0, 0], [5, 0, 0], [0, -2, 0], [0, 0, 0]], np.float32)
    scan = Scan(points, flow=flow)
    moving = scan.select(np.abs(flow).sum(axis=1) > 0)
    arrows = encode_actors(FrameContent((), scan, None), moving, ())["arrows"].reshape(-1, 6)
    assert np.allclose(sorted(arrows[:, 3:].tolist()), [[0, -2, 0], [5, 0, 0]])


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_empty_arrays_come_back(kind):
    assert unpack_arrays(pack_arrays({"a": np.empty(0, kind)}))["a"].dtype == kind


def test_boxes_and_tracks_are_lines_in_the_frame_of_the_sensor():
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[:, :3, 3] = [[10, 2, 0], [5, -3, 1]]
    boxes = Boxes.from_poses(
        np.array([4, 9], np.uint32),
        np.array([10, 4], np.uint32),
        poses,
        np.array([[4.0, 2, 1.5], [1, 1, 2]]),
    )
    pose = translation((100.0, 0, 0))
    trail = Trail(4, 10, np.array([[106.0, 2, 0], [108, 2, 0], [110, 2, 0]]))
    found = encode_actors(FrameContent((), None, None, boxes, pose), None, [trail])
    lines = found["boxes"].reshape(2, 13, 2, 3)
    assert np.allclose(lines[0, :12].reshape(-1, 3).min(axis=0), [8, 1, -0.75])
    assert np.allclose(lines[0, :12].reshape(-1, 3).max(axis=0), [12, 3, 0.75])
    assert np.allclose(
        np.linalg.norm(lines[1, :12, 1] - lines[1, :12, 0], axis=1).sum(), 4 * (1 + 1 + 2)
    )
    assert np.allclose(
        found["tracks"].reshape(2, 2, 3), [[[6, 2, 0], [8, 2, 0]], [[8, 2, 0], [10, 2, 0]]]
    )
    assert "arrows" not in found
    assert encode_actors(FrameContent((), None, None), None, ()) == {}


@pytest.fixture
def moving_grid(tmp_path):
    """A grid whose red block is actor 70,003 and moves at 3 m/s; the blue one is actor 6 and
    stands. There are no points.
    """
    folder = write_blocks(tmp_path / "cartesian", frames=1, points=False)
    add_actors(folder, frames=1)
    return folder


def test_voxels_have_actors_and_arrows_where_no_point_has_flow(moving_grid):
    content = open_content(Scene(moving_grid), 0.2)
    arrays, _ = content.read(0)
    assert set(np.unique(arrays["panel0/instance"]).tolist()) == {0, 6, 70_003}
    assert np.array_equal(arrays["panel0/instance"] == 6, arrays["panel0/label"] == BLUE)
    (arrow,) = arrays["actors/arrows"].reshape(-1, 6)
    assert np.allclose(arrow[:2], (10, 5), atol=0.5) and np.allclose(arrow[3:], (3, 0, 0))
    assert content.describe([])["hasFlow"] and content.panels[0].evidence == ("instance",)
    right = Scene(moving_grid).open().right_handed()
    moving = right.read_motion(0, None)
    assert np.allclose(moving.points.mean(axis=0)[:2], (10, -5), atol=0.5) and np.allclose(
        moving.flow, (3, 0, 0)
    )


def test_velocities_that_are_not_finite_are_named(moving_grid):
    file = moving_grid / "evaluation/000000.velocity.npz"
    with np.load(file) as arrays:
        broken = {"voxel": arrays["voxel"], "velocity": np.full_like(arrays["velocity"], np.nan)}
    np.savez(file, **broken)
    with pytest.raises(
        FormatError, match="evaluation/velocity of frame 0: expected finite velocities, found NaN"
    ):
        open_content(Scene(moving_grid), 0.2).read(0)


def test_pictures_colour_voxels_by_actor(moving_grid):
    drawing = evidence_drawing(Scene(moving_grid).open("grid").data, 0, "actor", ego=False)
    colors = {tuple(color) for color in np.unique(drawing.mesh.colors, axis=0).tolist()}
    assert len(colors) == 4  # the floor, no actor, and two
    assert [entry.name for entry in drawing.legend] == [
        "no actor",
        "an actor, each in a colour of its own",
    ]
