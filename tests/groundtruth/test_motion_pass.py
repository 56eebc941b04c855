"""What moves in a sequence: found in one pass, kept beside the grids, and used again."""

import json

import numpy as np
import pytest
from helpers.datasets.captures import read_tree
from helpers.scenes import passing_car

import carlasc
from carlasc import FromScans, Run
from carlasc.core.grids import VoxelFlag
from carlasc.errors import FormatError
from carlasc.groundtruth.from_scans import sequences
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.motion import Extent, MotionOptions, PoseOptions, Track
from carlasc.motion.tracks import MovingActors
from carlasc.storage import layout

FRAMES = 12


def track(first=3, frames=10, speed=8.0, label=10, instance=7, rigid=True, confidence=1.0):
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = 0.1 * speed * np.arange(frames)
    half = np.array([2.0, 0.9, 0.7])
    members = {first + i: np.arange(i, dtype=np.int32) for i in range(frames)}
    extent = Extent(-half, half - 0.5, (True, False, True, False), 300, (-9.0, 4.0, 1.0))
    velocity = np.tile([speed, 0.0, 0.0], (frames, 1))
    surface = np.arange(3 * frames, dtype=np.float32).reshape(-1, 3)
    whole = (-half, half, extent, rigid, surface, confidence)
    return Track(label, instance, members, first, poses, velocity, *whole)


def assert_equal(one, other):
    assert list(one.tracks) == list(other.tracks)
    for a, b in zip(one.tracks.values(), other.tracks.values(), strict=True):
        for name in ("label", "instance", "first", "rigid", "confidence"):
            assert getattr(a, name) == getattr(b, name)
        for name in ("world_T_actor", "velocity", "lower", "upper", "surface"):
            assert np.array_equal(getattr(a, name), getattr(b, name))
        assert (a.extent.faces, a.extent.points, a.extent.seen_from) == (
            b.extent.faces,
            b.extent.points,
            b.extent.seen_from,
        )
        assert np.array_equal(a.extent.lower, b.extent.lower) and np.array_equal(
            a.extent.upper, b.extent.upper
        )
        assert list(a.members) == list(b.members)
        assert all(np.array_equal(a.members[frame], b.members[frame]) for frame in a.members)
    assert list(one.moving) == list(other.moving)
    assert all(np.array_equal(one.moving[frame], other.moving[frame]) for frame in one.moving)
    assert np.array_equal(one.own, other.own)
    assert [dict(summary) for summary in one.summary] == [
        dict(summary) for summary in other.summary
    ]


ACTORS = MovingActors.of(
    [
        track(),
        track(speed=0.0),
        track(first=0, frames=4, label=4, instance=1 << 33, rigid=False, confidence=0.9999),
    ],
    {2: np.array([5, 9]), 4: np.array([], np.int64), 8: np.array([1])},
    [np.array([-3.0, 0.0, -1.0, -2.0, 1.0, 0.0])],
)


def test_an_actor_that_no_field_shows_has_no_number_in_the_data():
    assert [summary["instance"] for summary in ACTORS.summary] == [7, 7, 0]


