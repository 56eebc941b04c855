"""Where output may be written."""

from __future__ import annotations

from pathlib import Path

from carlasc.errors import ConflictError


def check_outside(out: Path, source: str) -> None:
    """Check that a folder to write to is not the source, and not inside it. A URL is never the same place.

    Raises:
        ConflictError: it is.
    """
    target, origin = out.resolve(), Path(source).resolve()
    if target.is_relative_to(origin):
        raise ConflictError(
            out,
            expected=f"a place outside {source}",
            found="one inside it",
            advice="choose another place, because the source is never written to",
        )
