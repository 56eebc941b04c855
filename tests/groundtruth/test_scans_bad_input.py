"""Scans that are wrong in some way: the run goes on where it can, keeps the road, and says what was
done.
"""

import numpy as np
import pytest
from helpers.scenes import passing_car

import carlasc
from carlasc import FromScans, Run
from carlasc.core.boxes import Boxes
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.motion import MotionOptions, PoseOptions
from carlasc.storage import FolderSink, layout

FRAMES, FRAME = 21, 10
GROUND = sorted(CARLA.ground)
VEHICLE = CARLA.id_of("Vehicle")


def make(street, name="x", frames=(FRAME, FRAME + 1), **options):
    result = carlasc.regrid(
        street,
        passing_car.SPEC,
        name=name,
        frames=frames,
        observe=FromScans(**options),
        run=Run(workers=1),
    )
    assert result.failures == ()
    return result


def grid_of(street, name="x", frame=FRAME):
    (sequence,) = carlasc.open(street).sequences().values()
    return sequence.grid(name, frame)


def change(street, field, function, frames=range(FRAMES)):
    """Replace a field of some frames by what a function makes of it."""
    (sequence,) = carlasc.open(street).sequences().values()
    writer = FolderSink(street.parents[1]).sequence("Val/Street/cartesian")
    for frame in frames:
        writer.write(field, frame, function(frame, sequence.read(field, frame).copy()))


