"""Inputs that change between two runs of a command, of which the first may have been killed: the
second run gives what a run into an empty folder gives, or is refused.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import time
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

import carlasc
from faults.commands import COMMANDS, MESSAGES, Command, run_command, start, wait, warm
from faults.comparing import STORES, Content, arrays_of, content_of, differences
from faults.outcome import Outcome
from faults.trying import shares, try_commands

_RECORDS = ".carlasc"
_TEXTS = (".txt", ".json")
_FRAME = re.compile(r"(\d+)\.[a-z.]+")
_OTHER_SETTINGS = "expected a grid with the same settings"  # such as another first frame
_REPAIRED = 0.3  # share of the changes that are taken back
_KILLED = 0.3  # share of the first runs that are killed
_ABOUT = ("simulation.json",)  # what carlasc.json says of a data set stays: users complete it
_CONTINUING = (
    "regrid",
    "convert",
    "export",
    "label",
    "refine",
    "map",
    "audit",
    "pack",
    "unpack",
    "report-save",
)
_STEPS = 16  # bytes: a point, and a multiple of the size of a label
REPEATED = tuple(
    name for name in COMMANDS if name.startswith(_CONTINUING) and "overwrite" not in name
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
    return Outcome.of("changes", began, tried, found)


def _try_command(
    command: Command, count: int | None, seed: int, base: Path, work: Path
) -> tuple[int, list[str]]:
    warm(command, base, work / "warm")
    shutil.rmtree(work / "done", ignore_errors=True)
    command.copy_inputs(base, work / "done")
    began = time.monotonic()
    code, seconds = run_command(command, work / "done"), time.monotonic() - began
    if code:
        raise RuntimeError(f"exit code {code}: {(work / 'done' / MESSAGES).read_text()}")
    inputs = [
        path.relative_to(base).as_posix()
        for name in command.inputs
        for path in sorted([base / name, *(base / name).rglob("*")])
        if path.is_file() and _RECORDS not in path.parts and path.name not in _ABOUT
    ]
    tried, number, found, refused = 0, 0, [], Counter[str]()
    while tried < (count or 1):
        rng = np.random.default_rng([seed, zlib.crc32(command.name.encode()), number])
        path, change = inputs[rng.integers(len(inputs))], CHANGES[rng.integers(len(CHANGES))]
        is_repaired, draw = bool(rng.random() < _REPAIRED), int(rng.integers(2**32))
        story = f"{command.name}, seed {seed}, case {number}: {change.__name__} {path}"
        number += 1
        shutil.rmtree(work / "case", ignore_errors=True)
        if rng.random() < _KILLED:
            moment = rng.random() * seconds
            story += f", killed at {moment:.3f} s"
            _kill(command, base, work / "case", moment)
        else:
            shutil.copytree(work / "done", work / "case")
        before = content_of(work / "case")
        if not change(work / "case" / path, np.random.default_rng(draw)):
            continue
        after = content_of(work / "case")
        tried += 1
        code = run_command(command, work / "case")
        if is_repaired:
            found += [
                f"{story}, repaired: {line}" for line in _repaired(command, work, before, after)
            ]
            continue
        if after == before and not code:  # the time of a file alone
            found += [f"{story}: {line}" for line in _wrong(command, work / "done", work / "case")]
            continue
        shutil.rmtree(work / "fresh", ignore_errors=True)
        command.copy_inputs(base, work / "fresh")
        change(work / "fresh" / path, np.random.default_rng(draw))
        fresh = run_command(command, work / "fresh")
        if code and not fresh:
            refused[_last_line(work / "case")] += 1
            if not _may_refuse(command, path) and _OTHER_SETTINGS not in _last_line(work / "case"):
                found.append(f"{story}: refused: {_last_line(work / 'case')}")
        elif fresh and not code:
            if _is_of_a_grid(command, path):
                continue
            found.append(f"{story}: exit code 0, and {fresh} into an empty folder")
        elif not code or _verdicts(work / "case"):  # an audit that finds a fault ends with 1
            found += [f"{story}: {line}" for line in _wrong(command, work / "fresh", work / "case")]
    lines = [f"{times} times: {line}\n" for line, times in refused.items()]
    (base.parent / f"refused-{command.name}.txt").write_text("".join(lines))
    return tried, found


def _kill(command: Command, base: Path, case: Path, moment: float) -> None:
    """Run a command in a new folder, and kill it with its workers at a moment, in seconds."""
    command.copy_inputs(base, case)
    child = start(command.argv, case)
    time.sleep(moment)
    with suppress(ProcessLookupError):  # it has finished
        os.killpg(child, signal.SIGKILL)
    wait(child, 60)


def _repaired(command: Command, work: Path, before: Content, after: Content) -> list[str]:
    """Take a change back and run a command once more; returns what differs from the first run."""
    case = work / "case"
    for name in before.keys() | after.keys():
        if (data := before.get(name)) is not None and data != after.get(name):
            (case / name).write_bytes(data)
        elif name not in before:
            (case / name).unlink()
    if code := run_command(command, case):
        may_refuse = _may_refuse(command) or _OTHER_SETTINGS in _last_line(case)
        return [] if may_refuse else [f"exit code {code}: {_last_line(case)}"]
    return _wrong(command, work / "done", case)


def _may_refuse(command: Command, path: str = "") -> bool:
    """Whether a command may refuse to continue: stores and copies that are finished, and poses and
    times of `convert`.
    """
    if command.name.startswith(("label", "refine", "map", "pack", "unpack")):
        return True
    is_convert = command.name.startswith("convert")
    return Path(command.output).suffix in (".h5", ".parquet") or (
        is_convert and Path(path).name in ("poses.txt", "times.txt")
    )


def _is_of_a_grid(command: Command, path: str) -> bool:
    """Whether a file is of a grid, which a command does not read: a finished output stays right."""
    is_of_scans = command.name.startswith(("label", "refine", "map"))
    return is_of_scans and Path(path).parent.name.startswith("evaluation")


def _last_line(case: Path) -> str:
    return (case / MESSAGES).read_text().strip().rpartition("\n")[2]


def _wrong(command: Command, fresh: Path, first: Path) -> list[str]:
    """Describe how the outputs differ, without records of inputs."""
    if Path(command.output).suffix in STORES:
        expected, found = (_content_of_store(case / command.output) for case in (fresh, first))
    else:
        expected, found = (_without_records(content_of(case)) for case in (fresh, first))
    wrong = differences(expected, found)
    verdicts = [_verdicts(case) for case in (fresh, first)]
    return wrong if verdicts[0] == verdicts[1] else [*wrong, "other verdicts"]


def _verdicts(case: Path) -> list[str]:
    """Return the verdicts of an audit; none of other commands, or if the data cannot be read."""
    lines = (case / MESSAGES).read_text().splitlines()
    shown = [line for line in lines if not line.startswith(("note:", "Auditing"))]
    return shown if any("sound" in line for line in shown) else []


def _content_of_store(store: Path) -> Content:
    """Return the digests of the arrays of a store, and its text files."""
    content: Content = {name: digest.encode() for name, digest in arrays_of(store).items()}
    for path, sequence in carlasc.open(store).sequences().items():
        for name in sequence.documents():
            content[f"{path}/{name}"] = sequence.read_document(name)
    return _without_records(content)


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
    if path.parent.name.startswith("pose"):
        pose = np.load(path)
        pose[rng.integers(3), 3] += 0.001
        np.save(path, pose)
        return True
    data[start * _STEPS] ^= 1
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


def _grow(path: Path, rng: np.random.Generator) -> bool:
    """Add a frame: a copy of the last file of each folder, and of the last line of text files."""
    if not _FRAME.fullmatch(path.name):
        return False
    for folder in path.parent.parent.iterdir():
        if folder.is_dir() and (frames := _frames(folder)):
            for last in frames[max(frames)]:
                number = str(max(frames) + 1).zfill(len(last.name.partition(".")[0]))
                shutil.copy(last, folder / f"{number}{''.join(last.suffixes)}")
        elif folder.name.startswith(("poses", "times")) and folder.suffix == ".txt":
            lines = folder.read_text().splitlines()
            lines.append(lines[-1])
            if folder.name.startswith("times"):
                lines[-1] = _next_time(lines[-1])
            folder.write_text("\n".join(lines) + "\n")
    return True


def _next_time(line: str) -> str:
    with suppress(ValueError):
        return str(float(line) + 0.1)
    number = int(line.partition(",")[0]) + 1  # of a capture
    elapsed = f"frame={number},elapsed_seconds={number / 10}"
    return (
        f"{number}, {re.sub(r'frame=.*?,elapsed_seconds=[^,]*', elapsed, line.partition(', ')[2])}"
    )


def _drop(path: Path, rng: np.random.Generator) -> bool:
    """Remove all files of a frame."""
    if not (match := _FRAME.fullmatch(path.name)):
        return False
    for folder in path.parent.parent.iterdir():
        for file in _frames(folder).get(int(match[1]), []) if folder.is_dir() else []:
            file.unlink()
    return True


def _frames(folder: Path) -> dict[int, list[Path]]:
    frames: dict[int, list[Path]] = {}
    for path in sorted(folder.iterdir()):
        if match := _FRAME.fullmatch(path.name):
            frames.setdefault(int(match[1]), []).append(path)
    return frames


CHANGES: tuple[Callable[[Path, np.random.Generator], bool], ...] = (
    _values,
    _values,
    _shorten,
    _remove,
    _text,
    _touch,
    _grow,
    _drop,
)
