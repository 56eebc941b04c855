"""Ground truth from ego scans: what moves leaves no trace, and is complete where it is."""

import json
import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest
from helpers.scenes import passing_car
from helpers.scenes.box_street import drive, write_drive
from typer.testing import CliRunner

import carlasc
from carlasc import GridSpec, Run
from carlasc.cli import app
from carlasc.core.geometry import translation
from carlasc.errors import ArgumentError, ConflictError, FormatError, MissingDataError
from carlasc.groundtruth import FromGrid, FromScans, Voting
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.merging import PreparedScan
from carlasc.motion import MotionOptions, PoseOptions
from carlasc.storage import FolderSink, layout

VEHICLE = 10
FRAME = 20


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return passing_car.write_sequence(tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="module")
def truth():
    return passing_car.reference(FRAME)


def grid_of(sequence, name, frame=FRAME):
    return next(iter(carlasc.open(sequence).sequences().values())).grid(name, frame)


def make(sequence, name, frames=(FRAME, FRAME + 1), spec=passing_car.SPEC, **options):
    observe = FromScans(**options.pop("settings", {}))
    return carlasc.regrid(
        sequence,
        spec,
        name=name,
        frames=frames,
        observe=observe,
        **{"run": Run(workers=1), **options},
    )


def vehicle_score(grid, truth):
    known = grid.known & truth.known
    found, real = (grid.labels == VEHICLE) & known, (truth.labels == VEHICLE) & known
    return (found & real).sum() / (found | real).sum(), int((found & ~real).sum())


@pytest.fixture(scope="module")
def scores(street, truth):
    results = {}
    for dynamic in ("tube", "align", "current", "drop"):
        make(street, dynamic, settings={"dynamic": dynamic})
        results[dynamic] = vehicle_score(grid_of(street, dynamic), truth)
    return results


def test_a_passing_car_leaves_a_tube_under_semantickittis_rule_and_none_when_aligned(scores):
    assert scores["tube"][1] > 10 * scores["align"][1]
    assert scores["align"][0] > 0.6
    assert scores["align"][0] > 2.5 * scores["tube"][0]


def test_no_voxel_farther_than_one_from_the_passing_car_is_called_a_vehicle(street, scores):
    car, here = passing_car.street(FRAME), passing_car.sensor_pose(FRAME)[:3, 3]
    near = passing_car.SPEC.voxel_size + 1e-6
    for name in ("align", "current"):
        found = passing_car.SPEC.centers()[grid_of(street, name).labels == VEHICLE] + here
        moving = found[found[:, 1] > 0]
        assert len(moving)
        assert ((moving > car.lower[-1] - near) & (moving < car.upper[-1] + near)).all()


def test_alignment_completes_the_car_that_one_scan_sees_in_part(street, truth, scores):
    moving = slice(0, 128), slice(64, 84)  # the right half: the parked car stands on the left
    real = (truth.labels[moving] == VEHICLE).sum()
    seen = {
        name: int(
            ((grid_of(street, name).labels == VEHICLE) & (truth.labels == VEHICLE))[moving].sum()
        )
        for name in scores
    }
    assert seen["drop"] == 0
    assert seen["current"] < seen["align"]
    assert seen["align"] > 0.95 * real


def test_static_voxels_are_the_same_whatever_becomes_of_moving_actors(street, scores):
    grids = [grid_of(street, name) for name in ("align", "current", "drop")]
    left = slice(0, 128), slice(0, 60)  # nothing moves there
    for grid in grids[1:]:
        assert (grid.labels[left] == grids[0].labels[left]).all()
        assert (grid.counts[left] == grids[0].counts[left]).all()


@pytest.mark.slow
def test_numbered_points_do_as_well_as_flow(tmp_path, truth, scores):
    street = passing_car.write_sequence(tmp_path, ("labels", "instances"))
    make(street, "by_instances")
    iou, wrong = vehicle_score(grid_of(street, "by_instances"), truth)
    assert iou > scores["align"][0] - 0.05
    assert wrong < scores["tube"][1] / 15


def test_a_cylindrical_grid_has_no_tube_either(street):
    spec = GridSpec.published("cylindrical")
    truth = passing_car.reference(FRAME, spec)
    for dynamic in ("tube", "align"):
        make(street, dynamic, spec=spec, settings={"dynamic": dynamic})
    sequences = carlasc.open(street).sequences()
    grids = {name: sequences["cylindrical"].grid(name, FRAME) for name in ("tube", "align")}
    iou, wrong = vehicle_score(grids["align"], truth)
    assert iou > 0.5
    assert vehicle_score(grids["tube"], truth)[1] > 10 * wrong


