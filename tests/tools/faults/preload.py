"""The library of calls.c: built with the machine's C compiler, loaded before the C library, and
armed from Python.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from enum import IntFlag
from pathlib import Path

SOURCE = Path(__file__).with_name("calls.c")
_COUNT, _ONCE, _FROM, _END = range(4)


class Kind(IntFlag):
    """Kinds of calls, as in calls.c."""

    OPEN = 1
    WRITE = 2
    READ = 4
    RENAME = 8
    LINK = 16
    SYNC = 32
    TRUNCATE = 64
    MKDIR = 128
    UNLINK = 256


ALL = Kind(511)
CHANGES = ALL & ~Kind.READ & ~Kind.OPEN


def reason_to_skip() -> str | None:
    """Say why the library cannot be used here; None if it can."""
    if not sys.platform.startswith("linux"):
        return "calls are intercepted on Linux only"
    if not shutil.which("cc"):
        return "there is no C compiler"
    return None


def run_module(module: str, arguments: list[str], folder: Path) -> None:
    """Run a Python module with the library loaded.

    Raises:
        RuntimeError: it fails; with what it said.
    """
    library = folder / "calls.so"
    subprocess.run(
        ["cc", "-O1", "-shared", "-fPIC", "-o", library, SOURCE, "-lpthread"], check=True
    )
    environment = os.environ | {
        "LD_PRELOAD": str(library),
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(
            f"{module}: exit code {done.returncode}: {done.stdout[-2000:]} {done.stderr[-4000:]}"
        )


def count_calls(folder: Path, kinds: Kind = ALL) -> None:
    """Count the calls of this process on files below a folder from now on."""
    _arm(folder, kinds, _COUNT)


def fail_call(folder: Path, k: int, error: int, *, always: bool, kinds: Kind = ALL) -> None:
    """Make the k-th call fail with an error number, or also all calls after it."""
    _arm(folder, kinds, _FROM if always else _ONCE, k, error)


def end_at_call(folder: Path, k: int, kinds: Kind = ALL) -> None:
    """End this process, as kill -9 does, before the k-th call."""
    _arm(folder, kinds, _END, k)


def record_calls(folder: Path, log: Path) -> None:
    """Write the calls that change files, with their data, to a log outside of the folder."""
    _arm(folder, Kind(0), _COUNT, log=os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC))


def counted_calls() -> int:
    """Return the number of calls since the last arming, of this process or of its forked child."""
    function = ctypes.CDLL(None).faults_counted
    function.restype = ctypes.c_long
    return int(function())


def failed_call() -> tuple[Kind, str] | None:
    """Return the kind and the path of the first call that failed, in this process or in its forked
    child; None if none did.
    """
    library = ctypes.CDLL(None)
    library.faults_failed_path.restype = ctypes.c_char_p
    path = library.faults_failed_path().decode()
    return (Kind(library.faults_failed_kind()), path) if path else None


def _arm(folder: Path, kinds: Kind, mode: int, k: int = 0, error: int = 0, log: int = -1) -> None:
    library = ctypes.CDLL(None)
    library.faults_arm(str(folder).encode(), int(kinds), mode, ctypes.c_long(k), error, log)
