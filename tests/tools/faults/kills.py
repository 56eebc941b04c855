"""Commands that are ended at random moments, and run again until they finish: the result is that of
an undisturbed run.
"""

from __future__ import annotations

import os
import shutil
import signal
import time
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from faults.commands import COMMANDS, MESSAGES, Command, run_command, start, wait, warm
from faults.comparing import (
    STORES,
    Content,
    arrays_of,
    changed,
    content_of,
    differences,
    wrong_arrays,
)
from faults.outcome import Outcome
from faults.trying import try_commands

SIGNALS, SHARES = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT), (0.7, 0.15, 0.15)
# how often a command is ended before it may finish
ENDINGS, ENDING_SHARES = (
    (1, 2, 3),
    (0.6, 0.3, 0.1),
)
# a slow command, or one that starts processes of its own, is ended so many times less often
SLOW = 10
_MANY = 100  # cases from which on slow commands are ended too
GRACE_S = 15.0  # within which the workers of a killed process end
# texts that a command writes early and completes at its end
GROWING = (
    "carlasc.json",
    "times.txt",
    "poses.txt",
    "times0.txt",
    "times1.txt",
    "carlasc-report.json",
    "sequence.json",
    "annotations.json",
)


def run(count: int, seed: int, folder: Path, names: Sequence[str] | None = None) -> Outcome:
    """End commands at `count` random moments, shared among all commands.

    Args:
        count: number of moments.
        seed: of the random numbers. The same seed ends the same commands at the same shares of
            their time.
        folder: an empty folder to work in. The folders of commands for which something was found
            stay there.
        names: only these commands.
    """
    began = time.monotonic()
    every = [name for name, one in COMMANDS.items() if count >= _MANY or not one.slow]
    tried, found = try_commands(
        _try_command, _shares(list(names or every), count, seed), seed, folder
    )
    return Outcome.of("kills", began, tried, found)


def _shares(names: list[str], count: int, seed: int) -> dict[str, int | None]:
    """Return how many moments each command gets."""
    commands = [COMMANDS[name] for name in names]
    slow = [command.slow or (command.workers or 1) > 1 for command in commands]
    weights = np.where(slow, 1 / SLOW, 1.0)
    chosen = np.random.default_rng(seed).choice(len(names), count, p=weights / weights.sum())
    numbers = np.bincount(chosen, minlength=len(names)).tolist()
    return {name: number for name, number in zip(names, numbers, strict=True) if number}


@dataclass(frozen=True)
class Undisturbed:
    """What a command does when nothing disturbs it.

    Attributes:
        before: content of its folder before it runs.
        after: the same after it has run.
        arrays: digests of all arrays of the store that it writes; none if it writes no store.
        code: its exit code when it runs once more: 1 where it refuses to write what exists.
        seconds: how long it takes.
    """

    before: Content
    after: Content
    arrays: dict[str, str]
    code: int
    seconds: float


def _try_command(
    command: Command, count: int, seed: int, base: Path, work: Path
) -> tuple[int, list[str]]:
    warm(command, base, work / "warm")
    case = work / "case"
    undisturbed = run_undisturbed(command, base, case)
    tried, number, found = 0, 0, []
    while tried < count:
        ended, faults = _try_case(command, seed, number, base, case, undisturbed)
        found += [f"{command.name}, seed {seed}, case {number}: {fault}" for fault in faults]
        tried, number = tried + ended, number + 1
    return tried, found


def run_undisturbed(command: Command, base: Path, case: Path) -> Undisturbed:
    seconds = []
    for _ in range(3):
        shutil.rmtree(case, ignore_errors=True)
        command.copy_inputs(base, case)
        before, began = content_of(case), time.monotonic()
        if code := run_command(command, case):
            raise RuntimeError(
                f"exit code {code} without a disturbance: {(case / MESSAGES).read_text()}"
            )
        seconds.append(time.monotonic() - began)
        after = content_of(case)
    output = case / command.output
    arrays = arrays_of(output) if output.suffix in STORES else {}
    again = run_command(command, case)
    return Undisturbed(before, after, arrays, again, float(np.median(seconds)))


