"""The grid of one frame, step by step: scenes of a few points, with actors that are given."""

import tracemalloc

import numpy as np
import pytest

from carlasc import FromScans, GridSpec, Voting
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import translation
from carlasc.core.grids import VoxelFlag
from carlasc.core.tables import CARLA
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.inputs import GridPlan
from carlasc.motion import Extent, MotionOptions, PoseOptions, Track, usual_shell
from carlasc.motion.tracks import MovingActors
from carlasc.storage import FolderSink, FolderSource, layout

ROAD, BUILDING, VEHICLE = CARLA.id_of("Road"), CARLA.id_of("Building"), CARLA.id_of("Vehicle")
SPEC = GridSpec("cartesian", (100, 50, 15), (-20, -10, -2.5), (20, 10, 3.5))
PLACE = (8.2, 0.2, 0.1)
# five free samples back on its ray is the place
BEHIND = tuple(np.array(PLACE) * (1 + 7.5 / np.linalg.norm(PLACE)))
ELSEWHERE = (-8.2, 5.0, 0.1)
NOW, FRAMES = 10, range(21)


def feed_of(folder, scans, pose=lambda frame: np.eye(4), **options):
    """Write scans, lists of (place, label) in world coordinates, and return what reads them."""
    writer = FolderSink(folder).sequence("Val/Street/cartesian")
    for frame, points in scans.items():
        world = np.array([(*place, 1.0) for place, _ in points])
        local = world @ np.linalg.inv(pose(frame)).T
        local[:, 3] = 0
        writer.write("points", frame, local.astype(np.float32))
        writer.write("labels", frame, np.array([label for _, label in points], np.uint32))
    writer.write_document(
        layout.POSES, layout.encode_poses(np.stack([pose(f) for f in range(max(scans) + 1)]))
    )
    (sequence,) = FolderSource(folder).sequences().values()
    return ScanFeed(
        sequence,
        FromScans(**{"motion": MotionOptions("none"), "poses": PoseOptions(force=True), **options}),
    )


def merge(feed, actors, frame=NOW, spec=SPEC, evidence=True):
    voting = Voting(keep_evidence=evidence and feed.options.dynamic != "tube")
    plan = GridPlan(spec, "evaluation", feed.options, voting, FrameRange())
    return merge_frame(plan, feed, actors, frame, feed.window_of(frame))


def at(merged, place):
    """Return the label and the count of the voxel at a place, and its flags."""
    voxel = SPEC.flat_index(np.array([place]))[0]
    flags = VoxelFlag(int(merged.flags.reshape(-1)[voxel]))
    return (
        int(merged.grid.labels.reshape(-1)[voxel]),
        int(merged.grid.counts.reshape(-1)[voxel]),
        flags,
    )


class TestWhereTrafficPasses:
    """A car is at a place in five scans, and other scans see through this place."""

    def make(self, folder, looked_at, **options):
        scans = {
            frame: [(PLACE, VEHICLE), (ELSEWHERE, BUILDING)]
            if frame > 15
            else [
                (BEHIND, BUILDING) if looked_at(frame) else (ELSEWHERE, BUILDING),
                (ELSEWHERE, BUILDING),
            ]
            for frame in FRAMES
        }
        feed = feed_of(folder, scans, **options)
        return merge(feed, MovingActors(moving={frame: np.array([0]) for frame in range(16, 21)}))

    def test_what_only_other_times_saw_free_is_unknown(self, tmp_path):
        merged = self.make(tmp_path, lambda frame: not 8 <= frame <= 12, own_path=False)
        label, count, flags = at(merged, PLACE)
        assert (label, count) == (0, 0)
        assert VoxelFlag.CONTESTED in flags and VoxelFlag.SEEN_NOW not in flags
        assert merged.evidence.occupied.reshape(-1)[SPEC.flat_index(np.array([PLACE]))[0]] == 0.5
        assert at(merged, BEHIND)[0] == BUILDING

    @pytest.mark.parametrize("near", [8, 10, 12])
    def test_what_the_scans_of_the_instant_saw_free_is_free(self, tmp_path, near):
        merged = self.make(tmp_path, lambda frame: frame == near or not 8 <= frame <= 12)
        label, count, flags = at(merged, PLACE)
        assert label == 0 and count > 0
        assert VoxelFlag.CONTESTED in flags
        assert (VoxelFlag.SEEN_NOW in flags) == (near == NOW)

    @pytest.mark.parametrize("dynamic", ["current", "drop"])
    def test_other_rules_take_the_free_space_of_other_times(self, tmp_path, dynamic):
        merged = self.make(tmp_path, lambda frame: not 8 <= frame <= 12, dynamic=dynamic)
        label, count, flags = at(merged, PLACE)
        assert label == 0 and count > 0
        assert VoxelFlag.CONTESTED not in flags


