"""The start of commands: a new process each, which is what a user waits for."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from carlasc.testing import write_dataset

pytestmark = pytest.mark.slow


@pytest.mark.benchmark(group="startup")
@pytest.mark.parametrize("command", ["--version", "--help", "info --help", "info DATA", "stats DATA"])
def test_bench_a_command(benchmark, tmp_path, command):
    data = write_dataset(tmp_path)
    arguments = [str(data) if word == "DATA" else word for word in command.split()]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}

    def run():
        line = [sys.executable, "-m", "carlasc", *arguments]
        return subprocess.run(line, env=environment, stdout=subprocess.DEVNULL, check=True)

    benchmark.pedantic(run, rounds=5, warmup_rounds=1)
