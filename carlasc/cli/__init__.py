"""The command line: one file per command, which parses, calls one function of the library, and prints its result."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator, MutableMapping
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from carlasc.cli.common import CommandGroup, echo
from carlasc.cli.late_help import load_help
from carlasc.core.first_use import note_compiling

_COMMANDS = (  # in the order of `--help`, which is that in which a new user needs them
    "demo",
    "simulate",
    "regrid",
    "convert",
    "export",
    "pack",
    "unpack",
    "finish",
    "info",
    "stats",
    "validate",
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
    "context_settings": {"help_option_names": ["-h", "--help"]},
}


class _Commands(MutableMapping[str, Any]):
    """The commands by name. The file of a command is imported on first use, so that `carlasc COMMAND` imports only one."""

    def __init__(self) -> None:
        self._loaded: dict[str, Any] = {
            name: None for name in _COMMANDS if importlib.util.find_spec(f"carlasc.cli.{name}")
        }

    def __getitem__(self, name: str) -> Any:
        if self._loaded[name] is None:
            single = typer.Typer(add_completion=False, **_SETTINGS)
            single.command(name, cls=_Command)(_function(name))
            self._loaded[name] = _without_flag_types(typer.main.get_command(single))
        return self._loaded[name]

    def __setitem__(self, name: str, command: Any) -> None:
        self._loaded[name] = command

    def __delitem__(self, name: str) -> None:
        del self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._loaded)

    def __len__(self) -> int:
        return len(self._loaded)


def _function(name: str) -> Callable[..., None]:
    """Return the function of a command."""
    function: Callable[..., None] = getattr(importlib.import_module(f"carlasc.cli.{name}"), name)
    return function


def _without_flag_types(command: Any) -> Any:
    """Remove the type from the help of flags: "--overwrite <bool>" would mean that a value follows."""
    for parameter in command.params:
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""
    return command


class _Command(TyperCommand):
    def format_help(self, ctx: Any, formatter: Any) -> None:
        load_help()
        super().format_help(ctx, formatter)


class _Group(CommandGroup):
    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.commands = _Commands()
        _without_flag_types(self)

    def list_commands(self, ctx: Any) -> list[str]:
        return list(self.commands)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help. It shows the first lines of commands alone, so their options are not made."""
        load_help()
        commands, self.commands = (
            self.commands,
            {name: _Command(name, help=_function(name).__doc__) for name in self.commands},
        )
        super().format_help(ctx, formatter)
        self.commands = commands


app = typer.Typer(
    name="carlasc",
    cls=_Group,
    no_args_is_help=True,
    **_SETTINGS,
    help="Read, convert, regenerate and score CarlaSC data: complete, trace-free semantic scenes.",
)


def _print_version(requested: bool) -> None:
    if requested:
        from carlasc import __version__

        echo(__version__)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
    durable: Annotated[
        bool | None,
        typer.Option(
            "--durable/--no-durable",
            show_default=False,
            help="Sync files to the disk before they get their names, so that a power failure leaves no empty ones; on unless"
            " CARLASC_DURABLE=no.",
        ),
    ] = None,
) -> None:
    if durable is not None:
        from carlasc.storage.durability import set_durable

        set_durable(durable)


def main() -> None:
    """Run the command line: the entry point `carlasc`."""
    if sys.stderr is not None and sys.stderr.isatty():  # as progress: logs and programs that read stderr are not told
        note_compiling(lambda: echo("compiling (once per machine) ...", err=True))
    app()
