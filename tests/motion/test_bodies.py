"""How large an actor is, although no scan saw all of it."""

import numpy as np
import pytest

from carlasc.motion import Extent, usual_shell
from carlasc.motion.bodies import Sizes, measure, surface_of

CAR, BUS, BICYCLE = 10, 11, 12
EVERY_SIDE = (True, True, True, True)
REAR, FRONT, LOW, HIGH = (tuple(i == side for i in range(4)) for side in range(4))


def extent(size, faces, seen_from=(-20.0, 0.0, 1.0)):
    half = np.array(size) / 2
    return Extent(-half, half, faces, 100, seen_from)


def box(count=200, size=(4.0, 1.8, 1.5)):
    return np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) * size


def measured(observations, sensors):
    return measure(np.concatenate(observations), np.array([*map(len, observations)]), sensors)


@pytest.mark.parametrize(
    ("sensor", "faces"),
    [
        ((-20, 0), REAR),
        ((20, 0), FRONT),
        ((0, -20), LOW),
        ((0, 20), HIGH),
        ((-20, 20), (True, False, False, True)),
        ((20, -20), (False, True, True, False)),
        ((-20, 2), REAR),  # the ray meets the side at less than 15 degrees
    ],
)
def test_a_sensor_sees_the_faces_that_are_turned_to_it(sensor, faces):
    found = measured([box()], np.array([[*sensor, 1.0]]))
    assert found.faces == faces
    assert found.seen_from[:2] == pytest.approx(sensor, abs=0.15)
    assert found.points == 200
    assert np.allclose(found.size, (4.0, 1.8, 1.5), atol=0.15)


def test_a_face_counts_from_twelve_points_and_two_percent_of_them():
    sensors = np.array([[-20.0, 0, 1], [0, 20.0, 1]])
    for points, seen in ((11, False), (12, True)):
        assert measured([box(100), box(points)], sensors).faces[3] == seen
    for points, seen in ((19, False), (21, True)):
        assert measured([box(1000 - points), box(points)], sensors).faces[3] == seen


def test_single_points_far_away_do_not_make_a_body_larger():
    points = np.concatenate([box(500), [[30.0, 9.0, 4.0], [-30.0, -9.0, -4.0]]])
    assert np.allclose(
        measured([points], np.array([[-20.0, 0, 1]])).size, (4.0, 1.8, 1.5), atol=0.15
    )


@pytest.mark.parametrize(
    ("faces", "known"),
    [
        (REAR, (False, True)),
        (FRONT, (False, True)),
        (LOW, (True, False)),
        ((True, True, False, False), (True, True)),
        ((False, False, True, True), (True, True)),
        ((True, False, True, False), (True, True)),
        ((False,) * 4, (False, False)),
    ],
)
def test_a_side_shows_the_length_and_an_end_the_width(faces, known):
    assert extent((4, 2, 1.5), faces).known == known


@pytest.mark.parametrize(
    ("seen", "lower", "upper"),
    [
        (extent((1.0, 1.8, 1.5), REAR, (-20.0, 0.0, 1.0)), (-0.5, -0.9), (3.9, 0.9)),
        (extent((1.0, 1.8, 1.5), FRONT, (20.0, 0.0, 1.0)), (-3.9, -0.9), (0.5, 0.9)),
        (extent((4.4, 0.6, 1.5), LOW, (0.0, -20.0, 1.0)), (-2.2, -0.3), (2.2, 1.55)),
        (extent((4.4, 0.6, 1.5), HIGH, (0.0, 20.0, 1.0)), (-2.2, -1.55), (2.2, 0.3)),
    ],
)
def test_a_body_extends_from_the_face_that_was_seen_away_from_the_sensor(seen, lower, upper):
    low, high = Sizes([]).complete(CAR, seen)
    assert np.allclose(low[:2], lower) and np.allclose(high[:2], upper)
    assert (low[2], high[2]) == (-0.75, 0.75)


NO_SURFACE = np.empty((0, 3), np.float32)


