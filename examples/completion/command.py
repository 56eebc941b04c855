"""The frame of the scripts: errors in one line, and progress bars."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer
from rich.console import Console
from rich.progress import Progress

from carlasc.errors import ArgumentError, CarlascError


def run(main: Callable[..., Any]) -> None:
    """Run a script's main function as a command. It exits with 1 if the work failed, and with 2 if an argument is wrong."""
    try:
        typer.run(main)
    except CarlascError as error:
        print(f"{sys.argv[0]}: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, ArgumentError) else 1)


@contextmanager
def progress_bar(description: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar on stderr if it is a terminal. Yields a callback of (done, total)."""
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(description, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)
