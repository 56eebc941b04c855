"""How large an actor is, although no scan saw all of it."""

import numpy as np
import pytest

from carlasc.motion import Extent, usual_shell
from carlasc.motion.bodies import Sizes, measure, surface_of

CAR, BUS, BICYCLE = 10, 11, 12
EVERY_SIDE = (True, True, True, True)
REAR, FRONT, LOW, HIGH = (tuple(i == side for i in range(4)) for side in range(4))


def extent(size, faces, seen_from=(-20.0, 0.0)):
    half = np.array(size) / 2
    return Extent(-half, half, faces, 100, seen_from)


def box(count=200, size=(4.0, 1.8, 1.5)):
    return np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) * size


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
    found = measure([box()], np.array([[*sensor, 1.0]]))
    assert found.faces == faces
    assert found.seen_from == pytest.approx(sensor)
    assert found.points == 200
    assert np.allclose(found.size, (4.0, 1.8, 1.5), atol=0.15)


def test_a_face_counts_from_twelve_points_and_two_percent_of_them():
    sensors = np.array([[-20.0, 0, 1], [0, 20.0, 1]])
    for points, seen in ((11, False), (12, True)):
        assert measure([box(100), box(points)], sensors).faces[3] == seen
    for points, seen in ((19, False), (21, True)):
        assert measure([box(1000 - points), box(points)], sensors).faces[3] == seen


def test_single_points_far_away_do_not_make_a_body_larger():
    points = np.concatenate([box(500), [[30.0, 9.0, 4.0], [-30.0, -9.0, -4.0]]])
    assert np.allclose(
        measure([points], np.array([[-20.0, 0, 1]])).size, (4.0, 1.8, 1.5), atol=0.15
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
    ("seen", "axis", "from_low"),
    [
        (extent((1.0, 1.8, 1.5), REAR, (-20.0, 0.0)), 0, True),
        (extent((1.0, 1.8, 1.5), FRONT, (20.0, 0.0)), 0, False),
        (extent((4.4, 0.6, 1.5), LOW, (0.0, -20.0)), 1, True),
        (extent((4.4, 0.6, 1.5), HIGH, (0.0, 20.0)), 1, False),
    ],
)
def test_a_body_extends_from_the_face_that_was_seen_away_from_the_sensor(seen, axis, from_low):
    low, high = Sizes([]).complete(CAR, seen)
    near = (seen.lower - low)[axis] if from_low else (high - seen.upper)[axis]
    far = (high - seen.upper)[axis] if from_low else (seen.lower - low)[axis]
    assert 0 <= near < 0.101 and far > 1.0
    assert np.allclose(high - low, (4.4, 1.85, 1.55), atol=0.15)


NO_SURFACE = np.empty((0, 3), np.float32)


def test_what_is_known_stays_nearly_as_it_was_seen():
    for size, faces in (
        ((3.9, 1.7, 1.4), EVERY_SIDE),
        ((5.5, 1.9, 1.5), REAR),
        ((4.4, 1.9, 1.5), LOW),
        ((25.0, 2.6, 3.4), EVERY_SIDE),
    ):
        lower, upper = Sizes([]).complete(CAR, extent(size, faces))
        assert np.allclose(upper - lower, size, atol=0.15 + 0.03 * size[0])


@pytest.mark.parametrize(
    ("faces", "length", "height", "most"),
    [
        (REAR, 1.0, 1.5, 0.25),
        (REAR, 3.9, 1.76, 0.25),
        ((True, False, True, False), 3.9, 1.76, 0.05),
        (EVERY_SIDE, 4.4, 1.5, 0.05),
        (EVERY_SIDE, 7.0, 2.8, 0.06),
    ],
)
def test_a_width_that_grows_by_a_centimetre_changes_the_body_a_little(faces, length, height, most):
    widths = np.arange(0.4, 2.8, 0.01)
    found = [Sizes([]).complete(CAR, extent((length, w, height), faces)) for w in widths]
    corners = np.array(found).reshape(len(widths), 6)
    assert np.abs(np.diff(corners, axis=0)).max() < most


