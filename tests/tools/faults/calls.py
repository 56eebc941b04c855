"""Commands of which one system call fails: they say so in one line, leave whole files only, and the
next run finishes the work.
"""

from __future__ import annotations

import errno
import re
import shutil
import signal
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from faults import preload
from faults.commands import (
    COMMANDS,
    MESSAGES,
    TEMPORARY,
    Command,
    run_command,
    start,
    wait,
    warm,
)
from faults.comparing import Content, content_of, differences
from faults.kills import Undisturbed, run_undisturbed, torn
from faults.outcome import Outcome
from faults.preload import Kind
from faults.trying import main, run_with_library

END = 0
"""Stands for an error number where the process ends before the call, as kill -9 ends it."""
ERRORS = {
    END: preload.CHANGES,
    errno.EIO: preload.ALL,
    errno.ENOSPC: preload.ALL & ~Kind.READ,
    errno.EDQUOT: preload.ALL & ~Kind.READ,
}
"""The error numbers, and the calls that fail with them."""
ALONE = [
    name
    for name, command in COMMANDS.items()
    if command.workers in (None, 1) and not command.slow and name != "capture"
]
"""Commands that work in one process and thread: calls of others cannot be numbered."""

GOES_ON = ("convert", "convert-zarr", "convert-parquet", "regrid-hdf5", "regrid-parquet")
"""Commands that go on past a frame of the input that cannot be read, and whose next run does not
replace what was made without it: the frames beside it, or
a store of one writer, which is finished. docs/reliability.md says so."""

PARTIAL = ("card", "evaluate-plot", "report", "stats")
"""Commands that say what they found in the frames that can be read, name the others, and end with
exit code 1.
"""


def run(count: int, seed: int, folder: Path, names: Sequence[str] | None = None) -> Outcome:
    """Let `count` calls fail, one in each run of a command.

    Args:
        count: number of calls, shared among the commands; 0 for every call of every command with
            every error, once and from then on.
        seed: of the random numbers that choose them.
        folder: an empty folder to work in.
        names: the commands; None for all that work in one process.

    Raises:
        RuntimeError: a command fails without any failing call.
    """
    began = time.monotonic()
    tried, found = run_with_library("faults.calls", count, seed, folder, names or ALONE)
    return Outcome.of("calls", began, tried, found)


def _try_command(
    command: Command, count: int | None, seed: int, base: Path, work: Path
) -> tuple[int, list[str]]:
    warm(command, base, work / "warm")
    case = work / "case"
    undisturbed = run_undisturbed(command, base, case)
    calls = {error: _count(command, kinds, base, case) for error, kinds in ERRORS.items()}
    tried, found = 0, []
    for k, error, always in _chosen(calls, count, np.random.default_rng(seed)):
        tried += 1
        story = f"{command.name}, call {k} of {calls[error]}: {_named(error, always)}"
        found += [
            f"{story}: {fault}"
            for fault in _try_call(command, k, error, always, base, case, undisturbed)
        ]
    return tried, found


def _named(error: int, always: bool) -> str:
    return (
        "the end"
        if error == END
        else f"{errno.errorcode[error]} {'from then on' if always else 'once'}"
    )


def _count(command: Command, kinds: Kind, base: Path, case: Path) -> int:
    """Return how many calls a command makes."""
    shutil.rmtree(case)
    command.copy_inputs(base, case)
    wait(start(command.argv, case, lambda: preload.count_calls(case, kinds)), 60)
    return preload.counted_calls()


def _chosen(
    calls: dict[int, int], count: int | None, rng: np.random.Generator
) -> Iterator[tuple[int, int, bool]]:
    every = [
        (k, error, always)
        for error, most in calls.items()
        for k in range(1, most + 1)
        for always in ((False,) if error == END else (False, True))
    ]
    numbers = (
        range(len(every))
        if count is None
        else sorted(rng.choice(len(every), min(count, len(every)), replace=False))
    )
    for number in numbers:
        yield every[int(number)]


