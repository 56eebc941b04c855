"""Commands of which one system call fails, and the library that makes it fail."""

from __future__ import annotations

from pathlib import Path

import pytest
from faults import calls, preload
from faults.commands import COMMANDS

pytestmark = pytest.mark.skipif(
    preload.reason_to_skip() is not None, reason=str(preload.reason_to_skip())
)

QUICK = ("convert", "download-extract")
"""Commands whose data are quickly made."""


@pytest.mark.slow
def test_a_failing_call_leaves_whole_files_and_the_next_run_finishes_them(tmp_path: Path) -> None:
    outcome = calls.run(10, 0, tmp_path, [name for name in QUICK if name in COMMANDS])
    assert outcome.found == []
    assert outcome.tried == 10


@pytest.mark.slow
def test_a_failing_call_of_any_command_leaves_whole_files_and_the_next_run_finishes_them(
    tmp_path: Path,
) -> None:
    outcome = calls.run(200, 0, tmp_path)
    assert outcome.found == []
    assert outcome.tried == 200


def test_calls_are_counted_made_to_fail_and_recorded(tmp_path: Path) -> None:
    """The library itself, in a process of its own: `_demonstrate` below."""
    preload.run_module("faults.demonstration", [str(tmp_path)], tmp_path)
