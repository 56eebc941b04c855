"""Damaged files: every reader is given files with random changes, and may raise nothing but a
CarlascError of one line.

A child process reads thousands of cases, one after the other, with a limit of memory and of time
for each; the parent learns of its death. Compiled loops check each index, as one out of bounds may
do damage that no error shows. Case `number` of a target depends on the seed, the target and the
number alone: `python -m faults.mutations TARGET SEED NUMBER` repeats one.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import mmap
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import unicodedata
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import accumulate
from pathlib import Path
from random import Random
from types import FrameType
from typing import Any

from carlasc.errors import CarlascError
from faults.damage import Changes, Files, damage
from faults.outcome import Outcome
from faults.targets import TARGETS, Target

CASE_S = 10.0  # fact: fault-case
"""Seconds that a case may take before it counts as a fault."""
HANG_S = 30.0
WRITE_S = 300.0  # for valid files, whose loops may have to be compiled first
"""Seconds without progress after which a child is ended."""
MEMORY = 1 << 30
"""Bytes of address space that reading a case may take beyond what reading the whole files took."""
LONGEST = 1000
"""Characters of a message."""
# categories of characters that end a line or that a terminal obeys, and halves of characters
_OBEYED = (
    "Cc",
    "Zl",
    "Zp",
    "Cs",
)
# those that turn the direction of writing
_TURNED = (
    "LRE",
    "RLE",
    "LRO",
    "RLO",
    "PDF",
    "LRI",
    "RLI",
    "FSI",
    "PDI",
)
_ROOT = Path(__file__).parents[3]
_CHECKING = {
    "NUMBA_BOUNDSCHECK": "1",
    # apart from the loops that check nothing
    "NUMBA_CACHE_DIR": str(_ROOT / "build" / "checked-loops"),
    "OMP_NUM_THREADS": "1",
}
_FOUND, _UNREADABLE = "found.txt", "the files cannot be read"


class Progress:
    """Which case a child has reached, and since when, in memory that it shares with its parent: two
    numbers, each written at once.
    """

    def __init__(self) -> None:
        self._values = memoryview(mmap.mmap(-1, mmap.PAGESIZE)).cast("q")

    def reach(self, case: int) -> None:
        """Begin a case."""
        self._values[0], self._values[1] = case, time.monotonic_ns()

    @property
    def case(self) -> int:
        """The case that was begun last."""
        return self._values[0]

    @property
    def seconds(self) -> float:
        """How long ago that was."""
        return (time.monotonic_ns() - self._values[1]) / 1e9


class TookTooLongError(BaseException):
    """A case took longer than `CASE_S`.

    It is no Exception, so that no reader takes it for one of its own.
    """


class Reading:
    """What the readers said of one case."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names, self.refused, self.complaint, self.first = names, 0, "", ""

    def attempt(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a reader; return what it returns, or None if it refuses with an error of ours.

        Any other error goes on.
        """
        try:
            return function(*arguments)
        except CarlascError as error:
            self.refused += 1
            self.first = self.first or str(error)
            self._check(str(error), error)
            return None

    def _check(self, message: str, error: CarlascError) -> None:
        if any(
            unicodedata.category(character) in _OBEYED
            or unicodedata.bidirectional(character) in _TURNED
            for character in message
        ):
            self.complaint = f"a message that is not one line of printable text: {message[:200]!r} {_place_of(error)}"
        elif len(message) > LONGEST:
            self.complaint = (
                f"a message of {len(message)} characters: {message[:100]!r} {_place_of(error)}"
            )
        elif not any(name in message for name in self.names):
            self.complaint = f"a message that names no file: {message[:200]!r} {_place_of(error)}"


def run(count: int, seed: int, folder: Path) -> Outcome:
    """Read `count` damaged cases, divided among the targets, in as many processes as there are
    processors.

    Args:
        count: number of cases in all.
        seed: of the random changes.
        folder: is not used: files of cases are in memory where the machine has a folder there.
    """
    started = time.monotonic()
    chosen = shares(count, [target for target in TARGETS if target.is_available()])
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        said = list(pool.map(lambda part: run_apart(part[0].name, seed, part[1]), chosen))
    found = [line.strip() for lines in said for line in lines.splitlines() if line.startswith(" ")]
    return Outcome("mutations", count, found, time.monotonic() - started)


def run_apart(names: str, seed: int, count: int) -> str:
    """Read cases of some targets in a process of its own, and return what it prints: a line for
    each, and faults after two spaces.
    """
    command = [sys.executable, "-m", "faults.mutations", names, str(seed), "x", str(count)]
    paths = [
        str(_ROOT / "tests"),
        str(_ROOT / "tests" / "tools"),
        str(_ROOT / "examples"),
        *filter(None, sys.path),
    ]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1) or done.stdout.count(" cases, ") != len(names.split(",")):
        raise RuntimeError(f"{names}: exit status {done.returncode}: {done.stderr}")
    return done.stdout


def shares(count: int, targets: Sequence[Target]) -> list[tuple[Target, int]]:
    """Divide a number of cases among targets by their weights."""
    ends = list(accumulate((target.weight for target in targets), initial=0))
    return [
        (target, count * end // ends[-1] - count * start // ends[-1])
        for target, start, end in zip(targets, ends, ends[1:], strict=False)
    ]


def run_target(target: Target, cases: range, seed: int, folder: Path) -> tuple[int, list[str]]:
    """Read cases of one target, and return how many were read, and a line for each kind of fault."""
    place, progress = folder / target.name, Progress()
    found = place / _FOUND
    place.mkdir(parents=True, exist_ok=True)
    found.touch()
    if status := _in_child(lambda: target.write(place / "valid"), progress, WRITE_S):
        return 0, [f"{target.name}: its valid files cannot be written: {status}"]
    start = cases.start
    while start < cases.stop:
        progress.reach(start)
        rest = range(start, cases.stop)
        status = _in_child(partial(_read_cases, target, rest, seed, place, progress), progress)
        if not status:
            break
        with found.open("a") as file:
            file.write(f"{target.name} {seed} {progress.case}: {status}\n")
        if status.startswith(_UNREADABLE):
            return progress.case - cases.start, _distinct(found.read_text().splitlines())
        start = progress.case + 1
    lines = found.read_text().splitlines()
    shutil.rmtree(place)
    return len(cases), _distinct(lines)


def _in_child(work: Callable[[], None], progress: Progress, limit_s: float = HANG_S) -> str:
    """Run a function in a forked process; return "" if it ended well, otherwise how it died.

    `limit_s` is the longest time without progress.
    """
    progress.reach(progress.case)
    child = os.fork()
    if child == 0:
        status = 1
        try:
            faulthandler.disable()
            work()
            status = 0
        except BaseException:  # noqa: BLE001 (a child must not go on as its parent)
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(status)
    wait, hung = 0.002, False
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            break
        if progress.seconds > CASE_S + limit_s:
            hung = True
            os.kill(child, signal.SIGKILL)
        time.sleep(wait)
        wait = min(0.2, wait * 2)
    if hung:
        return f"hangs: no progress in {limit_s:.0f} s"
    if os.WIFSIGNALED(status):
        return f"kills the process: {signal.Signals(os.WTERMSIG(status)).name}"
    return f"{_UNREADABLE}: exit status {os.WEXITSTATUS(status)}" if os.WEXITSTATUS(status) else ""


def _read_cases(target: Target, cases: range, seed: int, place: Path, progress: Progress) -> None:
    """Read cases in this process. What is wrong goes into a file, one line each."""
    files = load(place / "valid")
    root = place / "case"
    root.exists() and shutil.rmtree(root)
    shutil.copytree(place / "valid", root)
    warnings.simplefilter("ignore")
    whole = Reading([str(place)])
    target.read(root, whole.attempt)
    if whole.refused:
        raise RuntimeError(f"{target.name}: the valid files are refused: {whole.first}")
    limit_memory(MEMORY)
    signal.signal(signal.SIGALRM, stop)
    seen: dict[str, int] = {}
    with (place / _FOUND).open("a") as found:
        for number in cases:
            progress.reach(number)
            changes = damage(files, Random(f"{seed}/{target.name}/{number}"))
            # no reader that keeps something by path can mix cases up
            root = root.rename(place / f"case-{number}")
            fault = read_case(target, root, files, changes)
            kind = fault.partition(" [")[0]
            seen[kind] = seen.get(kind, 0) + 1
            if fault and seen[kind] <= 3:
                found.write(f"{target.name} {seed} {number}: {fault}\n")
                found.flush()
            if number % 200 == 0:
                gc.collect()
    progress.reach(cases.stop)


def read_case(
    target: Target, root: Path, files: Files, changes: Changes, show: bool = False
) -> str:
    """Apply changes to a folder, read it, and undo them.

    Return what was wrong, with its place in brackets, or "".
    """
    _apply(root, changes)
    reading = Reading(
        [str(root.parent), *(path.rstrip("/").rpartition("/")[2] for path in changes)]
    )
    try:
        signal.setitimer(signal.ITIMER_REAL, CASE_S)
        try:
            target.read(root, reading.attempt)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        return reading.complaint
    except TookTooLongError as error:
        return f"takes more than {CASE_S:.0f} s {_place_of(error)}"
    except BaseException as error:  # noqa: BLE001 (any of them is what is looked for)
        if show:
            traceback.print_exc()
        text = " ".join(str(error).split())[:160]
        return f"{type(error).__name__} {_place_of(error)} {text}"
    finally:
        _undo(root, files, changes)


def limit_memory(more: int) -> None:
    """Limit this process's address space to what it has now and some bytes more; only where the
    system says what it has.
    """
    with contextlib.suppress(FileNotFoundError):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(
            resource.RLIMIT_AS, (pages * resource.getpagesize() + more, resource.RLIM_INFINITY)
        )


def stop(number: int, frame: FrameType | None) -> None:
    """End a case that takes too long: what the alarm calls."""
    raise TookTooLongError


def _place_of(error: BaseException) -> str:
    """Return the last line of the package in an error's traceback:
    "[carlasc/storage/layout.py:12]".
    """
    own, last = "", ""
    for step in traceback.extract_tb(error.__traceback__):
        last = f"[{Path(step.filename).name}:{step.lineno}]"
        for package in ("carlasc", "carlasc_converters", "carlasc_recorders", "completion"):
            parts = Path(step.filename).parts
            # a checkout may be named after it
            if package in parts[:-1] and not {"site-packages", "tests"} & {*parts}:
                own = f"[{'/'.join(parts[len(parts) - 1 - parts[::-1].index(package) :])}:{step.lineno}]"
    return own or last


def _distinct(lines: list[str]) -> list[str]:
    """Return one line for each kind of fault: those of one type at one place are one."""
    kinds: dict[str, list[str]] = {}
    for line in lines:
        kinds.setdefault(_kind_of(line), []).append(line)
    return [found[0] for found in kinds.values()]


def _kind_of(line: str) -> str:
    """Return what faults of one kind have in common: target, type and place."""
    head, _, fault = line.partition(": ")
    what, bracket, rest = fault.partition("[")
    what = "message" if what.startswith("a message") else what
    place = rest.rpartition("[")[2] if what == "message" else rest
    return f"{head.partition(' ')[0]} {what}{bracket}{place.partition(']')[0]}"


def load(folder: Path) -> Files:
    """Return the files of a folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _apply(root: Path, changes: Changes) -> None:
    for path, data in changes.items():
        place = root / path.rstrip("/")
        if place.is_dir():
            continue  # two changes of one case
        place.unlink(missing_ok=True)  # a new file: the old one may still be mapped into memory
        if path.endswith("/"):
            place.mkdir()
        elif data is not None:
            place.write_bytes(data)


def _undo(root: Path, files: Files, changes: Changes) -> None:
    for path in changes:
        place = root / path.rstrip("/")
        if place.is_dir():
            place.rmdir()
        else:
            place.unlink(missing_ok=True)
    for path in changes:
        if (name := path.rstrip("/")) in files:
            (root / name).write_bytes(files[name])


@contextlib.contextmanager
def _place_in_memory(folder: Path) -> Iterator[Path]:
    """Give a folder whose files are in memory where the machine has such a place, and remove it."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(
        prefix="carlasc-faults-", dir=memory if os.access(memory, os.W_OK) else folder
    ) as place:
        yield Path(place)


def main() -> int:
    """Repeat one case, `python -m faults.mutations TARGET SEED NUMBER`, or run many:
    `TARGET,...|all SEED x COUNT`.
    """
    if not _CHECKING.items() <= os.environ.items():
        os.execve(
            sys.executable,
            [sys.executable, "-m", "faults.mutations", *sys.argv[1:]],
            os.environ | _CHECKING,
        )
    faults = 0
    names, seed, many = sys.argv[1], int(sys.argv[2]), sys.argv[3] == "x"
    chosen = [target for target in TARGETS if names == "all" or target.name in names.split(",")]
    with _place_in_memory(Path(tempfile.gettempdir())) as folder:
        for target, share in shares(int(sys.argv[-1]), chosen):
            if many:
                started = time.monotonic()
                tried, found = run_target(target, range(share), seed, folder)
                faults += len(found)
                rate = tried / (time.monotonic() - started)
                print(
                    f"{target.name}: {tried} cases, {rate:.0f} a second, {len(found)} kinds of "
                    f"faults",
                    *found,
                    sep="\n  ",
                    flush=True,
                )
            else:
                _repeat(target, seed, int(sys.argv[-1]), folder)
    return int(faults > 0)


def _repeat(target: Target, seed: int, number: int, folder: Path) -> None:
    target.write(folder / "valid")
    files = load(folder / "valid")
    changes = damage(files, Random(f"{seed}/{target.name}/{number}"))
    for path, data in changes.items():
        print(
            path,
            "removed"
            if data is None
            else f"{len(files.get(path, b''))} to {len(data)} bytes: {data[:300]!r}",
        )
    signal.signal(signal.SIGALRM, stop)
    print(read_case(target, folder / "valid", files, changes, show=True))


if __name__ == "__main__":
    sys.exit(main())
