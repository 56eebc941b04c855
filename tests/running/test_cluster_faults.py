"""Clusters that cannot be used, or that break in the middle."""

from __future__ import annotations

import gc
import signal
from pathlib import Path

import pytest
from helpers.processes import jobs
from helpers.servers import dask_cluster

from carlasc import Run
from carlasc.errors import ArgumentError, CarlascError
from carlasc.running import open_cluster, run_all

pytestmark = [pytest.mark.needs("distributed"), pytest.mark.posix("signals")]

OTHER_VERSION = (  # what a worker runs before anything else
    "import importlib.metadata as metadata; version = metadata.version\n"
    "metadata.version = lambda name: '0.0.1' if name == 'carlasc' else version(name)"
)


def run(where: str, count: int = 4, workers: int | None = None) -> list[int]:
    with open_cluster(where, workers=workers) as cluster:
        return list(run_all(jobs.square, range(count), run=Run(executor=cluster)))


@pytest.mark.parametrize(
    "where", ["nonsense", "local:0", "local:x", "no.such.Class", "carlasc.NoSuchClass", ""]
)
def test_what_is_no_cluster(where):
    with pytest.raises(ArgumentError) as error:
        run(where)
    assert error.value.where == "cluster" and "slurm" in error.value.expected


def test_two_numbers_of_workers_contradict_each_other():
    with pytest.raises(ArgumentError) as error:
        run("local:2", workers=3)
    assert (error.value.where, error.value.found) == ("workers", "3")


@pytest.mark.slow
def test_no_scheduler_at_the_address():
    import dask
    import distributed

    with dask.config.set({"carlasc.connect-timeout": "0.5s"}):
        for where in ("tcp://127.0.0.1:1", "tls://127.0.0.1:1", "tcp://nowhere.invalid:8786"):
            with pytest.raises(CarlascError) as caught:
                run(where)
            assert caught.value.where == f"cluster {where}"
            assert "\n" not in str(caught.value)
            # the finalizer of one that is not closed would block a client that starts
            left = [
                value for value in gc.get_objects() if issubclass(type(value), distributed.Client)
            ]
            assert all(client.status == "closed" for client in left)


def test_no_work_opens_nothing():
    with open_cluster("tcp://127.0.0.1:1") as cluster:
        assert list(run_all(jobs.square, [], run=Run(executor=cluster))) == []


@pytest.mark.slow
def test_a_cluster_without_workers(tmp_path: Path):
    import dask

    with pytest.raises(ArgumentError) as error:
        run("helpers.servers.dask_cluster.no_workers")
    assert error.value.where == "workers"
    with pytest.raises(CarlascError) as broken:
        run("helpers.servers.dask_cluster.broken")
    assert broken.value.where == "cluster helpers.servers.dask_cluster.broken"
    assert "no more machines" in " ".join(broken.value.problem.split())
    with (
        dask.config.set({"carlasc.workers-timeout": "300ms"}),
        dask_cluster.scheduler(tmp_path) as (address, _),
        pytest.raises(CarlascError, match="no worker started within 0.3 s: check its jobs"),
    ):
        run(address)


@pytest.mark.slow
def test_workers_with_other_versions_and_workers_without_carlasc(tmp_path: Path):
    wrong = {
        OTHER_VERSION: r"carlasc 0\.0\.1",
        "sys.modules['carlasc'] = None": "none",
    }
    with dask_cluster.scheduler(tmp_path) as (address, _):
        for before, found in wrong.items():
            message = rf"^worker tcp://\S+: expected carlasc .* found {found}"
            with dask_cluster.worker(address, before), pytest.raises(CarlascError, match=message):
                run(address)
        with dask_cluster.worker(address):
            assert run(address) == [0, 1, 4, 9]


@pytest.mark.slow
def test_a_worker_with_other_versions_that_comes_later(tmp_path: Path):
    with (
        dask_cluster.scheduler(tmp_path) as (address, _),
        dask_cluster.worker(address),
        open_cluster(address) as cluster,
    ):
        results = run_all(jobs.name_of_process, range(1000), run=Run(executor=cluster))
        next(results)
        with (
            dask_cluster.worker(address, OTHER_VERSION),
            pytest.raises(CarlascError, match=r"found carlasc 0\.0\.1"),
        ):
            list(results)


@pytest.mark.slow
def test_the_scheduler_is_lost_in_the_middle(tmp_path: Path):
    with (
        dask_cluster.scheduler(tmp_path) as (address, process),
        dask_cluster.worker(address),
        open_cluster(address) as cluster,
    ):
        results = run_all(jobs.name_of_process, range(1000), run=Run(executor=cluster))
        next(results)
        process.send_signal(signal.SIGKILL)
        with pytest.raises(
            CarlascError,
            match=f"^the scheduler {address}: the connection was lost: check that the scheduler",
        ) as caught:
            list(results)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_class_that_starts_a_cluster():
    assert run("helpers.servers.dask_cluster.two_workers") == [0, 1, 4, 9]