class TestKept:
    def test_those_that_move_are_kept_and_all_are_summed_up(self):
        assert list(ACTORS.tracks) == [0, 2]
        assert [summary["moves"] for summary in ACTORS.summary] == [True, False, True]
        assert ACTORS.summary[0] | {"size_m": None} == {
            "label": 10, "instance": 7, "first": 3, "last": 12, "scans": 10, "points": 45, "moves": True, "confidence": 1.0,
            "speed_m_s": 8.0, "size_m": None, "seen_m": [3.5, 1.3, 0.9], "faces": 2,
        }  # fmt: skip
        assert ACTORS.summary[2]["confidence"] == 0.999  # 1 is for what the data say

    @pytest.mark.parametrize(
        "actors",
        [
            ACTORS,
            MovingActors(),
            MovingActors.of([], {3: np.array([2])}),
            MovingActors.of([track()]),
        ],
    )
    def test_what_is_kept_is_read_back_with_what_it_was_made_from(self, actors):
        back, key = MovingActors.from_bytes(actors.to_bytes("a key"), "here")
        assert key == "a key"
        assert_equal(back, actors)

    @pytest.mark.parametrize("size", [0, 1, 100, -200, -1])
    def test_a_damaged_file_is_one_error_that_names_it(self, size):
        data = ACTORS.to_bytes("key")[:size]
        with pytest.raises(FormatError, match="^tracks.npz: .*expected "):
            MovingActors.from_bytes(data, "tracks.npz")

    @pytest.mark.parametrize("position", [60, 300, 1000])
    def test_a_file_with_a_damaged_part_is_refused(self, position):
        data = bytearray(ACTORS.to_bytes("key"))
        data[position : position + 20] = bytes(20)
        with pytest.raises(FormatError, match="^tracks.npz: .*expected "):
            MovingActors.from_bytes(bytes(data), "tracks.npz")

    def test_a_worker_gets_what_concerns_its_window(self):
        near = ACTORS.between(5, 8)
        assert list(near.tracks) == [0]
        assert sorted(near.tracks[0].members) == [5, 6, 7, 8]
        for frame in range(5, 9):
            assert np.array_equal(near.tracks[0].pose(frame), ACTORS.tracks[0].pose(frame))
        assert near.tracks[0].pose(4) is near.tracks[0].pose(9) is None
        assert sorted(near.moving) == [8]
        assert near.is_own(np.array([[-2.5, 0.5, -0.5], [-2.5, 0.5, 0.5]])).tolist() == [
            True,
            False,
        ]
        assert not ACTORS.between(30, 40).tracks and not ACTORS.between(30, 40).moving


@pytest.fixture
def street(tmp_path):
    return passing_car.write_sequence(tmp_path, ("labels", "instances"), FRAMES)


@pytest.fixture
def passes(monkeypatch):
    """Count the passes over a sequence."""
    made = []

    def find(*args, **options):
        made.append(1)
        return find_actors(*args, **options)

    monkeypatch.setattr(sequences, "find_actors", find)
    return made


def kept_in(street):
    """Return the one file of actors that is kept beside the grids."""
    (file,) = (street / "cartesian" / layout.DERIVED).glob("tracks-*.npz")
    return file


def run(street, name="mine", frames=None, workers=1, **options):
    result = carlasc.regrid(
        street,
        passing_car.SPEC,
        name=name,
        frames=frames,
        observe=FromScans(**options),
        run=Run(workers=workers),
    )
    assert result.failures == ()
    return {
        file: data
        for file, data in read_tree(street / "cartesian" / name).items()
        if file[:1].isdigit()
    }


