"""What every function here takes: a path, or a Source."""

from __future__ import annotations

import os

from carlasc.sources.base import Source


def open_source(source: str | os.PathLike[str] | Source) -> Source:
    """Return the Source itself, or what `carlasc.open` makes of a path."""
    if isinstance(source, Source):
        return source
    from carlasc import sources

    return sources.open(source)
