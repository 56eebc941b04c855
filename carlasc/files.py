"""Writing files so that a reader never meets half of one."""

from __future__ import annotations

import errno
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from carlasc.errors import CarlascError, FormatError


def write_atomic(path: Path, content: bytes | memoryview | Callable[[BinaryIO], object]) -> None:
    """Write a file beside its place and rename it over: it is there whole or not at all, Ctrl-C and full disks included.

    Args:
        path: where it goes; parent folders are made.
        content: the bytes, or a function that writes them to an open file.

    Raises:
        CarlascError: the disk is full or the folder cannot be written to; nothing is left behind.
    """
    temporary: str | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content)
        os.chmod(temporary, 0o666 & ~_UMASK)
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        advice = {errno.ENOSPC: "free some space and run again", errno.EACCES: "choose a folder that you may write to"}
        raise CarlascError(
            f"{path}: cannot be written: {error.strerror or error}: {advice.get(error.errno or 0, 'check the path')}"
        ) from error
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically, one line, as the published params.json is."""
    write_atomic(path, to_json(value))


def to_json(value: Any) -> bytes:
    """Return `value` as the bytes of a JSON file."""
    return json.dumps(value).encode()


def parse_json(data: bytes, where: str) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        FormatError: `where` (the file) holds something else.
    """
    try:
        value = json.loads(data)
    except (ValueError, UnicodeDecodeError) as error:
        raise FormatError(f"{where}: expected JSON, found something else: {error}") from error
    if not isinstance(value, dict):
        raise FormatError(f"{where}: expected a JSON object, found {type(value).__name__}")
    return value


def _read_umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


_UMASK = _read_umask()  # read once, at import: asking sets it for a moment, which threads would notice