def _try_case(
    command: Command, seed: int, number: int, base: Path, case: Path, undisturbed: Undisturbed
) -> tuple[int, list[str]]:
    """End a command one to three times, then let it finish; returns how often it was ended, and
    what is wrong.
    """
    rng = np.random.default_rng([seed, zlib.crc32(command.name.encode()), number])
    shutil.rmtree(case, ignore_errors=True)
    command.copy_inputs(base, case)
    ended, faults, story = 0, [], []
    for _ in range(rng.choice(ENDINGS, p=ENDING_SHARES)):
        chosen = SIGNALS[rng.choice(len(SIGNALS), p=SHARES)]
        whole = command.workers in (None, 1) or bool(rng.random() < 0.5)
        moment = rng.random() * undisturbed.seconds
        before = content_of(case)
        code, lived_on = _end(command, case, chosen, moment, whole)
        ended += code != 0
        story.append(f"{chosen.name} at {moment:.3f} s")
        if lived_on:
            faults.append(
                f"{lived_on} processes live on {GRACE_S:g} s after the main process ended"
            )
        # a recording also puts the server in order after SIGTERM
        is_caught = chosen == signal.SIGINT or command.name == "capture"
        if code not in (0, -chosen, *([130] if is_caught else [])):
            faults.append(f"exit code {code} after {chosen.name}: {_messages(case)}")
        found = content_of(case)
        faults += torn(found, case, command, undisturbed)
        if chosen == signal.SIGINT:
            faults += [
                f"{name} is left by Ctrl-C" for name in found.keys() - before if _is_temporary(name)
            ]
        finished = not differences(undisturbed.after, found)
        if code == 0 or finished:
            break
    try:
        code = run_command(command, case)
    except TimeoutError as error:
        return ended, [*faults, f"{error} after {', '.join(story)}"]
    if code != (undisturbed.code if finished else 0):
        faults.append(f"the next run ends with exit code {code}: {_messages(case)}")
    faults += differences(undisturbed.after, content_of(case))
    return ended, [f"{fault} ({', '.join(story)})" for fault in faults]


def _end(
    command: Command, case: Path, chosen: signal.Signals, moment: float, whole: bool
) -> tuple[int, int]:
    """Start a command and send a signal to it, or to its whole process group; returns its exit code
    and how many processes live on.
    """
    child = start(command.argv, case)
    time.sleep(moment)
    with suppress(ProcessLookupError):  # it has finished
        (os.killpg if whole else os.kill)(child, chosen)
    code = wait(child, 60)
    end = time.monotonic() + GRACE_S
    while _living(child) and time.monotonic() < end:
        time.sleep(0.01)
    left = _living(child)
    if left:
        os.killpg(child, signal.SIGKILL)
    return code, left


def _living(group: int) -> int:
    """Return the number of processes of a group that have not ended."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return 0
    if not Path("/proc/self/stat").is_file():
        return 1
    states = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, its_group = stat.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue  # it ended meanwhile
        states += [state] if int(its_group) == group else []
    return sum(state != "Z" for state in states)


def torn(found: Content, case: Path, command: Command, undisturbed: Undisturbed) -> list[str]:
    """Describe what can be read of an unfinished output and is neither as before the run nor as
    after it.
    """
    if Path(command.output).suffix in STORES:
        return [f"torn: {line}" for line in wrong_arrays(case / command.output, undisturbed.arrays)]
    now = {
        name: data for name, data in found.items() if data != undisturbed.before.get(name, b"\0")
    }
    return [
        f"torn: {line}"
        for line in changed(undisturbed.after, now)
        if Path(line.split(" has ")[0]).name not in GROWING
    ]


def _is_temporary(name: str) -> bool:
    file = Path(name).name
    return file.startswith(".") and file.endswith(".part")


def _messages(case: Path) -> str:
    lines = (case / MESSAGES).read_text().strip().splitlines() if (case / MESSAGES).exists() else []
    return lines[-1] if lines else "it said nothing"
