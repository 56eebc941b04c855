"""The command line: one file a command, each of which parses, calls one function of the library, and prints its result."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator, MutableMapping
from typing import Annotated, Any

import typer

from carlasc.cli.common import CommandGroup

_COMMANDS = (  # in the order of `--help`: the order in which a newcomer needs them
    "demo",
    "simulate",
    "regrid",
    "convert",
    "export",
    "pack",
    "unpack",
    "info",
    "stats",
    "validate",
    "evaluate",
    "scores",
    "render",
    "view",
    "download",
    "capture",
)

_SETTINGS: dict[str, Any] = {
    "pretty_exceptions_enable": False,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}


class _Commands(MutableMapping[str, Any]):
    """The commands by name; a command's file is loaded when it is asked for: reading all of them takes as long as `--help` may."""

    def __init__(self) -> None:
        self._loaded: dict[str, Any] = {
            name: None for name in _COMMANDS if importlib.util.find_spec(f"carlasc.cli.{name}")
        }

    def __getitem__(self, name: str) -> Any:
        if self._loaded[name] is None:
            alone = typer.Typer(add_completion=False, **_SETTINGS)
            alone.command(name)(getattr(importlib.import_module(f"carlasc.cli.{name}"), name))
            self._loaded[name] = _without_flag_types(typer.main.get_command(alone))
        return self._loaded[name]

    def __setitem__(self, name: str, command: Any) -> None:
        self._loaded[name] = command

    def __delitem__(self, name: str) -> None:
        del self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._loaded)

    def __len__(self) -> int:
        return len(self._loaded)


def _without_flag_types(command: Any) -> Any:
    """Take the type out of the help of flags: "--overwrite <bool>" would say that a value follows."""
    for parameter in command.params:
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""
    return command


class _Group(CommandGroup):
    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.commands = _Commands()
        _without_flag_types(self)

    def list_commands(self, ctx: Any) -> list[str]:
        return list(self.commands)


app = typer.Typer(
    name="carlasc",
    cls=_Group,
    no_args_is_help=True,
    **_SETTINGS,
    help="Read, convert, regenerate and train on CarlaSC: complete, trace-free semantic scenes.",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from carlasc import __version__

        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    pass


def main() -> None:
    """Run the command line: the entry point `carlasc`."""
    app()
