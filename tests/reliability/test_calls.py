"""Commands of which one system call fails, and the library that makes it fail."""

from __future__ import annotations

from pathlib import Path

import pytest
from faults import calls, preload

pytestmark = pytest.mark.skipif(
    preload.reason_to_skip() is not None, reason=str(preload.reason_to_skip())
)


@pytest.mark.slow
def test_a_failing_call_of_any_command_leaves_whole_files_and_the_next_run_finishes_them(
    tmp_path: Path,
) -> None:
    outcome = calls.run(80, 0, tmp_path)
    assert outcome.found == []
    assert outcome.tried == 80


def test_calls_are_counted_made_to_fail_and_recorded(tmp_path: Path) -> None:
    """The library itself, in a process of its own: `_demonstrate` below."""
    preload.run_module("faults.demonstration", [str(tmp_path)], tmp_path)
