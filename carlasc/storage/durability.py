"""Whether what is written survives a power failure: files reach the disk before they get their names.

File systems keep what was written in memory for up to half a minute, and may store a name before the bytes that belong to it. After a power failure, a
file that was renamed into place can therefore be empty. `os.fsync` waits until a file, or the names in a folder, are on the disk.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from carlasc.errors import ArgumentError

VARIABLE = "CARLASC_DURABLE"
"""The environment variable that turns it off. Worker processes have the environment of the process that starts them."""

_VALUES = {"yes": True, "1": True, "true": True, "no": False, "0": False, "false": False}
_SIDE_BY_SIDE = 16  # files that are synced at the same time
_UNSUPPORTED = {errno.EINVAL, errno.ENOTSUP, errno.ENOSYS}  # what file systems answer that cannot sync a folder


def is_durable() -> bool:
    """Whether files are synced before they get their names: yes, unless `CARLASC_DURABLE` is "no".

    Raises:
        ArgumentError: the variable has another value than yes or no.
    """
    text = os.environ.get(VARIABLE, "yes").strip().lower()
    if text not in _VALUES:
        raise ArgumentError(VARIABLE, expected="yes or no", found=repr(text))
    return _VALUES[text]


def set_durable(durable: bool) -> None:
    """Set the policy of this process and of the worker processes that it starts from now on."""
    os.environ[VARIABLE] = "yes" if durable else "no"


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
