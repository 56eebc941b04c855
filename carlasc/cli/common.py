"""What all commands share: exit codes for errors, progress, figures as JSON, and the parsing of small values."""

from __future__ import annotations

import copy
import dataclasses
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from typer.core import TyperGroup

from carlasc.errors import ArgumentError, CarlascError

if TYPE_CHECKING:
    from rich.console import Console

    from carlasc.core.frames import FrameRange
else:
    FrameRange = object  # only an annotation here: importing it loads NumPy, for which `--help` would wait

_Number = TypeVar("_Number", int, float)

FAILED, WRONG_USAGE, INTERRUPTED = 1, 2, 130

_ARGUMENT = re.compile(r"`(\w+)(?:=([^`]+))?`")  # an argument in an error of the library: `workers`, `overwrite=True`

Json = Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")]
Workers = Annotated[
    int | None, typer.Option(help="Processes that work side by side; if not given, one per core.", min=1)
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what an earlier run with other settings wrote.")]


class CommandGroup(TyperGroup):
    """Turns errors of the library into one line on stderr and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command. Exit codes: 1 if the work failed, 2 for a wrong argument, 130 if it was interrupted."""
        try:
            return super().invoke(ctx)
        except CarlascError as error:
            options, shown = self._options(ctx), copy.copy(error)
            shown.where = options.get(error.where, error.where)
            message = _replace_arguments(str(shown), options)
            fail(message, WRONG_USAGE if isinstance(error, ArgumentError) else FAILED)
        except _BatchError as error:
            for message in error.messages:
                typer.echo(f"carlasc: {_replace_arguments(message, self._options(ctx))}", err=True)
            fail(str(error))
        except KeyboardInterrupt:
            fail("interrupted: files written so far are complete; run the same command again to continue", INTERRUPTED)
        except BrokenPipeError:  # `carlasc info | head`
            sys.stderr.close()
            raise typer.Exit(FAILED) from None

    def _options(self, ctx: Any) -> dict[str, str]:
        """Return what a user types for each parameter of the command that runs, by its name."""
        command = self.commands.get(ctx.invoked_subcommand or "")
        return {} if command is None else {p.name: _typed(p) for p in command.params if p.name}


def _typed(parameter: Any) -> str:
    """Return what a user types for a parameter: `--frames`, or `SOURCE`."""
    longest = max(parameter.opts, key=len)
    return longest if longest.startswith("-") else (parameter.metavar or longest).upper()


def _replace_arguments(text: str, options: Mapping[str, str]) -> str:
    """Replace `` `window=8` `` by `` `--window 8` `` and `` `overwrite=True` `` by `` `--overwrite` ``, where there is such an option."""

    def replace(match: re.Match[str]) -> str:
        name, value = match[1], match[2]
        if name not in options:
            return match[0]
        return f"`{options[name]}`" if value in ("True", None) else f"`{options[name]} {value.strip(chr(34))}`"

    return _ARGUMENT.sub(replace, text)


def fail(message: str, code: int = FAILED) -> None:
    """Print one line on stderr and end the command with an exit code."""
    typer.echo(f"carlasc: {message}", err=True)
    raise typer.Exit(code)


class _BatchError(Exception):
    """Parts of a batch failed; `messages` say which and why."""

    def __init__(self, summary: str, messages: list[str]) -> None:
        super().__init__(summary)
        self.messages = messages


def report_failures(failures: Sequence[tuple[Any, str]], total: int, what: str = "frames") -> None:
    """End the command with exit code 1, and with what failed on stderr, if anything in a batch failed.

    Args:
        failures: (what failed, message) of each.
        total: how many were tried.
        what: what they are called.
    """
    if failures:
        summary = f"{len(failures)} of {total} {what} failed; the others are done: fix these and run the command again"
        raise _BatchError(summary, [message for _, message in failures])


@contextmanager
def progress_bar(description: str, unit: str = "frames") -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar on stderr while the block runs, if stderr is a terminal.

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
    columns = (
        "{task.description}",
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(description, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


def console() -> Console:
    """Return the console of stdout; 160 characters wide if it is not a terminal."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=160)


def print_json(value: Any) -> None:
    """Print a result as JSON; it may hold dataclasses, paths and NumPy values."""
    typer.echo(json.dumps(value, indent=2, default=_plain))


def parse_numbers(text: str, kind: type[_Number], counts: tuple[int, ...], option: str) -> tuple[_Number, ...]:
    """Read "a,b,c".

    Raises:
        ArgumentError: these are not numbers, or their number is not one of `counts`.
    """
    try:
        values = tuple(kind(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in counts:
        wanted = " or ".join(map(str, counts))
        raise ArgumentError(
            option, expected=f"{wanted} {'whole ' if kind is int else ''}numbers with commas between", found=repr(text)
        )
    return values


def _read_frames(text: str | None) -> FrameRange | None:
    from carlasc.core.frames import FrameRange

    return None if text is None else FrameRange.parse(text)


FramesOption = Annotated[  # a parser's ValueError would become typer's message; that of a callback keeps its own
    FrameRange | None,
    typer.Option(
        "--frames",
        metavar="A:B",
        help="Only frames A to B, B not included; A:, :B and a single frame A are allowed too.",
        parser=str,
        callback=_read_frames,
    ),
]


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


def parse_options(given: list[str] | None) -> dict[str, str]:
    """Return the values of options given as NAME=VALUE, by name. A dash in a name is an underscore, as in other options.

    Raises:
        ArgumentError: one has no =, or is given twice.
    """
    options: dict[str, str] = {}
    for entry in given or []:
        text, equals, value = entry.partition("=")
        name = text.strip().replace("-", "_")
        if not equals or not name or name in options:
            raise ArgumentError("--option", expected="NAME=VALUE, each name once", found=repr(entry))
        options[name] = value
    return options