def test_a_frame_does_not_depend_on_which_frames_a_run_makes(street):
    make(street, "alone", frames=(24, 25))
    make(street, "together", frames=(22, 27))
    assert (grid_of(street, "alone", 24).labels == grid_of(street, "together", 24).labels).all()
    assert (grid_of(street, "alone", 24).counts == grid_of(street, "together", 24).counts).all()


@pytest.mark.slow
def test_processes_make_the_same_grids(street):
    make(street, "one", frames=(18, 22))
    carlasc.regrid(
        street,
        passing_car.SPEC,
        name="two",
        frames=(18, 22),
        observe=FromScans(),
        run=Run(workers=2),
    )
    for frame in range(18, 22):
        assert (grid_of(street, "one", frame).labels == grid_of(street, "two", frame).labels).all()


@pytest.mark.slow
def test_an_executor_that_outlives_a_run_sees_the_files_of_the_next(tmp_path):
    street = passing_car.write_sequence(tmp_path)
    with ProcessPoolExecutor(1, get_context("spawn")) as executor:
        make(street, "before", run=Run(1, executor))
        for path in street.rglob(f"velodyne/{FRAME:06d}.bin"):
            points = np.fromfile(path, np.float32).reshape(-1, 4)
            points[:, :3] *= 0.9
            path.write_bytes(points.tobytes())
        make(street, "after", run=Run(1, executor))
    make(street, "plain")
    assert (grid_of(street, "after").labels == grid_of(street, "plain").labels).all()
    assert (grid_of(street, "after").labels != grid_of(street, "before").labels).any()


def test_times_that_do_not_rise_are_named(tmp_path):
    street = passing_car.write_sequence(tmp_path, ("labels", "instances"))
    (path,) = street.rglob(layout.TIMES)
    times = np.arange(passing_car.FRAMES) * 0.1
    times[22] = times[21]
    path.write_bytes(layout.encode_times(times))
    with pytest.raises(
        FormatError,
        match=r"times.txt: expected increasing times, found 2.1 s and 2.1 s at frames 21 and 22",
    ):
        make(street, "broken")
    path.unlink()
    assert make(street, "without").made == 1


def test_frames_keep_their_numbers_and_the_record_says_how(street):
    result = make(street, "numbered", frames=(30, 33), settings={"window": (-4, 4), "stride": 2})
    assert result.made == 3
    assert sorted(p.name for p in (street / "cartesian" / "numbered").glob("*.label")) == [
        f"0000{n}.label" for n in (30, 31, 32)
    ]
    record = json.loads((street / "cartesian" / "numbered" / "params.json").read_text())["carlasc"]
    assert (record["observe"], record["dynamic"], record["window"], record["stride"]) == (
        "scans",
        "align",
        "-4:4",
        2,
    )
    assert record["motion"] == "flow"
    with pytest.raises(ConflictError, match="stride|window"):
        make(street, "numbered", frames=(30, 33))
    assert (
        make(street, "numbered", frames=(30, 34), settings={"window": (-4, 4), "stride": 2}).skipped
        == 3
    )


def test_votes_for_things_and_for_free_space_are_kept_apart(street):
    make(street, "voted", voting=Voting(keep=True), settings={"complete": "seen"})
    sequence = next(iter(carlasc.open(street).sequences().values()))
    votes = sequence.read("voted/votes", FRAME)
    grid = sequence.grid("voted", FRAME)
    counts = np.bincount(votes["voxel"], votes["votes"], grid.spec.num_voxels)
    known = grid.known.reshape(-1)
    assert (counts[known] == grid.counts.reshape(-1)[known]).all()
    # where traffic passes, or a body hides them
    assert 0 < np.count_nonzero(counts[~known]) < 0.05 * np.count_nonzero(known)
    contested = np.intersect1d(
        votes["voxel"][votes["label"] == 0], votes["voxel"][votes["label"] > 0]
    )
    assert len(contested)
    occupied_labels = grid.labels.reshape(-1)[votes["voxel"][votes["label"] == 0]]
    assert (occupied_labels > 0).any()  # free votes that lost


