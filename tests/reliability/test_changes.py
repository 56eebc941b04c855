"""Inputs of finished commands that change before the command runs again."""

from __future__ import annotations

from pathlib import Path

import pytest
from faults import changes
from helpers.processes.fresh import in_fresh_process


@pytest.mark.slow
def test_a_changed_input_is_never_silent(tmp_path: Path) -> None:
    outcome = in_fresh_process(changes.run, 6, 0, tmp_path, ["regrid", "convert"])
    assert outcome.found == []
    assert outcome.tried == 6


@pytest.mark.slow
def test_a_changed_input_of_any_command_is_never_silent(tmp_path: Path) -> None:
    outcome = in_fresh_process(changes.run, 100, 1, tmp_path)
    assert outcome.found == []
    assert outcome.tried == 100
