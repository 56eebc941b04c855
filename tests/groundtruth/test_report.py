"""The report that a run leaves beside each grid: its figures, and that it is complete whatever the
run was like.
"""

import json
import shutil
from dataclasses import replace
from hashlib import blake2b

import numpy as np
import pytest
from helpers.datasets.captures import write_capture
from helpers.scenes import passing_car
from helpers.scenes.box_actors import MovingBox, scan_of

import carlasc
from carlasc import Grid, GridSpec, Run
from carlasc.core.frames import FrameRange
from carlasc.core.grids import VoxelFlag
from carlasc.core.tables import CARLA
from carlasc.errors import FormatError
from carlasc.groundtruth import FromGrid, FromScans, Voting, regrid
from carlasc.groundtruth.from_scans.sequences import ScanSequence
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.reporting import (
    Changes,
    FileDigest,
    FrameFacts,
    Report,
    Residual,
    actors_of,
    digest_of,
    sample_frames,
)
from carlasc.storage import FolderSink, layout

FRAMES = 8
SPEC = GridSpec.published().with_resolution(0.8)
OBSERVE = FromScans(window=(-3, 3))
GRID = layout.grid_folder(SPEC)


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return passing_car.write_sequence(tmp_path_factory.mktemp("street"), frames=FRAMES)


def make(source, out=None, **options):
    return regrid(source, SPEC, out, **{"observe": OBSERVE, "run": Run(workers=1), **options})


def report_in(folder, grid=GRID):
    (path,) = folder.rglob(f"{grid}/{layout.REPORT}")
    return Report.from_json(path.read_bytes(), str(path))


@pytest.fixture(scope="module")
def made(street, tmp_path_factory):
    out = tmp_path_factory.mktemp("made")
    make(street, out)
    return out


def test_a_report_says_what_the_grids_hold(made):
    report = report_in(made)
    (sequence,) = carlasc.open(made).sequences().values()
    grids = [sequence.grid(GRID, frame) for frame in range(FRAMES)]
    labels = np.concatenate([grid.labels[grid.known] for grid in grids])
    counts = np.concatenate([grid.counts[grid.known] for grid in grids])
    coverage = report.coverage
    assert report.frames == tuple(range(FRAMES))
    assert report.settings == sequence.params(GRID)
    assert coverage.voxels == FRAMES * SPEC.num_voxels
    assert coverage.known == len(labels)
    assert coverage.known_share == len(labels) / coverage.voxels
    assert coverage.occupied == (labels != 0).sum()
    assert coverage.classes["Vehicle"] == (labels == 10).sum() > 0
    assert sum(coverage.classes.values()) == coverage.known
    assert coverage.mean_votes == pytest.approx(counts.mean(), abs=1e-3)
    assert coverage.votes[0] == (counts == 1).sum()
    assert coverage.votes[2] == ((counts >= 4) & (counts < 8)).sum()
    assert sum(coverage.votes) == coverage.known
    flags = [sequence.read(f"{GRID}/flags", frame) for frame in range(FRAMES)]
    inferred = np.concatenate([values & VoxelFlag.INFERRED > 0 for values in flags])
    assert report.inferred_share == inferred.sum() / coverage.known > 0
    assert report.holdout is None


def test_a_report_lists_the_actor_that_moves_and_how_well_it_is_tracked(made):
    (car,) = report_in(made).actors
    assert car.label == "Vehicle"
    assert car.observations == car.last - car.first + 1 == FRAMES
    assert car.speed_m_s == pytest.approx(10.0, abs=0.2)
    assert car.residual_m < car.residual_static_m


def test_digests_are_those_of_the_published_files(made):
    report = report_in(made)
    of_grid = {f"{GRID}/{part}" for part in ("labels", "counts", "flags")}
    assert {*of_grid, "points", "labels", "flow"} == set(report.digests)
    (folder,) = made.rglob("cartesian")
    for name, digests in report.digests.items():
        for row, frame in enumerate(report.frames):
            data = (folder / layout.field_named(name).file(frame)).read_bytes()
            assert digests.of(row) == blake2b(data, digest_size=16).hexdigest()[:8]
    for name, digest in report.documents.items():
        assert digest == FileDigest.of((folder / name).read_bytes())


def test_convergence_compares_grids_made_with_and_without_a_tenth_of_the_scans(street):
    observe = FromScans(window=(-7, 7))
    (sequence,) = carlasc.open(street).sequences().values()
    plan = GridPlan(SPEC, GRID, observe, Voting(), FrameRange.of(None))
    frame = ScanSequence(sequence, plan, observe).frames[4]
    whole, thinned = frame.make(plan).grid, frame.thinned(plan)
    changes = Changes.between(whole, thinned)
    both = whole.known & thinned.known
    assert changes == Changes(int(both.sum()), int((whole.labels != thinned.labels)[both].sum()))
    share = 1 - thinned.counts.sum() / whole.counts.sum()
    assert 0.05 < share < 0.25  # one of seven other scans


