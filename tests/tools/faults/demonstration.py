"""What the library of calls.c does, shown with plain calls: run by test_calls.py in a process that
has loaded it.
"""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path

from faults import preload
from faults.crashes import read_log
from faults.preload import Kind


def _write(folder: Path) -> None:
    with (folder / "a").open("wb") as file:
        file.write(b"abc")
        file.flush()
        os.fsync(file.fileno())
    (folder / "a").rename(folder / "b")
    (folder / "b").read_bytes()


def _outcome(folder: Path) -> tuple[int | None, list[str]]:
    """Return the error number with which `_write` fails, if it does, and the files that it leaves."""
    try:
        _write(folder)
    except OSError as error:
        return error.errno, sorted(path.name for path in folder.iterdir())
    return None, sorted(path.name for path in folder.iterdir())


def main(work: Path) -> None:
    """Count, fail, end and record."""
    folder, log, outside = work / "watched", work / "log", work / "outside"
    folder.mkdir()
    outside.mkdir()
    preload.count_calls(folder)
    _write(outside)
    assert preload.counted_calls() == 0
    _write(folder)
    assert preload.counted_calls() >= 6  # open, write, sync, rename, open, read
    preload.count_calls(folder, Kind.WRITE | Kind.RENAME)
    _write(folder)
    assert preload.counted_calls() == 2
    (folder / "b").unlink()

    preload.fail_call(folder, 1, errno.ENOSPC, always=False, kinds=Kind.RENAME)
    assert _outcome(folder) == (errno.ENOSPC, ["a"])
    assert preload.failed_call() == (Kind.RENAME, str(folder / "b"))
    assert _outcome(folder) == (None, ["b"])  # only once
    preload.fail_call(folder, 1, errno.EIO, always=True, kinds=Kind.SYNC)
    assert [_outcome(folder), _outcome(folder)] == [(errno.EIO, ["a", "b"])] * 2

    child = os.fork()
    if not child:
        preload.end_at_call(folder, 1, Kind.RENAME)
        _write(folder)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 137
    assert (folder / "a").read_bytes() == b"abc"

    preload.record_calls(folder, log)
    _write(folder)
    found = [
        (call.kind, call.offset, call.data, call.path, call.other) for call in read_log(log, folder)
    ]
    assert found == [
        ("empty", 0, b"", "a", ""),
        ("write", 0, b"abc", "a", ""),
        ("sync", 0, b"", "a", ""),
        ("rename", 0, b"", "a", "b"),
    ], found


if __name__ == "__main__":
    main(Path(sys.argv[1]))
