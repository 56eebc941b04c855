"""`python -m measuring`: measure the figures of the documentation, write docs/figures.json, and
fill the pages in.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from measuring.figures import FILE, Figure, Figures, publish
from measuring.sizes import SIZES, Size

Measure = Callable[[Size, Path], Iterator[tuple[str, Figure]]]

GROUPS = {  # name -> module, function, and its first arguments
    "loading": ("measuring.loading", "measure_loading"),
    "stores": ("measuring.loading", "measure_stores"),
    "votes": ("measuring.voting", "measure_voting"),
    "regrid": ("measuring.voting", "measure_regrid"),
    "exporting": ("measuring.benchmarks", "measure_file"),
    "inspection": ("measuring.benchmarks", "measure_file"),
    "votes_file": ("measuring.benchmarks", "measure_file"),
    "merging": ("measuring.benchmarks", "measure_file"),
    "poses": ("measuring.benchmarks", "measure_file"),
    "converting": ("measuring.benchmarks", "measure_file"),
    "rendering": ("measuring.benchmarks", "measure_file"),
    "startup": ("measuring.benchmarks", "measure_file"),
    "metrics": ("measuring.benchmarks", "measure_file"),
    "simulation": ("measuring.simulating", "measure_simulation"),
    "recordings": ("measuring.recording", "measure_recordings"),
    "records": ("measuring.records", "measure_records"),
    "networks": ("measuring.networks", "measure_networks"),
}
_LONGEST_S = {"tiny": 600, "quick": 900, "full": 7200}  # of one group; what takes longer failed


def measure_of(group: str) -> Measure:
    """Return the function that measures a group."""
    module, name = GROUPS[group]
    function = getattr(import_module(module), name)
    return (
        partial(function, {"votes_file": "votes"}.get(group, group))
        if name == "measure_file"
        else function
    )


def main() -> int:
    """Measure what is asked for; returns 1 if a group failed, whose figures are then those of
    before.
    """
    parser = argparse.ArgumentParser(prog="measuring", description=__doc__)
    parser.add_argument(
        "--size",
        choices=tuple(SIZES),
        default="quick",
        help="tiny tries everything once; its figures are not for the pages",
    )
    parser.add_argument(
        "--only",
        choices=tuple(GROUPS),
        action="append",
        help="only this group; may be given several times",
    )
    parser.add_argument(
        "--out", type=Path, help="write the figures here, and leave the pages as they are"
    )
    parser.add_argument(
        "--fill", action="store_true", help="measure nothing; fill the pages in from the figures"
    )
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        _measure_here(given.only[0], SIZES[given.size], given.child)
        return 0
    file = given.out or FILE
    is_measured = not given.fill
    if is_measured and given.size == "tiny" and not given.out:
        parser.error("tiny figures are no figures: say with --out where they go")
    failed = [] if not is_measured else measure_all(given.only or list(GROUPS), given.size, file)
    if not given.out:
        publish(Figures.read(file))
    return int(bool(failed))


def measure_all(groups: list[str], size: str, file: Path) -> list[str]:
    """Measure groups one after another, each in a process of its own; write the file after each.

    Returns the groups that failed.
    """
    failed, run = [], _describe_run(size)
    print(f"{run['cores']} cores of {run['processor']}, load {run['load']:.1f}", flush=True)
    if run["load"] > 0.5:
        print(
            "other programs are running: processor times suffer little, wall times much", flush=True
        )
    for group in groups:
        start = time.perf_counter()
        measured, problem = _measure_in_a_process(group, size)
        Figures.read(file).updated(run, measured).write(file)
        seconds = time.perf_counter() - start
        print(
            f"{group}: {len(measured)} figures in {seconds:.0f} s{problem and ', then ' + problem}",
            flush=True,
        )
        failed += [group] if problem else []
    if failed:
        print(f"{', '.join(failed)} failed: these figures are those of before")
    return failed


def _measure_in_a_process(group: str, size: str) -> tuple[dict[str, Figure], str]:
    """Return what a group measured, and what went wrong: nothing, where the text is empty."""
    with tempfile.TemporaryDirectory(prefix="measuring-") as folder:
        lines = Path(folder, "figures.jsonl")
        command = [
            sys.executable,
            "-m",
            "measuring",
            "--only",
            group,
            "--size",
            size,
            "--child",
            str(lines),
        ]
        one_thread = dict.fromkeys(
            ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"
        )
        environment = os.environ if group == "networks" else os.environ | one_thread
        problem = ""
        try:
            ran = subprocess.run(
                command,
                env=environment,
                capture_output=True,
                text=True,
                timeout=_LONGEST_S[size],
                check=False,
            )
            if ran.returncode:
                problem = f"it failed:\n{ran.stderr[-3000:]}"
        except subprocess.TimeoutExpired:
            problem = f"it was stopped after {_LONGEST_S[size]} s"
        rows = (
            [json.loads(line) for line in lines.read_text().splitlines()] if lines.exists() else []
        )
    return {key: Figure(**figure) for key, figure in rows}, problem


def _measure_here(group: str, size: Size, out: Path) -> None:
    """Measure a group in this process; each figure becomes a line of a file at once."""
    with (
        tempfile.TemporaryDirectory(prefix="measuring-", dir=out.parent) as folder,
        out.open("w") as file,
    ):
        for key, figure in measure_of(group)(size, Path(folder)):
            file.write(json.dumps([key, dataclasses.asdict(figure)], default=float) + "\n")
            file.flush()


def _describe_run(size: str) -> dict[str, Any]:
    from carlasc import doctor

    found = doctor()
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "size": size,
        "processor": found.processor.model,
        "target": found.processor.target,
        "cores": found.processor.usable,
        "load": round(os.getloadavg()[0], 2),
        "system": f"{platform.system()} {platform.machine()}",
        "python": found.python.split()[0],
        "versions": {"carlasc": found.version}
        | {
            package.name: package.version
            for package in found.packages
            if package.name in ("numpy", "numba")
        },
    }


if __name__ == "__main__":
    sys.exit(main())