def road(grid):
    return np.isin(grid.labels, GROUND)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Return the grid of scans in which nothing is wrong."""
    street = passing_car.write_sequence(
        tmp_path_factory.mktemp("good"), ("labels", "instances"), FRAMES
    )
    make(street)
    return grid_of(street)


@pytest.fixture
def street(tmp_path):
    return passing_car.write_sequence(tmp_path, ("labels", "instances"), FRAMES)


def swapped(frame, ids):
    """The passing car and the parked car change their numbers in every second scan."""
    return np.where(ids == 0, 0, np.where(ids == 9, 4, 9)).astype(np.uint32) if frame % 2 else ids


def one_number(frame, ids):
    return np.full_like(ids, 5)


def a_number_per_scan(frame, ids):
    return np.where(ids > 0, ids + 100 * frame, 0).astype(np.uint32)


def noise(frame, ids):
    return np.random.default_rng(frame).integers(0, 20, len(ids)).astype(np.uint32)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [swapped, one_number, a_number_per_scan, noise])
def test_wrong_numbers_of_actors_do_not_swallow_the_road(street, good, wrong):
    change(street, "instances", wrong)
    result = make(street)
    if wrong is not noise:  # of which it is true
        assert not any("larger than any vehicle" in note for note in result.notes)
    grid = grid_of(street)
    kept = road(good) & road(grid)
    assert kept.sum() > 0.97 * road(good).sum()
    assert road(grid).sum() < 1.03 * road(good).sum()


def test_a_car_that_appears_from_nowhere_is_where_it_is_seen(tmp_path, good):
    street = passing_car.write_sequence(tmp_path, ("labels", "instances"), FRAMES)

    def only_from(frame, labels):
        return labels if frame >= FRAME else np.where(moving(frame), 0, labels).astype(np.uint32)

    def moving(frame):
        return passing_car.scan(frame, passing_car.sensor_pose(frame))[2]

    change(street, "labels", only_from)
    change(
        street,
        "instances",
        lambda frame, ids: ids if frame >= FRAME else np.where(ids == 9, 0, ids).astype(np.uint32),
    )
    make(street, frames=(FRAME - 6, FRAME + 1))
    here, before = grid_of(street), grid_of(street, frame=FRAME - 6)
    right = slice(0, 128), slice(64, 84)  # the lane of the passing car
    assert (here.labels[right] == VEHICLE).sum() > 0.7 * (good.labels[right] == VEHICLE).sum()
    assert not (before.labels[right] == VEHICLE).any()
    assert (road(good) & road(here)).sum() > 0.97 * road(good).sum()


@pytest.mark.parametrize("fields", [(), ("labels",), ("labels", "instances"), ("labels", "flow")])
def test_one_scan_alone_gives_what_it_saw(tmp_path, fields):
    street = passing_car.write_sequence(tmp_path, fields, frames=1)
    result = make(street, frames=None)
    assert result.made == 1
    assert any("one scan only" in note for note in result.notes)
    grid = grid_of(street, frame=0)
    assert grid.known.any() and (grid.labels > 0).any()


def test_scans_of_two_a_second_are_merged(tmp_path, good):
    street = passing_car.write_sequence(tmp_path, ("labels", "instances"), FRAMES)
    change_times = street / "cartesian" / layout.TIMES
    poses_file = street / "cartesian" / layout.POSES
    poses = layout.decode_poses(poses_file.read_bytes(), "poses.txt")
    poses[:, 0, 3] *= 100  # 10 m between two scans
    poses_file.write_bytes(layout.encode_poses(poses))
    with pytest.raises(FormatError, match="a jump of 100 m/s"):
        make(street)
    change_times.write_bytes(layout.encode_times(np.arange(FRAMES) * 0.5))
    assert make(street).made == 1


def test_times_that_fall_are_one_line(street):
    times = np.arange(FRAMES) * 0.1
    times[7] = 0.2
    (street / "cartesian" / layout.TIMES).write_bytes(layout.encode_times(times))
    with pytest.raises(
        FormatError,
        match=r"times.txt: expected increasing times, found 0.6 s and 0.2 s at frames 6 and 7",
    ):
        make(street)


@pytest.mark.parametrize("motion", ["boxes", "flow"])
def test_motion_from_a_field_that_is_not_there_is_one_line(street, motion):
    with pytest.raises(
        MissingDataError,
        match=rf"cartesian: expected {motion} in the sequence, found instances: use "
        rf'`motion=MotionOptions\("evidence"\)`',
    ) as error:
        make(street, motion=MotionOptions(motion))
    assert "\n" not in str(error.value)


def test_motion_from_numbers_needs_labels(tmp_path):
    street = passing_car.write_sequence(tmp_path, ("instances",), 3)
    with pytest.raises(MissingDataError) as error:
        make(street, frames=None, motion=MotionOptions("instances"))
    assert error.value.expected == "instances in the sequence"


@pytest.mark.parametrize("motion", ["flow", "evidence", "none"])
def test_a_tube_takes_no_motion(motion):
    with pytest.raises(ArgumentError) as error:
        FromScans(dynamic="tube", motion=MotionOptions(motion))
    assert error.value.where == "motion"


@pytest.mark.parametrize(
    ("name", "make_options"),
    [
        ("motion", lambda: MotionOptions("magic")),
        ("complete", lambda: FromScans(complete="magic")),
        ("poses", lambda: PoseOptions("magic")),
    ],
)
def test_choices_that_do_not_exist_are_named(name, make_options):
    with pytest.raises(ArgumentError, match=f"^{name}: expected one of .*, found 'magic'"):
        make_options()


@pytest.mark.parametrize(("name", "kind"), [("motion", "MotionOptions"), ("poses", "PoseOptions")])
def test_names_in_the_place_of_options_are_one_line(name, kind):
    with pytest.raises(ArgumentError, match=rf"^{name}: expected an? {kind}, found 'file'$"):
        FromScans(**{name: "file"})


def test_boxes_that_are_larger_than_any_vehicle_are_noted(street):
    add_boxes(street, size_m=40.0)
    assert any("1 actors are larger than any vehicle" in note for note in make(street).notes)


def add_boxes(street, label=VEHICLE, size_m=2.0):
    """Write one box in each frame, of a class."""
    box = Boxes.from_poses(
        np.array([9], np.uint32),
        np.array([label], np.uint32),
        np.eye(4)[None],
        np.full((1, 3), size_m),
        np.ones(1, bool),
    )
    for frame in range(FRAMES):
        FolderSink(street.parents[1]).sequence("Val/Street/cartesian").write(
            "boxes", frame, box.to_table()
        )


def test_boxes_of_frames_without_a_scan_are_left_out(street):
    add_boxes(street)
    for path in (street / "cartesian").glob(f"*/{FRAME - 2:06d}.*"):
        if path.parent.name != "boxes":
            path.unlink()
    (sequence,) = carlasc.open(street).sequences().values()
    assert set(sequence.frames("boxes").tolist()) - set(sequence.frames("points").tolist()) == {
        FRAME - 2
    }
    make(street, motion=MotionOptions("boxes"))


def test_a_box_of_a_class_that_does_not_exist_is_named(street):
    add_boxes(street, 4_294_967_295)
    with pytest.raises(
        FormatError,
        match=r"boxes of frame 0: expected class ids of carla, found 4294967295 \(1 times\) of 1",
    ):
        make(street, motion=MotionOptions("boxes"))
