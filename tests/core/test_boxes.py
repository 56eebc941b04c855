from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from carlasc import Boxes
from carlasc.core.boxes import BOXES_DTYPE
from carlasc.core.geometry import (
    quaternions_of,
    rotation_z,
    rotations_of,
    transform_points,
    translation,
)
from carlasc.errors import FormatError


def rotations(seed: int, count: int = 20) -> np.ndarray:
    found = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))[0]
    found[np.linalg.det(found) < 0, :, 0] *= -1
    return found


def some_boxes() -> Boxes:
    """A car 4 m long that looks to the left, and a person 2 m in front of it."""
    car, person = translation((10, 0, -1)) @ rotation_z(np.pi / 2), translation((10, 4, -1))
    return Boxes.from_poses(
        np.array([7, 3], np.uint32),
        np.array([10, 4], np.uint32),
        np.stack([car, person]),
        np.array([[4.0, 2.0, 1.5], [0.5, 0.5, 1.8]]),
        np.array([True, False]),
    )


@given(st.integers(0, 1000))
def test_quaternions_and_rotations_are_each_others_inverse(seed):
    wanted = rotations(seed)
    quaternions = quaternions_of(wanted)
    assert np.allclose(np.linalg.norm(quaternions, axis=1), 1)
    assert np.abs(rotations_of(quaternions) - wanted).max() < 1e-12
    assert np.abs(quaternions_of(rotations_of(-quaternions)) - quaternions).max() < 1e-9


def test_half_turns_have_quaternions_too():
    turns = np.stack(
        [np.diag(d) for d in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])]
    ).astype(float)
    assert quaternions_of(turns).tolist() == np.eye(4).tolist()
    assert np.allclose(
        rotations_of(np.array([[np.cos(0.3), 0, 0, np.sin(0.3)]]))[0], rotation_z(0.6)[:3, :3]
    )


def test_a_point_is_inside_by_the_axes_of_the_box():
    boxes = some_boxes()
    points = np.array(
        [[10, 1.9, -1], [11.9, 0, -1], [10, 4, -0.2], [10.9, 2.1, -1], [10, 0, -1.74]], np.float32
    )
    assert boxes.contains(points).tolist() == [
        [True, False, False, False, True],
        [False, False, True, False, False],
    ]
    assert boxes.contains(points, 0.2)[0].tolist() == [True, False, False, True, True]
    assert boxes.contains(points, -0.2)[0].tolist() == [False] * 5
    assert boxes.contains(points, -3.0).sum() == 0
    assert boxes.owners(points).tolist() == [0, -1, 1, -1, 0]


def test_a_point_in_two_boxes_belongs_to_the_smaller_one():
    boxes = some_boxes()
    inner = replace(boxes, centers=np.tile([10.0, 0, -1], (2, 1)))
    assert inner.owners(np.array([[10.0, 0, -1], [10, 1.5, -1]])).tolist() == [1, 0]
    assert inner.select(np.array([1, 0])).owners(
        np.array([[10.0, 0, -1], [10, 1.5, -1]])
    ).tolist() == [0, 1]


@given(st.integers(0, 1000))
def test_what_is_inside_stays_inside_when_all_is_moved(seed):
    rng = np.random.default_rng(seed)
    move = translation(rng.normal(size=3) * 20)
    move[:3, :3] = rotations(seed, 1)[0]
    boxes, points = some_boxes(), rng.uniform((7, -3, -2.5), (13, 6, 0.5), (200, 3))
    moved = boxes.transform(move)
    assert moved.contains(transform_points(move, points), 1e-3)[boxes.contains(points)].all()
    assert not moved.contains(transform_points(move, points), -1e-3)[~boxes.contains(points)].any()
    assert moved.tracks.tolist() == [7, 3] and moved.annotated.tolist() == [True, False]


def test_a_table_keeps_every_bit():
    boxes = some_boxes()
    table = boxes.to_table()
    assert table.dtype == BOXES_DTYPE and table.dtype.itemsize == 89
    assert table["length"].tolist() == [4.0, 0.5] and table["x"].tolist() == [10.0, 10.0]
    assert Boxes.from_table(table).to_table().tobytes() == table.tobytes()
    assert len(Boxes.from_table(table[:0])) == 0


def test_select_takes_boxes_by_mask_and_by_index():
    boxes = some_boxes()
    assert boxes.select(boxes.annotated).tracks.tolist() == [7]
    assert boxes.select(np.array([1, 0])).labels.tolist() == [4, 10]


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"sizes": np.ones((1, 3))}, "(1, 3)"),
        ({"labels": np.array([1, 2])}, "int64"),
        ({"centers": np.array([[0, 0, 0], [1, np.nan, 2]])}, "nan, 2.0] in box 1 (track 3)"),
        ({"sizes": np.array([[1, 1, 0], [1, 1, 1.0]])}, "in box 0 (track 7)"),
        ({"quaternions": np.array([[1, 0, 0, 0], [1, 0, 0, 0.1]])}, "in box 1 (track 3)"),
        ({"tracks": np.array([0, 3], np.uint32)}, "0 in box 0 (track 0)"),
        ({"tracks": np.array([3, 3], np.uint32)}, "3 in box 1 (track 3)"),
    ],
)
def test_boxes_that_make_no_sense_are_refused(change, found):
    with pytest.raises(FormatError) as error:
        replace(some_boxes(), **change)
    assert error.value.where == f"boxes: {next(iter(change))}"
    assert error.value.found.endswith(found)


def test_an_error_in_a_table_names_the_file():
    table = some_boxes().to_table()
    table["width"] = -1
    with pytest.raises(FormatError) as error:
        Boxes.from_table(table, "boxes/000003.bin")
    assert error.value.where == "boxes/000003.bin: boxes: sizes"
