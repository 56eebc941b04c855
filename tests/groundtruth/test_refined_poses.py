"""Grids of scans whose poses are wrong: poses are refined before, kept for the next run, and never
overwritten.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.datasets.captures import read_tree
from typer.testing import CliRunner

import carlasc
from carlasc import FromScans, GridSpec, Run
from carlasc.cli import app
from carlasc.core.geometry import invert
from carlasc.core.tables import CARLA
from carlasc.groundtruth.from_scans import motion_pass
from carlasc.inspection import holdout
from carlasc.inspection.report_page import describe
from carlasc.motion import MotionOptions, PoseOptions
from carlasc.motion.joint_alignment import move
from carlasc.storage import FolderSink, Metadata, layout
from carlasc.testing import KINDS, SimulatedDrive, wrong_poses

FRAMES = 24
SPEC = GridSpec("cartesian", (80, 80, 10), (-16.0, -16.0, -2.2), (16.0, 16.0, 1.8))
NAMES = (
    "Free",
    "Road",
    "Building",
    "Vegetation",
    "Pole",
    "Vehicle",
    "Vehicle",
    "Pedestrian",
    "Pedestrian",
)
LABELS = np.array([CARLA.id_of(name) for name in NAMES], np.uint32)
assert len(LABELS) == len(KINDS)


@pytest.fixture(scope="module")
def drive():
    """Scans with labels, and their exact poses."""
    drive = SimulatedDrive(frames=FRAMES, channels=16, columns=360)
    rng, scans = np.random.default_rng(0), []
    for frame in range(FRAMES):
        scan = drive.scan(frame)
        away = np.linalg.norm(scan.points[:, :3], axis=1, keepdims=True)
        points = scan.points.copy()
        points[:, :3] *= 1 + rng.normal(0, 0.02, away.shape) / away
        scans.append((points, LABELS[scan.kinds]))
    poses = drive.world_T_vehicle(drive.times) @ drive.sensors[0].vehicle_T_sensor
    return scans, invert(poses[0]) @ poses


def write(drive, folder, poses, labelled=True):
    scans, _ = drive
    with FolderSink(folder).sequence("cartesian") as writer:
        writer.write_document(layout.POSES, layout.encode_poses(poses))
        writer.write_document(layout.METADATA, Metadata("right").to_json())
        for frame, (points, labels) in enumerate(scans):
            writer.write("points", frame, points)
            if labelled:
                writer.write("labels", frame, labels)
    return folder


@pytest.fixture(scope="module")
def wrong(drive):
    return wrong_poses(drive[1], jitter_m=0.06, jitter_rad=0.004, seed=1)


@pytest.fixture
def folder(drive, wrong, tmp_path):
    return write(drive, tmp_path / "drive", wrong)


@pytest.fixture
def passes(monkeypatch):
    """Count the refinements."""
    made, refine = [], motion_pass.refine_poses

    def counted(*args, **options):
        made.append(1)
        return refine(*args, **options)

    monkeypatch.setattr(motion_pass, "refine_poses", counted)
    return made


def make(folder, name="mine", out=None, frames=(12, 13), workers=1, refine="auto", **options):
    observe = FromScans(poses=PoseOptions(refine=refine), **options)
    result = carlasc.regrid(
        folder,
        SPEC,
        out,
        name=name,
        frames=frames,
        observe=observe,
        run=Run(workers=workers),
        overwrite=False,
    )
    assert result.failures == ()
    return result


def occupied(folder, name="mine"):
    (sequence,) = carlasc.open(folder).sequences().values()
    grid = sequence.grid(name, 12)
    return grid.labels > 0, grid.known


def iou(one, other):
    (first, known), (second, also) = one, other
    both = known & also
    return (first & second & both).sum() / ((first | second) & both).sum()


def kept_in(folder):
    (file,) = (folder / "cartesian" / layout.DERIVED).glob("poses-*.npz")
    return file


@pytest.mark.slow
@pytest.mark.parametrize("labelled", [True, False])
def test_grids_under_wrong_poses_become_those_under_exact_ones(drive, wrong, tmp_path, labelled):
    true = write(drive, tmp_path / "true", drive[1], labelled)
    exact = make(true)
    given = write(drive, tmp_path / "wrong", wrong, labelled)
    result = make(given)
    make(given, "never", refine="never")
    reference = occupied(true)
    wrong_share, share = (1 - iou(occupied(given, name), reference) for name in ("never", "mine"))
    assert wrong_share > 0.06 and share < 0.3 * wrong_share
    assert not any("refined" in note for note in exact.notes)
    (note,) = [note for note in result.notes if "refined" in note]
    assert "poses were refined: neighbouring scans disagreed by " in note and note.startswith(
        str(given)
    )


def test_exact_poses_give_the_same_bytes_whether_they_may_be_refined_or_not(drive, tmp_path):
    trees = []
    for refine in ("auto", "never"):
        folder = write(drive, tmp_path / refine, drive[1])
        make(folder, refine=refine)
        trees.append(
            {n: d for n, d in read_tree(folder).items() if n.endswith((".label", ".bin", ".txt"))}
        )
    assert trees[0] == trees[1]


@pytest.mark.slow
def test_what_was_given_stays_and_the_record_says_how_poses_were_used(folder, wrong):
    before = (folder / "cartesian" / layout.POSES).read_bytes()
    make(folder)
    make(folder, "never", refine="never")
    assert (folder / "cartesian" / layout.POSES).read_bytes() == before
    records = [
        json.loads((folder / "cartesian" / n / layout.PARAMS).read_text())["carlasc"]
        for n in ("mine", "never")
    ]
    assert [record.get("refine") for record in records] == ["auto", None]
    assert carlasc.validate(folder).ok
    (sequence,) = carlasc.open(folder).sequences().values()
    assert np.array_equal(sequence.poses, layout.decode_poses(before, "poses"))
    assert not any(
        layout.DERIVED in name for name in (*sequence.documents(), *sequence.unknown_files())
    )


@pytest.mark.slow
def test_refined_poses_are_kept_and_used_again(folder, passes):
    make(folder)
    kept = kept_in(folder).read_bytes()
    make(folder, "again", window=(-3, 3))
    assert len(passes) == 1
    make(folder, "always", refine="always")
    assert (
        len(passes) == 2 and len(list((folder / "cartesian" / layout.DERIVED).glob("poses-*"))) == 2
    )
    for file in (folder / "cartesian" / layout.DERIVED).iterdir():
        file.unlink()
    make(folder, "anew")
    assert len(passes) == 3 and kept_in(folder).read_bytes() == kept


@pytest.mark.slow
@pytest.mark.parametrize("data", [b"", b"not an archive"])
def test_what_is_kept_and_damaged_is_made_again(folder, passes, data):
    make(folder)
    good = kept_in(folder).read_bytes()
    kept_in(folder).write_bytes(data)
    make(folder, "again")
    assert len(passes) == 2 and kept_in(folder).read_bytes() == good


@pytest.mark.slow
def test_two_processes_give_the_bytes_of_one(drive, wrong, folder, tmp_path):
    make(folder, frames=(10, 14))
    other = write(drive, tmp_path / "other", wrong)
    make(other, frames=(10, 14), workers=2)
    assert read_tree(folder) == read_tree(other)


def test_a_scan_that_cannot_be_read_is_left_out_of_the_refinement(folder):
    path = folder / "cartesian" / layout.field_named("points").file(20)
    path.write_bytes(path.read_bytes()[:-3])
    assert make(folder, frames=(10, 12), window=(-5, 5), motion=MotionOptions("none")).made == 2


@pytest.mark.slow
def test_poses_that_cannot_be_refined_are_said_so(drive, tmp_path):
    other = drive[1].copy()
    move(other, np.arange(FRAMES)[:, None] * (0.0, 0.0, 0.0, 0.0, 0.0, 0.02), 0)
    result = make(write(drive, tmp_path / "other", other))
    (note,) = [note for note in result.notes if "refined" in note]
    assert (
        "scans do not fit each other under the poses of frames 0 to 23, which were not refined"
        in note
    )


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_scans_are_not_refined(drive, tmp_path, count, passes):
    scans, poses = drive
    folder = write((scans[:count], poses), tmp_path / "few", poses[:count])
    make(folder, frames=(0, 1))
    assert not passes
    assert not (folder / "cartesian" / layout.DERIVED).exists() or not list(
        (folder / "cartesian" / layout.DERIVED).glob("poses*")
    )


def test_scans_far_apart_keep_their_poses(drive, tmp_path):
    scans, poses = drive
    apart = poses[:6].copy()
    apart[:, 0, 3] += 20.0 * np.arange(6)
    folder = write((scans[:6], apart), tmp_path / "apart", apart)
    observe = FromScans(poses=PoseOptions(force=True))
    result = carlasc.regrid(folder, SPEC, name="mine", observe=observe, run=Run(workers=1))
    assert (result.made, result.failures) == (6, ())


@pytest.mark.slow
def test_frames_without_a_scan_get_the_correction_of_the_one_before(drive, wrong, tmp_path):
    scans, true = drive
    folder = write((scans, wrong), tmp_path / "gap", wrong)
    for name in ("points", "labels"):
        (folder / "cartesian" / layout.field_named(name).file(5)).unlink()
    (sequence,) = carlasc.open(folder).sequences().values()
    from carlasc.groundtruth.from_scans.feed import ScanFeed

    feed = ScanFeed(sequence, FromScans())
    refined = motion_pass.refine_sequence(feed)
    poses = motion_pass.with_refined_poses(sequence, feed.frames, refined).poses
    assert poses.shape == wrong.shape
    assert np.allclose(poses[5], poses[4] @ invert(wrong[4]) @ wrong[5])
    off = invert(invert(true[:-8]) @ true[8:]) @ invert(poses[:-8]) @ poses[8:]
    assert np.abs(np.delete(off, 5, axis=0)[8:, :3, 3]).max() < 0.03


@pytest.mark.slow
def test_the_report_says_how_poses_were_refined(folder, drive, tmp_path):
    make(folder)
    made = next(iter(carlasc.report(folder, run=Run(workers=1)).reports.values()))
    assert made.poses.before_m > 0.03 and made.poses.after_m < 0.02
    assert made.poses.changed_m == pytest.approx([0.06 * 2**0.5] * 3, rel=0.5)
    assert made.poses.changed_rad == pytest.approx([0.004 * 2**0.5] * 3, rel=0.5)
    assert 0.05 < made.poses.height_drift_m < 0.5 and made.poses.left == ()
    again = next(iter(carlasc.report(folder, remake=True, run=Run(workers=1)).reports.values()))
    assert again == made
    text = dict(describe(made))["poses"]
    assert (
        text.startswith("refined: neighbouring scans disagreed by ")
        and "degrees of roll, pitch, yaw per scan" in text
    )
    make(folder, "never", refine="never")
    reports = carlasc.report(folder, run=Run(workers=1)).reports
    assert {name.rpartition("/")[2]: report.poses is None for name, report in reports.items()} == {
        "mine": False,
        "never": True,
    }
    exact = write(drive, tmp_path / "exact", drive[1])
    make(exact)
    (report,) = carlasc.report(exact, run=Run(workers=1)).reports.values()
    assert report.poses.left == ((0, FRAMES - 1),) and report.poses.height_drift_m == 0.0
    assert dict(describe(report))["poses"].startswith("as given: neighbouring scans agree within ")


@pytest.mark.slow
def test_held_out_rays_get_better_and_are_measured_before_and_after(folder, drive, tmp_path):
    steps = []
    run = Run(workers=1, progress=lambda *step: steps.append(step))
    found = holdout(folder, SPEC, every=8, run=run)
    (before,), (after,) = found.given_poses.values(), found.sequences.values()
    assert before.frames == after.frames > 0
    wrong, right = (
        (scores.all.free or 0) + (scores.all.unknown or 0) for scores in (before, after)
    )
    assert right < 0.75 * wrong
    assert found.to_dict()["given_poses"] and steps[-1][0] == steps[-1][1]
    exact = holdout(write(drive, tmp_path / "exact", drive[1]), SPEC, every=8, run=Run(workers=1))
    assert not exact.given_poses
    make(folder)
    (report,) = carlasc.report(folder, holdout=True, save=True, run=Run(workers=1)).reports.values()
    assert report.holdout["given_poses"]["returns"] == report.holdout["rays"]["returns"]
    assert next(iter(carlasc.report(folder).reports.values())) == report
    assert "under the given poses" in dict(describe(report))["held-out rays"]
    result = CliRunner().invoke(
        app, ["validate", str(folder), "--holdout", "--every", "8", "--workers", "1"]
    )
    assert "under the given poses: returns in " in result.output
    assert "scans agree within " in result.output
