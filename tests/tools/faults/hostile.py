"""Files, stores and servers that were made to do harm: each is refused in one line that names it,
and nothing outside the output is touched.

A case lies in a folder of its own:

    victim.txt, secret.txt     what a hostile file tries to replace, or to show
    work/                      where the command runs; `Case.make` puts the hostile file here
    work/out*                  what the command may create

The command runs in a forked child whose memory and time are bounded. Before and after, all files
outside of the output are compared; during the run, an audit hook notes every file that Python opens
for writing, creates, renames or links outside of it.
"""

from __future__ import annotations

import hashlib
import os
import re
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from carlasc.core.compiling import cache_folder
from carlasc.errors import CarlascError
from faults.commands import MESSAGES, TEMPORARY, start, wait
from faults.outcome import Outcome

MEMORY = 1 << 30  # bytes above what the child has when it starts; fact: fault-memory
LIMIT_S = 30.0  # fact: fault-limit
SECRET = b"this text is of another file"
_LONGEST = 4000  # characters of a line
_UNSAFE = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
_WRITES = {
    "os.mkdir",
    "os.rename",
    "os.link",
    "os.symlink",
    "os.remove",
    "os.rmdir",
    "os.truncate",
    "os.chmod",
    "os.utime",
}
_ADDRESS = "{url}"


@dataclass(frozen=True)
class Case:
    """Something hostile, and what is done with it.

    Attributes:
        name: what it is.
        make: puts it into a folder.
        arguments: those of `carlasc` that meet it, with spaces between; "{url}" stands for the
            address of the server.
        names: what each error must contain: the name of the file or of the server.
        serve: runs a server, and yields its address; it is given the folder of the case.
        harmless: whether the command may succeed, because only what it prints and writes has to be
            safe.
        forbidden: what no file of the output may contain.
        environment: variables of the command.
        read: called in the folder, in the place of a command; what it raises must be an error of
            carlasc.
    """

    name: str
    make: Callable[[Path], object]
    arguments: str
    names: str = ""
    serve: Callable[[Path], AbstractContextManager[str]] = lambda place: nullcontext("")
    harmless: bool = False
    forbidden: tuple[bytes, ...] = (SECRET,)
    environment: tuple[tuple[str, str], ...] = ()
    read: Callable[[], object] | None = None


def run(count: int, seed: int, folder: Path) -> Outcome:
    """Try the cases, at most `count` of them: every one that there is, in an order that depends on
    `seed`, if it is 0 the table's.

    The folders of cases that did harm stay in `folder`.
    """
    from faults.hostile_files import cases as of_files
    from faults.hostile_formats import cases as of_formats
    from faults.hostile_servers import cases as of_servers
    from faults.hostile_stores import cases as of_stores
    from faults.hostile_weights import cases as of_weights

    began = time.monotonic()
    for command in ("convert", "download", "info", "pack", "unpack", "validate", *_OTHERS):
        import_module(f"carlasc.cli.{command}")  # once, for all children
    base = folder / "inputs"
    base.mkdir(parents=True)
    of_data = [*of_files(base), *of_stores(base), *of_formats(base)]
    others = [_met_by_another(case, place) for place, case in enumerate(of_data)]
    table = [*of_data, *of_servers(), *of_weights(), *filter(None, others)]
    if seed:
        table = [table[place] for place in sorted(range(len(table)), key=lambda k: hash((seed, k)))]
    chosen = table[:count]
    found = [
        f"{case.name}: {fault}" for case in chosen for fault in try_case(case, folder / "cases")
    ]
    return Outcome("hostile", len(chosen), found, time.monotonic() - began)


_OTHERS = {
    "view": "view {} -o out.html",
    "map": "map {} out.ply --workers 1",
    "label": "label {} -o out --from motion --workers 1",
    "refine": "refine {} -o out --workers 1",
    "audit": "audit {} {} --keep out --workers 1",
    "convert": "convert scans {} out --force --workers 1",
    "regrid": "regrid {} -o out --size 8,8,4 --observe scans --workers 1",
    "report": "report {} --html out.html --remake --workers 1",
    "stats": "stats {} --workers 1",
}
"""Commands that read a data set, and may end before they meet what is hostile."""


def _met_by_another(case: Case, place: int) -> Case | None:
    """Return the case of another command with the same data set, each in turn; None if the command
    of the case has no data set as its first argument.
    """
    command, *arguments = case.arguments.split()
    if case.read is not None or command not in ("info", "validate", "unpack", "pack"):
        return None
    name = [*_OTHERS][place % len(_OTHERS)]
    return replace(
        case,
        name=f"{case.name}, {name}",
        arguments=_OTHERS[name].replace("{}", arguments[0]),
        names="",
        harmless=True,
    )


