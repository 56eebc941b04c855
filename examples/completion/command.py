"""The common part of the scripts: errors in one line, a message after Ctrl-C, and progress: a bar
on a terminal, otherwise lines.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

import typer
from rich.console import Console
from rich.progress import Progress

from carlasc.errors import ArgumentError, CarlascError

EVERY_S = 10.0  # seconds between two lines of progress without a terminal


def run(main: Callable[..., Any], continued: str = "the same command continues") -> None:
    """Run a script's main function as a command.

    It exits with 1 if the work failed, with 2 if an argument is wrong, and with 130 after Ctrl-C.

    Args:
        main: the function, whose parameters are options.
        continued: how to continue an interrupted run.
    """

    @wraps(main)
    def command(**given: Any) -> None:
        try:
            main(**given)
        except KeyboardInterrupt:  # typer would say "Aborted." and exit with 1
            print(f"\n{sys.argv[0]}: interrupted: {continued}", file=sys.stderr)
            sys.exit(130)

    try:
        typer.run(command)
    except CarlascError as error:
        print(f"{sys.argv[0]}: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, ArgumentError) else 1)


@contextmanager
def progress_bar(description: str) -> Iterator[Callable[[int, int], None]]:
    """Show progress on stderr: a bar on a terminal, otherwise a line every ten seconds.

    Yields a callback of (done, total).
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        line = Line()
        yield lambda done, total: line.show(f"{description} {done}/{total}")
        return
    with Progress(console=console) as progress:
        task = progress.add_task(description, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


class Line:
    """A line on stderr that changes: it is overwritten on a terminal, and otherwise printed again
    every ten seconds.
    """

    def __init__(self) -> None:
        self._last_s = time.monotonic()

    def show(self, text: str) -> None:
        """Show a text in place of the last one."""
        if sys.stderr.isatty():
            print(f"\r{text}", end="", file=sys.stderr, flush=True)
        elif time.monotonic() - self._last_s >= EVERY_S:
            self._last_s = time.monotonic()
            print(text, file=sys.stderr, flush=True)
