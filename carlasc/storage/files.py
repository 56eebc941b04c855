"""Writing files so that a reader never sees one that is half written; what survives a power failure; JSON; names that lead out of a folder.

File systems keep what was written in memory for up to half a minute, and may store a name before the bytes that belong to it. After a power failure, a
file that was renamed into place can therefore be empty. `os.fsync` waits until a file, or the names in a folder, are on the disk.
"""

from __future__ import annotations

import errno
import glob
import json
import os
import re
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from carlasc.errors import ArgumentError, FormatError, StorageError, describe

Content = bytes | memoryview | Callable[[BinaryIO], object]


def write_atomic(path: Path, content: Content, *, create: bool = False) -> bool:
    """Write a file under a temporary name in its folder, then rename it: it exists whole or not at all, also after Ctrl-C or on a full disk.

    It exists whole or not at all after a power failure too, and is on the disk when this returns, unless that is turned off
    (see `is_durable`).

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


def write_at(descriptor: int, data: bytes | memoryview, offset: int) -> None:
    """Write all bytes at a place of an open file."""
    view = memoryview(data)
    while view:
        written = os.pwrite(descriptor, view, offset)
        view, offset = view[written:], offset + written


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

DURABLE = "CARLASC_DURABLE"
"""The environment variable that turns it off. Worker processes have the environment of the process that starts them."""

_VALUES = {"yes": True, "1": True, "true": True, "no": False, "0": False, "false": False}
_SIDE_BY_SIDE = 16  # files that are synced at the same time
_UNSUPPORTED = {errno.EINVAL, errno.ENOTSUP, errno.ENOSYS}  # what file systems answer that cannot sync a folder


def is_durable() -> bool:
    """Whether files are synced before they get their names: yes, unless `CARLASC_DURABLE` is "no".

    Raises:
        ArgumentError: the variable has another value than yes or no.
    """
    text = os.environ.get(DURABLE, "yes").strip().lower()
    if text not in _VALUES:
        raise ArgumentError(DURABLE, expected="yes or no", found=repr(text))
    return _VALUES[text]


def set_durable(durable: bool) -> None:
    """Set the policy of this process and of the worker processes that it starts from now on."""
    os.environ[DURABLE] = "yes" if durable else "no"


def sync_file(descriptor: int) -> None:
    """Wait until the bytes of an open file are on the disk. Nothing is done unless `is_durable`."""
    if is_durable():
        _sync(descriptor)


def sync_all(paths: Iterable[Path]) -> None:
    """Wait until files, and the names in folders, are on the disk, each once. Nothing is done unless `is_durable`.

    They are synced side by side: the file system then writes its journal once for several of them, which takes a quarter of the time.

    Raises:
        OSError: the disk is full or fails; names the path.
    """
    found = list(dict.fromkeys(paths))
    if not is_durable():
        return
    if len(found) < 2:
        for path in found:
            _sync_path(path)
        return
    with ThreadPoolExecutor(min(len(found), _SIDE_BY_SIDE), thread_name_prefix="sync") as pool:
        list(pool.map(_sync_path, found))


def sync_tree(path: Path) -> None:
    """Wait until a file, or a folder with everything below it, is on the disk. Nothing is done unless `is_durable`."""
    sync_all([path, *path.rglob("*")] if path.is_dir() else [path])


def rename(old: Path, new: Path) -> None:
    """Rename a file or a folder whose content is on the disk, and wait until its new name is; an existing file is replaced."""
    old.replace(new)
    sync_all([new.parent])


def remove_file(path: Path) -> None:
    """Remove a file, if it exists, and wait until its name is gone from the disk, where the file would mean something to the next run."""
    try:
        path.unlink()
    except FileNotFoundError:
        return
    sync_all([path.parent])


def make_folder(folder: Path) -> None:
    """Create a folder, and those above it, unless they exist, and wait until the names of the new ones are on the disk."""
    if folder.is_dir():
        return
    new = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    sync_all(place.parent for place in new)


def _sync_path(path: Path) -> None:
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            _sync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno in _UNSUPPORTED and path.is_dir():
            return  # such as some network shares, which store names in their own way
        raise OSError(error.errno, error.strerror, str(path)) from error


if sys.platform == "darwin":
    import fcntl

    def _sync(descriptor: int) -> None:
        try:
            fcntl.fcntl(descriptor, fcntl.F_FULLFSYNC)  # fsync alone leaves the bytes in the drive's own memory
        except OSError:  # a file system that has no such call, such as a network share
            os.fsync(descriptor)

else:

    def _sync(descriptor: int) -> None:
        os.fsync(descriptor)


def unfinished(path: Path) -> Path:
    """Return where a store or a folder is written until it is whole: `<name>.part` beside it."""
    return path.with_name(f"{path.name}.part")


def replaced(path: Path) -> Path:
    """Return where an older store waits until the new one is whole: `<name>.replaced`, which users hardly call a copy of their own."""
    return path.with_name(f"{path.name}.replaced")