def try_case(case: Case, folder: Path) -> list[str]:
    """Run the command of a case; returns what it did wrong."""
    place = folder / re.sub(r"[^a-z0-9]+", "-", case.name.lower())
    work = place / "work"
    work.mkdir(parents=True)
    (place / "victim.txt").write_bytes(b"mine")
    (place / "secret.txt").write_bytes(SECRET)
    case.make(work)
    before, noted = listing(place), place / "noted.txt"
    with case.serve(place) as url:
        argv = [word.replace(_ADDRESS, url) for word in case.arguments.split()]
        began = time.monotonic()
        child = start(argv, work, lambda: _prepare(case, work, noted))
        try:
            code = wait(child, LIMIT_S)
        except TimeoutError as error:
            code = str(error)
    messages = (work / MESSAGES).read_bytes()
    faults = [*_judge_messages(case, code, messages), *_judge_files(case, before, place)]
    if noted.exists():
        faults += [
            f"wrote outside: {line}" for line in sorted(set(noted.read_text().splitlines()))[:5]
        ]
    if not faults:
        shutil.rmtree(place)
    return [f"{fault} ({time.monotonic() - began:.1f} s)" for fault in faults]


def _prepare(case: Case, work: Path, noted: Path) -> None:
    restrict(work, noted, dict(case.environment))
    if case.read is not None:
        try:
            case.read()
        except CarlascError as error:
            print(f"carlasc: {error}", flush=True)
            os._exit(1)
        sys.stdout.flush()
        os._exit(0)


def restrict(work: Path, noted: Path, environment: dict[str, str]) -> None:
    """Bound the memory of this process, and note what it writes outside of the output."""
    os.environ.update(environment)
    used = int(re.search(r"VmData:\s*(\d+)", Path("/proc/self/status").read_text())[1]) << 10  # type: ignore[index]
    resource.setrlimit(resource.RLIMIT_DATA, (used + MEMORY, used + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.environ["MPLCONFIGDIR"] = str(work / TEMPORARY)
    allowed = (
        str(work / "out"),
        str(work / ".out"),
        str(noted),
        str(work / TEMPORARY),
        str(work / MESSAGES),
        os.devnull,
    )
    cache = os.path.realpath(cache_folder().parent)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            path, _, flags = arguments
            if not (isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
                return
        elif event in _WRITES:
            path = arguments[1] if event in ("os.rename", "os.link", "os.symlink") else arguments[0]
        else:
            return
        if not isinstance(path, str | bytes):
            return  # a descriptor, or the file of notes
        if event in ("os.remove", "os.rmdir") and arguments[1] != -1:
            return  # in a folder that is being removed, which is noted itself
        if event == "os.mkdir" and Path(os.fsdecode(path)).is_dir():
            return
        written = os.path.realpath(os.fsdecode(path))
        if not written.startswith((*allowed, cache)) and "__pycache__" not in written:
            line = f"{event} {written}\n".encode("utf-8", "backslashreplace")
            descriptor = os.open(noted, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            os.write(descriptor, line)
            os.close(descriptor)

    sys.addaudithook(hook)


def listing(place: Path) -> dict[str, str]:
    """Return all files, folders and links of a case outside of its output, with what they hold."""
    found = {}
    for path in sorted(place.rglob("*")):
        inside = path.relative_to(place)
        if inside.parts[0] == "noted.txt" or (
            len(inside.parts) > 1 and inside.parts[1].startswith(("out", MESSAGES, TEMPORARY))
        ):
            continue
        if path.is_symlink():
            found[str(inside)] = f"link to {path.readlink()}"
        else:
            found[str(inside)] = (
                hashlib.md5(path.read_bytes()).hexdigest() if path.is_file() else "folder"
            )
    return found


def _judge_messages(case: Case, code: int | str, messages: bytes) -> Iterable[str]:
    text = messages.decode(errors="backslashreplace")
    lines = [line for line in text.split("\n") if line]
    if unsafe := _UNSAFE.search(text):
        yield f"{unsafe[0]!r} was printed: {text[max(0, unsafe.start() - 60) : unsafe.end() + 20]!r}"
    # a map of a data set with several sequences is refused before its files are read
    is_refused = code == 1 or (code == 2 and "expected one sequence" in text)
    if not (is_refused or (case.harmless and code == 0)):
        yield f"exit code {code}: {text[-600:]!r}"
        return
    if code == 0:
        return
    if "Traceback" in text or not lines or not (case.harmless or lines[-1].startswith("carlasc: ")):
        yield f"the last line is no error of carlasc: {text[-300:]!r}"
    if long := [line for line in lines if len(line) > _LONGEST]:
        yield f"a line of {len(long[0])} characters was printed"
    if case.names and not any(case.names in line for line in lines):
        yield f"no line names {case.names}: {text[-600:]!r}"


def _judge_files(case: Case, before: dict[str, str], place: Path) -> Iterable[str]:
    after = listing(place)
    for name in sorted(before.keys() | after.keys()):
        if before.get(name) != after.get(name):
            yield f"{name} was changed from {before.get(name)} to {after.get(name)}"
    for path in place.glob("work/out*"):
        for file in [path, *path.rglob("*")]:
            if file.is_symlink() and not file.resolve().is_relative_to(place / "work"):
                yield f"{file} is a link that leads outside"
            elif file.is_file():
                content = file.read_bytes()
                yield from (
                    f"{file} contains {text!r}" for text in case.forbidden if text in content
                )
