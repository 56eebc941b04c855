"""What all commands share: exit codes for errors, progress, figures as JSON, and the parsing of
small values.
"""

from __future__ import annotations

import dataclasses
import json
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from carlasc.errors import ArgumentError, count, printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

_Number = TypeVar("_Number", int, float)
_Row = TypeVar("_Row")

# of more sequences or grids, sums and the worst are printed
MANY = 100
WORST = 10
_LINE_S = 10.0  # time between two lines of progress without a terminal, seconds
FAILED = 1
WRONG_USAGE = 2
INTERRUPTED = 130

OPTIONS: ContextVar[Mapping[str, str]] = ContextVar("OPTIONS", default=MappingProxyType({}))
"""What a user types for each argument of the library that is an option of the running command."""

# an argument in a message of the library: `workers`, `overwrite=True`
_ARGUMENT = re.compile(r"`(\w+)(?:=([^`]+))?`")
_VALUES = re.compile(r"\w+Options\((.*)\)")  # the value of one: `poses=PoseOptions("kiss-icp")`

# a URL, also with one slash only; a single letter is a drive
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")


def read_place(parameter: typer.CallbackParam, place: str | None) -> str | None:
    """Return a path with `~` replaced, or a URL as it is.

    Raises:
        ArgumentError: the place is empty, or is a URL with one slash (`Path` removes the other
            one).
    """
    if place is None:
        return None
    name = parameter.name or "source"
    if not place:
        raise ArgumentError(name, expected="a path or a URL", found="an empty text")
    if "://" in place:
        return place
    if _URL.match(place) and not Path(place).exists():
        raise ArgumentError(
            name, expected="a path, or a URL such as s3://bucket/folder", found=place
        )
    return str(Path(place).expanduser()) if place.startswith("~") else place


def read_places(parameter: typer.CallbackParam, places: list[str]) -> list[str | None]:
    """Return several paths or URLs, each as `read_place` does."""
    return [read_place(parameter, place) for place in places]


def read_file(parameter: typer.CallbackParam, file: Path | None) -> Path | None:
    """Return the path of a file on this machine.

    Raises:
        ArgumentError: it is a URL.
    """
    if file is None or not _URL.match(str(file)):
        return None if file is None else file.expanduser()
    raise ArgumentError(
        parameter.name or "out",
        expected="a path on this machine",
        found=f"the URL {str(file).replace(':/', '://', 1)}",
        advice="write a file on this machine, then upload it",
    )


def place_argument(
    text: str, name: str = "SOURCE", default: str | None = None, read: Any = read_place
) -> Any:
    """Return an argument for a path or a URL. `text` is its help, `name` its name in the help."""
    return typer.Argument(metavar=name, help=text, callback=read, show_default=default or True)


def file_argument(text: str) -> Any:
    """Return an argument for a path on this machine, where files of other formats are written."""
    return place_argument(text, "OUT", read=read_file)


def place_option(*flags: str, text: str, read: Any = read_place, **settings: Any) -> Any:
    """Return an option for a path or a URL."""
    return typer.Option(*flags, help=text, callback=read, **settings)


file_option = partial(place_option, read=read_file)
"""Return an option for a path on this machine."""

SourceArgument = Annotated[
    str, place_argument("A data set, a split, a sequence, a zip, a packed store, or a URL.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace what an earlier run with other settings wrote.")
]


def few(
    rows: Iterable[_Row], badness: Callable[[_Row], Any] = lambda _: 0, *, everything: bool
) -> list[_Row]:
    """Return all rows; of more than 100 the ten worst (by default the first), unless everything is
    wanted.
    """
    all_rows = [*rows]
    if everything or len(all_rows) <= MANY:
        return all_rows
    return sorted(all_rows, key=badness, reverse=True)[:WORST]


def starting_with(incomplete: str, names: Iterable[str]) -> list[str]:
    """Return the names that begin with `incomplete`, for completion in a shell."""
    return [name for name in names if name.startswith(incomplete)]


def echo(text: object, *, err: bool = False, nl: bool = True) -> None:
    """Print lines on stdout or stderr.

    Control characters are escaped, because names come from data.
    """
    typer.echo("\n".join(map(printable, str(text).split("\n"))), err=err, nl=nl)


def line(text: str, style: str = "") -> Text:
    """Return a line for a console, without markup and with control characters escaped."""
    from rich.text import Text

    return Text(printable(text), style)


def show(text: str, style: str = "") -> None:
    """Print a line on stdout, which the width of the terminal does not break."""
    console().print(line(text, style), soft_wrap=True)


def fail(message: str, code: int = FAILED) -> None:
    """Print one line on stderr and end the command with an exit code."""
    echo(f"carlasc: {message}", err=True)
    raise typer.Exit(code)


class BatchError(Exception):
    """Parts of a batch failed; `messages` say which and why."""

    def __init__(self, summary: str, messages: list[str]) -> None:
        super().__init__(summary)
        self.messages = messages


