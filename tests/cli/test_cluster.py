"""The option --cluster on real commands."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest
from helpers.datasets.captures import read_tree, write_capture
from helpers.datasets.tiny_kitti import write_tiny_kitti
from helpers.processes import interrupted
from helpers.servers import dask_cluster, slurm

from carlasc import Run
from carlasc.inspection import validate
from carlasc.running import open_cluster

COMMANDS = (
    "simulate regrid convert export pack unpack stats validate report evaluate render".split()
)
FRAMES = 12

pytestmark = pytest.mark.needs("distributed")


def run(*arguments: object, code: int = 0, **environment: str) -> str:
    """Run a command; return what it prints to stdout, or to stderr if it fails."""
    path = os.pathsep.join(filter(None, sys.path))
    result = subprocess.run(
        [sys.executable, "-m", "carlasc", *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": path} | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert result.returncode == code, result.stderr
    return result.stderr if code else result.stdout


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """The folder of a capture, and all that one process makes of it."""
    root = tmp_path_factory.mktemp("capture")
    write_capture(root, frames=FRAMES, points=2000)
    run("regrid", root, "-o", root / "whole", "--preset", "coarse", "--workers", 1)
    return root, read_tree(root / "whole")


@pytest.mark.slow
def test_regrid_gives_the_same_bytes_and_a_second_run_starts_no_cluster(capture, tmp_path):
    root, whole = capture
    command = ("regrid", root, "-o", tmp_path, "--preset", "coarse", "--cluster")
    assert f"{FRAMES} frames made" in run(*command, "local:2")
    assert read_tree(tmp_path) == whole
    assert f"0 frames made ({FRAMES} existed)" in run(*command, "tcp://127.0.0.1:1")


@pytest.mark.slow
def test_convert_gives_the_same_bytes(tmp_path):
    write_tiny_kitti(tmp_path / "kitti")
    command = ("convert", "kitti", tmp_path / "kitti")
    run(*command, tmp_path / "one", "--workers", 1)
    run(*command, tmp_path / "cluster", "--cluster", "local:2")
    assert read_tree(tmp_path / "cluster") == read_tree(tmp_path / "one")


@pytest.mark.slow
@pytest.mark.needs("zarr")
def test_stores_are_packed_and_unpacked_to_the_same_bytes(capture, tmp_path):
    root, _ = capture
    whole = read_tree(root / "whole")
    for name, options in {"one": ("--workers", 1), "cluster": ("--cluster", "local:2")}.items():
        run("pack", root / "whole", tmp_path / f"{name}.zarr", *options)
        run("unpack", tmp_path / f"{name}.zarr", tmp_path / name, *options)
    assert read_tree(tmp_path / "cluster.zarr") == read_tree(tmp_path / "one.zarr")
    assert read_tree(tmp_path / "cluster") == read_tree(tmp_path / "one")
    assert read_tree(tmp_path / "cluster").keys() <= whole.keys()


@pytest.mark.slow
def test_what_reads_a_data_set_prints_the_same(capture):
    root, _ = capture
    data = root / "whole"
    for command in (("stats", data), ("evaluate", data, data, "--by", "distance", "--far", 20)):
        assert run(*command, "--json", "--cluster", "local:2") == run(*command, "--json"), command
    one, two = (validate(data, run=Run(1, executor)) for executor in (None, ThreadPoolExecutor(2)))
    assert one == two
    with open_cluster("local:2") as cluster:
        assert validate(data, run=Run(executor=cluster)) == one


@pytest.mark.slow
def test_a_film_is_the_same(capture, tmp_path):
    root, _ = capture
    command = (
        "render",
        root / "whole",
        "--view",
        "bev",
        "--size",
        "160x120",
        "--frames",
        "0:4",
        "-o",
    )
    run(*command, tmp_path / "one.gif", "--workers", 1)
    run(*command, tmp_path / "two.gif", "--cluster", "local:2")
    assert (tmp_path / "one.gif").read_bytes() == (tmp_path / "two.gif").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGINT])
def test_ctrl_c_stops_the_workers_at_once_and_the_next_run_finishes(capture, tmp_path, kind):
    root, whole = capture
    command = [
        sys.executable,
        interrupted.__file__,
        kind.name,
        "3",
        "regrid",
        root,
        "-o",
        tmp_path,
        "--preset",
        "coarse",
    ]
    start = time.monotonic()
    with subprocess.Popen(
        [*command, "--cluster", "local:2"],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        _, stderr = process.communicate(timeout=60)
    with suppress(ProcessLookupError):
        while time.monotonic() - start < 60:
            os.killpg(process.pid, 0)  # the group is there as long as one of its processes is
            time.sleep(0.01)
    assert process.returncode == 130
    assert time.monotonic() - start < 60
    (line,) = stderr.splitlines()
    assert line.startswith("carlasc: interrupted")
    run("regrid", root, "-o", tmp_path, "--preset", "coarse", "--workers", 1)
    assert read_tree(tmp_path) == whole


@pytest.mark.slow
def test_the_same_command_continues_after_the_scheduler_was_lost(capture, tmp_path):
    root, whole = capture
    command = ("regrid", root, "-o", tmp_path / "out", "--preset", "coarse", "--cluster")
    with dask_cluster.scheduler(tmp_path) as (address, scheduler), dask_cluster.worker(address):
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        process = subprocess.Popen(
            [sys.executable, "-m", "carlasc", *map(str, command), address],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        while not list((tmp_path / "out").rglob("000001.bin")) and process.poll() is None:
            time.sleep(0.01)
        scheduler.kill()
        _, stderr = process.communicate(timeout=60)
    assert (process.returncode, stderr.count("\n")) == (1, 1)
    assert stderr.startswith(f"carlasc: the scheduler {address}: the connection was lost")
    with dask_cluster.scheduler(tmp_path) as (address, _), dask_cluster.worker(address):
        assert "existed)" in run(*command, address)
    assert read_tree(tmp_path / "out") == whole


@pytest.mark.slow
def test_jobs_of_slurm(capture, tmp_path):
    root, whole = capture
    fake = tmp_path / "slurm"
    fake.mkdir()
    command = ("regrid", root, "-o", tmp_path / "out", "--preset", "coarse", "--cluster", "slurm")
    environment = slurm.install(fake)
    assert "--workers: expected the number of jobs" in run(*command, code=2, **environment)
    run(*command, "--workers", 2, **environment)
    assert read_tree(tmp_path / "out") == whole
    assert len(slurm.read_jobs(fake)) == 2
    assert sorted(slurm.read_jobs(fake, "cancelled")) == sorted(slurm.read_jobs(fake))
    assert all(
        "#SBATCH --cpus-per-task=1" in script.read_text() for script in fake.glob("job-*.sh")
    )


@pytest.mark.slow
def test_wrong_clusters_are_one_line(capture, tmp_path):
    root, _ = capture
    command = ("regrid", root, "-o", tmp_path, "--preset", "coarse", "--cluster")
    assert run(*command, "nowhere", code=2).startswith(
        "carlasc: --cluster: expected local, local:N, tcp://HOST:PORT"
    )
    environment = {"DASK_CARLASC__CONNECT_TIMEOUT": "500ms"}
    stderr = run(*command, "tcp://127.0.0.1:1", code=1, **environment)
    assert stderr.startswith("carlasc: cluster tcp://127.0.0.1:1: no scheduler answers: ")
    assert stderr.count("\n") == 1


def test_help_loads_no_dask():
    script = (
        "import sys; from typer.testing import CliRunner; from carlasc.cli import app\n"
        f"for name in {COMMANDS!r}:\n"
        "    result = CliRunner().invoke(app, [name, '--help'], env={'COLUMNS': '200'})\n"
        "    assert '--cluster' in result.output, name\n"
        "assert not {'dask', 'distributed', 'numpy'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
