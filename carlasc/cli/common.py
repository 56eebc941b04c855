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

from carlasc.errors import ArgumentError, CarlascError, printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from carlasc.core.frames import FrameRange
    from carlasc.running import Engine, Part
else:
    FrameRange = object  # only an annotation here: importing it loads NumPy, for which `--help` would wait

_Number = TypeVar("_Number", int, float)

FAILED, WRONG_USAGE, INTERRUPTED = 1, 2, 130

_INTERRUPTED = "interrupted: files written so far are complete; run the same command again to continue"
_ARGUMENT = re.compile(r"`(\w+)(?:=([^`]+))?`")  # an argument in an error of the library: `workers`, `overwrite=True`

_OPTIONS = re.compile(r"\w+Options\((.*)\)")  # the value of one: `poses=PoseOptions("kiss-icp")`
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")  # a URL, also one that lost a slash; a drive has one letter


def _read_place(parameter: typer.CallbackParam, place: str | None) -> str | None:
    """Return a path with `~` replaced, or a URL as it is.

    Raises:
        ArgumentError: the place is empty, or is a URL with one slash, as shells and `Path` leave it.
    """
    if place is None:
        return None
    name = parameter.name or "source"
    if not place:
        raise ArgumentError(name, expected="a path or a URL", found="nothing")
    if "://" in place:
        return place
    if _URL.match(place) and not Path(place).exists():
        raise ArgumentError(name, expected="a path, or a URL such as s3://bucket/folder", found=place)
    return str(Path(place).expanduser()) if place.startswith("~") else place


def _read_places(parameter: typer.CallbackParam, places: list[str]) -> list[str | None]:
    """Return several paths or URLs, each as `_read_place` does."""
    return [_read_place(parameter, place) for place in places]


def _read_file(parameter: typer.CallbackParam, file: Path | None) -> Path | None:
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
        advice="write it here, then upload it",
    )


def place_argument(text: str, name: str = "SOURCE", default: str | None = None) -> Any:
    """Return an argument for a path or a URL. `text` is its help, `name` what it is called there."""
    return typer.Argument(metavar=name, help=text, callback=_read_place, show_default=default or True)


def places_argument(text: str, name: str = "SOURCES") -> Any:
    """Return an argument for one or more paths or URLs. `text` is its help, `name` what it is called there."""
    return typer.Argument(metavar=name, help=text, callback=_read_places)


def place_option(*flags: str, text: str) -> Any:
    """Return an option for a path or a URL."""
    return typer.Option(*flags, help=text, callback=_read_place)


def file_argument(text: str, name: str = "OUT") -> Any:
    """Return an argument for a path on this machine, where files of other formats are written."""
    return typer.Argument(metavar=name, help=text, callback=_read_file)


def file_option(*flags: str, text: str, **settings: Any) -> Any:
    """Return an option for a path on this machine."""
    return typer.Option(*flags, help=text, callback=_read_file, **settings)


Json = Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")]
Workers = Annotated[
    int | None, typer.Option(help="Processes that work side by side; if not given, one per core.", min=1)
]
Cluster = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="WHERE",
        help="Work on a Dask cluster: local or local:N (processes here), tcp://HOST:PORT (a scheduler), slurm (with --workers jobs),"
        " or the dotted path of a class that starts one.",
    ),
]
PartOption = Annotated[
    str | None,
    typer.Option(
        "--part",
        metavar="I/N",
        help="Do only the I-th of N parts; other commands do the others, on any machine that reaches the output.",
    ),
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
            if isinstance(error, ArgumentError):
                shown.where = options.get(error.where, error.where)
            message = _replace_arguments(str(shown), options)
            fail(message, WRONG_USAGE if isinstance(error, ArgumentError) else FAILED)
        except _BatchError as error:
            for message in error.messages:
                echo(f"carlasc: {_replace_arguments(message, self._options(ctx))}", err=True)
            fail(str(error))
        except KeyboardInterrupt:
            fail(_INTERRUPTED, INTERRUPTED)
        except (SystemError, ValueError) as error:
            # Ctrl-C while compiled code returned its result, or while a zip was written, which then cannot be closed
            if not isinstance(error.__cause__ or error.__context__, KeyboardInterrupt):
                raise
            fail(_INTERRUPTED, INTERRUPTED)
        except BrokenPipeError:  # `carlasc info | head`
            sys.stderr.close()
            raise typer.Exit(FAILED) from None
        except OSError as error:  # of a file that the library reads or writes in passing
            fail(f"{error.filename or 'the file system'}: {error.strerror or error}")

    def _options(self, ctx: Any) -> dict[str, str]:
        """Return what a user types for each parameter of the command that runs, by its name."""
        command = self.commands.get(ctx.invoked_subcommand or "")
        return {} if command is None else {p.name: _typed(p) for p in command.params if p.name}


def parse_part(text: str | None) -> Part:
    """Return the part that `--part` names, or the whole.

    Raises:
        ArgumentError: it is not of the form I/N.
    """
    from carlasc.running import Part

    return Part() if text is None else Part.parse(text)


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
        if value in ("True", None):
            return f"`{options[name]}`"
        value = _OPTIONS.sub(r"\1", value).strip('"')
        return f"`{options[name]} {value}`"

    return _ARGUMENT.sub(replace, text)


def echo(text: object, *, err: bool = False, nl: bool = True) -> None:
    """Print lines on stdout or stderr. Names in them come from data: what a terminal would obey is shown escaped."""
    typer.echo("\n".join(map(printable, str(text).split("\n"))), err=err, nl=nl)


def line(text: str, style: str = "") -> Text:
    """Return a line for a console, as it is: without markup, and with what a terminal would obey escaped."""
    from rich.text import Text

    return Text(printable(text), style)


def fail(message: str, code: int = FAILED) -> None:
    """Print one line on stderr and end the command with an exit code."""
    echo(f"carlasc: {message}", err=True)
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
def engine(cluster: str | None, workers: int | None) -> Iterator[Engine | None]:
    """Yield what does the work: the cluster of the option `--cluster`, or None for processes on this machine."""
    if cluster is None:
        yield None
    else:
        from carlasc.running import open_cluster

        with open_cluster(cluster, workers=workers) as opened:
            yield opened


@contextmanager
def progress_bar(
    description: str, unit: str = "frames", *, transient: bool = False
) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar on stderr while the block runs, if stderr is a terminal.

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
    columns = (
        "{task.description}",
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=transient, disable=not console.is_terminal) as progress:
        task = progress.add_task(description, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


def console() -> Console:
    """Return the console of stdout; 160 characters wide if it is not a terminal."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=160)


def print_json(value: Any) -> None:
    """Print a result as JSON; it may hold dataclasses, paths and NumPy values."""
    echo(json.dumps(value, indent=2, default=_plain))


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
