"""One number for each actor: that of the data, or new ones, also where an actor has several tracks."""

from dataclasses import replace

import numpy as np
import pytest

from carlasc.core.geometry import translation
from carlasc.motion import Extent, Track
from carlasc.motion.numbering import number_actors
from carlasc.motion.tracks import FIRST_MOVER

CAR, PERSON = 10, 4


def track(first, frames, *, x=0.0, instance=0, label=CAR, rigid=True, half=(2.0, 1.0, 0.75), seen=None):
    """A track at 1 m per frame along x, from x at frame 0 on, whose members are in all frames, or in those of `seen`."""
    poses = np.stack([translation((x + frame, 0.0, 0.0)) for frame in range(first, first + frames)])
    members = {frame: np.arange(5) for frame in (range(first, first + frames) if seen is None else seen)}
    upper = np.array(half)
    extent = Extent(-upper, upper, (True,) * 4, 100)
    velocity = np.tile([10.0, 0, 0], (frames, 1))
    return Track(label, instance, members, first, poses, velocity, -upper, upper, extent, rigid)


def test_numbers_of_the_data_are_kept_and_others_are_new_and_above_them():
    tracks = {
        3: track(0, 9, instance=7),
        4: track(0, 9, x=50, instance=FIRST_MOVER + 2),
        8: track(2, 9, x=-50),
        9: track(1, 9, x=90),
    }
    assert number_actors(tracks) == {3: 7, 4: 8, 9: 9, 8: 10}
    assert number_actors(tracks, highest=70_000) == {3: 7, 4: 70_001, 9: 70_002, 8: 70_003}
    assert number_actors({}) == {}


@pytest.mark.parametrize(
    ("second", "is_same"),
    [
        (track(6, 10, x=1.5), True),
        (track(6, 10, x=2.2), True),  # at the body
        (track(6, 10, x=2.4), False),  # beside it
        (track(7, 10, x=1.5), True),  # three common frames
        (track(8, 10, x=1.5), False),  # two
        (track(6, 10, x=1.5, label=PERSON), False),
        (track(6, 10, x=1.5, half=(0.5, 0.5, 0.5)), True),
    ],
)
def test_tracks_of_one_class_of_which_one_is_in_the_body_of_the_other_are_one_actor(second, is_same):
    found = number_actors({0: track(0, 10), 1: second})
    assert (found[0] == found[1]) == is_same


@pytest.mark.parametrize(("seen", "is_same"), [(range(10, 16), True), (range(9, 16), False)])
def test_two_people_who_are_seen_at_once_are_two(seen, is_same):
    first, second = (track(n, 10, label=PERSON, rigid=False) for n in (0, 6))
    found = number_actors({0: first, 1: replace(second, members={f: np.arange(5) for f in seen})})
    assert (found[0] == found[1]) == is_same


def test_a_track_without_a_number_takes_that_of_its_actor_and_two_numbers_are_never_joined():
    assert number_actors({0: track(0, 10), 1: track(5, 10, instance=6)}) == {0: 6, 1: 6}
    assert number_actors({0: track(0, 10, instance=3), 1: track(5, 10, instance=6)}) == {0: 3, 1: 6}
    # the one in the middle is of both, and both have numbers: it goes with the first
    tracks = {0: track(0, 10, instance=3), 1: track(5, 10), 2: track(10, 10, instance=6)}
    assert number_actors(tracks) == {0: 3, 1: 3, 2: 6}


def test_a_number_that_is_in_two_places_at_once_is_of_the_longer_track():
    tracks = {0: track(0, 5, instance=3), 1: track(2, 20, x=40, instance=3), 2: track(60, 5, x=90, instance=3)}
    assert number_actors(tracks) == {0: 4, 1: 3, 2: 3}
