"""How long a study takes, said on standard error while it runs, so that the table on standard output can be copied as it is."""

from __future__ import annotations

import sys
import time


class Clock:
    """Counts the seconds since it was made."""

    def __init__(self) -> None:
        self.start = self.last = time.perf_counter()

    def __call__(self, what: str) -> None:
        """Say what is done, how long it took, and how long everything has taken."""
        now = time.perf_counter()
        print(f"{what}: {now - self.last:.0f} s, {now - self.start:.0f} s in all", file=sys.stderr, flush=True)
        self.last = now
