"""Loops: drives along streets of walls that return, and streets that repeat."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.scenes.walls import close, drifted, drive, level, off_at_end, record, wall

from carlasc.motion import refinement
from carlasc.motion.refinement import RefinedPoses, ThinnedScan, refine_poses

AROUND = [(10, -2), (80, -2), (80, 42), (-2, 42), (-2, -2), (60, -2)]
BACK = [(0, -2), (90, -2), (90, 2), (0, 2)]


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
def test_refining_closes_loops_and_leaves_other_drives_as_they_were(monkeypatch):
    true = drive(AROUND)
    scans, given = record(block(), true), drifted(true)

    def refine(rows, poses, **options):
        thinned = (ThinnedScan.of(scans[row], poses[row]) for row in range(rows))
        return refine_poses(thinned, poses[:rows], **options)

    fits = iter([False])
    with monkeypatch.context() as patch:  # the first stretch seems not to fit
        patch.setattr(refinement, "_fit", lambda *_: next(fits, True))
        found = refine(len(true), given, always=True)
    assert 0 < found.fits.sum() < len(true)
    assert off_at_end(found.poses, true, 25)[0] < 0.05 and found.refined.all()
    kept, key = RefinedPoses.from_bytes(found.to_bytes("key"), "file")
    assert key == "key" and np.array_equal(kept.loops, found.loops) and len(kept.loops)
    ends = refine(40, given)
    assert not len(ends.loops)
    assert np.array_equal(ends.poses, refine(40, given, loops="never").poses)
    exact = refine(len(true), true)
    assert not len(exact.loops) and np.array_equal(exact.poses, true)
