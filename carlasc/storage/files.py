"""Writing files so that a reader never sees one that is half written."""

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


def write_atomic(
    path: Path, content: bytes | memoryview | Callable[[BinaryIO], object], *, create: bool = False
) -> bool:
    """Write a file under a temporary name in its folder, then rename it: it exists whole or not at all, also after Ctrl-C or on a full disk.

    Args:
        path: the file; missing parent folders are created.
        content: the bytes, or a function that writes them to an open file.
        create: write only a file that does not exist. Of several processes that do so at once, exactly one succeeds.

    Returns:
        False if `create` is given and the file exists; True otherwise.

    Raises:
        StorageError: the disk is full or the folder cannot be written to; nothing is left behind.
    """
    # The name is fixed before the file exists: whenever a signal ends this, the name to remove is known.
    temporary = path.with_name(f".{path.name}.{_HOST}-{os.getpid()}.{os.urandom(4).hex()}{_PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("xb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content)
        if create:
            os.link(temporary, path)  # a rename would replace a file that another process has just written
        else:
            temporary.replace(path)
    except FileExistsError as error:
        if create and path.is_file():
            return False
        raise _storage_error(path, error) from error
    except OSError as error:
        raise _storage_error(path, error) from error
    finally:
        with suppress(OSError):  # it does not exist after success, nor does its folder where a file is in the way
            temporary.unlink()
    return True


def remove_stale(folder: Path, *, deep: bool = False) -> None:
    """Remove the temporary files that killed writers left in a folder and in the folders in it; with `deep`, also in the folders in these.

    A temporary file is stale if the process on this machine that wrote it has ended, or if it is a day old.
    """
    found = folder.rglob(f".*{_PART}") if deep else (*folder.glob(f".*{_PART}"), *folder.glob(f"*/.*{_PART}"))
    for part in list(found):
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
        path,
        problem=f"cannot be written: {error.strerror or error}",
        advice=advice.get(error.errno or 0, "check the path"),
    )


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically, as one line, like the published params.json."""
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
        raise FormatError(where, expected="JSON", found="something else", advice=str(error)) from error
    if not isinstance(value, dict):
        raise FormatError(where, expected="a JSON object", found=type(value).__name__)
    return value


_PART = ".part"
_HOST = re.sub(r"[^A-Za-z0-9]", "_", socket.gethostname())
