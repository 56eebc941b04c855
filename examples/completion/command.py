"""What the scripts share: a user's mistake is one line on stderr, not a traceback."""

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
    """Run a script's main function as a command: exit 1 where the work failed, 2 where an argument makes no sense."""
    try:
        typer.run(main)
    except CarlascError as error:
        print(f"{sys.argv[0]}: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, ArgumentError) else 1)


@contextmanager
def progress_bar(description: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar on stderr, quiet where there is no terminal; yields a callback of (done, total)."""
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(description, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


def parse_frames(text: str | None) -> tuple[int | None, int | None] | None:
    """Read a half-open range of frames, "A:B", "A:" or ":B".

    Raises:
        ArgumentError: it is none.
    """
    if text is None:
        return None
    first, colon, stop = text.partition(":")
    try:
        if colon:
            return int(first) if first else None, int(stop) if stop else None
    except ValueError:
        pass
    raise ArgumentError("--frames", expected="A:B, A: or :B", found=f"{text!r}")
