"""Tests on a Ray cluster that runs on this machine, through the client of Ray."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from contextlib import closing

import pytest
from helpers.converters.ncore_files import write_store
from helpers.datasets.captures import read_tree
from helpers.errors import raises
from helpers.processes import jobs

from carlasc import Run
from carlasc.converting import convert
from carlasc.errors import CarlascError
from carlasc.running import open_cluster, run_all
from carlasc.testing import SimulatedDrive

pytestmark = [pytest.mark.slow, pytest.mark.needs("ray", "cbor2"), pytest.mark.timeout(300)]


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.fixture(scope="module")
def address():
    """The address of a cluster with two cores, whose workers have the tests' helpers."""
    ports = [free_port() for _ in range(2)]
    code = "import sys; from ray.scripts.scripts import main; sys.argv[0] = 'ray'; main()"
    options = ["--head", "--block", f"--port={ports[0]}", f"--ray-client-server-port={ports[1]}"]
    options += ["--num-cpus=2", "--include-dashboard=false", "--disable-usage-stats"]
    options += ["--min-worker-port=0", "--max-worker-port=0"]
    own = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", code, "start", *options]
    head = subprocess.Popen(command, env=own, start_new_session=True, stdout=subprocess.DEVNULL)
    jobs.wait_until(lambda: answers(ports[1]) or head.poll() is not None)
    yield f"ray://127.0.0.1:{ports[1]}"
    os.killpg(head.pid, signal.SIGTERM)
    head.wait()


def answers(port: int) -> bool:
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


def test_ray_does_what_processes_do(address, tmp_path):
    with open_cluster(address) as cluster:
        run = Run(executor=cluster)
        assert list(run_all(jobs.square, range(40), run)) == [n * n for n in range(40)]
        assert set(run_all(jobs.environment, ["OMP_NUM_THREADS"] * 2, run)) == {"1"}
        with pytest.raises(OSError, match="disk"):
            list(run_all(jobs.raise_error, [OSError("disk")], run))
        lost = list(run_all(jobs.kill_itself_at_three, range(5), run, lost=lambda _, text: text))
        assert lost[:3] + lost[4:] == [0, 1, 2, 4] and "3 worker processes died" in lost[3]
        with closing(run_all(jobs.square, range(200), run)) as results:
            next(results)
        for index in range(3):
            drive = SimulatedDrive(2, channels=6, columns=40)
            write_store(tmp_path, drive, sequence=f"clip{index}")
        (tmp_path / "list").write_text(
            "".join(f"{path.name}\n" for path in sorted(tmp_path.glob("*.itar")))
        )
        for name, spread in {"ray": run, "one": Run(1)}.items():
            given = Run(spread.workers, spread.executor, sequences_from=tmp_path / "list")
            made = convert("ncore", tmp_path, tmp_path / name, grids=None, run=given)
            assert made.made == 6 and not made.failures
        assert read_tree(tmp_path / "ray") == read_tree(tmp_path / "one")


def test_a_cluster_that_does_not_answer_is_an_error_of_one_line():
    where = f"ray://127.0.0.1:{free_port()}"
    with (
        open_cluster(where) as cluster,
        raises(CarlascError, where=f"cluster {where}", advice="ray start"),
    ):
        list(run_all(jobs.square, range(3), Run(executor=cluster)))
