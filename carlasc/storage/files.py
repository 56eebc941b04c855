"""Writing files so that a reader never meets half of one."""

from __future__ import annotations

import errno
import json
import os
import re
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from carlasc.errors import FormatError, StorageError


def write_atomic(path: Path, content: bytes | memoryview | Callable[[BinaryIO], object]) -> None:
    """Write a file beside its place and rename it over: it is there whole or not at all, Ctrl-C and full disks included.

    Args:
        path: where it goes; parent folders are made.
        content: the bytes, or a function that writes them to an open file.

    Raises:
        StorageError: the disk is full or the folder cannot be written to; nothing is left behind.
    """
    # Named before it is made: whenever a signal ends this, there is a name to remove.
    temporary = path.with_name(f".{path.name}.{_HOST}-{os.getpid()}.{os.urandom(4).hex()}{_PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("xb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content)
        temporary.replace(path)
    except OSError as error:
        raise _storage_error(path, error) from error
    finally:
        with suppress(OSError):  # gone where all went well; no folder where there is a file in its way
            temporary.unlink()


def append_line(path: Path, line: str) -> None:
    """Add a line to a text file; it is made where it is not there, with its folders.

    Raises:
        StorageError: the disk is full or the folder cannot be written to.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write(f"{line}\n")
    except OSError as error:
        raise _storage_error(path, error) from error


def remove_stale(folder: Path) -> None:
    """Remove what writers that were killed left half-written in a folder and the folders in it.

    A temporary file is stale when the process that wrote it, on this machine, is gone, or when it is a day old.
    """
    for part in (*folder.glob(f".*{_PART}"), *folder.glob(f"*/.*{_PART}")):
        match = re.search(rf"\.{re.escape(_HOST)}-([0-9]+)\.[^.]+{re.escape(_PART)}$", part.name)
        try:
            if (match and not _is_alive(int(match[1]))) or time.time() - part.stat().st_mtime > 86400:
                part.unlink()
        except FileNotFoundError:
            continue  # its writer finished meanwhile


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)  # signal 0 only asks
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _storage_error(path: Path, error: OSError) -> StorageError:
    advice = {errno.ENOSPC: "free some space and run again", errno.EACCES: "choose a folder that you may write to"}
    return StorageError(
        f"{path}: cannot be written: {error.strerror or error}: {advice.get(error.errno or 0, 'check the path')}"
    )


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
        raise FormatError(where, expected="JSON", found="something else", advice=f"{error}") from error
    if not isinstance(value, dict):
        raise FormatError(where, expected="a JSON object", found=f"{type(value).__name__}")
    return value


_PART = ".part"
_HOST = re.sub(r"[^A-Za-z0-9]", "_", socket.gethostname())
