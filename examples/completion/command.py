"""What the scripts share: a user's mistake is one line on stderr, not a traceback."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import typer

from carlasc.errors import ArgumentError, CarlascError


def run(main: Callable[..., Any]) -> None:
    """Run a script's main function as a command: exit 1 where the work failed, 2 where an argument makes no sense."""
    try:
        typer.run(main)
    except CarlascError as error:
        print(f"{sys.argv[0]}: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, ArgumentError) else 1)
