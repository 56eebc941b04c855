"""The examples are scripts and the packages beside them, not an installed package: they are found by their folder."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
sys.path.insert(0, str(EXAMPLES))
torch = pytest.importorskip("torch", reason="the examples need carlasc[torch]")
torch.set_num_threads(1)  # the networks are tiny here: threads that wait for each other cost more than they bring


@pytest.fixture(scope="session")
def examples() -> Path:
    return EXAMPLES
