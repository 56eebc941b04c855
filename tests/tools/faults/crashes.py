"""Power failures: what a command did is recorded, and the folder is built as a disk may hold it
after each of its calls.

A disk keeps what was synced. Of the rest it keeps any part: the bytes of a file that were not
synced may be there, missing, cut short or zeros, and names that were given or removed since their
folder was synced may be as before or as after, in any combination or in their order (`Disk`).
"""

from __future__ import annotations

import itertools
import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from faults import preload
from faults.calls import ALONE
from faults.commands import (
    MESSAGES,
    TEMPORARY,
    Command,
    run_command,
    start,
    wait,
    warm,
)
from faults.comparing import content_of, differences
from faults.kills import Undisturbed, run_undisturbed, torn
from faults.outcome import Outcome
from faults.trying import main, run_with_library

LOSSES = ("all", "prefix", "zeros", "some")
"""What is lost of what was not synced: everything; names in order from some point on, and the ends
of files; likewise, but bytes become zeros; any part.
"""

RECORDED = [name for name in ALONE if name != "render-film"]
"""Commands whose bytes are all written by this process: the encoder of films is a program of its
own.
"""


def run(count: int, seed: int, folder: Path, names: Sequence[str] | None = None) -> Outcome:
    """Let the power fail at `count` moments, shared among the commands.

    Args:
        count: number of moments; 0 for every call of every command with every kind of loss.
        seed: of the random numbers that choose the moments and what is lost.
        folder: an empty folder to work in.
        names: the commands; None for all in `RECORDED`.

    Raises:
        RuntimeError: a command fails without any disturbance.
    """
    began = time.monotonic()
    tried, found = run_with_library("faults.crashes", count, seed, folder, names or RECORDED)
    return Outcome.of("crashes", began, tried, found)


def _try_command(
    command: Command, count: int | None, seed: int, base: Path, work: Path
) -> tuple[int, list[str]]:
    warm(command, base, work / "warm")
    case, log = work / "case", work / "log"
    undisturbed = run_undisturbed(command, base, case)
    shutil.rmtree(case)
    command.copy_inputs(base, case)
    if code := wait(start(command.argv, case, lambda: preload.record_calls(case, log)), 60):
        raise RuntimeError(f"exit code {code}: {(case / MESSAGES).read_text()}")
    calls, finished = read_log(log, case), content_of(case)
    every = [(moment, loss) for moment in range(1, len(calls) + 1) for loss in LOSSES]
    rng = np.random.default_rng(seed)
    chosen = (
        range(len(every))
        if count is None
        else sorted(rng.choice(len(every), min(count, len(every)), False))
    )
    tried, found = 0, []
    for number in chosen:
        moment, loss = every[int(number)]
        tried += 1
        shutil.rmtree(case, ignore_errors=True)
        command.copy_inputs(base, case)
        disk = Disk(case)
        for call in calls[:moment]:
            disk.apply(call)
        disk.fail(loss, np.random.default_rng([seed, moment, LOSSES.index(loss)]))
        story = f"{command.name}, seed {seed}, after call {moment} of {len(calls)} ({calls[moment - 1]}), lost: {loss}"
        faults = _judge(
            command, case, undisturbed, whole=finished if moment == len(calls) else None
        )
        found += [f"{story}: {fault}" for fault in faults]
    return tried, found


def _judge(
    command: Command, case: Path, undisturbed: Undisturbed, whole: dict[str, bytes | None] | None
) -> list[str]:
    """Check what the power failure left, then let the command finish; returns what is wrong.

    Args:
        command: the command.
        case: its folder.
        undisturbed: what it does without a disturbance.
        whole: what must be there already, as the command had ended.
    """
    faults, found = torn(content_of(case), case, command, undisturbed), content_of(case)
    if whole is not None:
        faults += [
            f"lost after the command had ended: {line}" for line in differences(whole, found)[:3]
        ]
    finished = not differences(undisturbed.after, found)
    try:
        code = run_command(command, case)
    except TimeoutError as problem:
        return [*faults, str(problem)]
    if code != (undisturbed.code if finished else 0):
        faults.append(
            f"the next run ends with exit code {code}: {(case / MESSAGES).read_text()[-300:]}"
        )
    return faults + [
        f"after the next run {line}"
        for line in differences(undisturbed.after, content_of(case))[:3]
    ]


@dataclass(frozen=True)
class Call:
    """A call that changed something below the folder.

    Attributes:
        kind: create, empty, write, truncate, sync, rename, link, mkdir, unlink or rmdir.
        offset: where bytes were written, or the length that a file was cut to.
        data: the bytes.
        path: what it changed.
        other: the new name, of renames and links.
    """

    kind: str
    offset: int
    data: bytes
    path: str
    other: str

    def __str__(self) -> str:
        return f"{self.kind} {Path(self.path).name}"


def read_log(log: Path, folder: Path) -> list[Call]:
    """Read the calls that `preload.record_calls` wrote, with paths relative to a folder."""
    data, place, calls = log.read_bytes(), 0, []
    while place < len(data):
        ends = []
        for _ in range(3):
            ends.append(data.index(b"\0", ends[-1] + 1 if ends else place))
        kind, _, offset, length = data[place : ends[0]].decode().split()
        paths = [data[a + 1 : b].decode() for a, b in itertools.pairwise(ends)]
        body = int(length) if kind == "write" else 0
        place = ends[-1] + 1 + body
        path, other = (os.path.relpath(path, folder) if path else "" for path in paths)
        if Path(path).parts[:1] == (TEMPORARY,):
            continue  # the folder of temporary files, which a machine empties when it starts
        calls.append(Call(kind, int(offset), data[place - body : place], path, other))
    return calls


