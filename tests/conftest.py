"""Fixtures that every test may use."""

from __future__ import annotations

import os
import tarfile
from pathlib import Path

import hypothesis
import pytest

DATA = Path(__file__).parent / "data"

hypothesis.settings.register_profile("carlasc", deadline=None)  # how long an example takes is the machine's affair
hypothesis.settings.load_profile("carlasc")


@pytest.fixture(scope="session")
def golden_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden capture, unpacked: raw/, and what the authors' generator made of it. Read only by convention."""
    folder = tmp_path_factory.mktemp("golden")
    with tarfile.open(DATA / "golden" / "capture.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder


@pytest.fixture(scope="session")
def golden() -> Path:
    """The folder of the golden files."""
    return DATA / "golden"


@pytest.fixture(scope="session")
def real() -> Path:
    """Real data made elsewhere, which may not be shipped: $CARLASC_REAL, or shared/real beside the checkout."""
    folder = Path(os.environ.get("CARLASC_REAL", Path(__file__).parents[2] / "shared" / "real"))
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there: set CARLASC_REAL to a folder with the real data")
    return folder
