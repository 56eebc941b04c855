"""Schedulers and workers of Dask as processes of their own, and classes that start clusters, for
the tests of `--cluster`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_QUIET = {"DASK_LOGGING__DISTRIBUTED": "critical"}


@contextmanager
def scheduler(folder: Path, port: int = 0) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Yield the address of a scheduler and its process."""
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    options = [
        "--host",
        "127.0.0.1",
        "--port",
        str(port),
        "--no-dashboard",
        "--scheduler-file",
        str(file),
    ]
    with _process("dask_scheduler", *options) as process:
        end = time.monotonic() + 30
        while not file.exists() or not file.read_text():
            assert time.monotonic() < end and process.poll() is None, "the scheduler does not start"
            time.sleep(0.02)
        yield json.loads(file.read_text())["address"], process


@contextmanager
def worker(address: str, before: str = "") -> Iterator[subprocess.Popen[bytes]]:
    """Yield the process of a worker, which runs some lines of Python first."""
    options = [
        address,
        "--nthreads",
        "1",
        "--no-nanny",
        "--no-dashboard",
        "--memory-limit",
        "0",
        "--death-timeout",
        "20",
    ]
    with _process("dask_worker", *options, before=before) as process:
        yield process


@contextmanager
def _process(module: str, *options: str, before: str = "") -> Iterator[subprocess.Popen[bytes]]:
    code = f"import runpy, sys; sys.argv[0] = {module!r}\n{before}\nrunpy.run_module('distributed.cli.{module}', run_name='__main__')"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *options],
        env=os.environ | _QUIET | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def two_workers() -> Any:
    """Start a cluster of two workers, as a class that `--cluster` names would."""
    from distributed import LocalCluster

    return LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0")


def no_workers() -> Any:
    """Start a cluster without workers, which never come."""
    from distributed import LocalCluster

    return LocalCluster(n_workers=0, dashboard_address=":0")


def broken() -> Any:
    """Fail to start a cluster."""
    raise RuntimeError("no more\nmachines")