class TestTheFramesOwnActor:
    """A point moves, and only the frame itself sees it; all other scans see through its place."""

    def make(self, folder, dynamic, actors=None):
        scans = {
            frame: [(PLACE, VEHICLE) if frame == NOW else (BEHIND, BUILDING)] for frame in FRAMES
        }
        feed = feed_of(folder, scans, dynamic=dynamic)
        return merge(feed, MovingActors(moving={NOW: np.array([0])}) if actors is None else actors)

    @pytest.mark.parametrize("dynamic", ["current", "align"])
    def test_it_is_kept(self, tmp_path, dynamic):
        assert at(self.make(tmp_path, dynamic), PLACE)[0] == VEHICLE

    def test_it_is_left_out_with_drop(self, tmp_path):
        label, count, _ = at(self.make(tmp_path, "drop"), PLACE)
        assert label == 0 and count > 0

    def test_a_point_that_does_not_move_is_outvoted(self, tmp_path):
        assert at(self.make(tmp_path, "current", MovingActors()), PLACE)[0] == 0


class TestBodies:
    """A car of 4 by 2 m whose side at y = 3 m is seen in every scan."""

    HALF = np.array([2.0, 1.0, 0.8])

    def make(self, folder, spec=SPEC, evidence=True, beyond=(), **options):
        side = [
            ((x, 3.1, z), VEHICLE)
            for x in np.arange(-1.9, 2.0, 0.2)
            for z in (-0.5, -0.1, 0.3, 0.5)
        ]
        ground = [((0.1, 4.1, -0.7), ROAD), ((0.1, 4.9, -0.7), ROAD)]  # seen under the car
        feed = feed_of(
            folder, dict.fromkeys(FRAMES, side + ground + list(beyond)), own_path=False, **options
        )
        members = {frame: np.arange(len(side), dtype=np.int32) for frame in FRAMES}
        poses = np.tile(translation((0.0, 4.0, 0.0)), (len(FRAMES), 1, 1))
        lower, upper = -self.HALF - 0.1, self.HALF + 0.1
        extent = Extent(-self.HALF, self.HALF, (False, False, True, False), 1000, (0.0, -4.0, 1.0))
        surface = usual_shell(lower, upper, extent)
        track = Track(
            VEHICLE,
            0,
            members,
            0,
            poses,
            np.zeros((len(FRAMES), 3)),
            lower,
            upper,
            extent,
            surface=surface,
        )
        return merge(feed, MovingActors({3: track}), spec=spec, evidence=evidence)

    def test_the_side_that_no_scan_saw_is_taken_from_the_other_one_and_marked(self, tmp_path):
        merged = self.make(tmp_path, complete="mirror")
        seen, other = (at(merged, (0.3, y, -0.1)) for y in (3.1, 4.9))
        assert seen[0] == other[0] == VEHICLE
        assert other[1] > 0
        assert VoxelFlag.INFERRED in other[2] and VoxelFlag.INFERRED not in seen[2]
        assert VoxelFlag.IN_ACTOR in seen[2] and VoxelFlag.IN_ACTOR in other[2]
        inside = np.flatnonzero(merged.flags & VoxelFlag.INFERRED)
        assert (merged.flags.reshape(-1)[inside] & VoxelFlag.IN_ACTOR).all()

    def test_without_completion_it_stays_unknown(self, tmp_path):
        merged = self.make(tmp_path, complete="seen")
        assert at(merged, (0.3, 3.1, -0.1))[0] == VEHICLE
        assert at(merged, (0.3, 4.9, -0.1))[1] == 0
        assert not (merged.flags & VoxelFlag.INFERRED).any()

    def test_the_usual_shape_closes_the_ends_that_a_mirror_image_does_not_show(self, tmp_path):
        front = (1.75, 4.1, -0.1)
        assert at(self.make(tmp_path / "mirror", complete="mirror"), front)[0] != VEHICLE
        label, _, flags = at(self.make(tmp_path / "body"), front)
        assert label == VEHICLE and VoxelFlag.INFERRED in flags

    def test_what_rays_went_through_is_not_filled(self, tmp_path):
        roof = np.array([0.3, 4.1, 0.5])
        label, _, flags = at(self.make(tmp_path / "unseen"), roof)
        assert label == VEHICLE and VoxelFlag.INFERRED in flags
        beyond = [(tuple((1 + 0.1 * i) * 2 * roof), BUILDING) for i in range(10)]
        label, count, flags = at(self.make(tmp_path / "seen", beyond=beyond), roof)
        assert (label, count > 0) == (0, True) and VoxelFlag.INFERRED not in flags

    def test_nothing_is_completed_where_rays_pass_through_the_middle_of_a_voxel(self, tmp_path):
        rng = np.random.default_rng(3)
        aims = rng.uniform(-1, 1, (60, 3)) * (self.HALF + 0.2) + (0.0, 4.0, 0.0)
        ends = [tuple(2.5 * aim) for aim in aims]
        merged = self.make(tmp_path / "passed", beyond=[(end, BUILDING) for end in ends])
        flags = merged.flags.reshape(-1)
        completed = (flags & VoxelFlag.INFERRED > 0) & (merged.grid.labels.reshape(-1) > 0)
        size = np.asarray(SPEC.voxel_size)
        samples = np.array(ends)[:, None] * np.linspace(0.01, 0.9, 2000)[:, None]
        places = (samples.reshape(-1, 3) - SPEC.lower) / size
        inner = np.abs(places % 1 - 0.5).max(axis=1) < 0.14  # in a ball of a quarter of a voxel
        passed = SPEC.flat_index(samples.reshape(-1, 3)[inner])
        assert completed.sum() > 50
        assert not completed[passed[passed >= 0]].any()

    def test_the_space_above_a_roof_over_which_rays_passed_is_free_and_marked(self, tmp_path):
        over = np.array([0.3, 4.1, 1.3])  # just above the body
        beyond = [(tuple((1 + 0.1 * i) * 2 * over), BUILDING) for i in range(10)]
        higher = (0.3, 4.1, 1.7)
        label, count, flags = at(self.make(tmp_path / "body", beyond=beyond), higher)
        assert (label, count) == (0, 1) and VoxelFlag.INFERRED in flags
        for name, options in (("seen", {"complete": "seen", "beyond": beyond}), ("none", {})):
            assert at(self.make(tmp_path / name, **options), higher)[1] == 0

    @pytest.mark.parametrize("complete", ["seen", "mirror", "body"])
    def test_a_body_does_not_swallow_the_road(self, tmp_path, complete):
        merged = self.make(tmp_path, complete=complete)
        for y in (4.1, 4.9):
            label, count, flags = at(merged, (0.1, y, -0.7))
            assert (label, count > 0) == (ROAD, True)
            assert VoxelFlag.INFERRED not in flags

    @pytest.mark.parametrize("complete", ["seen", "mirror", "body"])
    def test_the_grid_is_the_same_without_what_says_how_certain_it_is(self, tmp_path, complete):
        kept = self.make(tmp_path / "kept", complete=complete)
        merged = self.make(tmp_path / "not kept", evidence=False, complete=complete)
        assert merged.evidence is None
        np.testing.assert_array_equal(merged.grid.labels, kept.grid.labels)
        np.testing.assert_array_equal(merged.grid.counts, kept.grid.counts)
        np.testing.assert_array_equal(merged.votes.to_sparse(), kept.votes.to_sparse())

    def test_a_voxel_needs_no_more_memory_than_the_arrays_that_the_votes_fill(self, tmp_path):
        spec = SPEC.with_size((200, 200, 50))
        self.make(tmp_path / "compiled", evidence=False)
        tracemalloc.start()
        self.make(tmp_path / "fine", spec=spec, evidence=False)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        # bytes: the ballot has 10, the grid 5, the votes for free space 4
        assert peak / spec.num_voxels < 32


