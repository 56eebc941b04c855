"""What moved is found from free space alone: no flow, no instances, no labels."""

import numpy as np
import pytest
from helpers.scenes.moving_scenes import CAR, GROUND, PERSON, WALL, WALLS, car, film, person

from carlasc.captures.settings import Lidar
from carlasc.errors import FormatError
from carlasc.motion.evidence import HORIZON_S, EvidenceScan, find_evidence


def moved_of(evidence):
    flags = np.zeros(evidence.count, bool)
    flags[
        np.concatenate([np.empty(0, int), *(one.segment.members for one in evidence.clusters)])
    ] = True
    return flags


def shares(filmed, first=0, last=10**9):
    """Return the share of moved points of each class over frames, without those on the ground."""
    scans, classes = zip(*filmed, strict=True)
    counts, moved = np.zeros(20), np.zeros(20)
    for scan, labels, evidence in zip(scans, classes, find_evidence(scans), strict=True):
        assert evidence.frame == scan.frame and evidence.count == len(scan.points)
        if first <= scan.frame <= last:
            high = place_height(scan) > 0.25
            counts += np.bincount(labels[high], minlength=20)
            moved += np.bincount(labels[high], moved_of(evidence)[high], minlength=20)
    return moved / np.maximum(counts, 1)


def place_height(scan):
    return scan.points[:, 2] + 1.8


def passing(seconds):
    return [*WALLS, car(-16.0 + 8.0 * seconds, 6.0), car(5.0, -6.0)]


@pytest.mark.parametrize("channels", [16, 32, 64])
def test_a_passing_car_is_found_and_a_parked_one_is_not(channels):
    lidar = Lidar(channels=channels, points=channels * 900, noise_m=0.0)
    scans = [(scan, labels) for scan, labels in film(passing, lidar=lidar)]
    parked = [
        (s, np.where((labels == CAR) & (s.points[:, 1] < 0), 11, labels)) for s, labels in scans
    ]
    share = shares(parked)
    assert share[CAR] > 0.95
    assert share[11] < 0.01
    assert share[WALL] < 0.01


@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.2])
def test_someone_who_walks_is_found_at_any_rate(period_s):
    frames = round(4.0 / period_s)
    share = shares(film(lambda t: [*WALLS, person(-3.0 + 1.4 * t, 7.0)], frames, period_s=period_s))
    assert share[PERSON] > 0.95
    assert share[WALL] < 0.01


def test_errors_of_poses_and_a_moving_sensor_do_not_make_walls_move():
    share = shares(film(passing, ego_m_s=5.0, noise_m=0.03, noise_deg=0.1))
    assert share[WALL] < 0.01
    assert share[CAR] > 0.3  # one of the two


@pytest.mark.slow
def test_a_car_that_starts_is_whole_while_it_stands():
    def starts(seconds):
        return [*WALLS, car(-6.0 + 4.0 * max(seconds - 2.0, 0.0) ** 2, 6.0)]

    assert shares(film(starts, 60), last=15)[CAR] > 0.9


@pytest.mark.slow
def test_a_car_that_stops_is_whole_while_it_stands():
    def stops(seconds):
        return [*WALLS, car(8.0 - 4.0 * max(3.5 - seconds, 0.0) ** 2, 6.0)]

    assert shares(film(stops, 60), first=42)[CAR] > 0.9


def test_nothing_moves_on_empty_ground_or_in_a_single_scan():
    assert not shares(film(lambda _: [])).any()
    assert not shares(film(passing, 1)).any()
    empty = EvidenceScan(0, np.empty((0, 3), np.float32), np.eye(4), 0.0)
    (evidence,) = find_evidence([empty])
    assert evidence.clusters == () and evidence.count == 0


def test_explained_points_are_no_evidence():
    def without(scan, labels):
        return EvidenceScan(
            scan.frame, scan.points, scan.world_T_sensor, scan.seconds, None, None, labels == CAR
        )

    filmed = [(without(*pair), pair[1]) for pair in film(passing)]
    assert shares(filmed)[CAR] == 0


def test_labels_name_clusters_and_keep_them_apart():
    def together(seconds):
        return [*WALLS, car(-12.0 + 6.0 * seconds, 6.0), person(-9.6 + 6.0 * seconds, 6.0)]

    scans = [scan for scan, _ in film(together, labels=True)]
    found = list(find_evidence(scans, movable={CAR, PERSON}))[20]
    segments = [cluster.segment for cluster in found.clusters]
    assert sorted(segment.label for segment in segments) == [PERSON, CAR]
    for segment in segments:
        labels = scans[20].labels[segment.members]
        assert (labels == segment.label).all() and not (labels == GROUND).any()


def test_scans_are_given_back_after_the_horizon():
    read = []

    def reading():
        for scan, _ in film(passing, 80):
            read.append(scan.frame)
            yield scan

    for evidence in find_evidence(reading()):
        assert read[-1] <= evidence.frame + round(HORIZON_S / 0.1) + 1


def test_times_that_do_not_rise_are_replaced():
    wrong = [
        (EvidenceScan(s.frame, s.points, s.world_T_sensor, 3.0), labels)
        for s, labels in film(passing)
    ]
    assert shares(wrong)[CAR] == pytest.approx(shares(film(passing))[CAR], abs=0.02)


def test_points_that_are_not_finite_are_left_out():
    def broken(scan):
        points = scan.points.copy()
        points[::50] = np.nan
        return EvidenceScan(scan.frame, points, scan.world_T_sensor, scan.seconds)

    filmed = [(broken(s), labels) for s, labels in film(passing)]
    assert shares(filmed)[CAR] > 0.3


def test_shapes_are_checked():
    with pytest.raises(FormatError) as error:
        EvidenceScan(0, np.zeros((5, 4), np.float32), np.eye(4), 0.0)
    assert (error.value.where, error.value.found) == ("points", "(5, 4)")
    with pytest.raises(FormatError) as error:
        EvidenceScan(0, np.zeros((5, 3), np.float32), np.eye(4), 0.0, np.zeros(4, bool))
    assert (error.value.where, error.value.found) == ("ground", "(4,)")
