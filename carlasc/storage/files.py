"""Writing files so that a reader never sees one that is half written; JSON; names that lead out of a folder."""

from __future__ import annotations

import errno
import glob
import json
import os
import re
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from carlasc.errors import FormatError, StorageError, describe
from carlasc.storage.durability import make_folder, sync_all

Content = bytes | memoryview | Callable[[BinaryIO], object]


def write_atomic(path: Path, content: Content, *, create: bool = False) -> bool:
    """Write a file under a temporary name in its folder, then rename it: it exists whole or not at all, also after Ctrl-C or on a full disk.

    It exists whole or not at all after a power failure too, and is on the disk when this returns, unless that is turned off
    (see `carlasc.storage.durability`).

    Args:
        path: the file; missing parent folders are created.
        content: the bytes, or a function that writes them to an open file.
        create: write only a file that does not exist. Of several processes that do so at once, exactly one succeeds.

    Returns:
        False if `create` is given and the file exists; True otherwise.

    Raises:
        StorageError: the disk is full or the folder cannot be written to; nothing is left behind.
    """
    temporary = _temporary(path)
    try:
        _write(temporary, content)
        sync_all([temporary])
        if create:
            os.link(temporary, path)  # a rename would replace a file that another process has just written
            temporary.unlink()  # before the folder is synced, or a power failure could bring it back
        else:
            temporary.replace(path)
        sync_all([path.parent])
    except FileExistsError as error:
        if create and path.is_file():
            return False
        raise storage_error(path, error) from error
    except OSError as error:
        raise storage_error(path, error) from error
    finally:
        _remove(temporary)
    return True


def write_many(*groups: Mapping[Path, Content]) -> None:
    """Write several files as `write_atomic` does, which takes less time than one after the other: they are synced together.

    Args:
        groups: the files, in the order in which they get their names. After a power failure, no file of a group exists unless all those of the
            groups before it do.

    Raises:
        StorageError: one cannot be written. No file of its group that has not got its name yet exists, nor any of the groups after it.
    """
    temporaries = {path: _temporary(path) for group in groups for path in group}
    path = Path()
    try:
        for path, content in (file for group in groups for file in group.items()):
            _write(temporaries[path], content)
        sync_all(temporaries.values())
        for group in groups:
            for path in group:
                temporaries[path].replace(path)
            sync_all(path.parent for path in group)
    except OSError as error:
        named = {str(temporary): path for path, temporary in temporaries.items()}
        raise storage_error(named.get(error.filename, path), error) from error
    finally:
        for temporary in temporaries.values():
            _remove(temporary)


def _temporary(path: Path) -> Path:
    """Return the temporary name of a file: it is known before the file exists, so that the file is removed whenever a signal ends the writing."""
    return path.with_name(f".{path.name}.{_HOST}-{os.getpid()}.{os.urandom(4).hex()}{_PART}")


def _write(temporary: Path, content: Content) -> None:
    make_folder(temporary.parent)
    with temporary.open("xb") as file:
        if callable(content):
            content(file)
        else:
            file.write(content)


def _remove(temporary: Path) -> None:
    with suppress(OSError):  # it does not exist after success, nor does its folder where a file is in the way
        temporary.unlink()


def has_content(path: str | os.PathLike[str]) -> bool:
    """Whether a file exists and is not empty: a power failure can leave an empty file in the place of one that was not written durably."""
    try:
        return os.stat(path).st_size > 0
    except (FileNotFoundError, NotADirectoryError):
        return False


def write_output(path: Path, content: Content) -> None:
    """Write a single file that a user named, as `write_atomic` does, and remove what killed runs left of it.

    Those who write many files into a folder call `remove_stale` once instead.
    """
    _remove_ended(path.parent.glob(f".{glob.escape(path.name)}.*{_PART}"))
    write_atomic(path, content)


def remove_stale(folder: Path, *, deep: bool = False) -> None:
    """Remove the temporary files that killed writers left in a folder and in the folders in it; with `deep`, also in the folders in these.

    A temporary file is stale if the process on this machine that wrote it has ended, or if it is a day old.
    """
    found = folder.rglob(f".*{_PART}") if deep else (*folder.glob(f".*{_PART}"), *folder.glob(f"*/.*{_PART}"))
    _remove_ended(found)


def _remove_ended(parts: Iterable[Path]) -> None:
    for part in list(parts):
        match = re.search(rf"\.{re.escape(_HOST)}-([0-9]{{1,9}})\.[^.]+{re.escape(_PART)}$", part.name)
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


@contextmanager
def writing(place: str | os.PathLike[str]) -> Iterator[None]:
    """Report what the operating system refuses as a StorageError of the file that it names, else of `place`."""
    try:
        yield
    except OSError as error:
        raise storage_error(Path(error.filename or place), error) from error


def storage_error(path: Path, error: OSError) -> StorageError:
    """Return the error of a file that cannot be written."""
    advice = {
        errno.ENOSPC: _FREE_SPACE,
        errno.EDQUOT: _FREE_SPACE,
        errno.EACCES: "choose a folder that you may write to",
    }
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
    value = parse_json_value(data, where)
    if not isinstance(value, dict):
        raise FormatError(where, expected="a JSON object", found=type(value).__name__)
    return value


def parse_json_value(data: bytes | str, where: str) -> Any:
    """Read any JSON value.

    Raises:
        FormatError: `where` (the file) holds something else, is nested too deeply, or has text that no file can hold.
    """
    try:
        value = json.loads(data)
        if _HALF.search(data if isinstance(data, bytes) else data.encode()):
            json.dumps(
                value, ensure_ascii=False
            ).encode()  # ValueError: half of a character, which could not be written again
        return value
    except (ValueError, RecursionError, TypeError) as error:  # ValueError: also a number of more than 4,300 digits
        raise FormatError(where, expected="JSON", found="something else", advice=describe(error)) from error


def leads_outside(name: str) -> bool:
    """Whether a name with parts joined by "/" may lead out of the folder that it is relative to, on any system.

    Names come from archives and stores, which anybody may have made. Such are absolute names, names with a drive ("C:"), with a part "..", with a
    backslash, and with a zero byte or half a character, which no file can have.
    """
    return name.startswith("/") or ".." in name.split("/") or bool(_DRIVE.match(name) or _NEVER.search(name))


_DRIVE = re.compile(r"[A-Za-z]:")
_NEVER = re.compile("[\\\\\0\ud800-\udfff]")
_HALF = re.compile(rb"\\u[dD][89a-fA-F]")
_PART = ".part"
_FREE_SPACE = "free some space and run again"
_HOST = re.sub(r"[^A-Za-z0-9]", "_", socket.gethostname())
