"""Coverage-guided mutations: libFuzzer, through atheris, keeps the changes by which readers come to
lines that no earlier ones reached.

An input is a byte that says which file is replaced, and its new content. `python -m faults.coverage
TARGET RUNS SEED FOLDER` runs one target. Inputs that once found a fault are in `corpus/TARGET`, and
are tried first. Without atheris, nothing is tried.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from random import Random
from types import ModuleType

from faults.outcome import Outcome

NAMES = (
    "folder",
    "zip",
    "zarr",
    "parquet",
    "capture",
    "results",
    "kitti",
    "nuscenes",
    "paris-carla-3d",
    "carlaocc",
)
"""The targets that read thousands of inputs a minute."""
CORPUS = Path(__file__).parent / "corpus"
_PACKAGES = ("carlasc", "carlasc_converters", "carlasc_recorders")
_RUNS = re.compile(r"stat::number_of_executed_units: *([0-9]+)")
_MOST_S = 1800  # seconds of one target


def run(count: int, seed: int, folder: Path) -> Outcome:
    """Run libFuzzer on each target, for `count` inputs in all."""
    started = time.monotonic()
    tried, found = 0, []
    for name in NAMES if find_spec("atheris") else ():
        command = [
            sys.executable,
            "-m",
            "faults.coverage",
            name,
            str(count // len(NAMES)),
            str(seed),
            str(folder / name),
        ]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_MOST_S, check=False)
        match = _RUNS.search(done.stderr)
        tried += int(match[1]) if match else 0
        if done.returncode:
            lines = [
                line
                for line in done.stderr.splitlines()
                if "Error" in line or "ERROR" in line or "Test unit" in line
            ]
            found.append(
                f"coverage {name} seed {seed}: {' | '.join(lines[-3:]) or done.stderr[-300:]}"
            )
    return Outcome("coverage", tried, found, time.monotonic() - started)


def fuzz(name: str, runs: int, seed: int, folder: Path) -> None:
    """Run libFuzzer on one target in this process, which it ends."""
    os.environ["NUMBA_DISABLE_JIT"] = "1"  # Numba does not compile functions that were instrumented
    import atheris

    with atheris.instrument_imports(include=list(_PACKAGES)):
        from faults import damage, mutations
        from faults.targets import TARGETS

        target = next(target for target in TARGETS if target.name == name)
        target.write(folder / "valid")
        reading = mutations.Reading([str(folder)])
        target.read(folder / "valid", reading.attempt)  # what is imported late is instrumented, too
    files = mutations.load(folder / "valid")
    paths = sorted(files)
    signal.signal(signal.SIGALRM, mutations.stop)

    def read(data: bytes) -> None:
        if data:
            fault = mutations.read_case(
                target, folder / "valid", files, {paths[data[0] % len(paths)]: data[1:]}
            )
            if fault:
                raise RuntimeError(fault)

    def mutate(data: bytes, most: int, number: int) -> bytes:
        rng = Random(number)
        if not data or rng.random() < 0.4:
            return atheris.Mutate(data, most)
        return (data[:1] + damage.change(data[1:], rng))[:most]

    _write_corpus(
        folder / "corpus",
        name,
        [bytes([place]) + files[path] for place, path in enumerate(paths[:256])],
    )
    _start(atheris, read, mutate, runs, seed, folder, 2 * max(map(len, files.values())))


def _write_corpus(corpus: Path, name: str, inputs: list[bytes]) -> None:
    corpus.mkdir()
    for place, data in enumerate(inputs):
        (corpus / f"valid-{place}").write_bytes(data)
    for file in sorted((CORPUS / name).glob("*")):
        shutil.copy(file, corpus)


def _start(
    atheris: ModuleType,
    read: object,
    mutate: object,
    runs: int,
    seed: int,
    folder: Path,
    longest: int,
) -> None:
    options = [
        f"-runs={runs}",
        f"-seed={seed + 1}",
        "-timeout=30",
        "-print_final_stats=1",
        "-verbosity=0",
    ]
    options += [f"-max_len={longest}", f"-artifact_prefix={folder}/", str(folder / "corpus")]
    atheris.Setup([sys.argv[0], *options], read, custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    fuzz(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
