"""Loops: drives along streets of walls that return, and streets that repeat."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from carlasc.core.geometry import invert, multiply, rotation_z, small_motions, translation
from carlasc.motion.loops import Submaps, close_loops
from carlasc.motion.refinement import RefinedPoses, ThinnedScan, refine_poses

AROUND = [(10, -2), (80, -2), (80, 42), (-2, 42), (-2, -2), (60, -2)]
BACK = [(0, -2), (90, -2), (90, 2), (0, 2)]


def wall(one, other, height, per_m2=8.0):
    """Return points of an upright wall between two places, (x, y) each."""
    one, other = np.array(one, float), np.array(other, float)
    count = int(np.linalg.norm(other - one) * height * per_m2)
    rng = np.random.default_rng(0)
    at, up = rng.random((count, 1)), rng.random(count) * height
    return np.column_stack([one + at * (other - one), up])


def level(low, high, z, per_m2=2.0):
    """Return points of a level rectangle."""
    count = int(np.prod(np.subtract(high, low)) * per_m2)
    rng = np.random.default_rng(1)
    return np.column_stack([rng.uniform(low, high, (count, 2)), np.full(count, z)])


def houses(line, side, rng, alike=False):
    """Return houses along a straight street, (x, y) to (x, y), on one side of it."""
    (one, other), made, at = np.array(line, float), [], 0.0
    length = np.linalg.norm(other - one)
    ahead = (other - one) / length
    out = side * np.array([-ahead[1], ahead[0]])
    while at < length:
        width, gap, back = (7.0, 1.0, 8.0) if alike else rng.uniform((5, 1, 7), (12, 5, 10))
        near, far = one + at * ahead + back * out, one + (at + width) * ahead + back * out
        height = 6.0 if alike else rng.uniform(4, 8)
        made.append(wall(near, far, height))
        made += [wall(end, end + 4 * out, height) for end in (near, far)]
        at += width + gap
    return made


def block(alike=False):
    rng, made = np.random.default_rng(5), [level((-40, -40), (120, 80), 0.0)]
    for line in (((-30, 0), (110, 0)), ((0, 10), (0, 34)), ((80, 10), (80, 34))):
        for side in (-1, 1):
            made += houses(line, side, rng, alike)
    made += houses(((-30, 40), (110, 40)), 1, rng, alike)
    return np.concatenate(made)


def tunnel():
    sides = [wall((-40, y), (140, y), 5.0) for y in (-7, 7)]
    return np.concatenate([*sides, *(level((-40, -7), (140, 7), z) for z in (0.0, 5.0))])


def drive(corners):
    """Return world_T_sensor every two metres along a line of corners, 1.7 m above the ground."""
    corners, poses = np.array(corners, float), []
    for one, other in pairwise(corners):
        way = other - one
        length, yaw = np.linalg.norm(way), np.arctan2(way[1], way[0])
        for at in np.arange(0, length, 2.0):
            pose = np.eye(4)
            pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
            pose[:3, 3] = *(one + at / length * way), 1.7
            poses.append(pose)
    return np.array(poses)


def scan(world, pose, rng):
    """Return a third of the points within 35 m, with errors of 2 cm, in the frame of the sensor."""
    off = world[rng.integers(3) :: 3] - pose[:3, 3]
    near = off[np.square(off[:, :2]).sum(axis=1) < 35**2]
    return ((near + rng.normal(0, 0.02, near.shape)) @ pose[:3, :3]).astype(np.float32)


def close(scans, given):
    submaps = Submaps()
    for row, (points, pose) in enumerate(zip(scans, given, strict=True)):
        thinned = ThinnedScan.of(points, pose)
        submaps.add(row, thinned.used, thinned.measured, pose)
    submaps.finish()
    return close_loops(submaps.done, given)


def record(world, true, seed=0):
    rng = np.random.default_rng(seed)
    return [scan(world, pose, rng) for pose in true]


def off_at_end(found, true, start):
    """Return the error of the motion from a pose at the start to the last one, m and degrees."""
    motions = [multiply(invert(poses[start]), poses[-1]) for poses in (true, found)]
    off = small_motions(multiply(invert(motions[0]), motions[1])[None])[0]
    return np.linalg.norm(off[:3]), np.degrees(np.linalg.norm(off[3:]))


def drifted(true):
    """Return poses whose motions are wrong by 3 mm and 0.002 degrees per metre."""
    error, found = translation((0.006, 0.002, 0.003)) @ rotation_z(np.radians(0.004)), [true[0]]
    for one, other in pairwise(true):
        found.append(multiply(found[-1], invert(one), other, error))
    return np.array(found)


class TestReturn:
    @pytest.mark.parametrize(
        ("corners", "start"),
        [(AROUND, 25), pytest.param(BACK, 1, marks=pytest.mark.slow)],
        ids=["around", "back"],
    )
    def test_a_drive_that_returns_is_consistent_there(self, corners, start):
        true = drive(corners)
        given = drifted(true)
        assert off_at_end(given, true, start)[0] > 0.2
        poses, loops = close(record(block(), true), given)
        moved, turned = off_at_end(poses, true, start)
        assert len(loops) >= 2 and moved < 0.08 and turned < 0.1
        assert loops[:, 2].mean() > 5 * loops[:, 3].mean()
        assert np.allclose(poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2), np.eye(3))
        steps = np.diff(poses[:, :3, 3], axis=0) - np.diff(given[:, :3, 3], axis=0)
        assert np.abs(steps).max() < 0.05  # spread over the drive


class TestNoLoop:
    @pytest.mark.parametrize(
        "alike",
        ["storeys", *(pytest.param(a, marks=pytest.mark.slow) for a in ("houses", "tunnel"))],
    )
    def test_places_that_look_alike_are_not_joined(self, alike):
        if alike == "tunnel":
            true = drive(BACK)
            given, scans = drifted(true), record(tunnel(), true)
        elif alike == "houses":  # a straight street: each house looks like the next ones
            true = drive([(-20, 0), (100, 0)])
            given, scans = drifted(true), record(block(alike=True), true)
        else:  # the same place three metres higher, as in a parking house
            world = np.concatenate([block(), level((-40, -40), (120, 80), 2.5)])
            true = drive(AROUND[:2])
            scans = record(world, true) * 2
            given = np.concatenate([true, true])
            given[len(true) :, 2, 3] += 3.0
        poses, loops = close(scans, given)
        assert len(loops) == 0 and np.array_equal(poses, given)

    def test_without_scans_there_are_none(self):
        poses, loops = close([], np.empty((0, 4, 4)))
        assert len(poses) == len(loops) == 0


@pytest.mark.slow
def test_refining_closes_loops_and_leaves_other_drives_as_they_were():
    true = drive(AROUND)
    scans, given = record(block(), true), drifted(true)

    def refine(rows, poses, **options):
        thinned = (ThinnedScan.of(scans[row], poses[row]) for row in range(rows))
        return refine_poses(thinned, poses[:rows], **options)

    found = refine(len(true), given, always=True)
    assert off_at_end(found.poses, true, 25)[0] < 0.05 and found.refined.all()
    kept, key = RefinedPoses.from_bytes(found.to_bytes("key"), "file")
    assert key == "key" and np.array_equal(kept.loops, found.loops) and len(kept.loops)
    ends = refine(40, given)
    assert not len(ends.loops)
    assert np.array_equal(ends.poses, refine(40, given, loops="never").poses)
    exact = refine(len(true), true)
    assert not len(exact.loops) and np.array_equal(exact.poses, true)
