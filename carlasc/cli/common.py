"""What every command shares: errors to exit codes, progress, figures as JSON, and the parsing of small values."""

from __future__ import annotations

import copy
import dataclasses
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from typer.core import TyperGroup

from carlasc.errors import ArgumentError, CarlascError

if TYPE_CHECKING:
    from rich.console import Console

_Number = TypeVar("_Number", int, float)

FAILED, WRONG_USAGE, INTERRUPTED = 1, 2, 130

_ARGUMENT = re.compile(
    r"`(\w+)(?:=([^`]+))?`"
)  # how the library's errors name an argument: `workers`, `overwrite=True`

Json = Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")]
Workers = Annotated[int | None, typer.Option(help="Processes that work side by side; all cores if not given.", min=1)]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what an earlier run with other settings wrote.")]


class CommandGroup(TyperGroup):
    """Turns the library's errors into one line on stderr and an honest exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command: 1 where the work failed, 2 where an argument made no sense, 130 where it was interrupted."""
        try:
            return super().invoke(ctx)
        except ArgumentError as error:
            fail(str(self._with_options(ctx, error)), WRONG_USAGE)
        except CarlascError as error:
            fail(str(self._with_options(ctx, error)))
        except KeyboardInterrupt:
            fail("interrupted: what is written is whole; run the same command again to go on", INTERRUPTED)
        except BrokenPipeError:  # `carlasc info | head`
            sys.stderr.close()
            raise typer.Exit(FAILED) from None

    def _with_options(self, ctx: Any, error: CarlascError) -> CarlascError:
        """Return an error of the library with the command's options for the names of arguments: `--window` for window."""
        command = self.commands.get(ctx.invoked_subcommand or "")
        options = {} if command is None else {p.name: option_of(p) for p in command.params if p.name}
        changed = copy.copy(error)
        changed.where = options.get(error.where, error.where)
        for part in ("problem", "expected", "found", "advice"):
            setattr(changed, part, _ARGUMENT.sub(lambda match: _as_option(match, options), getattr(error, part)))
        return changed


def option_of(parameter: Any) -> str:
    """Return what a user types for a parameter of a command: `--frames`, or `SOURCE`."""
    longest = max(parameter.opts, key=len)
    return longest if longest.startswith("-") else (parameter.metavar or longest).upper()


def _as_option(match: re.Match[str], options: Mapping[str, str]) -> str:
    name, value = match[1], match[2]
    if name not in options:
        return match[0]
    return f"`{options[name]}`" if value in ("True", None) else f"`{options[name]} {value.strip(chr(34))}`"


def fail(message: str, code: int = FAILED) -> None:
    """Print one line on stderr and leave with an exit code."""
    typer.echo(f"carlasc: {message}", err=True)
    raise typer.Exit(code)


def report_failures(failures: list[tuple[Any, str]], total: int, what: str = "frames") -> None:
    """List what a batch could not do, and exit 1 if there was anything."""
    if failures:
        for _, message in failures:
            typer.echo(f"carlasc: {message}", err=True)
        fail(f"{len(failures)} of {total} {what} failed; the others are done: fix these and run again")


@contextmanager
def progress_bar(description: str, unit: str = "frames") -> Iterator[Callable[[int, int], None]]:
    """Show a bar on stderr while the block runs; it is quiet where there is no terminal.

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
    """Return the console of stdout; tables are as wide as they need where it is no terminal."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=160)


def print_json(value: Any) -> None:
    """Print a result as JSON: dataclasses, paths and NumPy values included."""
    typer.echo(json.dumps(value, indent=2, default=_plain))


def parse_numbers(text: str, kind: type[_Number], counts: tuple[int, ...], option: str) -> tuple[_Number, ...]:
    """Read "a,b,c".

    Raises:
        ArgumentError: not numbers, or not as many as one of `counts`.
    """
    try:
        values = tuple(kind(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in counts:
        wanted = " or ".join(map(str, counts))
        raise ArgumentError(
            option, expected=f"{wanted} {'whole ' if kind is int else ''}numbers with commas between", found=f"{text!r}"
        )
    return values


def parse_frames(text: str | None) -> tuple[int | None, int | None] | None:
    """Read a half-open range of frame numbers: "A:B", "A:", ":B", or one frame "A".

    Raises:
        ArgumentError: it is no range.
    """
    if text is None:
        return None
    first, colon, last = text.partition(":")
    try:
        start, stop = int(first) if first else None, int(last) if last else None
    except ValueError:
        raise ArgumentError("--frames", expected="A:B, A:, :B or a frame number", found=f"{text!r}") from None
    if not colon:
        return start, None if start is None else start + 1
    if start is not None and stop is not None and start >= stop:
        raise ArgumentError("--frames", expected="a range that holds a frame", found=f"{text!r}")
    return start, stop


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
