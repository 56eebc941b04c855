"""Movers are followed over time, and only what overlays better along a path than standing earns a track."""

import numpy as np
from helpers.references.whole_drives import find_movers, link_segments
from helpers.scenes.moving_scenes import CAR, PERSON, WALLS, car, film, person


def movers(scene, frames=40, **options):
    return find_movers([sighting for sighting, _ in film(scene, frames, **options)])


def test_a_passing_car_is_one_mover_with_its_velocity():
    found = movers(lambda t: [*WALLS, car(-16.0 + 8.0 * t, 6.0), car(5.0, -6.0)])
    (mover,) = found.tracked
    assert mover.rigid
    assert len(mover.segments) >= 35
    velocities = np.stack([segment.velocity for segment in mover.segments])
    assert np.abs(velocities - (8.0, 0.0, 0.0)).max() < 0.5
    assert {segment.instance for segment in found.segments} == {1}


def test_someone_who_walks_is_a_mover_that_changes_its_shape():
    (mover,) = movers(lambda t: [*WALLS, person(-3.0 + 1.4 * t, 7.0)], noise_m=0.01).tracked
    assert not mover.rigid
    assert abs(np.median([segment.velocity[0] for segment in mover.segments]) - 1.4) < 0.2


def test_two_cars_that_meet_are_two_movers():
    def meet(seconds):
        return [*WALLS, car(-16.0 + 8.0 * seconds, 4.0), car(16.0 - 8.0 * seconds, 8.0)]

    speeds = sorted(float(np.median([s.velocity[0] for s in m.segments])) for m in movers(meet).tracked)
    assert np.allclose([speeds[0], speeds[-1]], [-8.0, 8.0], atol=0.4)
    assert all(abs(abs(speed) - 8.0) < 1.0 for speed in speeds)


def test_numbers_and_classes_can_be_given():
    sightings = [sighting for sighting, _ in film(lambda t: [*WALLS, car(-16.0 + 8.0 * t, 6.0)])]
    found = find_movers(sightings, first_instance=500, default_label=3)
    assert {(segment.instance, segment.label) for segment in found.segments} == {(500, 3)}


def test_labels_say_what_moved():
    def both(seconds):
        return [*WALLS, car(-16.0 + 8.0 * seconds, 6.0), person(-3.0 + 1.4 * seconds, -7.0)]

    sightings = [sighting for sighting, _ in film(both, labels=True)]
    found = find_movers(sightings, movable={CAR, PERSON}, deformable={PERSON})
    assert sorted((m.segments[0].label, m.rigid) for m in found.tracked) == [(PERSON, False), (CAR, True)]


def test_segments_become_tracks_as_those_of_labelled_actors():
    found = movers(lambda t: [*WALLS, car(-16.0 + 8.0 * t, 6.0)])
    (track,) = link_segments(found.segments, {frame: 0.1 * frame for frame in range(40)})
    assert track.moves
    assert np.allclose(track.velocity_at(20), (8.0, 0.0, 0.0), atol=0.4)
    assert abs(track.pose(20)[0, 3]) < 0.6


def test_moved_points_are_told_for_every_frame():
    found = movers(lambda t: [*WALLS, car(-16.0 + 8.0 * t, 6.0)], 20)
    assert sorted(found.moved) == list(range(20))
    for segment in found.segments:
        assert np.isin(segment.members, found.moved[segment.frame]).all()


def test_nothing_moves_without_scans_or_with_one():
    assert movers(lambda _: [*WALLS], 0).tracked == ()
    assert movers(lambda t: [*WALLS, car(8.0 * t, 6.0)], 1).tracked == ()
