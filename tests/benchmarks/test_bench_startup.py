"""The start of commands: a new process each, which is what a user waits for."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from carlasc.testing import write_dataset

pytestmark = pytest.mark.slow


@pytest.mark.benchmark(group="startup")
@pytest.mark.parametrize(
    "command", ["--version", "--help", "info --help", "info DATA", "stats DATA"]
)
def test_bench_a_command(benchmark, tmp_path, command):
    data = write_dataset(tmp_path)
    arguments = [str(data) if word == "DATA" else word for word in command.split()]
    environment = {
        name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"
    }

    def run():
        line = [sys.executable, "-m", "carlasc", *arguments]
        return subprocess.run(line, env=environment, stdout=subprocess.DEVNULL, check=True)

    benchmark.pedantic(run, rounds=5, warmup_rounds=1)


_FIRST_USES = {
    "pictures": "from carlasc.core.grids import Grid, GridSpec; from carlasc.viewing import "
    "Look, render_grid\n"
    "spec = GridSpec.published(); render_grid(Grid(spec, np.ones(spec.size, np.uint8)), "
    "look=Look(size=(128, 72)))",
    "scores": "from carlasc.metrics.confusion import count_arrays\n"
    "count_arrays(np.zeros(9, np.uint8), np.zeros(9, np.uint8), None, 3)",
}


@pytest.mark.benchmark(group="first use")
@pytest.mark.parametrize("use", _FIRST_USES)
def test_bench_first_use(benchmark, tmp_path, use):
    """A new process with an empty cache, which compiles what it needs."""
    folders = iter(range(100))

    def run():
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / str(next(folders)))}
        program = f"import numpy as np; {_FIRST_USES[use]}"
        subprocess.run([sys.executable, "-c", program], env=environment, check=True)

    benchmark.pedantic(run, rounds=3, warmup_rounds=0)
