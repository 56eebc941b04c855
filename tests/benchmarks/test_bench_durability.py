"""What it costs a frame of `regrid` that its files are synced: the same run with and without, by
turns.

`pytest tests/benchmarks/test_bench_durability.py --benchmark-enable -m slow` makes frames of 20
sensors on the published grid; without that both cases run once on small scans.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from helpers.datasets.captures import write_capture

from carlasc import Run, simulate
from carlasc.core.grids import GridSpec
from carlasc.groundtruth import regrid
from carlasc.storage.files import DURABLE

pytestmark = [pytest.mark.slow, pytest.mark.needs("trimesh", "embreex")]

FRAMES = 12


@pytest.fixture(scope="module")
def capture(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    if request.config.getoption("benchmark_enable"):
        simulate(folder, count=FRAMES, bev=False)
    else:
        write_capture(folder, frames=2)
    return folder


@pytest.mark.parametrize("kind", ["folder", "zarr"])
@pytest.mark.parametrize("durable", ["no", "yes"])
def test_regrid(
    benchmark: pytest.FixtureRequest,  # type: ignore[misc]
    capture: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    durable: str,
    kind: str,
) -> None:
    monkeypatch.setenv(DURABLE, durable)
    spec, numbers = GridSpec.published("cartesian"), itertools.count()

    def run() -> None:
        out = tmp_path / (f"{next(numbers)}" + (".zarr" if kind == "zarr" else ""))
        assert not regrid(capture, spec, out, run=Run(workers=1)).failures

    benchmark.pedantic(run, rounds=6, warmup_rounds=1)  # type: ignore[attr-defined]
