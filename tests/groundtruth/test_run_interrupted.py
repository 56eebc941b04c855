"""A run that is stopped leaves whole files only, and the next one finishes it."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from helpers.datasets.captures import read_tree, write_capture
from helpers.processes import interrupted

from carlasc import Run
from carlasc.core.grids import GridSpec
from carlasc.groundtruth import regrid

pytestmark = pytest.mark.posix("signals")

SPEC = GridSpec.published()
FRAMES = 30


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """The folder of a capture, and all that an uninterrupted run makes of it."""
    root = tmp_path_factory.mktemp("interrupted")
    write_capture(root, frames=FRAMES, points=5000)
    regrid(root, SPEC, root / "whole", run=Run(workers=1))
    return root, read_tree(root / "whole")


def _interrupt(root: Path, out: Path, kind: signal.Signals, workers: int) -> tuple[int, str]:
    """Return the exit code and stderr of a run that was sent a signal after 5 frames, once all its
    processes are gone.
    """
    command = [
        sys.executable,
        interrupted.__file__,
        kind.name,
        "5",
        "regrid",
        str(root),
        "-o",
        str(out),
    ]
    options = ["--preset", "coarse", "--workers", str(workers)]
    with subprocess.Popen(
        [*command, *options], stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        _, stderr = process.communicate(timeout=60)
    with suppress(ProcessLookupError):
        for _ in range(500):
            os.killpg(process.pid, 0)  # the group is there as long as one of its processes is
            time.sleep(0.01)
    return process.returncode, stderr


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_ctrl_c_stops_at_once_with_whole_files_and_the_next_run_finishes(
    capture, tmp_path, workers
):
    root, whole = capture
    start = time.monotonic()
    code, stderr = _interrupt(root, tmp_path, signal.SIGINT, workers)
    assert code == 130
    assert time.monotonic() - start < 30
    (line,) = stderr.splitlines()
    assert line.startswith("carlasc: interrupted")
    left = read_tree(tmp_path)
    assert left.items() < whole.items()  # every file that is there is whole, and some are missing
    assert sum(name.endswith("evaluation/000004.bin") for name in left) == 1
    result = regrid(root, SPEC, tmp_path, run=Run(workers=1))
    assert 0 < result.made <= FRAMES - 5
    assert result.made + result.skipped == FRAMES
    assert read_tree(tmp_path) == whole


@pytest.mark.slow
def test_a_killed_run_is_finished_by_the_next_one(capture, tmp_path):
    root, whole = capture
    assert _interrupt(root, tmp_path, signal.SIGKILL, 2)[0] == -signal.SIGKILL
    half = {name for name in read_tree(tmp_path) if name.endswith(".part")}
    assert {
        name: data for name, data in read_tree(tmp_path).items() if name not in half
    }.items() < whole.items()
    result = regrid(root, SPEC, tmp_path, run=Run(workers=1))
    assert result.made + result.skipped == FRAMES and result.skipped >= 5
    assert read_tree(tmp_path) == whole
