"""Commands that are ended at random moments, and finished by the next run."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from faults import kills
from faults.commands import COMMANDS, EVERY, READ_ONLY
from helpers.processes.fresh import in_fresh_process

from carlasc.cli import app

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
    outcome = in_fresh_process(kills.run, 32, 0, tmp_path)
    assert outcome.found == []
    assert outcome.tried >= 32


def test_every_command_that_writes_is_killed_and_changed() -> None:
    listed = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    covered = {command.arguments.split()[0] for command in EVERY}
    assert covered | set(READ_ONLY) == set(listed)
    assert not covered & set(READ_ONLY)