def report_failures(
    failures: Sequence[tuple[Any, str]], total: int, what: str = "frames", waiting: int = 0
) -> None:
    """End the command with exit code 1, and with what failed on stderr, if anything in a batch
    failed.

    Args:
        failures: (what failed, message) of each.
        total: number of things that were tried.
        what: what these are, in the plural.
        waiting: how many of the failures only wait for another one.
    """
    if failures:
        wait = f", and {waiting} wait for them" if waiting else ""
        summary = (
            f"{len(failures) - waiting} of {total} {what} failed{wait}; the others are done: fix "
            "these and run the command again"
        )
        raise BatchError(summary, [message for _, message in failures])


def as_typed(text: str) -> str:
    """Replace `` `window=8` `` by `` `--window 8` `` and `` `overwrite=True` `` by `` `--overwrite`
    ``, if the running command has such an option.
    """
    options = OPTIONS.get()

    def replace(match: re.Match[str]) -> str:
        name = match[1]
        value = match[2]
        if name not in options:
            return match[0]
        if value in ("True", None):
            return f"`{options[name]}`"
        value = _VALUES.sub(r"\1", value).strip('"')
        return f"`{options[name]} {value}`"

    return _ARGUMENT.sub(replace, text)


def print_warnings(findings: Iterable[Any]) -> None:
    """Print what is probably wrong, a line each."""
    for finding in findings:
        if finding.severity == "warning":
            echo(as_typed(f"warning: {finding}"))


def print_frames(result: Any, places: Iterable[object], done: str, *, json: bool) -> None:
    """Print what a run made, as JSON or in lines, and end with exit code 1 if frames failed.

    Args:
        result: what the library returned: with notes, failures, made, skipped and elapsed_s.
        places: a line for each place that was written to.
        done: what was done to the frames: "made"; may begin with what was made and a colon.
        json: print JSON.
    """
    if json:
        print_json(result)
    else:
        for note in result.notes:
            echo(as_typed(f"note: {note}"))
        for place in places:
            echo(place)
        if uses := getattr(result, "source_classes", ()):
            echo(f"classes: {', '.join(map(str, uses))}")
        what, _, verb = done.rpartition(": ")
        skipped = f" ({result.skipped} existed)" if result.skipped else ""
        echo(
            f"{what}{what and ': '}{count(result.made, 'frame')} {verb}{skipped} in "
            f"{result.elapsed_s:.1f} s"
        )
    failures = [(failure.frame, failure.message) for failure in result.failures]
    waiting = sum(getattr(failure, "waits", False) for failure in result.failures)
    report_failures(failures, result.made + result.skipped + len(failures), waiting=waiting)


@contextmanager
def progress_bar(
    description: str, unit: str = "frames", *, transient: bool = False
) -> Iterator[Callable[[int, int], None]]:
    """Show progress on stderr while the block runs: a bar on a terminal, otherwise a line every ten
    seconds.

    Args:
        description: what is being done.
        unit: what is counted.
        transient: whether the bar is removed at the end of the block.

    Yields:
        A callback of (done, total) for the library's `progress` arguments.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(description, unit)
        return
    columns = (
        "{task.description}",
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=transient) as progress:
        task = progress.add_task(description, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


def _lines(description: str, unit: str) -> Callable[[int, int], None]:
    """Return a callback of (done, total) that prints a line on stderr, at most one every `_LINE_S`
    seconds.
    """
    start = last = time.monotonic()

    def show(done: int, total: int) -> None:
        nonlocal last
        if (now := time.monotonic()) - last >= _LINE_S:
            last = now
            echo(f"{description}: {done} of {total} {unit}, {now - start:.0f} s", err=True)

    return show


def console() -> Console:
    """Return the console of stdout; 160 characters wide if it is not a terminal."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=160)


def print_json(value: Any) -> None:
    """Print a result as JSON; it may hold dataclasses, paths and NumPy values."""
    echo(json.dumps(value, indent=2, default=_plain))


def parse_numbers(
    text: str, kind: type[_Number], counts: tuple[int, ...], option: str
) -> tuple[_Number, ...]:
    """Read "a,b,c".

    Raises:
        ArgumentError: the text holds something else, or not as many numbers as one of `counts`.
    """
    try:
        values = tuple(kind(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in counts:
        wanted = " or ".join(map(str, counts))
        raise ArgumentError(
            option,
            expected=f"{wanted} {'whole ' if kind is int else ''}numbers separated by commas",
            found=repr(text),
        )
    return values


def read_frames(text: str | None) -> Any:
    """Return the FrameRange of "A:B"; typer reads the annotations, and the class loads NumPy."""
    from carlasc.core.frames import FrameRange

    return None if text is None else FrameRange.parse(text)


def read_window(parameter: typer.CallbackParam, text: str | None) -> tuple[int, int] | None:
    """Return the first and the last scan of a window from "A:B"."""
    if text is None:
        return None
    first, _, last = text.partition(":")
    try:
        return int(first), int(last)
    except ValueError:
        raise ArgumentError(
            parameter.name or "window",
            expected="A:B, in frames relative to the current frame, such as -30:30",
            found=repr(text),
        ) from None


FRAMES_HELP = "Only frames A to B, without B. Also: A: (from A on), :B (before B), A (one frame)."


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, set | frozenset):
        return sorted(value)
    raise TypeError(f"no JSON for {type(value).__name__}")
