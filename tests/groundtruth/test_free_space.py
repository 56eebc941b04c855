"""Grids whose free space is taken from maps do not depend on the grids made before them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import passing_car

import carlasc
from carlasc import FromScans, GridSpec, Run, Voting
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import rotation_z, translation
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.groundtruth.inputs import GridPlan
from carlasc.running import Part
from carlasc.storage import FolderSink

SPEC = passing_car.SPEC.with_size((64, 64, 8))
ORDER = (20, 21, 22, 30, 23, 24, 20)  # forward, a jump ahead and back


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return passing_car.write_sequence(tmp_path_factory.mktemp("street"))


def sequence_of(street):
    (sequence,) = carlasc.open(street / "cartesian").sequences().values()
    return sequence


def plan_of(feed, spec=SPEC, **voting):
    return GridPlan(spec, "g", feed.options, Voting(**voting), FrameRange())


def assert_same(one, other):
    np.testing.assert_array_equal(one.grid.labels, other.grid.labels)
    np.testing.assert_array_equal(one.grid.counts, other.grid.counts)
    np.testing.assert_array_equal(one.votes.to_sparse(), other.votes.to_sparse())
    np.testing.assert_array_equal(one.flags, other.flags)
    assert (one.evidence is None) == (other.evidence is None)
    if one.evidence is not None:
        for name in ("occupied", "classes", "views"):
            np.testing.assert_array_equal(
                getattr(one.evidence, name), getattr(other.evidence, name)
            )


def tilted(sequence, turn_rad=0.6):
    """Return the sequence in a world whose axes are turned about x."""
    turn = rotation_z(turn_rad)[[2, 0, 1, 3]][:, [2, 0, 1, 3]]
    return sequence.with_poses(translation((500.0, -2e4, 30.0)) @ turn @ sequence.poses)


CASES = {
    "align": ({}, {"keep_evidence": True}, SPEC),
    "stride": ({"stride": 3}, {}, SPEC),
    "distance": ({"window_m": 1.5}, {}, SPEC),
    "short window": ({"window": (-3, 2)}, {"keep_evidence": True}, SPEC),
    "tube": ({"dynamic": "tube"}, {}, SPEC),
    "sensor": ({}, {"rule": "sensor"}, SPEC),
    "cylindrical": ({}, {}, GridSpec.published("cylindrical").with_size((32, 64, 8))),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_frame_is_the_same_alone_and_after_others(street, case):
    settings, voting, spec = CASES[case]
    feed = ScanFeed(sequence_of(street), FromScans(**settings))
    actors, plan = find_actors(feed), plan_of(feed, spec, **voting)
    for frame in ORDER:
        alone = ScanFeed(sequence_of(street), feed.options)
        window = feed.reaching(frame, spec)
        # a worker has the actors of the window only
        near = actors.between(frame - 30, frame + 30)
        assert_same(
            merge_frame(plan, feed, near, frame, window),
            merge_frame(plan, alone, actors, frame, window),
        )


def test_a_frame_is_the_same_after_others_and_after_one_with_fewer_scans(street):
    feed = ScanFeed(sequence_of(street), FromScans(window=(-4, 4)))
    actors, plan = find_actors(feed), plan_of(feed)
    window = feed.reaching(21, SPEC)
    merge_frame(plan, feed, actors, 20, feed.reaching(20, SPEC))
    merge_frame(plan, feed, actors, 21, window[::2])
    again = ScanFeed(sequence_of(street), feed.options)
    assert_same(
        merge_frame(plan, feed, actors, 21, window), merge_frame(plan, again, actors, 21, window)
    )


@pytest.mark.slow
def test_the_axes_of_the_world_do_not_matter(street):
    level = ScanFeed(sequence_of(street), FromScans(window=(-4, 4)))
    other = level.with_poses_of(tilted(level.sequence))
    grids = [
        merge_frame(plan_of(feed), feed, find_actors(feed), 20, feed.reaching(20, SPEC)).grid
        for feed in (level, other)
    ]
    same = (grids[0].labels == grids[1].labels) & (grids[0].known == grids[1].known)
    assert same.mean() > 0.998  # places on the edges of cells, by rounding


@pytest.mark.slow
def test_rays_from_many_places_are_followed_from_each(street, tmp_path):
    """The origins of a LiDAR that turns differ by less than a cell."""
    whole = sequence_of(street)
    with FolderSink(tmp_path) as sink, sink.sequence("cartesian") as writer:
        writer.write_document("poses.txt", whole.read_document("poses.txt"))
        for frame in range(16, 25):
            for name in ("points", "labels", "flow"):
                writer.write(name, frame, whole.read(name, frame))
            part = np.linspace(-1, 1, len(whole.read("points", frame)))
            origins = np.outer(np.round(part * 8) / 8, [0.02, 0.0, 0.0]).astype(np.float32)
            writer.write("origins", frame, origins)
    (turning,) = carlasc.open(tmp_path).sequences().values()
    grids = []
    for sequence in (whole, turning):
        feed = ScanFeed(sequence, FromScans(window=(-4, 4)))
        window = feed.reaching(20, SPEC)
        grids.append(merge_frame(plan_of(feed), feed, find_actors(feed), 20, window).grid)
    assert len(feed.read(20).rays.ends) == 17
    known = grids[0].known & grids[1].known
    assert known.sum() > 0.97 * grids[0].known.sum()
    assert (grids[0].labels == grids[1].labels)[known].mean() > 0.98


@pytest.mark.slow
def test_other_settings_have_maps_of_their_own(street):
    feed = ScanFeed(sequence_of(street), FromScans(window=(-4, 4)))
    actors = find_actors(feed)
    for spec, step in ((SPEC, 1.5), (SPEC.with_size((96, 96, 12)), 1.5), (SPEC, 0.7)):
        plan = plan_of(feed, spec, free_step_m=step)
        window = feed.reaching(20, spec)
        alone = ScanFeed(sequence_of(street), replace(feed.options))
        assert_same(
            merge_frame(plan, feed, actors, 20, window),
            merge_frame(plan, alone, actors, 20, window),
        )


@pytest.mark.slow
def test_a_run_makes_the_same_bytes_however_its_frames_are_dealt(street, tmp_path):
    """Alone, in one process, by two workers with ranges of frames, and in parts."""
    settings = {"observe": FromScans(window=(-6, 6)), "voting": Voting(keep_evidence=True)}

    def made(name, frames, *runs):
        for run in runs:
            carlasc.regrid(
                street, SPEC, tmp_path / name, frames=frames, name="g", run=run, **settings
            )
        grids = tmp_path / name / "cartesian" / "g"
        return {
            path.name: path.read_bytes() for path in grids.iterdir() if path.stem.startswith("0000")
        }

    whole = made("whole", (16, 24), Run(1))
    assert len(whole) > 16
    assert made("two", (16, 24), Run(2)) == whole
    assert made("parts", (16, 24), Run(1, part=Part(2, 2)), Run(1, part=Part(1, 2))) == whole
    (alone,) = {path[:6] for path in made("alone", (20, 21), Run(1))}
    assert made("alone", (20, 21), Run(1)).items() <= whole.items() and alone == "000020"