def test_convergence_is_in_the_report(made):
    convergence = report_in(made).convergence
    assert convergence.frames == 1
    assert 0 <= convergence.changed_share < 0.05
    assert convergence.known > 1000


def test_frames_are_sampled_by_their_numbers():
    assert sample_frames(range(100)) == {20, 60}
    assert sample_frames(range(50, 100)) == {60}
    assert sample_frames(range(3)) == {1}
    assert sample_frames([]) == frozenset()


def test_a_run_that_is_continued_leaves_the_report_of_one_run(street, made, tmp_path):
    make(street, tmp_path)
    whole = (report := next(tmp_path.rglob(layout.REPORT))).read_bytes()
    assert whole == next(made.rglob(layout.REPORT)).read_bytes()
    report.unlink()  # as if it had been interrupted
    for frame in (2, 5):
        next(tmp_path.rglob(f"{GRID}/{frame:06d}.label")).unlink()
    assert make(street, tmp_path).made == 2
    assert report.read_bytes() == whole


@pytest.mark.slow
def test_parts_of_a_sequence_add_up_in_the_report(street, made, tmp_path):
    make(street, tmp_path, frames=(0, 3))
    assert report_in(tmp_path).frames == (0, 1, 2)
    make(street, tmp_path, frames=(5, FRAMES))
    assert report_in(tmp_path).frames == (0, 1, 2, 5, 6, 7)
    make(street, tmp_path, frames=(3, 5))
    ours, theirs = report_in(tmp_path), report_in(made)
    assert ours == theirs


def test_a_complete_run_measures_nothing_again(street, made, monkeypatch):
    before = next(made.rglob(layout.REPORT)).stat().st_mtime_ns
    monkeypatch.setattr("carlasc.groundtruth.run.FrameTask._read", None)  # would fail
    assert make(street, made).skipped == FRAMES
    assert next(made.rglob(layout.REPORT)).stat().st_mtime_ns == before


def test_a_damaged_report_is_replaced_by_the_next_run(street, made, tmp_path):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    report = next(tmp_path.rglob(layout.REPORT))
    whole = report.read_bytes()
    report.write_bytes(whole[:100])
    assert make(street, tmp_path).made == 0
    assert report.read_bytes() == whole


def test_an_overwritten_grid_has_a_report_of_its_own(street, made, tmp_path):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    make(street, tmp_path, observe=FromScans(window=(-1, 1)), frames=(0, 2), overwrite=True)
    report = report_in(tmp_path)
    assert report.frames == (0, 1)
    assert report.settings["carlasc"]["window"] == "-1:1"


def test_a_frame_that_fails_is_not_in_the_report(tmp_path):
    folder = passing_car.write_sequence(tmp_path, frames=3)
    (folder / "cartesian" / "labels" / "000001.label").write_bytes(b"odd")
    result = make(folder, tmp_path / "out", observe=FromScans(window=(0, 0), dynamic="tube"))
    assert [failure.frame for failure in result.failures] == [1]
    report = report_in(tmp_path / "out")
    assert report.frames == (0, 2)
    assert report.actors is None


def test_captures_and_finer_grids_have_reports_too(tmp_path):
    write_capture(tmp_path)
    regrid(tmp_path, GridSpec.published(), run=Run(workers=1))
    report = report_in(tmp_path, "evaluation")
    assert report.frames == (0, 1, 2)
    assert (report.convergence, report.actors) == (None, None)
    assert "bev" in report.digests
    regrid(tmp_path, SPEC, observe=FromGrid(), run=Run(workers=1))
    assert report_in(tmp_path).coverage.voxels == 3 * SPEC.num_voxels


@pytest.mark.slow
def test_the_report_is_the_same_in_a_store(street, made, tmp_path):
    pytest.importorskip("h5py")
    from carlasc.storage.hdf5.hdf5_sink import HDF5Sink

    with HDF5Sink(tmp_path / "made.h5") as sink:
        make(street, sink)
    (sequence,) = carlasc.open(tmp_path / "made.h5").sequences().values()
    name = layout.report_file(GRID)
    assert sequence.read_document(name) == next(made.rglob(layout.REPORT)).read_bytes()


def test_votes_of_every_class_are_in_the_digests(street, tmp_path):
    make(street, tmp_path, frames=(0, 2), voting=Voting(keep=True))
    (sequence,) = carlasc.open(tmp_path).sequences().values()
    digests = report_in(tmp_path).digests[f"{GRID}/votes"]
    assert digests.of(1) == digest_of(f"{GRID}/votes", sequence.read(f"{GRID}/votes", 1)).hex()[:8]