class TestPass:
    def test_it_is_made_once_for_several_grids_and_runs(self, street, passes):
        run(street, frames=(0, 2))
        assert len(passes) == 1
        kept = kept_in(street).read_bytes()
        run(street, frames=(0, 4))
        run(street, "other", frames=(0, 2), window=(-2, 2))
        assert len(passes) == 1
        assert kept_in(street).read_bytes() == kept

    @pytest.mark.slow
    def test_kept_actors_give_the_same_grids_as_new_ones(self, street, passes):
        first, again = run(street, "first", (4, 6)), run(street, "again", (4, 6))
        kept_in(street).unlink()
        assert first == again == run(street, "new", (4, 6))
        assert len(passes) == 2

    @pytest.mark.slow
    def test_it_is_made_again_after_a_scan_was_replaced(self, street, passes):
        run(street, "before", (4, 6))
        path = street / "cartesian" / layout.field_named("points").file(5)
        copy = path.with_suffix(".new")
        points = np.fromfile(path, "<f4").reshape(-1, 4)
        (points * np.float32([1, 1, 1.001, 1])).tofile(copy)
        copy.replace(path)
        run(street, "after", (4, 6))
        assert len(passes) == 2

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "data", [b"", b"not an archive", MovingActors().to_bytes("of another drive")]
    )
    def test_it_is_made_again_if_what_is_kept_is_damaged_or_of_something_else(
        self, street, passes, data
    ):
        run(street, "first", frames=(4, 5))
        kept_in(street).write_bytes(data)
        run(street, frames=(4, 5))
        assert len(passes) == 2
        assert MovingActors.from_bytes(kept_in(street).read_bytes(), "tracks")[0].tracks

    @pytest.mark.slow
    def test_other_options_of_motion_need_another_one(self, street, passes):
        run(street, "fields", (4, 5))
        run(street, "evidence", (4, 5), motion=MotionOptions("evidence"))
        assert len(passes) == 2
        run(street, "tube", (4, 5), dynamic="tube")
        run(street, "none", (4, 5), motion=MotionOptions("none"))
        assert len(passes) == 2  # nothing is asked about motion

    @pytest.mark.slow
    def test_two_workers_find_the_same_as_one(self, street):
        one = run(street, "one", (3, 6))
        kept = kept_in(street).read_bytes()
        kept_in(street).unlink()
        assert one == run(street, "two", (3, 6), workers=2)
        assert_equal(
            MovingActors.from_bytes(kept, "")[0],
            MovingActors.from_bytes(kept_in(street).read_bytes(), "")[0],
        )

    def test_what_was_completed_is_marked_and_can_be_left_out(self, street):
        made, seen = (run(street, how, (5, 6), complete=how) for how in ("body", "seen"))
        assert "000005.flags.bin" in made and "000005.flags.bin" not in seen
        counts = np.frombuffer(made["000005.bin"], "<f4")
        is_inferred = np.frombuffer(made["000005.flags.bin"], np.uint8) & VoxelFlag.INFERRED > 0
        assert is_inferred.any() and (counts[is_inferred] > 0).all()
        assert not np.frombuffer(seen["000005.bin"], "<f4")[is_inferred].any()
        whole, sure = (
            carlasc.Dataset(street, grid="body", fields=("known",), inferred=inferred)[0]["known"]
            for inferred in (True, False)
        )
        assert np.array_equal(whole.reshape(-1), counts > 0)
        assert np.array_equal(sure.reshape(-1), (counts > 0) & ~is_inferred)
        report = json.loads((street / "cartesian/body" / layout.REPORT).read_bytes())
        assert report["inferred_share"] == pytest.approx(is_inferred.sum() / (counts > 0).sum())

    def test_a_grid_does_not_depend_on_the_frames_of_the_run(self, street):
        assert run(street, "alone", (5, 6))["000005.label"] == run(street, "all")["000005.label"]

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("options", "scans"),
        [
            ({}, 3 * FRAMES),  # poses, then fields, and then free space
            ({"motion": MotionOptions("instances")}, 2 * FRAMES),
            ({"motion": MotionOptions("instances"), "poses": PoseOptions(refine="never")}, FRAMES),
            ({"dynamic": "tube"}, FRAMES),
        ],
    )
    def test_progress_counts_every_scan_that_is_read_and_every_frame(self, street, options, scans):
        for name in ("first", "again"):  # with a pass, and with actors that are kept
            steps = []
            carlasc.regrid(
                street,
                passing_car.SPEC,
                name=name,
                frames=(4, 6),
                observe=FromScans(**options),
                run=Run(workers=1, progress=lambda *step, steps=steps: steps.append(step)),
            )
            done, totals = zip(*steps, strict=True)
            assert set(totals) == {scans + 2}
            assert list(done) == sorted(set(done)) and (done[0], done[-1]) == (0, scans + 2)


@pytest.mark.slow
def test_the_file_depends_on_what_the_actors_are_made_from(street):
    folder = street / "cartesian" / layout.DERIVED
    settings = (
        {},
        {"motion": MotionOptions("instances")},
        {"motion": MotionOptions(min_speed_m_s=0.5)},
        {"max_range_m": 20.0},
        {"min_range_m": 2.0},
    )
    for number, options in enumerate(settings):
        run(street, f"grid{number}", (4, 5), **options)
    assert len(list(folder.glob("tracks-*.npz"))) == len(settings)
    run(street, "same", (4, 5), window=(-2, 2), complete="seen")
    assert len(list(folder.glob("tracks-*.npz"))) == len(settings)
    poses = (street / "cartesian" / layout.POSES).read_text().splitlines()
    numbers = poses[3].split()
    poses[3] = " ".join([*numbers[:3], str(float(numbers[3]) + 0.01), *numbers[4:]])
    (street / "cartesian" / layout.POSES).write_text("\n".join(poses))
    run(street, "moved", (4, 5))
    assert len(list(folder.glob("tracks-*.npz"))) == len(settings) + 1
