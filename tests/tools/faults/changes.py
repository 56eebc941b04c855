"""Inputs that change between two runs of a command: the second run gives what a run into an empty
folder gives, or is refused.
"""

from __future__ import annotations

import shutil
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from faults.commands import COMMANDS, MESSAGES, Command, run_command, warm
from faults.comparing import STORES, Content, arrays_of, content_of, differences
from faults.outcome import Outcome
from faults.trying import shares, try_commands

_RECORDS = ".carlasc"
_TEXTS = (".txt", ".json")
_STEPS = 16  # bytes: a point, and a multiple of the size of a label
REPEATED = tuple(
    name
    for name in COMMANDS
    if name.startswith(("regrid", "convert", "export", "label", "refine", "map", "audit"))
    and "overwrite" not in name
)
"""The commands that continue or keep what an earlier run wrote."""


def run(count: int, seed: int, folder: Path, names: Sequence[str] | None = None) -> Outcome:
    """Change an input of commands `count` times, shared among all commands.

    Args:
        count: number of changes.
        seed: of the random numbers.
        folder: an empty folder to work in. The folders of commands for which something was found
            stay there.
        names: only these commands.
    """
    began = time.monotonic()
    tried, found = try_commands(_try_command, shares(names or REPEATED, count), seed, folder)
    return Outcome("changes", tried, found, time.monotonic() - began)


def _try_command(
    command: Command, count: int | None, seed: int, base: Path, work: Path
) -> tuple[int, list[str]]:
    warm(command, base, work / "warm")
    first, fresh, found = work / "case", work / "fresh", []
    shutil.rmtree(work / "done", ignore_errors=True)
    command.copy_inputs(base, work / "done")
    if code := run_command(command, work / "done"):
        raise RuntimeError(f"exit code {code}: {(work / 'done' / MESSAGES).read_text()}")
    inputs = [
        path.relative_to(base).as_posix()
        for name in command.inputs
        for path in sorted([base / name, *(base / name).rglob("*")])
        if path.is_file() and _RECORDS not in path.parts
    ]
    for number in range(count or 1):
        rng = np.random.default_rng([seed, zlib.crc32(command.name.encode()), number])
        path = inputs[rng.integers(len(inputs))]
        change = CHANGES[rng.integers(len(CHANGES))]
        shutil.rmtree(fresh, ignore_errors=True)
        shutil.rmtree(first, ignore_errors=True)
        command.copy_inputs(base, fresh)
        shutil.copytree(work / "done", first)
        draw = int(rng.integers(2**32))
        changed = [change(case / path, np.random.default_rng(draw)) for case in (first, fresh)]
        if not all(changed):
            continue
        codes = [run_command(command, case) for case in (first, fresh)]
        if codes[0]:  # refused, or the input is damaged
            continue
        story = f"{command.name}, seed {seed}, case {number}: {change.__name__} {path}"
        if codes[1]:
            found.append(f"{story}: exit code 0, and {codes[1]} into an empty folder")
            continue
        found += [f"{story}: {line}" for line in _wrong(command, fresh, first)]
    return count or 1, found


def _wrong(command: Command, fresh: Path, first: Path) -> list[str]:
    """Describe how the outputs differ, without records of inputs."""
    if Path(command.output).suffix in STORES:
        expected, found = (arrays_of(case / command.output) for case in (fresh, first))
        return [f"{name} differs" for name in expected if found.get(name) != expected[name]]
    return differences(*(_without_records(content_of(case)) for case in (fresh, first)))


def _without_records(content: Content) -> Content:
    return {
        name: data
        for name, data in content.items()
        if _RECORDS not in Path(name).parts and not Path(name).match("carlasc-*-of-*.json")
    }


def _values(path: Path, rng: np.random.Generator) -> bool:
    """Change a value a little: poses by more than their tolerance of 1e-6."""
    data = bytearray(path.read_bytes())
    if path.suffix not in (".bin", ".label", ".npy") or len(data) < 256:
        return False
    start = 128 // _STEPS + int(rng.integers((len(data) - 128) // _STEPS))
    data[start * _STEPS + (5 if path.parent.name.startswith("pose") else 0)] ^= 1
    path.write_bytes(data)
    return True


def _shorten(path: Path, rng: np.random.Generator) -> bool:
    data = path.read_bytes()
    path.write_bytes(data[: rng.integers(len(data)) // _STEPS * _STEPS])
    return bool(data)


def _remove(path: Path, rng: np.random.Generator) -> bool:
    path.unlink()
    return True


def _text(path: Path, rng: np.random.Generator) -> bool:
    """Change the last digit of a number of a text file."""
    if path.suffix not in _TEXTS:
        return False
    text = path.read_text()
    digits = [place for place, char in enumerate(text) if char in "12345678"]
    if not digits:
        return False
    place = digits[rng.integers(len(digits))]
    path.write_text(f"{text[:place]}{int(text[place]) + 1}{text[place + 1 :]}")
    return True


def _touch(path: Path, rng: np.random.Generator) -> bool:
    path.touch()
    return True


CHANGES: tuple[Callable[[Path, np.random.Generator], bool], ...] = (
    _values,
    _values,
    _shorten,
    _remove,
    _text,
    _touch,
)
