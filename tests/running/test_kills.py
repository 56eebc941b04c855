"""Workers that are killed at random moments: nothing is lost, and nothing is done wrong."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from multiprocessing.context import SpawnProcess
from pathlib import Path

import psutil
import pytest
from helpers.processes import jobs

from carlasc import Run
from carlasc.running import Engine, open_cluster, run_all
from carlasc.running.pools import LostTaskError

pytestmark = pytest.mark.posix("signals")


class Killer:
    """Kills a worker process of this process every now and then, at random moments, but not before
    there is a result since the last kill.
    """

    def __init__(self, kills: int) -> None:
        self.wanted, self.kills, self.results = kills, 0, 0
        self._random, self._over = random.Random(kills), threading.Event()

    def run(self) -> None:
        before = 0
        while self.kills < self.wanted and not self._over.wait(self._random.uniform(0.0, 0.4)):
            workers = [
                process
                for process in psutil.Process().children(recursive=True)
                if is_spawned(process)
            ]
            if workers and self.results > before:
                before = self.results
                with suppress(ProcessLookupError):
                    os.kill(self._random.choice(workers).pid, signal.SIGKILL)
                    self.kills += 1

    @contextmanager
    def at_work(self) -> Iterator[None]:
        thread = threading.Thread(target=self.run)
        thread.start()
        try:
            yield
        finally:
            self._over.set()
            thread.join()


def is_spawned(process: psutil.Process) -> bool:
    with suppress(psutil.Error):
        return any("spawn_main" in part for part in process.cmdline())
    return False


def work_until_killed_often_enough(killer: Killer, folder: Path, executor: Engine | None) -> None:
    made, is_whole = list[int](), False
    with killer.at_work():
        # the last hundred is finished, too: others may have worked beside a lost one
        while killer.kills < killer.wanted or not is_whole:
            is_whole = False
            paths = [folder / str(number) for number in range(len(made), len(made) + 100)]
            results = run_all(jobs.write_own_number, paths, run=Run(workers=2, executor=executor))
            # one that three workers died of is said to be lost: run again
            with (
                suppress(LostTaskError),
                closing(results),
            ):
                for number in results:
                    made.append(number)
                    killer.results += 1
                is_whole = True
    assert made == list(range(len(made)))
    written = {
        file.name: file.read_text() for file in folder.iterdir() if not file.name.startswith(".")
    }
    assert written == {str(number): str(number) for number in made}


@pytest.mark.slow
@pytest.mark.needs("distributed")
@pytest.mark.parametrize("kills", [3, 50])
def test_workers_of_a_cluster_are_killed(kills, tmp_path: Path):
    with open_cluster("local:2") as cluster:
        # it has started
        assert list(run_all(jobs.square, range(2), run=Run(executor=cluster))) == [
            0,
            1,
        ]
        work_until_killed_often_enough(Killer(kills), tmp_path, cluster)


@pytest.mark.parametrize("kills", [3, pytest.param(50, marks=pytest.mark.slow)])
def test_processes_of_our_own_are_killed(kills, tmp_path: Path):
    work_until_killed_often_enough(Killer(kills), tmp_path, None)


@pytest.mark.slow
@pytest.mark.parametrize(
    "is_first", [True, False], ids=["before it is started", "after it was started"]
)
def test_a_worker_that_dies_while_another_is_started_stops_nothing(
    monkeypatch: pytest.MonkeyPatch, is_first: bool
):
    start, killed = SpawnProcess.start, list[int]()

    def start_while_another_dies(process: SpawnProcess) -> None:
        if killed or not (others := multiprocessing.active_children()):
            start(process)
            return
        killed.append(others[0].pid or 0)
        for kills in (is_first, not is_first):
            if kills:
                os.kill(killed[0], signal.SIGKILL)
            else:
                start(process)
            # the pool sees it: it closes its queues, and ends the processes that it knows
            time.sleep(0.1)

    monkeypatch.setattr(SpawnProcess, "start", start_while_another_dies)
    assert list(run_all(jobs.square, range(20), run=Run(workers=3))) == [
        number**2 for number in range(20)
    ]
    assert killed