def test_an_actor_of_which_no_face_was_seen_well_is_as_large_as_its_points():
    lower, upper = Sizes([]).complete(CAR, extent((1.0, 0.5, 0.5), (False,) * 4))
    assert np.allclose(upper - lower, (1.0, 0.5, 0.5))


def test_sizes_are_learned_from_similar_actors_of_the_same_class():
    def length(examples, label=CAR):
        known = [(label, e, NO_SURFACE) for e in examples]
        lower, upper = Sizes(known).complete(CAR, extent((1.0, 1.8, 1.5), REAR))
        return float(upper[0] - lower[0])

    estates = [extent((5.2, 1.8 + 0.02 * i, 1.5), EVERY_SIDE) for i in range(3)]
    alone = length([])
    assert alone == pytest.approx(4.35, abs=0.1)
    assert alone < length(estates[:1]) < length(estates) < 5.2
    assert length(estates) > 4.8
    assert length(estates, BUS) == alone
    others = [extent((5.2, 2.2, 2.0), EVERY_SIDE)] * 3 + [extent((5.2, 1.8, 1.5), REAR)] * 3
    assert length(others) == pytest.approx(alone, abs=0.1)


def test_an_actor_is_no_example_of_itself():
    seen = extent((1.23, 0.67, 1.54), (True, False, False, True))
    alone = Sizes([]).complete(CAR, seen)
    assert np.array_equal(Sizes([(CAR, seen, NO_SURFACE)]).complete(CAR, seen), alone)


def test_a_length_that_no_vehicle_of_this_width_has_is_completed_although_its_side_was_seen():
    part = extent((1.5, 1.9, 1.5), (True, False, True, False))
    assert part.known == (True, True) and part.plausible == (False, True)
    lower, upper = Sizes([]).complete(CAR, part)
    assert upper[0] - lower[0] == pytest.approx(4.4, abs=0.1)
    assert lower[0] == pytest.approx(-0.85)
    examples = [(CAR, part, NO_SURFACE)] * 5  # nor is it an example for others
    seen = extent((1.0, 1.9, 1.5), REAR)
    assert np.array_equal(Sizes(examples).complete(CAR, seen), Sizes([]).complete(CAR, seen))


@pytest.mark.parametrize(
    ("seen", "size"),
    [
        (extent((0.5, 0.6, 1.7), REAR), (1.8, 0.7, 1.7)),  # a cyclist
        (extent((1.8, 0.3, 1.7), LOW, (0.0, -20.0)), (1.8, 0.7, 1.7)),
        (extent((1.2, 0.67, 1.5), (True, False, False, True)), (1.75, 0.7, 1.6)),
        (extent((1.0, 2.5, 3.2), REAR), (11.0, 2.5, 3.3)),  # a lorry or a bus
        (extent((1.0, 2.0, 2.6), REAR), (6.0, 2.1, 2.7)),  # a large van, by its height
        (extent((3.9, 1.77, 1.76), (True, False, True, False)), (4.3, 1.85, 1.8)),
        # with points of a neighbour
        (extent((11.0, 3.3, 2.9), EVERY_SIDE, (0.0, -20.0)), (11.8, 2.65, 3.1)),
        (extent((11.0, 0.4, 2.0), LOW, (0.0, -20.0)), (10.4, 2.4, 2.8)),  # by its length
    ],
)
def test_usual_sizes_are_those_of_two_wheelers_cars_and_lorries(seen, size):
    lower, upper = Sizes([]).complete(CAR, seen)
    assert np.allclose(upper - lower, size, atol=0.1 + 0.03 * size[0])


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
            Extent(-half, half, (True, True, True, False), len(points), (0.0, -9.0)),
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
        lower, upper = Sizes(examples).complete(CAR, extent((0.4, 1.8, 1.1), REAR, (-20.0, 0.0)))
        assert np.allclose(upper - lower, (4.4, 1.8, 1.5), atol=0.1)
        assert lower[2] == pytest.approx(-0.9, abs=0.05)
        assert upper[2] == pytest.approx(0.55, abs=0.05)
