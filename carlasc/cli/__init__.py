"""The command line: one file a command, each of which parses, calls one function of the library, and prints its result."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Annotated

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
    "render",
    "view",
    "download",
    "capture",
)

app = typer.Typer(
    name="carlasc",
    cls=CommandGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
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


for _name in _COMMANDS:
    if importlib.util.find_spec(f"carlasc.cli.{_name}"):
        app.command(_name)(getattr(importlib.import_module(f"carlasc.cli.{_name}"), _name))


def main() -> None:
    """Run the command line: the entry point `carlasc`."""
    app()
