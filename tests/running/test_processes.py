import os
import subprocess
import sys
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import closing
from multiprocessing import get_context
from pathlib import Path

import pytest
from helpers.processes import jobs

from carlasc import Run
from carlasc.errors import ArgumentError
from carlasc.running.pools import LostTaskError
from carlasc.running.processes import run_all

pytestmark = pytest.mark.posix("signals")


class RecordingExecutor(Executor):
    """Does its work when asked for the result, and counts what is under way."""

    def __init__(self):
        self.submitted, self.most_pending, self.pending = [], 0, 0

    def submit(self, fn, /, *args, **kwargs):
        self.submitted.append((fn, args))
        self.pending += 1
        self.most_pending = max(self.most_pending, self.pending)
        executor = self

        class Lazy(Future):
            def result(self, timeout=None):
                executor.pending -= 1
                return fn(*args, **kwargs)

        return Lazy()


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_items(workers):
    assert list(run_all(jobs.square, range(20), run=Run(workers=workers))) == [
        n * n for n in range(20)
    ]


def test_one_worker_works_in_this_process_and_two_in_others():
    assert set(run_all(jobs.name_of_process, range(3), run=Run(workers=1))) == {os.getpid()}
    others = set(run_all(jobs.name_of_process, range(8), run=Run(workers=2)))
    assert others and os.getpid() not in others


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_the_function_is_raised_in_its_place(workers):
    results = run_all(jobs.fail_at_three, range(6), run=Run(workers=workers))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="three"):
        next(results)


def test_a_callers_executor_gets_a_bounded_number_of_tasks_and_stays_open():
    executor = RecordingExecutor()
    assert list(run_all(jobs.square, range(50), run=Run(workers=3, executor=executor))) == [
        n * n for n in range(50)
    ]
    assert len(executor.submitted) == 50
    assert executor.most_pending == 6
    with ThreadPoolExecutor(2) as threads:
        assert list(run_all(jobs.square, range(5), run=Run(executor=threads))) == [0, 1, 4, 9, 16]
        assert threads.submit(jobs.square, 9).result() == 81


def test_workers_have_one_thread_each_and_the_caller_keeps_its_environment(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    names = ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"]
    assert list(run_all(jobs.environment, names, run=Run(workers=2))) == ["1", "1"]
    assert [os.environ.get(name) for name in names] == ["7", None]


def test_workers_are_deaf_to_ctrl_c():
    assert list(run_all(jobs.ignores_interrupt, range(2), run=Run(workers=2))) == [True, True]


@pytest.mark.slow
def test_what_a_killed_worker_worked_on_is_done_by_another(tmp_path: Path):
    marks = [tmp_path / f"{number}" for number in range(4)]
    assert list(run_all(jobs.die_once, marks, run=Run(workers=2))) == ["0", "1", "2", "3"]


def test_what_always_kills_its_worker_is_given_up_and_nothing_else():
    results = run_all(
        jobs.kill_itself_at_three,
        range(8),
        run=Run(workers=2),
        lost=lambda item, message: f"{item}: {message}",
    )
    found = list(results)
    assert found[:3] + found[4:] == [0, 1, 2, 4, 5, 6, 7]
    assert found[3].startswith(
        "3: a task: 3 worker processes died while running it: they ran out of memory"
    )


def test_without_a_result_for_what_is_given_up_there_is_one_clear_line():
    with pytest.raises(LostTaskError) as caught:
        list(run_all(jobs.kill_itself, range(2), run=Run(workers=2)))
    assert "\n" not in str(caught.value)


def test_workers_that_cannot_start_are_one_clear_line(tmp_path: Path):
    script = tmp_path / "unguarded.py"
    script.write_text(
        "from carlasc.running import Run, run_all\n"
        "try:\n"
        "    list(run_all(abs, range(4), Run(workers=2)))\n"
        "except Exception as error:\n"
        "    raise SystemExit(f'{type(error).__name__}: {error}')\n"
    )
    result = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    lines = [line for line in result.stderr.splitlines() if "CarlascError: " in line]
    assert result.returncode == 1
    assert lines == [lines[0]]
    assert lines[0].startswith("CarlascError: worker processes die as soon as they start: ")


@pytest.mark.parametrize(
    "job",
    [
        jobs.write_for_a_minute,
        pytest.param(jobs.write_on_a_slow_disk, marks=pytest.mark.slow),
    ],
)
def test_stopping_in_the_middle_ends_the_workers_at_once_and_leaves_no_half_file(job, tmp_path):
    slow = [tmp_path / "a.bin", tmp_path / "b.bin"]
    started = time.monotonic()
    with (
        pytest.raises(KeyboardInterrupt),
        closing(run_all(job, [Path("nothing"), *slow], run=Run(workers=2))) as results,
    ):
        next(results)
        while not all(path.with_suffix(".begun").exists() for path in slow):
            time.sleep(0.01)
        raise KeyboardInterrupt
    assert time.monotonic() - started < 30
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.begun", "b.begun"]


def test_workers_end_when_the_main_process_is_killed_and_leave_no_half_file(tmp_path: Path):
    slow = [tmp_path / "a.bin", tmp_path / "b.bin"]
    main = get_context("spawn").Process(target=jobs.write_in_two_workers, args=(slow,))
    main.start()
    while not all(path.with_suffix(".begun").exists() for path in slow):
        time.sleep(0.01)
    workers = [int(path.read_text()) for path in sorted(tmp_path.glob("*.begun"))]
    main.kill()
    end = time.monotonic() + 20
    while any(map(is_alive, workers)) and time.monotonic() < end:
        time.sleep(0.02)
    assert not any(map(is_alive, workers))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.begun", "b.begun"]


def is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    # an ended process whose parent was killed may wait to be forgotten
    status = Path(f"/proc/{process}/stat")
    return not status.is_file() or status.read_text().rpartition(")")[2].split()[0] != "Z"


def test_a_worker_that_is_told_to_end_between_tasks_leaves_the_next_one_whole():
    code = (
        "import os, signal, threading; from multiprocessing import Pipe; from carlasc.running "
        "import pools\n"
        "pools._prepare_worker(None, ()); tasks, _writer = Pipe(duplex=False)\n"
        "threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGTERM)).start()\n"
        "try: tasks.recv()\n"
        "except BaseException: print('the rest of the task is in the pipe', flush=True)"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60
    )
    assert (ran.returncode, ran.stdout, ran.stderr) == (143, "", "")


def test_a_number_of_workers_below_one_makes_no_sense():
    with pytest.raises(ArgumentError) as error:
        list(run_all(jobs.square, range(3), run=Run(workers=0)))
    assert (error.value.where, error.value.found) == ("workers", "0")
