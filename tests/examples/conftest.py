"""The examples are scripts and the packages beside them.

They are not installed, so their folder goes on the path.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
sys.path.insert(0, str(EXAMPLES))


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    """Use one thread: the networks are so small here that threads take longer."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def examples() -> Path:
    return EXAMPLES
