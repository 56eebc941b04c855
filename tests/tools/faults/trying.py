"""Cases that are shared among the commands; each command is tried in a child of its own, which
becomes warm.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from faults import preload
from faults.commands import COMMANDS, Command, build_inputs, serving

Try = Callable[[Command, int | None, int, Path, Path], tuple[int, list[str]]]
"""Tries a command, given the number of cases (None: all), the seed, the folder of inputs and a
folder to work in; returns the number and what was found.
"""


def shares(names: Sequence[str], count: int) -> dict[str, int | None]:
    """Return how many of `count` cases each command gets; None, which means all, if `count` is 0."""
    if not count:
        return dict.fromkeys(names)
    numbers = {name: (count + place) // len(names) for place, name in enumerate(names)}
    return {name: number for name, number in numbers.items() if number}


def try_commands(
    attempt: Try, cases: Mapping[str, int | None], seed: int, folder: Path
) -> tuple[dict[str, int], list[str]]:
    """Try each command with its number of cases; returns how many of each were tried, and what was
    found.

    The folders of commands for which something was found stay in `folder`.
    """
    build_inputs(folder / "inputs", [COMMANDS[name] for name in cases])
    tried, found = dict[str, int](), list[str]()
    with serving():
        for name, count in cases.items():
            tried[name], faults = _in_a_child(attempt, COMMANDS[name], count, seed, folder)
            found += faults
            print(f"{name}: {tried[name]} cases, {len(faults)} faults", flush=True)
    return tried, found


def _in_a_child(
    attempt: Try, command: Command, count: int | None, seed: int, folder: Path
) -> tuple[int, list[str]]:
    work = folder / command.name
    work.mkdir()
    result = work / "result.json"
    child = os.fork()
    if not child:
        try:
            result.write_text(json.dumps(attempt(command, count, seed, folder / "inputs", work)))
        except BaseException:  # noqa: BLE001 (the parent reports it)
            result.write_text(
                json.dumps([0, [f"{command.name}, seed {seed}: {traceback.format_exc()}"]])
            )
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    if not result.exists():
        return 0, [f"{command.name}, seed {seed}: the child that tries it was killed"]
    tried, found = json.loads(result.read_text())
    if not found:
        shutil.rmtree(work)
    return tried, found


def run_with_library(
    module: str, count: int, seed: int, folder: Path, names: Sequence[str]
) -> tuple[dict[str, int], list[str]]:
    """Try commands in another Python, into which the library of calls.c is loaded: it runs
    `module`, which calls `main`.
    """
    result = folder / "result.json"
    preload.run_module(module, [str(folder), str(count), str(seed), str(result), *names], folder)
    tried, found = json.loads(result.read_text())
    return tried, found


def main(attempt: Try) -> None:
    """Do the work of `run_with_library`, with the arguments that it gives."""
    folder, count, seed, result, *names = sys.argv[1:]
    Path(result).write_text(
        json.dumps(try_commands(attempt, shares(names, int(count)), int(seed), Path(folder)))
    )
