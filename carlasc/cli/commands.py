"""Base classes of the commands: plain help under headings, and errors as one line with an exit
code.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Container, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from carlasc.cli.common import (
    FAILED,
    INTERRUPTED,
    OPTIONS,
    WRONG_USAGE,
    BatchError,
    as_typed,
    echo,
    fail,
)
from carlasc.cli.library import SEPARATOR
from carlasc.errors import ArgumentError, CarlascError, CompleteError

_INTERRUPTED = (
    "interrupted: files written so far are complete; run the same command again to continue"
)
_UsageError: Any = typer.BadParameter.__mro__[1]  # typer does not export it


class _Plain:
    """Plain help, and errors in one line.

    Options without a value, and texts, skip typer's conversion of values, which loads pydantic:
    0.1 s, as long as it takes to load what most commands need.

    Attributes:
        texts: names of the parameters whose values are taken as they are typed.
    """

    texts: Container[str] = ()

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters, with the option `--help`."""
        parameters: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for one in parameters:
            if not isinstance(one.process_value, partial):
                is_text = one.name in self.texts
                one.process_value = partial(_process, one, one.process_value, is_text)
        return parameters

    def make_context(
        self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any
    ) -> Any:
        """Read the arguments."""
        with _errors_in_one_line(self):
            return super().make_context(  # type: ignore[misc]
                info_name, args, parent, **extra
            )

    def invoke(self, ctx: Any) -> Any:
        """Run the command.

        Exit codes: 1 if the work failed, 2 for a wrong argument, 130 if it was interrupted.
        """
        with _errors_in_one_line(self):
            return super().invoke(ctx)  # type: ignore[misc]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, and the options under their headings."""
        write_options(self.get_params(ctx), ctx, formatter)


class Command(_Plain, TyperCommand):
    """A command with plain help, whose errors are one line on stderr and an exit code."""


class CommandGroup(_Plain, TyperGroup):
    """The commands. An unknown name prints one line on stderr."""

    def make_context(
        self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any
    ) -> Any:
        """Read the options before the command. Without arguments, print the help."""
        return super().make_context(info_name, args or ["--help"], parent, **extra)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options and the commands."""
        super().format_options(ctx, formatter)
        rows = [(name, self.summary(name)) for name in self.list_commands(ctx)]
        with formatter.section("Commands"):
            formatter.write_dl(rows)

    def summary(self, name: str) -> str:
        """Return what a command does, in a sentence or two: the first paragraph of its help."""
        return " ".join((self.commands[name].help or "").partition("\n\n")[0].split())


def _process(parameter: Any, convert: Any, is_text: bool, ctx: Any, value: Any) -> Any:
    needs_none = is_text or value in (None, parameter.default)
    if not needs_none or (value is None and parameter.required):
        return convert(ctx, value)
    return value if parameter.callback is None else parameter.callback(ctx, parameter, value)


def write_options(parameters: list[Any], ctx: Any, formatter: Any) -> None:
    """Write parameters under their headings: arguments first, then the options of the command, then
    those of its groups.
    """
    sections: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
    for parameter in parameters:
        is_argument = parameter.param_type_name == "argument"
        heading = getattr(parameter, "rich_help_panel", None) or (
            "Arguments" if is_argument else "Options"
        )
        if (record := parameter.get_help_record(ctx)) is not None:
            sections.setdefault(heading, []).append(record)
    for heading, records in sections.items():
        if records:
            with formatter.section(heading):
                formatter.write_dl(records)


@contextmanager
def _errors_in_one_line(command: Any) -> Iterator[None]:
    """Turn errors of the library and of the arguments into one line on stderr and an exit code."""
    options: dict[str, str] = {}
    # a library's argument may be called as an option of the command itself, which then counts
    for one in sorted(getattr(command, "params", ()), key=lambda one: SEPARATOR not in one.name):
        typed = _typed(one)
        names = (one.name, one.name.rpartition(SEPARATOR)[2], typed.strip("-").replace("-", "_"))
        options |= dict.fromkeys(names, typed)
    OPTIONS.set(options)
    try:
        yield
    except _UsageError as error:
        path = f"carlasc {command.name}" if error.ctx is None else error.ctx.command_path
        text = " ".join(error.format_message().replace(": Value error, ", ": ").split()).rstrip(".")
        fail(f"{text[:1].lower()}{text[1:]}: see `{path} --help`", WRONG_USAGE)
    except CompleteError as error:
        echo(as_typed(str(error)))
    except CarlascError as error:
        shown = copy.copy(error)
        if isinstance(error, ArgumentError):
            shown.where = options.get(error.where, error.where)
        fail(
            as_typed(str(shown)),
            WRONG_USAGE if isinstance(error, ArgumentError) else FAILED,
        )
    except BatchError as error:
        for message in error.messages:
            echo(f"carlasc: {as_typed(message)}", err=True)
        fail(str(error))
    except KeyboardInterrupt:
        fail(_INTERRUPTED, INTERRUPTED)
    except (SystemError, ValueError) as error:
        # caused by Ctrl-C while compiled code returned its result, or while a zip was written,
        # which then cannot be closed
        if not any(isinstance(one, KeyboardInterrupt) for one in _chain(error)):
            raise
        fail(_INTERRUPTED, INTERRUPTED)
    except BrokenPipeError:  # `carlasc info | head`
        sys.stderr.close()
        raise typer.Exit(FAILED) from None
    except OSError as error:  # of a file that the library reads or writes in passing
        fail(f"{error.filename or 'the file system'}: {error.strerror or error}")


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and the chain of its causes."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _typed(parameter: Any) -> str:
    """Return what a user types for a parameter: `--frames`, or `SOURCE`."""
    longest: str = max(parameter.opts, key=len)
    return longest if longest.startswith("-") else (parameter.metavar or longest).upper()
