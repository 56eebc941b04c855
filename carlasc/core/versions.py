"""The version of this package, for rooms that write it down; the top package says it to users as `carlasc.__version__`."""

from __future__ import annotations

from importlib import metadata


def carlasc_version() -> str:
    """Return the version of the installed package; "unknown" if it is only found on the path."""
    try:
        return metadata.version("carlasc")
    except metadata.PackageNotFoundError:
        return "unknown"
