import json

import pytest
from carlasc_recorders import SimulatedCapture
from typer.testing import CliRunner

import carlasc
from carlasc import GridSpec, Run
from carlasc.captures import Lidar
from carlasc.cli import app
from carlasc.storage import layout
from carlasc.storage import open as open_store
from carlasc.testing import wrong_poses

SPEC = GridSpec(lower=(-8, -8, -2), upper=(8, 8, 2), size=(16, 16, 4), coordinates="cartesian")


def call(*options):
    return CliRunner().invoke(app, ["refine", "--workers", "1", *map(str, options)])


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive of six scans whose poses are off by some centimetres."""
    folder = tmp_path_factory.mktemp("drive")
    capture = SimulatedCapture(
        count=6, sensors=1, seed=3, bev=False, lidar=Lidar(channels=32, points=30_000)
    )
    carlasc.regrid(capture, SPEC, folder / "Train" / "One", run=Run(workers=1))
    poses = open_store(folder).sequences()["Train/One/cartesian"].poses
    wrong = wrong_poses(poses, jitter_m=0.04, jitter_rad=0.002, seed=1)
    (folder / "Train/One/cartesian/poses.txt").write_bytes(layout.encode_poses(wrong))
    return folder


def test_it_says_what_was_done_to_each_sequence_and_what_was_written(drive, tmp_path):
    done = call(drive, "-o", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    first, note, last = done.stdout.splitlines()
    assert first.startswith(
        "Train/One/cartesian: poses were refined: neighbouring scans disagreed by "
    )
    assert note == "note: evaluation_16x16x4/ left out, because of other poses"
    assert last == f"{tmp_path}/out: poses of 1 of 1 sequence refined; 24 files linked, 0 written"
    again = call(tmp_path / "out", "-o", tmp_path / "again", "--json")
    printed = json.loads(again.stdout)
    assert printed["refined"] == [] and printed["linked"] == 24
    assert printed["notes"][0].startswith(
        "Train/One/cartesian: poses left as they are: neighbouring scans disagree by "
    )


def test_the_options_of_poses_reach_the_run(drive, tmp_path):
    call(drive, "-o", tmp_path / "good")
    assert call(tmp_path / "good", "-o", tmp_path / "out").exit_code == 0
    assert (
        call(
            tmp_path / "good", "-o", tmp_path / "out", "--refine", "always", "--overwrite"
        ).exit_code
        == 0
    )
    files = [tmp_path / name / "Train/One/cartesian/poses.txt" for name in ("good", "out")]
    assert files[0].read_bytes() != files[1].read_bytes()
    (tmp_path / "good/Train/One/cartesian/poses.txt").unlink()
    failed = call(tmp_path / "good", "-o", tmp_path / "none", "--poses", "file")
    assert failed.exit_code == 1
    assert (
        failed.stderr.count("\n") == 1
        and "expected poses" in failed.stderr
        and "`--poses kiss-icp`" in failed.stderr
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--refine", "never"), "carlasc: --refine: expected auto or always, found 'never'"),
        (("--refine", "often"), "'often' is not one of 'auto', 'always', 'never'"),
        (("--poses", "guess"), "'guess' is not one of"),
        (("--frames", "0:2"), "--frames"),
        (("--part", "3/2"), "--part"),
        (("--part", "1/2", "--overwrite"), "--overwrite: expected False with `--part`"),
    ],
)
def test_wrong_use_is_one_line(drive, tmp_path, options, message):
    result = call(drive, "-o", tmp_path / "out", *options)
    assert result.exit_code == 2 and result.stderr.count("\n") == 1
    assert message in result.stderr
    assert not list(tmp_path.iterdir())


def test_an_output_is_needed_and_an_existing_one_is_kept(drive, tmp_path):
    assert call(drive).exit_code == 2
    (tmp_path / "out").mkdir()
    refused = call(drive, "-o", tmp_path / "out")
    assert refused.exit_code == 1 and "or give `--overwrite`" in refused.stderr
