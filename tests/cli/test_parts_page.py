"""The job scripts of the page on many machines, as jobs of this machine."""

import os
import re
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.datasets.captures import read_tree, write_capture

from carlasc import Run
from carlasc.core.grids import GridSpec
from carlasc.groundtruth import regrid

pytestmark = pytest.mark.posix("programs without a suffix")
PAGE = Path(__file__).parents[2] / "docs" / "howto" / "many-machines.md"
SPEC = GridSpec.published().with_size((32, 32, 4))


@pytest.fixture
def site(tmp_path):
    """A folder with the scripts of the page, a command `carlasc`, a capture, and what one run makes
    of it.
    """
    for name, text in re.findall(r'```bash title="([^"]+)"\n(.*?)```', PAGE.read_text(), re.DOTALL):
        (tmp_path / name).write_text(text)
    command = tmp_path / "bin" / "carlasc"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m carlasc "$@"\n')
    command.chmod(command.stat().st_mode | stat.S_IXUSR)
    write_capture(tmp_path / "source", frames=70, points=50)
    regrid(tmp_path / "source", SPEC, tmp_path / "one.zarr", run=Run(workers=1))
    return tmp_path


def environment(site, **more):
    return os.environ | {"PATH": f"{site / 'bin'}:{os.environ['PATH']}"} | more


@pytest.mark.slow
@pytest.mark.needs("zarr")
@pytest.mark.parametrize("out", ["fine.zarr", "fine"])
def test_the_jobs_of_an_array_write_one_output(site, out):
    jobs = []
    for number in range(1, 5):
        about = {"SOURCE": str(site / "source"), "OUT": str(site / out)}
        about |= {
            "SLURM_ARRAY_TASK_ID": str(number),
            "SLURM_ARRAY_TASK_COUNT": "4",
            "SLURM_CPUS_PER_TASK": "1",
        }
        jobs.append(subprocess.Popen(["bash", site / "regrid.sh"], env=environment(site, **about)))
    assert [job.wait(timeout=180) for job in jobs] == [0, 0, 0, 0]
    if out == "fine.zarr":
        assert read_tree(site / out) == read_tree(site / "one.zarr")
    else:
        regrid(site / "source", SPEC, site / "one", run=Run(workers=1))
        assert read_tree(site / out) == read_tree(site / "one")


@pytest.mark.slow
@pytest.mark.needs("zarr")
def test_the_script_for_hosts_starts_a_part_on_each_and_says_whether_one_failed(site):
    ssh = site / "bin" / "ssh-here"
    ssh.write_text('#!/bin/sh\n[ "$1" = lost ] && exit 255\nshift\nexec sh -c "$*"\n')
    ssh.chmod(ssh.stat().st_mode | stat.S_IXUSR)
    command = ["bash", site / "parts.sh", site / "source", site / "fine.zarr"]
    lost = subprocess.run(
        [*command, "one", "lost"], env=environment(site, SSH=str(ssh)), check=False, timeout=180
    )
    assert lost.returncode == 1
    again = subprocess.run(
        [*command, "one", "two"], env=environment(site, SSH=str(ssh)), check=False, timeout=180
    )
    assert again.returncode == 0
    assert read_tree(site / "fine.zarr") == read_tree(site / "one.zarr")
