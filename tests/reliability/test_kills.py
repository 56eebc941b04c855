"""Commands that are ended at random moments, and finished by the next run."""

from __future__ import annotations

from pathlib import Path

import pytest
from faults import kills
from faults.commands import COMMANDS
from helpers.processes.fresh import in_fresh_process

QUICK = ("convert", "download-extract")
"""Commands whose data are quickly made."""


def test_what_a_killed_run_began_the_next_run_finishes_with_the_same_bytes(tmp_path: Path) -> None:
    outcome = in_fresh_process(
        kills.run, 6, 0, tmp_path, [name for name in QUICK if name in COMMANDS]
    )
    assert outcome.found == []
    assert outcome.tried >= 6


@pytest.mark.slow
def test_what_a_killed_run_of_any_command_began_the_next_run_finishes_with_the_same_bytes(
    tmp_path: Path,
) -> None:
    outcome = in_fresh_process(kills.run, 60, 0, tmp_path)
    assert outcome.found == []
    assert outcome.tried >= 60
