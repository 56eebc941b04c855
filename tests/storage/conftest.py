"""A data set, and the same packed into the kind of store that a module's ENDING names."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers.datasets.sequences import write_dataset

from carlasc.storage.packing import pack


@pytest.fixture(scope="session")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("published") / "data")


@pytest.fixture(scope="module")
def packed(
    request: pytest.FixtureRequest, published: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    return pack(published, tmp_path_factory.mktemp("packed") / f"x{request.module.ENDING}").out


@pytest.fixture
def store(packed: Path, tmp_path: Path) -> Path:
    """A copy that a test may harm."""
    copy = shutil.copytree if packed.is_dir() else shutil.copy
    return Path(copy(packed, tmp_path / packed.name))