def test_what_is_known_stays_as_it_was_seen_and_nothing_gets_smaller():
    for size, faces in (
        ((3.9, 1.7, 1.4), EVERY_SIDE),
        ((5.5, 1.9, 1.5), REAR),
        ((4.4, 2.1, 1.5), LOW),
    ):
        lower, upper = Sizes([]).complete(CAR, extent(size, faces))
        assert np.allclose(upper - lower, size)


def test_an_actor_of_which_no_face_was_seen_well_is_as_large_as_its_points():
    lower, upper = Sizes([]).complete(CAR, extent((1.0, 0.5, 0.5), (False,) * 4))
    assert np.allclose(upper - lower, (1.0, 0.5, 0.5))


@pytest.mark.parametrize(("above", "lowered"), [(0.5, 0.0), (1.2, 0.6), (1.8, 1.8)])
def test_a_vehicle_stands_on_the_ground_that_others_hide(above, lowered):
    # The sensor is 1.75 m above the lower ends of vehicles that were seen from all sides. It is 20 m
    # away: ground that is higher by 0.8 m is possible, by 1.6 m it is not.
    learned = Sizes([(CAR, extent((4.5, 1.8, 1.5), EVERY_SIDE), np.empty((0, 3), np.float32))])
    roof = extent((0.2, 1.8, 0.5), REAR, (-20.0, 0.0, 1.5 - above))
    lower, upper = learned.complete(CAR, roof)
    assert (lower[2], upper[2]) == pytest.approx((-0.25 - lowered, 0.25))


def test_sizes_are_learned_from_three_similar_actors_of_the_same_class():
    seen = extent((1.0, 1.8, 1.5), REAR)
    vans = [(CAR, extent((5.2, 1.8 + 0.02 * i, 2.0), EVERY_SIDE)) for i in range(3)]
    others = [(CAR, extent((5.2, 2.2, 2.0), EVERY_SIDE))] * 3 + [
        (CAR, extent((5.2, 1.8, 2.0), REAR))
    ] * 3
    for known, length in (
        (vans, 5.2),
        (vans[:2], 4.4),
        (others, 4.4),
        ([(BUS, e) for _, e in vans], 4.4),
    ):
        lower, upper = Sizes([(*one, NO_SURFACE) for one in known]).complete(CAR, seen)
        assert upper[0] - lower[0] == pytest.approx(length)


def test_a_length_that_no_vehicle_of_this_width_has_is_completed_although_its_side_was_seen():
    part = extent((1.5, 1.9, 1.5), (True, False, True, False))
    assert part.known == (True, True) and part.plausible == (False, True)
    lower, upper = Sizes([]).complete(CAR, part)
    assert upper[0] - lower[0] == pytest.approx(4.4)
    assert lower[0] == pytest.approx(-0.75)
    examples = [(CAR, part, NO_SURFACE)] * 5  # nor is it an example for others
    assert np.ptp(Sizes(examples).complete(CAR, extent((1.0, 1.9, 1.5), REAR)), axis=0)[
        0
    ] == pytest.approx(4.4)


@pytest.mark.parametrize(
    ("seen", "size"),
    [
        (extent((0.5, 0.64, 1.7), REAR), (1.8, 0.64, 1.7)),  # a cyclist
        (extent((1.8, 0.3, 1.7), LOW, (0.0, -20.0, 1.0)), (1.8, 0.7, 1.7)),
        (extent((1.0, 2.5, 3.2), REAR), (7.5, 2.5, 3.2)),  # a lorry, by its width
        (extent((1.0, 2.0, 2.6), REAR), (5.4, 2.0, 2.6)),  # a van, by its height
        # a rear that was hidden in part
        (
            extent((11.0, 1.9, 2.0), (True, False, True, False), (0.0, -20.0, 1.0)),
            (11.0, 2.5, 2.8),
        ),
        # with points of a neighbour
        (
            extent((11.0, 3.3, 2.9), EVERY_SIDE, (0.0, -20.0, 1.0)),
            (11.0, 2.5, 2.9),
        ),
        (extent((11.0, 0.4, 2.0), LOW, (0.0, -20.0, 1.0)), (11.0, 2.5, 2.8)),  # by its length
    ],
)
def test_usual_sizes_are_those_of_two_wheelers_cars_and_lorries(seen, size):
    lower, upper = Sizes([]).complete(CAR, seen)
    assert np.allclose(upper - lower, size)