class TestOwnPath:
    """The vehicle drives 1 m per frame along x; something was seen ahead, where it drives through
    later.
    """

    TRACE, GROUND, BESIDE = (6.1, 0.1, -0.6), (6.1, 0.1, -1.1), (6.1, 1.3, -0.6)

    def make(self, folder, seen_now=False, **options):
        things = [(self.TRACE, VEHICLE), (self.GROUND, ROAD), (self.BESIDE, BUILDING)]
        scans = {
            frame: things if 0 < frame < 3 or (seen_now and frame == 0) else [((0.1, 9, 0), 1)]
            for frame in range(11)
        }
        feed = feed_of(
            folder, scans, lambda frame: translation((float(frame), 0.0, 0.0)), **options
        )
        return merge(feed, MovingActors(), 0)

    def test_it_clears_a_trace_and_neither_the_ground_nor_what_is_beside(self, tmp_path):
        merged = self.make(tmp_path)
        label, count, _ = at(merged, self.TRACE)
        assert label == 0 and count > 0
        assert at(merged, self.GROUND)[0] == ROAD
        assert at(merged, self.BESIDE)[0] == BUILDING
        assert (
            merged.evidence.occupied.reshape(-1)[SPEC.flat_index(np.array([self.TRACE]))[0]] < 0.05
        )

    def test_without_it_the_trace_stays(self, tmp_path):
        assert at(self.make(tmp_path, own_path=False), self.TRACE)[0] == VEHICLE

    def test_what_the_frame_itself_sees_stays(self, tmp_path):
        assert at(self.make(tmp_path, seen_now=True), self.TRACE)[0] == VEHICLE


