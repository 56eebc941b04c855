"""Tests on real Dask clusters of this machine."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from helpers.processes import jobs

from carlasc import Run
from carlasc.core import first_use
from carlasc.running import open_cluster, run_all
from carlasc.running.pools import LostTaskError
from carlasc.running.spreading import LazyClient

pytestmark = pytest.mark.needs("distributed")


@pytest.fixture(scope="module")
def cluster() -> Iterator[LazyClient]:
    with open_cluster("local:2") as cluster:
        yield cluster


def test_results_come_in_the_order_of_the_items_and_from_other_processes(cluster):
    assert list(run_all(jobs.square, range(40), run=Run(executor=cluster))) == [
        n * n for n in range(40)
    ]
    workers = set(run_all(jobs.name_of_process, range(8), run=Run(executor=cluster)))
    assert len(workers) == 2 and os.getpid() not in workers


def test_a_client_of_dask_is_an_executor_too(cluster):
    assert list(run_all(jobs.square, range(3), run=Run(executor=cluster.client))) == [0, 1, 4]


def test_an_error_of_the_function_is_raised_in_its_place(cluster):
    results = run_all(jobs.fail_at_three, range(6), run=Run(executor=cluster))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="three"):
        next(results)
    with pytest.raises(OSError, match="disk"):
        list(run_all(jobs.raise_error, [OSError("disk")], run=Run(executor=cluster)))


def test_the_scheduler_knows_few_tasks_at_a_time_and_forgets_all(cluster):
    tasks, most = cluster.client.cluster.scheduler.tasks, 0
    with closing(run_all(jobs.square, range(200), run=Run(executor=cluster))) as results:
        for _ in results:
            most = max(most, len(tasks))
    assert 2 <= most <= 64  # 32, and some that are being forgotten
    jobs.wait_until(lambda: not tasks)


def test_tasks_of_a_run_that_ends_early_are_cancelled(cluster):
    with closing(run_all(jobs.square, range(200), run=Run(executor=cluster))) as results:
        next(results)
    jobs.wait_until(lambda: not cluster.client.cluster.scheduler.tasks)


def test_workers_have_one_thread_each(cluster):
    names = ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"]
    assert list(run_all(jobs.environment, names, run=Run(executor=cluster))) == ["1"] * 4
    assert set(cluster.client.nthreads().values()) == {1}


@pytest.mark.slow
def test_what_a_killed_worker_worked_on_is_done_by_another(cluster, tmp_path: Path):
    marks = [tmp_path / f"{number}" for number in range(4)]
    assert list(run_all(jobs.die_once, marks, run=Run(executor=cluster))) == ["0", "1", "2", "3"]


@pytest.mark.slow
def test_what_always_kills_its_worker_is_given_up_and_nothing_else(cluster):
    results = run_all(
        jobs.kill_itself_at_three,
        range(8),
        run=Run(executor=cluster),
        lost=lambda item, message: f"{item}: {message}",
    )
    found = list(results)
    assert found[:3] + found[4:] == [0, 1, 2, 4, 5, 6, 7]
    assert found[3].startswith(
        "3: a task: 3 worker processes died while running it: they ran out of memory"
    )
    with pytest.raises(LostTaskError):
        list(run_all(jobs.kill_itself, [0], run=Run(executor=cluster)))


@pytest.mark.slow
def test_workers_of_a_host_compile_once(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(first_use, "loop_folders", {str(tmp_path)})  # as if loops were loaded
    with open_cluster("local:2") as workers:
        compiled = dict(run_all(jobs.compile_something, range(8), run=Run(executor=workers)))
    assert sorted(compiled.values()) == [0, 1]
