"""Power failures, and the model of a disk that they are tried with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from faults import crashes, preload
from faults.comparing import content_of
from faults.crashes import Call, Disk

needs_compiler = pytest.mark.skipif(
    preload.reason_to_skip() is not None, reason=str(preload.reason_to_skip())
)


@needs_compiler
@pytest.mark.slow
def test_a_power_failure_at_any_call_of_a_download_loses_nothing(tmp_path: Path) -> None:
    outcome = crashes.run(0, 0, tmp_path, ["download", "download-extract"])
    assert outcome.found == []
    assert outcome.tried > 200


@needs_compiler
@pytest.mark.slow
def test_after_a_power_failure_of_any_command_the_next_run_finishes(tmp_path: Path) -> None:
    outcome = crashes.run(80, 0, tmp_path)
    assert outcome.found == []
    assert outcome.tried == 80


@needs_compiler
@pytest.mark.slow
def test_without_syncing_a_power_failure_loses_what_the_commands_had_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model of the disk finds what syncing prevents."""
    monkeypatch.setenv("CARLASC_DURABLE", "no")
    outcome = crashes.run(12, 0, tmp_path, ["convert"])
    assert outcome.found


def _call(kind: str, path: str, other: str = "", data: bytes = b"", offset: int = 0) -> Call:
    return Call(kind, offset, data, path, other)


WRITTEN = [_call("create", "t"), _call("write", "t", data=b"abc")]
NAMED = _call("rename", "t", "a")
CASES = {
    "nothing synced": ([*WRITTEN, NAMED], {}),
    "only the file": ([*WRITTEN, _call("sync", "t"), NAMED], {}),
    "only the folder, so that the file is empty": (
        [*WRITTEN, NAMED, _call("sync", ".")],
        {"a": b""},
    ),
    "the file, then the folder": (
        [*WRITTEN, _call("sync", "t"), NAMED, _call("sync", ".")],
        {"a": b"abc"},
    ),
    "written after it was synced": (
        [
            *WRITTEN,
            _call("sync", "t"),
            NAMED,
            _call("sync", "."),
            _call("write", "a", data=b"d", offset=3),
        ],
        {"a": b"abc"},
    ),
    "in a new folder whose own name is not stored": (
        [_call("mkdir", "x"), _call("create", "x/a"), _call("sync", "x/a"), _call("sync", "x")],
        {},
    ),
    "linked and unlinked": (
        [
            *WRITTEN,
            _call("sync", "t"),
            _call("link", "t", "a"),
            _call("sync", "."),
            _call("unlink", "t"),
        ],
        {"a": b"abc", "t": b"abc"},
    ),
    "cut": (
        [*WRITTEN, _call("truncate", "t", offset=2), _call("sync", "t"), _call("sync", ".")],
        {"t": b"ab"},
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_disk_that_loses_all_that_was_not_synced(tmp_path: Path, name: str) -> None:
    calls, expected = CASES[name]
    folder = tmp_path / "disk"
    folder.mkdir()
    (folder / "old").write_bytes(b"old")
    disk = Disk(folder)
    for call in calls:
        disk.apply(call)
    disk.fail("all", np.random.default_rng(0))
    (folder / "tmp").rmdir()
    assert content_of(folder) == {"old": b"old", **expected}


def test_a_disk_that_keeps_any_part_of_what_was_not_synced(tmp_path: Path) -> None:
    found: dict[str, set[bytes | None]] = {}
    for loss in crashes.LOSSES:
        for seed in range(40):
            folder = tmp_path / f"{loss}{seed}"
            folder.mkdir()
            disk = Disk(folder)
            for call in (*WRITTEN, NAMED):
                disk.apply(call)
            disk.fail(loss, np.random.default_rng(seed))
            found.setdefault(loss, set()).add(content_of(folder).get("a"))
    assert found["all"] == {None}
    assert found["prefix"] >= {None, b"", b"a", b"ab", b"abc"}
    assert found["zeros"] >= {None, b"\0\0\0", b"a\0\0"}
    assert None in found["some"]
    assert found["some"] - {None}
