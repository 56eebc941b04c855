"""The same input gives the same bytes: with any number of workers, order and threads, and on every
version of Python and processor.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from faults import sums
from faults.commands import run_here

KEPT = json.loads(sums.SUMS.read_text())
ANYWHERE = ("regrid", "cylinders", "coarse", "scans", "export")
"""Steps whose files do not depend on the versions of other packages."""


@pytest.mark.slow
def test_files_are_those_that_every_version_of_python_writes(tmp_path: Path) -> None:
    found = sums.sums_of(tmp_path / "case", only=ANYWHERE)
    assert len(found) > 80
    assert found == {name: KEPT[name] for name in found}


def test_parts_in_any_order_write_the_same_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sums.write_inputs(tmp_path)
    monkeypatch.chdir(tmp_path)
    command = [*sums.STEPS["regrid"].split(), "--workers", "1"]
    for part in ("3/3", "1/3", "2/3"):
        assert run_here([*command, "--part", part]) == 0
    found = sums.sums_in(tmp_path / "grids")
    assert found == {
        name.removeprefix("grids/"): kept
        for name, kept in KEPT.items()
        if name.startswith("grids/")
    }


@pytest.mark.slow
@pytest.mark.needs("trimesh", "embreex")
@pytest.mark.parametrize("workers", [2, 4])
def test_any_number_of_workers_writes_the_same_files(tmp_path: Path, workers: int) -> None:
    assert run_elsewhere(tmp_path, "--workers", str(workers)) == run_elsewhere(tmp_path)


@pytest.mark.slow
@pytest.mark.needs("trimesh", "embreex")
def test_any_number_of_threads_writes_the_same_files(tmp_path: Path) -> None:
    threads = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "4")
    assert run_elsewhere(tmp_path, **threads) == run_elsewhere(tmp_path)


@pytest.mark.slow
@pytest.mark.needs("trimesh", "embreex")
@pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64"),
    reason="the names of instruction sets are those of x86",
)
def test_a_processor_without_avx_writes_the_same_files(tmp_path: Path) -> None:
    dispatched = np._core._multiarray_umath.__cpu_dispatch__  # type: ignore[attr-defined]
    plain = {
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": str(tmp_path / "numba"),
        "NPY_DISABLE_CPU_FEATURES": " ".join(dispatched),
        "OPENBLAS_CORETYPE": "Prescott",
    }
    found, usual = run_elsewhere(tmp_path, **plain), run_elsewhere(tmp_path)
    assert found == usual


def run_elsewhere(folder: Path, *arguments: str, **environment: str) -> dict[str, str]:
    """Run all steps in a new process, and return the sums."""
    case = folder / f"case{len(list(folder.glob('case*')))}"
    command = [sys.executable, "-m", "faults.sums", str(case), *arguments]
    paths = os.pathsep.join(
        [
            str(Path(__file__).parents[1]),
            str(Path(__file__).parents[1] / "tools"),
            *filter(None, [os.environ.get("PYTHONPATH")]),
        ]
    )
    ran = subprocess.run(
        command,
        env={**os.environ, "PYTHONPATH": paths, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)
