"""Data that grow: time and memory of an item stay flat."""

from __future__ import annotations

from pathlib import Path

import pytest
from faults import large
from helpers.processes.fresh import in_fresh_process


@pytest.mark.slow
def test_time_and_memory_of_an_item_stay_flat(tmp_path: Path) -> None:
    outcome = in_fresh_process(large.run, 0, 0, tmp_path)
    assert outcome.found == []
    assert outcome.tried > 10