def test_labels_of_which_a_network_is_not_sure_count_less(tmp_path):
    names, likely = [BUILDING] * 3 + [ROAD] * 2, [0.3] * 3 + [0.9] * 2
    scans = {
        frame: [((8.1, 0.2 + 0.02 * i, 0.1), name) for i, name in enumerate(names)]
        for frame in FRAMES
    }
    feed = feed_of(tmp_path / "sure", scans, own_path=False)
    assert at(merge(feed, MovingActors()), (8.1, 0.2, 0.1))[0] == BUILDING
    writer = FolderSink(tmp_path / "unsure").sequence("Val/Street/cartesian")
    pairs = np.zeros((5, 6), np.uint16)
    pairs[:, 0], pairs[:, 1] = names, np.array(likely) * layout.CERTAIN
    for frame in FRAMES:
        writer.write("probabilities", frame, pairs)
    feed = feed_of(tmp_path / "unsure", scans, own_path=False)
    assert at(merge(feed, MovingActors()), (8.1, 0.2, 0.1))[0] == ROAD


class TestOwnReturns:
    """A thing of two points that only the frame's own scan hit; the rays of the other scans go
    through it.
    """

    THING = ((8.1, 0.2, 0.1), (8.1, 0.3, 0.1))

    def make(self, folder, things=THING, label=BUILDING, through=1, **options):
        behind = [
            (tuple(np.array(place) * (1 + 7.5 / np.linalg.norm(place))), BUILDING)
            for place in self.THING
        ]
        scans = {
            frame: behind * through if frame != NOW else [(place, label) for place in things]
            for frame in FRAMES
        }
        return merge(feed_of(folder, scans, own_path=False, **options), MovingActors())

    @pytest.mark.parametrize("dynamic", ["align", "current", "drop"])
    def test_they_are_occupied_whatever_other_scans_say(self, tmp_path, dynamic):
        merged = self.make(tmp_path, dynamic=dynamic)
        assert at(merged, self.THING[0])[0] == BUILDING
        assert (
            merged.evidence.occupied.reshape(-1)[SPEC.flat_index(np.array(self.THING[:1]))[0]] > 0.5
        )

    def test_one_alone_is_an_outlier(self, tmp_path):
        assert at(self.make(tmp_path, self.THING[:1]), self.THING[0])[0] == 0

    def test_so_are_some_that_hundreds_of_rays_contradict(self, tmp_path):
        assert at(self.make(tmp_path, through=4), self.THING[0])[0] == 0