def _try_call(
    command: Command,
    k: int,
    error: int,
    always: bool,
    base: Path,
    case: Path,
    undisturbed: Undisturbed,
) -> list[str]:
    """Let a call fail, then let the command finish; returns what is wrong."""
    shutil.rmtree(case, ignore_errors=True)
    command.copy_inputs(base, case)

    def arm() -> None:
        if error == END:
            preload.end_at_call(case, k, ERRORS[error])
        else:
            preload.fail_call(case, k, error, always=always, kinds=ERRORS[error])

    child = start(command.argv, case, arm)
    try:
        code = wait(child, 60)
    except TimeoutError as problem:
        return [str(problem)]
    failed, messages, found = (
        preload.failed_call(),
        (case / MESSAGES).read_text(errors="replace"),
        content_of(case),
    )
    if failed is None:
        return []  # threads made fewer calls this time
    kind, path = failed
    what = f"{kind.name} of {Path(path).relative_to(case)}"
    faults = _said(code, messages, None if always else path, case) if error != END else []
    if always and code == -signal.SIGSEGV and path is not None and path.endswith(".h5"):
        faults = []  # libhdf5 crashes on a disk that stays dead; the next run must complete all
    if error == END and code != 137:
        faults.append(f"exit code {code} where the process was ended: {messages[-300:]}")
    same = {name: data for name, data in found.items() if not _is_temporary(name)}
    if kind == Kind.UNLINK:
        same = _without_refused(same)
    of_input = bool({*Path(path).relative_to(case).parts[:1]} & {*command.inputs})
    if code == 1 and command.name in GOES_ON and of_input:
        return [f"{what}: {fault}" for fault in faults]
    finished = not differences(undisturbed.after, same)
    if code == 0 and not finished:
        faults += [f"exit code 0, but {line}" for line in differences(undisturbed.after, same)[:2]]
    if not (command.name in PARTIAL and code == 1):
        faults += torn(found, case, command, undisturbed)
    if kind != Kind.UNLINK and not always and error != END:
        faults += [
            f"{name} is left"
            for name in found
            if _is_temporary(name) and re.match(r"\..*\.part", Path(name).name)
        ]
    try:
        again = run_command(command, case)
    except TimeoutError as problem:
        return [f"{what}: {fault}" for fault in [*faults, str(problem)]]
    if again != (undisturbed.code if finished else 0):
        faults.append(
            f"the next run ends with exit code {again}: {(case / MESSAGES).read_text()[-300:]}"
        )
    left = content_of(case)
    # the system's own folder for temporary files is emptied by the system
    if error == END or always:
        left = {name: data for name, data in left.items() if Path(name).parent.name != TEMPORARY}
    elif kind == Kind.UNLINK:
        left = _without_refused(left)
    faults += [f"after the next run {line}" for line in differences(undisturbed.after, left)[:3]]
    return [f"{what}: {fault}" for fault in faults]


def _said(code: int, messages: str, path: str | None, case: Path) -> list[str]:
    """Check the exit code, and what the command said on stderr: lines of its own that name the
    file.
    """
    if code == 0:
        return []
    if code != 1:
        return [f"exit code {code}: {messages[-600:]}"]
    said = [line for line in messages.splitlines() if line.startswith("carlasc: ")]
    if "Traceback" in messages or "Exception ignored" in messages:
        return [f"a traceback: {messages[-900:]}"]
    if not said:
        return [f"exit code 1 without a message: {messages[-300:]}"]
    if path is not None and not any(_names(line, path, case) for line in said):
        return [f"the message does not name it: {said[-1]}"]
    return []


def _names(line: str, path: str, case: Path) -> bool:
    """Whether a message names a file, by the name that it gets when it is whole, or the folder or
    store that it is in, unless a temporary folder takes its place at once.
    """
    relative = Path(path).relative_to(case).as_posix()
    part = r"(^|/)\.([^/]+?)(?:\.[^./]+-[0-9]+\.[0-9a-f]{8})?\.part(?=/|$)"
    final = re.sub(part, r"\1\2", relative)
    if final == ".":  # all files are in it
        return True
    names = {final}
    if not re.match(r"\.\w+\.part/", relative):
        names |= {parent.as_posix() for parent in Path(final).parents if parent != Path()}
    if final != relative and final.startswith("out.ply/"):  # cells of a map, read for its files
        names.add("out_actors/")
    return any(name.removesuffix(".part").removesuffix(".replaced") in line for name in names)


def _without_refused(content: Content) -> Content:
    """Leave out the temporary files that could not be removed, and that no later run of the same
    command looks for.
    """
    return {
        name: data
        for name, data in content.items()
        if (not Path(name).name.startswith(".") or not name.endswith(".part"))
        and (Path(name).parts[0] != TEMPORARY or name == TEMPORARY)
    }


def _is_temporary(name: str) -> bool:
    return any(part.endswith((".part", ".part.json", ".replaced")) for part in Path(name).parts)


if __name__ == "__main__":
    main(_try_command)