@dataclass(eq=False)
class _File:
    """The bytes of a file now, and those that the disk is sure to hold."""

    now: bytearray
    synced: bytes = b""
    time: int | None = None  # of modification, ns, of a file that was there before


@dataclass(eq=False)
class _Folder:
    """The names in a folder now, and those that the disk is sure to hold."""

    now: dict[str, _File | _Folder] = field(default_factory=dict)
    stored: dict[str, _File | _Folder] = field(default_factory=dict)


_Changes = list[tuple[_Folder, str, _File | _Folder | None]]
"""What one call does to names: in a folder, a name gets a file or a folder, or goes (None).

It happens whole or not at all.
"""


class Disk:
    """A folder, and what a disk may hold of it after a power failure: a name is stored once its
    folder has been synced.
    """

    def __init__(self, root: Path) -> None:
        self.root, self._top = root, _read(root)
        self._pending: list[_Changes] = []  # of names, in order, that may or may not be on the disk

    def apply(self, call: Call) -> None:
        """Do what a call did."""
        folder, name = self._at(call.path)
        if call.kind in ("create", "mkdir"):
            self._change(
                [(folder, name, _File(bytearray()) if call.kind == "create" else _Folder())]
            )
        elif call.kind in ("unlink", "rmdir"):
            self._change([(folder, name, None)])
        elif call.kind in ("link", "rename"):
            new = (*self._at(call.other), folder.now[name])
            self._change([new] if call.kind == "link" else [(folder, name, None), new])
        elif call.kind == "sync":
            self._sync(self._top if call.path == "." else folder.now.get(name))
        else:
            file = folder.now.get(name)
            if isinstance(file, _File):
                file.time = None
                _write(file.now, call)

    def _at(self, path: str) -> tuple[_Folder, str]:
        *above, name = Path(path).parts or (".",)
        folder = self._top
        for part in above:
            inside = folder.now[part]
            assert isinstance(inside, _Folder)
            folder = inside
        return folder, name

    def _change(self, changes: _Changes) -> None:
        for folder, name, node in changes:
            _set(folder.now, name, node)
        self._pending.append(changes)

    def _sync(self, node: _File | _Folder | None) -> None:
        if isinstance(node, _File):
            node.synced = bytes(node.now)
        elif node is not None:
            waiting = []
            for changes in self._pending:
                if all(folder is not node for folder, _, _ in changes):
                    waiting.append(changes)
                    continue
                for folder, name, inside in changes:
                    _set(folder.stored, name, inside)
            self._pending = waiting

    def fail(self, loss: str, rng: np.random.Generator) -> None:
        """Write the folder as it may be after the power failed now."""
        if loss == "all":
            kept = []
        elif loss == "some":
            kept = [changes for changes in self._pending if rng.random() < 0.5]
        else:
            kept = self._pending[: int(rng.integers(0, len(self._pending) + 1))]
        for changes in kept:
            for folder, name, node in changes:
                _set(folder.stored, name, node)
        shutil.rmtree(self.root)
        _build(self._top, self.root, loss, rng)
        (self.root / TEMPORARY).mkdir(exist_ok=True)


def _read(folder: Path) -> _Folder:
    found = _Folder()
    for path in folder.iterdir():
        data = b"" if path.is_dir() else path.read_bytes()
        file = _File(bytearray(data), data, path.stat().st_mtime_ns)
        found.now[path.name] = _read(path) if path.is_dir() else file
    found.stored = dict(found.now)
    return found


def _set(names: dict[str, _File | _Folder], name: str, node: _File | _Folder | None) -> None:
    if node is None:
        names.pop(name, None)
    else:
        names[name] = node


def _build(folder: _Folder, place: Path, loss: str, rng: np.random.Generator) -> None:
    place.mkdir()
    for name, node in folder.stored.items():
        if isinstance(node, _Folder):
            _build(node, place / name, loss, rng)
        else:
            (place / name).write_bytes(_after(node, loss, rng))
            if node.time is not None:
                os.utime(place / name, ns=(node.time, node.time))


def _write(data: bytearray, call: Call) -> None:
    if call.kind == "empty":
        data.clear()
    elif call.kind == "truncate":
        del data[call.offset :]
        data.extend(bytes(call.offset - len(data)))
    else:
        data.extend(bytes(max(0, call.offset - len(data))))
        data[call.offset : call.offset + len(call.data)] = call.data


def _after(file: _File, loss: str, rng: np.random.Generator) -> bytes:
    """Return the bytes of a file after a power failure: the synced ones, with any part of what came
    later.
    """
    synced, now = file.synced, bytes(file.now)
    if now == synced:
        return now
    if loss == "all":
        return synced
    cut = int(rng.integers(0, len(now) + 1))
    if loss == "zeros":
        return now[:cut] + bytes(len(now) - cut)
    return now[:cut] if len(now) >= len(synced) and now.startswith(synced) else synced


if __name__ == "__main__":
    main(_try_command)
