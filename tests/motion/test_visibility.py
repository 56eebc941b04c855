"""Directions that are looked up in another scan: free, occupied or hidden places, and when no more
scans have to be asked.
"""

import numpy as np
import pytest

from carlasc.core.cells import as_pose
from carlasc.core.geometry import translation
from carlasc.motion.evidence import SortedReturns, look_up, undecided


def wall(x, origin=(0.0, 0.0, 0.0), half=0.6, width=200):
    """Return where rays from a place, in all directions within some radians, meet a wall across x."""
    azimuth, steep = np.meshgrid(np.linspace(-half, half, width), np.linspace(-0.3, 0.3, 40))
    reach = x - origin[0]
    points = np.stack(
        [np.full(azimuth.shape, reach), reach * np.tan(azimuth), reach * steep], axis=-1
    )
    return (points.reshape(-1, 3) + origin).astype(np.float32)


def answers(view, points, pose=None):
    free, hit = np.zeros((2, len(points)), np.uint32)
    asked = np.arange(len(points), dtype=np.int32)
    look_up(
        np.array(points, np.float32),
        asked,
        as_pose(np.eye(4) if pose is None else pose),
        view,
        3,
        free,
        hit,
    )
    assert not ((free | hit) & ~np.uint32(8)).any()  # the bit that was asked for
    return ["free" if f else "hit" if h else "?" for f, h in zip(free, hit, strict=True)]


# before a wall, in it, behind it, and where nothing was seen
PLACES = [
    (10, 0, 0),
    (20, 0.5, 0.2),
    (30, 0, 0),
    (-10, 0, 0),
]


def test_places_before_a_wall_are_free_and_those_behind_it_hidden():
    assert answers(SortedReturns.of(wall(20)), PLACES) == ["free", "hit", "?", "?"]
    moved = [(x - 2, y, z) for x, y, z in PLACES]
    assert answers(SortedReturns.of(wall(20)), moved, translation((2, 0, 0))) == [
        "free",
        "hit",
        "?",
        "?",
    ]


def test_rays_are_seen_from_where_they_began():
    """One half of the turn began 1 m farther to the left: seen from one place, the wall would have
    a step.
    """
    left, right = wall(20, (0, 1, 0)), wall(20)
    left, right = left[left[:, 1] > 1.2], right[right[:, 1] < -0.2]
    origins = np.repeat(
        np.array([(0, 1, 0), (0, 0, 0)], np.float32), [len(left), len(right)], axis=0
    )
    view = SortedReturns.of(np.concatenate([left, right]), origins)
    assert len(view.distance) == len(left) + len(right)
    assert answers(view, [(20, 6, 0), (20, -6, 0), (10, 3.5, 0), (10, -3, 0)]) == [
        "hit",
        "hit",
        "free",
        "free",
    ]
    assert (view.origin[512 + 50] == (0, 1, 0)).all() and (view.origin[512 - 50] == 0).all()


def test_a_direction_that_was_seen_from_two_places_counts_from_the_one_of_more_rays():
    many, few = wall(20, width=200), wall(20, (-2, 0, 0), width=40)
    origins = np.repeat(
        np.array([(0, 0, 0), (-2, 0, 0)], np.float32), [len(many), len(few)], axis=0
    )
    view = SortedReturns.of(np.concatenate([many, few]), origins)
    assert len(view.distance) == len(many)
    assert answers(view, PLACES) == answers(SortedReturns.of(many), PLACES)


def test_returns_are_sorted_by_column_and_slope():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3)).astype(np.float32) * (8, 8, 1)
    view = SortedReturns.of(points)
    assert len(view.distance) == (np.linalg.norm(points, axis=1) >= 1.0).sum()
    for begin, end in zip(view.start[:-1], view.start[1:], strict=True):
        assert (np.diff(view.slope[begin:end]) >= 0).all()


def verdicts(free, hit, agreeing, in_a_row):
    """Return what is said of each place, in the words of the rule."""
    found = []
    for f, h in zip(free.T, hit.T, strict=True):
        passed, occupied = sum(int(v).bit_count() for v in f), sum(int(v).bit_count() for v in h)
        row = max((int(a) >> int(b).bit_length()).bit_count() for a, b in zip(f, h, strict=True))
        moved = passed >= agreeing and passed > occupied
        found.append(
            (
                moved,
                not moved and row >= in_a_row,
                not moved and row < in_a_row and occupied > passed,
            )
        )
    return found


@pytest.mark.parametrize("seed", range(4))
def test_places_that_are_decided_keep_their_verdict_whatever_the_other_scans_say(seed):
    rng = np.random.default_rng(seed)
    # hidden, free, occupied
    bits = rng.choice(3, (2, 12, 400), p=(0.2, 0.2, 0.6) if seed % 2 else (0.1, 0.6, 0.3))
    weights = (1 << np.arange(12))[None, :, None]
    free, hit = (((bits == kind) * weights).sum(axis=1).astype(np.uint32) for kind in (1, 2))
    whole, asked, saved = verdicts(free, hit, 2, 4), np.arange(400, dtype=np.int32), 0
    seen_free, seen_hit = np.zeros_like(free), np.zeros_like(hit)
    rest = np.full(2, (1 << 12) - 1, np.uint32)
    for left, place in zip(range(11, -1, -1), rng.permutation(12).tolist(), strict=True):
        bit = np.uint32(1 << place)
        rest &= ~bit
        seen_free[:, asked] |= free[:, asked] & bit
        seen_hit[:, asked] |= hit[:, asked] & bit
        asked = undecided(asked, seen_free, seen_hit, rest, (2, 4, 25))
        saved += (400 - len(asked)) if left else 0
    assert verdicts(seen_free, seen_hit, 2, 4) == whole
    assert saved > 400


def test_a_place_that_four_scans_saw_occupied_and_none_free_is_decided():
    free, hit = np.zeros((2, 2, 3), np.uint32)
    hit[:, :2], hit[1, 1], free[0, 2], hit[:, 2] = 0b110, 0b100, 0b1000, 0b110
    left, asked = np.full(2, 0b1, np.uint32) << np.uint32(11), np.arange(3, dtype=np.int32)
    left |= np.uint32(0b11111110000)
    assert undecided(asked, free, hit, left, (2, 4, 4)).tolist() == [1, 2]