class TestWindows:
    def feed(self, street, **settings):
        sequence = next(iter(carlasc.open(street / "cartesian").sequences().values()))
        return ScanFeed(sequence, FromScans(**settings))

    def test_a_window_is_cut_at_the_ends_of_a_sequence(self, street):
        assert self.feed(street).window_of(5) == list(range(36))
        assert self.feed(street, window=(-2, 1)).window_of(40) == [38, 39, 40]

    def test_strides_count_from_the_current_frame(self, street):
        assert self.feed(street, window=(-5, 5), stride=2).window_of(10) == [6, 8, 10, 12, 14]
        assert self.feed(street, window=(-5, 5), stride=2).window_of(11) == [7, 9, 11, 13, 15]

    def test_distance_driven_leaves_out_scans_from_the_same_place(self, street):
        window = self.feed(street, window_m=1.5).window_of(20)
        assert 20 in window
        assert (min(window), max(window)) == (5, 35)  # 0.1 m a frame
        few = self.feed(street, window_m=30.0).window_of(20)
        assert len(few) < 8
        assert window == sorted(window)

    def test_points_out_of_range_do_not_vote(self, street):
        feed = self.feed(street, min_range_m=5.0, max_range_m=12.0)
        distance = np.linalg.norm(feed.read(3).points, axis=1)
        assert distance.min() >= 5
        assert distance.max() <= 12

    def test_a_feed_pickles_small_and_is_shared_by_its_copies(self, street):
        feed = self.feed(street)
        feed.read(3)
        data = pickle.dumps(feed)
        assert len(data) < 5000
        assert pickle.loads(data) is pickle.loads(data)

    @pytest.mark.parametrize(
        "settings",
        [
            {"window": (1, 5)},
            {"window": (-5, -1)},
            {"stride": 0},
            {"window_m": 0.0},
            {"dynamic": "melt"},
            {"min_range_m": 5.0, "max_range_m": 2.0},
        ],
    )
    def test_settings_that_are_not_valid_are_refused(self, settings):
        with pytest.raises(ArgumentError):
            FromScans(**settings)


def test_rays_through_a_box_are_those_a_plain_look_at_all_rays_finds():
    rng = np.random.default_rng(0)
    points = rng.uniform(-20, 20, (300, 3)).astype(np.float32)
    scan = PreparedScan.of(0, points, np.ones(300, np.uint16), np.eye(4))
    for _ in range(12):
        middle, half = rng.uniform(-10, 10, 3), rng.uniform(0.5, 4, 3)
        lower, upper = -half, half
        box_T_sensor = translation(-middle)
        found = np.sort(scan.rays.through(box_T_sensor[None], lower, upper)[0])
        steps = np.linspace(0, 1, 1001)[:, None]
        plain = [
            i
            for i, p in enumerate(points)
            if (((steps * p - middle) > lower) & ((steps * p - middle) < upper)).all(axis=1).any()
        ]
        assert set(plain) <= set(found.tolist())
        grazing = set(found.tolist()) - set(plain)
        assert len(grazing) <= 3  # rays that only touch a corner, between two steps


