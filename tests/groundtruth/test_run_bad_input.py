"""A bad frame is named and the others go on; a place that cannot be written to stops the run;
nothing half-written stays.
"""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.captures import read_tree, write_capture

from carlasc import Run
from carlasc.core.grids import GridSpec
from carlasc.errors import FormatError, MissingDataError
from carlasc.groundtruth import FromCapture, Voting, regrid
from carlasc.storage import FolderSource

SMALL = GridSpec.published().with_size((32, 32, 4))
GRID = "evaluation_32x32x4"


def _cut_short(path):
    path.write_bytes(path.read_bytes()[:-7])


def _replace(array):
    return lambda path: np.save(path, array)


BAD = {  # the file of frame 101, what is done to it, what the message says
    "cut short": ("velodyne1", _cut_short, "expected 3728 bytes .*, found 3721"),
    "not an array": ("labels0", lambda path: path.write_bytes(b"hello"), "expected a .npy array"),
    "wrong type": (
        "velodyne1",
        _replace(np.zeros((300, 3))),
        "expected float32 values, found float64",
    ),
    "NaN point": (
        "velodyne1",
        _replace(np.full((300, 3), np.nan, np.float32)),
        "expected finite coordinates",
    ),
    "infinite point": (
        "velodyne0",
        _replace(np.full((300, 3), np.inf, np.float32)),
        "expected finite coordinates",
    ),
    "missing": ("labels1", lambda path: path.unlink(), "expected a file, found nothing"),
    "label beyond the table": (
        "labels1",
        _replace(np.full(300, 25, np.uint32)),
        "expected class ids of carla, found 25",
    ),
    "points without label": (
        "labels1",
        _replace(np.zeros(200, np.uint32)),
        "expected 300 values, .* found 200",
    ),
    "pose not rigid": ("pose1", _replace(np.eye(4) * 3), "expected a rigid transform"),
    "ego pose not rigid": ("pose0", _replace(np.eye(4) * 3), "expected a rigid transform"),
    "ego pose missing": ("pose0", lambda path: path.unlink(), "expected a file, found nothing"),
    "ego pose mirrored": (
        "pose0",
        _replace(np.diag([1.0, -1, 1, 1])),
        "expected a rotation, found a reflection",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("bad", BAD)
def test_a_bad_frame_is_named_the_others_are_made_and_a_fixed_one_is_added(tmp_path, bad):
    folder, spoil, message = BAD[bad]
    capture = write_capture(tmp_path)
    regrid(tmp_path, SMALL, tmp_path / "good", run=Run(workers=1))
    path = Path(capture.location) / folder / "101.npy"
    sound = path.read_bytes()
    spoil(path)

    result = regrid(tmp_path, SMALL, tmp_path / "out", run=Run(workers=1))
    (failure,) = result.failures
    assert (result.made, result.skipped, failure.frame) == (2, 0, 101)
    assert failure.message.startswith(str(path)) and "\n" not in failure.message
    assert re.search(message, failure.message)
    (sequence,) = FolderSource(tmp_path / "out").sequences().values()
    assert sequence.frames(f"{GRID}/labels").tolist() == [0, 2]
    assert sequence.scan_frames().tolist() == [0, 2]
    assert np.isfinite(sequence.read_pose(2)).all() and len(sequence.times) == 3

    path.write_bytes(sound)
    again = regrid(tmp_path, SMALL, tmp_path / "out", run=Run(workers=1))
    assert (again.made, again.skipped, again.failures) == (1, 2, ())
    assert read_tree(tmp_path / "out") == read_tree(tmp_path / "good")


def test_the_first_pose_is_the_origin_without_which_nothing_is_written(tmp_path):
    capture = write_capture(tmp_path)
    np.save(Path(capture.location) / "pose0" / "100.npy", np.eye(4) * 3)
    with pytest.raises(
        FormatError,
        match="pose0/100.npy: .*: the first frame's pose is the origin .*start with a later",
    ):
        regrid(tmp_path, SMALL, run=Run(workers=1))
    assert not (tmp_path / "cartesian").exists()
    assert regrid(tmp_path, SMALL, run=Run(workers=1), frames=(101, None)).made == 2


def test_no_capture_and_no_sensor_are_said(tmp_path):
    with pytest.raises(
        MissingDataError, match="expected a capture .* or sequences with scans .*, found neither"
    ):
        regrid(tmp_path, SMALL)
    with pytest.raises(MissingDataError, match="expected a capture .*, found none"):
        regrid(tmp_path, SMALL, observe=FromCapture())
    (tmp_path / "raw").mkdir()
    with pytest.raises(
        MissingDataError, match="expected the folder velodyne0 of the ego sensor, found no sensor"
    ):
        regrid(tmp_path, SMALL)
    assert read_tree(tmp_path, leave_out="nothing") == {}


def test_files_cut_short_in_the_output_are_made_again(tmp_path):
    write_capture(tmp_path)
    regrid(tmp_path, SMALL, run=Run(workers=1), voting=Voting(keep=True))
    whole = read_tree(tmp_path, leave_out="nothing")
    for file in (
        "velodyne/000001.bin",
        f"{GRID}/000000.bin",
        f"{GRID}/000001.votes.npz",
        f"{GRID}/000002.label",
    ):
        _cut_short(tmp_path / "cartesian" / file)
    result = regrid(tmp_path, SMALL, run=Run(workers=1), voting=Voting(keep=True))
    assert (result.made, result.failures) == (3, ())
    assert read_tree(tmp_path, leave_out="nothing") == whole


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.slow
def test_a_full_disk_stops_the_run_in_one_line_and_leaves_whole_files(tmp_path, workers):
    """A limit on the size of files fails a write in its middle, as a full disk does."""
    write_capture(tmp_path, frames=4)
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))\n"
        "from carlasc.cli import main; main()"
    )
    command = [
        sys.executable,
        "-c",
        code,
        "regrid",
        str(tmp_path),
        "--preset",
        "coarse",
        "--workers",
        str(workers),
    ]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert "Traceback" not in run.stderr
    # Numba may warn that its cache of compiled code exceeds this limit, too; of our own there is
    # one line.
    (line,) = [line for line in run.stderr.splitlines() if line.startswith("carlasc: ")]
    assert "evaluation/00000" in line and "cannot be written: File too large" in line
    written = read_tree(tmp_path)
    assert not [
        name for name in written if ".part" in name or name.startswith("cartesian/evaluation/0")
    ]
    result = regrid(tmp_path, GridSpec.published(), run=Run(workers=1))
    assert result.made == 4  # with room again it goes on
    assert written.items() <= read_tree(tmp_path).items()


def test_an_output_that_is_a_file_is_said(tmp_path):
    write_capture(tmp_path, frames=1)
    (tmp_path / "out").write_text("in the way")
    run = subprocess.run(
        [
            sys.executable,
            "-m",
            "carlasc",
            "regrid",
            str(tmp_path),
            "-o",
            str(tmp_path / "out"),
            "--preset",
            "coarse",
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 1
    (line,) = run.stderr.splitlines()
    assert f"{tmp_path / 'out'}/" in line and "cannot be written" in line
