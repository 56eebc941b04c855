"""The command line: one file per command, which parses, calls one function of the library, and
prints its result.
"""

from __future__ import annotations

import atexit
import importlib
import os
import signal
import sys
from collections import UserDict
from collections.abc import Sequence
from contextlib import suppress
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from carlasc.cli.commands import Command, CommandGroup
from carlasc.cli.common import INTERRUPTED, echo
from carlasc.cli.flags import declared_by, flatten
from carlasc.core.first_use import note_compiling, say_compiling

if TYPE_CHECKING:
    from carlasc.converting import OptionDeclaration

_COMMANDS = (  # in the order of `--help`: what a new user needs first
    "demo",
    "simulate",
    "regrid",
    "convert",
    "label",
    "refine",
    "map",
    "export",
    "pack",
    "unpack",
    "finish",
    "info",
    "stats",
    "validate",
    "audit",
    "report",
    "card",
    "evaluate",
    "scores",
    "render",
    "view",
    "download",
    "capture",
    "doctor",
)

_SETTINGS: dict[str, Any] = {
    "pretty_exceptions_enable": False,
    "rich_markup_mode": None,  # help is plain text, which takes half the time
    "context_settings": {"help_option_names": ["-h", "--help"], "max_content_width": 120},
}


class _Commands(UserDict[str, Any]):
    """The commands by name.

    The file of a command is imported on first use, so that `carlasc COMMAND` imports only one.
    """

    def __getitem__(self, name: str) -> Any:
        if self.data[name] is None:
            self.data[name] = make_command(name)
        return self.data[name]


def make_command(name: str, declared: Sequence[OptionDeclaration] = ()) -> Any:
    """Return a command.

    Args:
        name: its name.
        declared: the options that a converter or an exporter declares.
    """
    module = _module(name)
    single = typer.Typer(add_completion=False, **_SETTINGS)
    cls = _DeclaringCommand if hasattr(module, "DECLARED_BY") and not declared else Command
    function = flatten(getattr(module, name), declared)
    single.command(name, cls=cls)(function)
    made: Any = typer.main.get_command(single)
    kinds = {name: get_args(hint)[0] for name, hint in function.__annotations__.items()}
    made.texts = [name for name, kind in kinds.items() if kind in (str, str | None)]
    return made


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"carlasc.cli.{name}")


class _DeclaringCommand(Command):
    """A command with its own options and those of the converter or exporter that its arguments
    name.
    """

    def make_context(
        self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any
    ) -> Any:
        """Read the arguments, including the options of the converter or exporter."""
        name = self.name or ""
        declared = declared_by(_module(name).DECLARED_BY, args)
        if not declared:
            return super().make_context(info_name, args, parent, **extra)
        return make_command(name, declared).make_context(info_name, args, parent, **extra)


class _Group(CommandGroup):
    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.commands = _Commands(dict.fromkeys(_COMMANDS))

    def list_commands(self, ctx: Any) -> list[str]:
        return list(self.commands)

    def summary(self, name: str) -> str:
        """Return what a command does, without making its options."""
        text: str = getattr(_module(name), name).__doc__
        return " ".join(text.partition("\n\n")[0].split())


app = typer.Typer(
    name="carlasc",
    cls=_Group,
    **_SETTINGS,
    help="A toolkit for semantic scene completion: read CarlaSC, convert other data sets to its "
    "layout, make ground truth at any voxel size, and score predictions.",
)


def _print_version(requested: bool) -> None:
    if requested:
        from carlasc import __version__

        echo(__version__)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
    durable: Annotated[
        bool | None,
        typer.Option(
            "--durable/--no-durable",
            show_default=False,
            help="Sync each file to the disk before it is renamed to its final name, so that a "
            "power failure leaves no empty file. Default: on, unless the environment variable "
            "CARLASC_DURABLE is no.",
        ),
    ] = None,
) -> None:
    if durable is not None:
        from carlasc.storage.files import set_durable

        set_durable(durable)


def main() -> None:
    """Run the command line: the entry point `carlasc`."""
    # the last thing that Python does before it takes its modules apart, without handlers of signals
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
    if sys.stderr is not None and sys.stderr.isatty():  # on terminals only, like progress bars
        note_compiling(say_compiling)
    try:
        app()
    except KeyboardInterrupt:  # after the command caught its own
        sys.exit(INTERRUPTED)
    finally:
        # the result is printed: Ctrl-C ends what Python does before it exits
        with suppress(OSError, ValueError):
            sys.stdout.flush()
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(INTERRUPTED))