class TestBadInput:
    def test_no_poses_offer_kiss_icp_if_those_of_the_file_are_asked_for(self, tmp_path):
        street = passing_car.write_sequence(tmp_path, frames=3, poses=False)
        with pytest.raises(
            MissingDataError, match=r"poses.txt: expected poses.*poses=PoseOptions\(\"kiss-icp\"\)"
        ):
            make(street, "x", frames=None, settings={"poses": PoseOptions("file")})

    @pytest.mark.parametrize("source", ["auto", "kiss-icp"])
    def test_kiss_icp_can_find_them(self, tmp_path, source):
        pytest.importorskip("kiss_icp")
        folder = write_drive(tmp_path / "Street" / "cartesian", drive(8, speed_m=0.8))
        (folder / "poses.txt").unlink()
        result = make(tmp_path, "x", frames=(2, 4), settings={"poses": PoseOptions(source)})
        assert sum("they were estimated from the scans" in note for note in result.notes) == (
            source == "auto"
        )
        record = json.loads((folder / "x" / "params.json").read_bytes())["carlasc"]
        assert record["poses"] == "kiss-icp"
        again = make(tmp_path, "x", frames=(2, 5), settings={"poses": PoseOptions(source)})
        assert (again.made, again.skipped) == (1, 2)
        poses = layout.decode_poses((folder / "poses.txt").read_bytes(), "poses.txt")
        assert poses.shape == (8, 4, 4)
        assert poses[7, 0, 3] == pytest.approx(5.6, abs=0.3)

    def test_scans_without_labels_give_geometry_and_say_so(self, tmp_path):
        street = passing_car.write_sequence(tmp_path, (), frames=3)
        result = make(street, "x", frames=None)
        assert "no labels" in result.notes[0]
        assert set(np.unique(grid_of(street, "x", 1).labels)) == {0, 3}

    @pytest.mark.parametrize(
        ("times", "cause"), [(None, "rain, snow or dust"), (np.r_[0:10, 40:50] / 10, "the clock")]
    )
    def test_many_points_that_move_without_an_actor_are_a_warning_with_its_cause(
        self, tmp_path, times, cause
    ):
        street, rng = passing_car.write_sequence(tmp_path, (), frames=20), np.random.default_rng(5)
        for file in sorted((street / "cartesian/velodyne").glob("*.bin")):  # drops of rain
            points = np.fromfile(file, np.float32).reshape(-1, 4)
            wet = rng.random(len(points)) < 0.05
            points[wet, :3] *= rng.uniform(0.2, 0.8, (wet.sum(), 1)).astype(np.float32)
            points.tofile(file)
        if times is not None:
            (street / "cartesian" / layout.TIMES).write_bytes(layout.encode_times(times))
        options = {"poses": PoseOptions(refine="never")}
        notes = make(street, "x", frames=(10, 11), settings=options).notes
        (warning,) = (note for note in notes if "warning" in note)
        assert "% of all points seem to move and belong to no actor" in warning
        assert cause in warning

    def test_what_is_found_without_a_field_that_shows_motion_is_said(self, tmp_path):
        street = passing_car.write_sequence(tmp_path, ("labels",), frames=20)
        (note,) = make(street, "x", frames=(10, 11)).notes
        assert "cartesian: free space shows 1 actors that move" in note
        assert ", although no field of the data shows it" in note
        (note,) = make(
            street, "y", frames=(10, 11), settings={"motion": MotionOptions("none")}
        ).notes
        assert "cartesian: no field shows motion: all points were treated as static" in note
        assert make(street, "z", frames=(10, 11), settings={"dynamic": "tube"}).notes == ()

    def test_a_window_larger_than_the_sequence_is_fine(self, tmp_path):
        street = passing_car.write_sequence(tmp_path, frames=3)
        assert make(street, "x", frames=None, settings={"window": (-500, 500)}).made == 3

    def test_flow_that_is_no_number_counts_as_static(self, tmp_path):
        street = passing_car.write_sequence(tmp_path, frames=3)
        writer = FolderSink(tmp_path).sequence("Val/Street/cartesian")
        flow = next(iter(carlasc.open(street).sequences().values())).read("flow", 1).copy()
        flow[:10] = np.nan
        writer.write("flow", 1, flow)
        assert make(street, "x", frames=None).failures == ()

    def test_poses_that_jump_name_the_frame_and_force_goes_on(self, tmp_path):
        street = passing_car.write_sequence(tmp_path, frames=6)
        path = street / "cartesian" / "poses.txt"
        poses = layout.decode_poses(path.read_bytes(), "poses.txt")
        poses[4:, 0, 3] += 30
        path.write_bytes(layout.encode_poses(poses))
        with pytest.raises(
            FormatError, match=r"poses.txt: .*jump of 301 m/s.* at frame 4 .*`force=True`"
        ):
            make(street, "x", frames=None)
        assert make(street, "x", frames=None, settings={"poses": PoseOptions(force=True)}).made == 6

    def test_a_scan_cut_short_fails_its_frames_and_the_command_says_which(self, tmp_path):
        street = passing_car.write_sequence(tmp_path, frames=30)
        path = street / "cartesian" / "velodyne" / "000002.bin"
        path.write_bytes(path.read_bytes()[:-3])
        arguments = [
            "regrid",
            str(street),
            "--preset",
            "coarse",
            "--window=-1:1",
            "--workers",
            "1",
            "--frames",
            "0:30",
        ]
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 1
        assert "000002.bin" in result.stderr


class TestFromFinerGrids:
    def test_a_coarser_grid_of_the_finest_there_is(self, street):
        fine = replace(passing_car.SPEC, size=(256, 256, 16))
        make(street, "fine", frames=(20, 22), spec=fine)
        result = carlasc.regrid(
            street, passing_car.SPEC, name="coarse", observe=FromGrid("fine"), run=Run(workers=1)
        )
        assert result.made == 2
        coarse, finer = grid_of(street, "coarse", 20), grid_of(street, "fine", 20)
        assert coarse.counts.sum() == finer.counts.sum()
        record = json.loads((street / "cartesian" / "coarse" / "params.json").read_text())[
            "carlasc"
        ]
        assert (record["observe"], record["grid"]) == ("grid", "fine")

    def test_finer_than_what_is_there_is_refused_with_the_reason(self, street):
        make(street, "base")
        with pytest.raises(ArgumentError, match="new measurements"):
            carlasc.regrid(
                street, GridSpec.published().with_resolution(0.1), observe=FromGrid("base")
            )

    def test_a_grid_that_is_not_there_is_named(self, street):
        with pytest.raises(MissingDataError, match="the grid ghost"):
            carlasc.regrid(street, passing_car.SPEC, observe=FromGrid("ghost"))