def test_a_report_survives_its_json(made):
    report = report_in(made)
    assert Report.from_json(report.to_json(), "here") == report
    assert Report.from_dict(json.loads(json.dumps(report.to_dict()))) == report


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "upgrade carlasc"),
        ({"format": None}, "remake"),
        ({"coverage": {}}, "something else"),
        ({"frames": [3]}, "something else"),
        ({"settings": {"grid_size": [8.0, {}, 4.0]}}, "^report: .*dict"),
        ({"actors": [{"label": "Vehicle"}]}, "something else"),
    ],
)
def test_what_is_no_report_is_refused(made, change, message):
    with pytest.raises(FormatError, match=message):
        Report.from_dict(report_in(made).to_dict() | change)


def test_a_grid_without_counts_has_no_votes():
    labels = np.zeros(SPEC.size, np.uint32)
    labels[0, 0, 0] = 10
    facts = FrameFacts.of(0, {"g/labels": labels}, "g", CARLA)
    coverage = Report.make("g", [facts], SPEC.to_params(), CARLA, {}).coverage
    assert coverage.known_share == 1
    assert (coverage.mean_votes, coverage.votes) == (None, ())
    assert coverage.classes == {"Free": SPEC.num_voxels - 1, "Vehicle": 1}


def test_the_inferred_share_needs_every_frame_to_say_it():
    labels = np.ones(SPEC.size, np.uint32)
    facts = [FrameFacts.of(frame, {"g/labels": labels}, "g", CARLA) for frame in (0, 1)]
    told = [replace(row, inferred=SPEC.num_voxels // 4) for row in facts]
    assert Report.make("g", told, SPEC.to_params(), CARLA, {}).inferred_share == 0.25
    assert Report.make("g", [told[0], facts[1]], SPEC.to_params(), CARLA, {}).inferred_share is None


def residual_of(actor, frame):
    """Compare the observations of an actor in two frames, with the sensor at the origin of the
    world.
    """
    one, other = (scan_of([actor], number).points for number in (frame, frame + 1))
    return Residual.between(one, other, actor.pose(0.1 * frame), actor.pose(0.1 * (frame + 1)))


def test_a_true_motion_overlays_observations_better_than_no_motion():
    moving, parked = (
        residual_of(MovingBox((5.0, 2.0, 0.0), speed=speed), 3) for speed in (8.0, 0.0)
    )
    assert moving.count == parked.count > 50
    assert moving.moving_m / moving.count < 0.15
    assert moving.static_m > 1.3 * moving.moving_m
    assert parked.static_m == pytest.approx(parked.moving_m)


def test_residuals_are_means_over_the_observations_of_each_actor_that_moves():
    about = {
        "label": 10,
        "instance": 0,
        "scans": 3,
        "points": 50,
        "speed_m_s": 5.0,
        "faces": 2,
        "confidence": 0.7,
    }
    about |= {"first": 1, "last": 3, "size_m": [4.0, 2.0, 1.5], "seen_m": [3.0, 1.0, 1.5]}
    summaries = [
        about | {"moves": False},
        about | {"moves": True},
        about | {"moves": True, "first": 0, "label": 4},
    ]
    frames = [{1: Residual(1.0, 4.0, 10), 0: Residual(9.0, 9.0, 1)}, {1: Residual(5.0, 6.0, 20)}]
    person, car = actors_of(summaries, frames, CARLA)
    assert (person.label, person.residual_m, person.residual_static_m) == ("Pedestrian", None, None)
    assert (car.label, car.residual_m, car.residual_static_m) == ("Vehicle", 0.2, round(1 / 3, 4))
    assert (car.size_m, car.seen_m, car.faces, car.observations) == (
        (4.0, 2.0, 1.5),
        (3.0, 1.0, 1.5),
        2,
        3,
    )
    assert car.confidence == 0.7


def test_changes_count_only_voxels_known_in_both():
    spec = GridSpec("cartesian", (4, 1, 1), (0.0, 0.0, 0.0), (4.0, 1.0, 1.0))

    def grid(labels, counts):
        return Grid(
            spec, np.array(labels, np.uint8).reshape(spec.size), np.array(counts).reshape(spec.size)
        )

    assert Changes.between(
        grid([1, 2, 3, 0], [1, 1, 1, 0]), grid([1, 5, 0, 4], [2, 2, 0, 1])
    ) == Changes(2, 1)


def test_more_lines_in_a_text_file_are_no_change():
    digest = FileDigest.of(b"one\ntwo\n")
    assert digest.matches(b"one\ntwo\n")
    assert digest.matches(b"one\ntwo\nthree\n")
    assert not digest.matches(b"one\n")
    assert not digest.matches(b"One\ntwo\n")


def test_a_run_into_the_source_digests_what_lies_beside_the_grid(tmp_path):
    folder = passing_car.write_sequence(tmp_path, frames=4)
    make(folder)
    assert set(report_in(folder).digests) >= {"points", "labels", "flow", f"{GRID}/labels"}
    assert (
        FolderSink(folder).sequence("cartesian").read_document(layout.report_file(GRID)) is not None
    )
