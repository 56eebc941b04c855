"""Vehicles that are parked in one pass of a street, and gone in another one, are not in its map."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.scenes.box_street import BUILDING, POLE, SENSOR_HEIGHT_M, VEHICLE, Street

import carlasc
from carlasc import Run
from carlasc.core.geometry import rotation_z, translation
from carlasc.motion import MotionOptions, PoseOptions
from carlasc.motion.parked import other_passes
from carlasc.storage import FolderSink, layout
from carlasc.storage.layout import Metadata

STEP_M, FRAME_S, FAR_M = 2.0, 0.5, 72.0
CARS = [((14, -6.1, 0.2), (18.4, -4.3, 1.5)), ((32, 4.2, 0.2), (36.4, 6.0, 1.5))]
STRUCTURE = [
    ((-10, -16, 0), (22, -10, 6), BUILDING),
    ((26, -15, 0), (60, -9, 5), BUILDING),
    ((-10, 11, 0), (28, 16, 7), BUILDING),
    ((34, 10, 0), (60, 15, 5), BUILDING),
    ((10, 6.5, 0), (10.3, 6.8, 4), POLE),
    ((24, -6.3, 0), (24.3, -6, 4), POLE),
    ((2, 7.5, 0), (16, 8.2, 1.2), BUILDING),  # a hedge
]


def street(cars):
    boxes = [*STRUCTURE, *((*CARS[number], VEHICLE) for number in cars)]
    lower, upper, labels = zip(*boxes, strict=True)
    return Street(np.array(lower, float), np.array(upper, float), np.array(labels, np.uint32))


def poses():
    """Return world_T_sensor of a drive along the street and back in the other lane."""
    out = [translation((x, -2.0, SENSOR_HEIGHT_M)) for x in np.arange(0, FAR_M, STEP_M)]
    turn = [
        translation((FAR_M + 2 * np.sin(a), -2 * np.cos(a), SENSOR_HEIGHT_M)) @ rotation_z(a)
        for a in np.linspace(0.0, np.pi, 4)
    ]
    back = [
        translation((x, 2.0, SENSOR_HEIGHT_M)) @ rotation_z(np.pi)
        for x in np.arange(FAR_M, 0, -STEP_M)
    ]
    return np.stack([*out, *turn[1:-1], *back])


def write(folder, first, second, off=(0.0, 0.0), until=None):
    """Write a drive with some cars in its first and in its second pass; `off`, the poses of the
    second pass are wrong by so much.
    """
    writer = FolderSink(folder).sequence("drive")
    true = poses()[:until]
    given = true.copy()
    given[len(true) // 2 :, :2, 3] += off
    for frame, pose in enumerate(true):
        scene = street(first if frame < len(poses()) // 2 else second)
        rng = np.random.default_rng(frame)
        points, _ = scene.scan(pose, rng, channels=32, columns=300)
        writer.write("points", frame, np.column_stack([points, np.zeros(len(points), np.float32)]))
    writer.write_document(layout.POSES, layout.encode_poses(given))
    writer.write_document(layout.TIMES, layout.encode_times(np.arange(len(true)) * FRAME_S))
    writer.write_document(layout.METADATA, Metadata("right").to_json())
    return folder


def mapped(drive, name="map.npz", **options):
    given = {
        "poses": PoseOptions("file", "never", force=True),
        "motion": MotionOptions("evidence"),
        "run": Run(workers=1),
    }
    result = carlasc.map(drive, drive / name, **given | options)
    with np.load(drive / name) as file:
        return result, file["points"].astype(np.float64)


def in_box(points, box, around=0.1):
    """Return which points are in a box; those on the road below it are not."""
    lower, upper = np.array(box, float)
    return ((points > lower - (around, around, -0.1)) & (points < upper + around)).all(axis=1)


def structure_of(points):
    on = [in_box(points, box, 0.05) for *box, _ in STRUCTURE]
    return points[np.any(on, axis=0) & (points[:, 2] > 0.2)]


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), [((0,), (1,)), ((1,), (0,))])
def test_cars_of_one_pass_only_are_left_out(tmp_path, first, second):
    drive = write(tmp_path, first, second)
    whole, every = mapped(drive, "all.npz", keep_parked=True)
    result, points = mapped(drive)
    assert (whole.parked, result.parked) == (0, 2)
    assert any("2 parked actors" in note for note in result.notes)
    for car in CARS:
        before, after = in_box(every, car).sum(), in_box(points, car).sum()
        assert before > 300 and after <= 0.04 * before
    kept, road = structure_of(points), points[points[:, 2] < 0.1]
    assert len(kept) >= 0.995 * len(structure_of(every))
    assert len(road) >= 0.995 * (every[:, 2] < 0.1).sum()


@pytest.mark.slow
@pytest.mark.parametrize("off", [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5)])
def test_what_stays_is_kept_also_under_wrong_poses(tmp_path, off):
    result, _ = mapped(write(tmp_path, (0, 1), (0, 1), off))
    assert result.parked == 0


def test_without_a_second_pass_nothing_changes(tmp_path):
    drive = write(tmp_path, (0,), (0,), until=8)
    mapped(drive, "all.npz", keep_parked=True)
    result, _ = mapped(drive)
    assert result.parked == 0
    assert (tmp_path / "all.npz").read_bytes() == (tmp_path / "map.npz").read_bytes()


def test_passes_are_far_in_time_and_along_the_drive_and_near_in_space():
    places = poses()[:, :3, 3]
    found = other_passes(places, np.arange(len(places)) * FRAME_S)
    row = 5
    (rows,) = found[row]
    assert 0 < len(rows) <= 10
    away = np.linalg.norm(places[rows] - places[row], axis=1)
    assert away.max() < away.min() + 12.0
    assert (rows > len(places) // 2).all()
    assert not other_passes(places[: len(places) // 2], np.arange(len(places) // 2) * FRAME_S)
    assert not other_passes(places, np.zeros(len(places)))


def test_a_pass_that_ends_early_is_compared_with_what_is_ahead_of_it():
    along = np.r_[np.arange(0.0, 100), np.arange(100.0, 200), np.arange(200.0, 130, -1)]
    places = np.column_stack([along, np.zeros_like(along), np.zeros_like(along)])
    found = other_passes(places, np.arange(len(places)) * 1.0)
    (rows,) = found[110]  # 21 m from the end of the way back
    assert (rows > 200).all()
    assert places[rows, 0].min() == 131.0
    assert 90 not in found  # too far away


def test_a_street_that_is_driven_often_is_compared_with_a_few_of_its_passes():
    laps = np.tile(np.r_[np.arange(0.0, 90), np.arange(90.0, 0, -1)], 20)
    passes = other_passes(np.stack([laps, 0 * laps, 0 * laps], axis=1), np.arange(len(laps)) * 1.0)
    assert max(map(len, passes.values())) == 6
    assert min(map(len, passes.values())) >= 5