@pytest.mark.parametrize(
    "faces", [REAR, LOW, (True, False, True, False), EVERY_SIDE], ids=["rear", "side", "two", "all"]
)
@pytest.mark.parametrize("size", [(1.0, 2.0, 1.6), (3.9, 2.26, 1.76), (5.9, 2.3, 2.2)])
def test_a_size_that_grows_by_a_centimetre_changes_the_body_by_centimetres(faces, size):
    for axis, sizes in enumerate(((0.5, 7.0), (0.5, 3.2), (0.5, 3.2))):
        found = []
        for value in np.arange(*sizes, 0.01):
            seen = extent([*size[:axis], value, *size[axis + 1 :]], faces)
            found.append(np.concatenate(Sizes([]).complete(CAR, seen)))
        assert np.abs(np.diff(found, axis=0)).max() < 0.25


def test_the_shape_of_a_car_becomes_that_of_a_lorry_without_a_step():
    tops = []
    for width in np.arange(1.9, 2.6, 0.01):
        half = np.array((4.4, width, 1.9)) / 2
        shell = usual_shell(-half, half, extent(2 * half, REAR))
        tops.append(shell[shell[:, 0] > half[0] - 0.3, 2].max())  # of its front
    assert (np.diff(tops) > -1e-6).all() and np.diff(tops).max() < 0.05
    assert tops[-1] - tops[0] == pytest.approx(0.38 * 1.9 - 0.44, abs=0.01)


class TestUsualShell:
    def of(self, size, faces=REAR):
        half = np.array(size) / 2
        return usual_shell(-half, half, extent(size, faces)), half

    @pytest.mark.parametrize("size", [(4.4, 1.85, 1.5), (10.0, 2.5, 3.2)])
    def test_it_lies_within_the_box_and_reaches_near_all_sides_but_the_ground(self, size):
        shell, half = self.of(size)
        assert shell.dtype == np.float32
        assert (np.abs(shell) <= half - 0.2).all()
        assert np.allclose(shell.max(axis=0), half - 0.22, atol=1e-5)
        assert np.allclose(shell.min(axis=0), -half + (0.22, 0.22, 0.37), atol=1e-5)

    def test_a_cars_cabin_is_narrower_shorter_and_nearer_to_its_rear(self):
        shell, half = self.of((4.4, 1.85, 1.5))
        cabin = shell[shell[:, 2] > half[2] - 0.3]
        body = shell[shell[:, 2] < 0]
        assert np.abs(cabin[:, 1]).max() < np.abs(body[:, 1]).max()
        assert cabin[:, 0].min() > body[:, 0].min()
        assert cabin[:, 0].max() < body[:, 0].max() - 0.5

    def test_a_lorry_is_a_box(self):
        shell, half = self.of((10.0, 2.5, 3.2))
        top = shell[shell[:, 2] > half[2] - 0.25]
        assert np.allclose(np.ptp(top[:, :2], axis=0), (10.0 - 0.44, 2.5 - 0.44), atol=1e-4)

    def test_there_is_none_for_two_wheels_or_what_was_hardly_seen(self):
        assert not len(self.of((1.8, 0.7, 1.7))[0])
        assert not len(self.of((4.4, 1.85, 1.5), (False,) * 4)[0])
        assert not len(self.of((4.4, 1.85, 0.5))[0])


class TestLearnedShapes:
    """Cars with a box on their hood, which only those show that were seen from the front and from
    one side.
    """

    HALF = np.array([2.2, 0.9, 0.75])

    def example(self, stretch=1.0):
        """Return a car of which the front, the rear, the side of low y and the box were seen."""
        half = self.HALF * stretch
        x, y, z = (np.arange(-h, h + 0.01, 0.05) for h in half)
        side = np.stack(np.meshgrid(x, [-half[1]], z), axis=-1).reshape(-1, 3)
        ends = np.stack(np.meshgrid([-half[0], half[0]], y, z), axis=-1).reshape(-1, 3)
        box = np.stack(
            np.meshgrid(np.arange(1.3, 1.8, 0.05), y[y < 0], [half[2]]), axis=-1
        ).reshape(-1, 3)
        points = np.concatenate([side, ends, box])
        return (
            CAR,
            Extent(-half, half, (True, True, True, False), len(points), (0.0, -9.0, 1.0)),
            surface_of(points),
        )

    def surface(self, examples, size=(4.3, 1.8, 1.5)):
        half = np.array(size) / 2
        seen = extent((0.5, size[1], size[2]), REAR)
        return Sizes(examples).surface(CAR, -half, half, seen)

    def test_the_rest_of_a_car_that_showed_its_rear_is_that_of_cars_seen_well(self):
        found = self.surface([self.example(), self.example(1.02), self.example(0.98)])
        on_hood = (found[:, 0] > 1.1) & (found[:, 0] < 1.9) & (found[:, 2] > 0.65)
        low, high = found[:, 1] < -0.8, found[:, 1] > 0.8
        assert found.dtype == np.float32
        assert (np.abs(found) <= np.array([2.15, 0.9, 0.75]) + 0.15).all()
        assert on_hood.sum() > 10
        assert low.sum() == pytest.approx(high.sum(), rel=0.1)  # the other side is its mirror image
        for around in (low, high, found[:, 0] > 2.0, found[:, 0] < -2.0):
            assert around.sum() > 30

    def test_what_most_of_them_do_not_have_is_left_out(self):
        label, whole, surface = self.example()
        bare = (
            label,
            whole,
            surface[
                ~(
                    (np.abs(surface[:, 0] - 1.55) < 0.3)
                    & (surface[:, 2] > 0.6)
                    & (surface[:, 1] > -0.8)
                )
            ],
        )
        found = self.surface([self.example(), bare, bare])
        assert not ((np.abs(found[:, 0] - 1.55) < 0.2) & (np.abs(found[:, 1]) < 0.6)).any()

    def test_unlike_actors_and_other_classes_teach_nothing(self):
        usual = self.surface([])
        _, whole, surface = self.example()
        for others in ([self.example(1.3)] * 3, [(BUS, whole, surface)] * 3):
            np.testing.assert_array_equal(self.surface(others), usual)

    def test_wheels_that_are_hidden_lengthen_the_body_downwards(self):
        examples = [self.example(scale) for scale in (1.0, 1.01, 0.99)]
        lower, upper = Sizes(examples).complete(
            CAR, extent((0.4, 1.8, 1.1), REAR, (-20.0, 0.0, 1.0))
        )
        assert np.allclose(upper - lower, (4.4, 1.8, 1.5), atol=0.05)
        assert upper[2] == pytest.approx(0.55)


@pytest.mark.parametrize("found", [True, False])
def test_an_interval_is_narrower_with_more_visible_faces(found):
    size = np.array([4.4, 1.8, 1.5])
    rows = [
        Extent(-size / 2, size / 2, (rear, front, low, False), 100).interval(size, found=found)
        for rear, front, low in ((True, False, False), (True, False, True), (True, True, True))
    ]
    wide = [(row[1] - row[0]) for row in rows]
    assert (wide[0] > wide[1]).all() and (wide[1] > wide[2]).all()
    assert all((row[1] > size).all() for row in rows)
    for faces, points, own in (
        ((False,) * 4, 100, size),
        ((True,) * 4, 0, size),
        ((True,) * 4, 100, size * (0.4, 0.4, 1)),
    ):
        assert np.isnan(Extent(-size / 2, size / 2, faces, points).interval(own, found=found)).all()
