"""Atomic and durable writing of files, JSON, and checks of file names.

File systems keep written data in memory for up to half a minute, and may store a file name before
the content. After a power failure, a renamed file can therefore be empty. `os.fsync` waits until a
file, or the names in a folder, are on the disk.
"""

from __future__ import annotations

import csv
import errno
import glob
import io
import json
import os
import re
import shutil
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from carlasc.errors import ArgumentError, ConflictError, FormatError, StorageError, describe

AnyPath = str | os.PathLike[str]
"""A path, as a text or as an object."""
Content = bytes | memoryview | Callable[[BinaryIO], object]


def write_atomic(path: Path, content: Content, *, create: bool = False) -> bool:
    """Write a file under a temporary name in its folder, then rename it.

    It exists whole or not at all, also after Ctrl-C or on a full disk.

    The same holds after a power failure, and the file is on the disk when this function returns,
    unless this is turned off (see `is_durable`).

    Args:
        path: the file; missing parent folders are created.
        content: the bytes, or a function that writes them to an open file.
        create: write only if the file does not exist. If several processes do this at once, exactly
            one succeeds.

    Returns:
        False if `create` is given and the file exists; True otherwise.

    Raises:
        StorageError: the disk is full or the folder cannot be written to; nothing is left behind.
    """
    with _written({path: content}) as temporaries:
        if not create:
            temporaries[path].replace(path)
        else:
            try:
                # unlike a rename, a link fails if another process has written the file
                os.link(temporaries[path], path)
            except FileExistsError:
                if path.is_file():
                    return False
                raise
            # before the folder is synced, otherwise a power failure could restore it
            temporaries[path].unlink()
        sync_all([path.parent])
    return True


def write_many(*groups: Mapping[Path, Content]) -> None:
    """Write several files as `write_atomic` does.

    They are synced together, which is faster than one after the other.

    Args:
        groups: files by path, in order. After a power failure, files of a group exist only if all
            files of the earlier groups do.

    Raises:
        StorageError: a file cannot be written. Files of its group that were not renamed yet, and of
            later groups, do not exist.
    """
    with _written({path: content for group in groups for path, content in group.items()}) as named:
        for group in groups:
            for path in group:
                named[path].replace(path)
            sync_all(path.parent for path in group)


@contextmanager
def _written(files: Mapping[Path, Content]) -> Iterator[Mapping[Path, Path]]:
    """Write and sync files under temporary names, which are removed at the end of the block.

    Yields:
        The temporary names, by path.

    Raises:
        StorageError: a file cannot be written; also for an OSError in the block.
    """
    temporaries = {path: _temporary(path) for path in files}
    path = Path()
    try:
        for path, content in files.items():
            make_folder(path.parent)
            with temporaries[path].open("xb") as file:
                if callable(content):
                    content(file)
                else:
                    file.write(content)
        sync_all(temporaries.values())
        yield temporaries
    except OSError as error:
        named = {str(temporary): path for path, temporary in temporaries.items()}
        raise storage_error(named.get(error.filename, path), error) from error
    finally:
        for temporary in temporaries.values():
            _remove(temporary)


def _temporary(path: Path) -> Path:
    """Return the temporary name of a file.

    It is determined before the file is created, so that it is removed whenever a signal interrupts.
    """
    return path.with_name(f".{path.name}.{_HOST}-{os.getpid()}.{os.urandom(4).hex()}{_PART}")


def _remove(temporary: Path) -> None:
    with suppress(OSError):  # it does not exist after success; its folder may not exist either
        temporary.unlink()


def write_at(descriptor: int, data: bytes | memoryview, offset: int) -> None:
    """Write all bytes at an offset of an open file. Several threads may write to one file."""
    view = memoryview(data)
    with _POSITION:
        os.lseek(descriptor, offset, os.SEEK_SET)
        while view:
            view = view[os.write(descriptor, view) :]


def has_content(path: AnyPath) -> bool:
    """Whether a file exists and is not empty.

    A power failure can leave empty files, if they were not written durably.
    """
    try:
        return os.stat(path).st_size > 0
    except (FileNotFoundError, NotADirectoryError):
        return False


def write_output(path: Path, content: Content) -> None:
    """Write a single output file as `write_atomic` does, and remove the temporary files of killed
    runs.

    To write many files into a folder, call `remove_stale` once instead.
    """
    remove_stale_of(path)
    write_atomic(path, content)


def remove_stale_of(path: Path) -> None:
    """Remove what killed processes left of a file that they wrote."""
    _remove_ended(path.parent.glob(f".{glob.escape(path.name)}.*{_PART}"))


@contextmanager
def temporary_folder(beside: Path) -> Iterator[Path]:
    """Make a folder beside an output file, and remove it at the end.

    Raises:
        StorageError: it cannot be written to; names the output.
    """
    folder = _temporary(beside)
    try:
        beside.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir()
        yield folder
    except OSError as error:
        if error.filename and not Path(error.filename).is_relative_to(beside.parent):
            raise
        raise storage_error(beside, error) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def writing_folder(out: Path) -> Iterator[Path]:
    """Yield a temporary folder, which is renamed at the end of the block, and removed if the block
    fails.

    An existing folder is replaced at the end of the block: check before that it may be.

    Raises:
        StorageError: a file cannot be written; names it as it would be called in `out`. Nothing is
            left behind.
    """
    out = out.resolve()  # "." has no name
    part, old = (out.with_name(f".{out.name}.{ending}") for ending in ("part", "old"))
    try:
        with writing(out):
            remove(part)  # left by a killed run
            make_folder(part)
            yield part
            sync_tree(part)
            if out.exists():
                remove(old)
                out.rename(old)
            part.rename(out)
            sync_all([out.parent])
            remove(old)
    except StorageError as error:
        error.where = error.where.replace(str(part), str(out))
        raise
    finally:
        remove(part)
        if old.exists() and not out.exists():
            old.rename(out)


def check_target(out: Path, endings: tuple[str, ...], overwrite: bool) -> None:
    """Check that a file can be written: its ending, and that its path is free.

    Raises:
        ArgumentError: another ending, or a folder.
        ConflictError: the file exists, and `overwrite` is not given.
    """
    if out.suffix.lower() not in endings:
        raise ArgumentError(
            "out", expected=f"a file name that ends in {' or '.join(endings)}", found=out
        )
    if out.is_dir():
        raise ArgumentError("out", expected="a file name", found=f"the folder {out}")
    if out.exists() and not overwrite:
        raise ConflictError(
            out,
            problem="the file exists",
            advice="choose another name, or replace it with `overwrite=True`",
        )


def remove_stale(folder: Path) -> None:
    """Remove the temporary files of killed processes in a folder and everything below it.

    A temporary file is stale if the process on this machine that wrote it has ended, or if it is a
    day old.
    """
    _remove_ended(folder.rglob(f".*{_PART}"))


def _remove_ended(parts: Iterable[Path]) -> None:
    for part in list(parts):
        match = re.search(
            rf"\.{re.escape(_HOST)}-([0-9]{{1,9}})\.[^.]+{re.escape(_PART)}$", part.name
        )
        try:
            if (
                match and not _is_alive(int(match[1]))
            ) or time.time() - part.stat().st_mtime > 86400:
                (shutil.rmtree if part.is_dir() else Path.unlink)(part)
        except FileNotFoundError:
            continue  # its writer finished meanwhile


def _is_alive(process: int) -> bool:
    if os.name == "nt":  # there, os.kill ends the process
        return True
    try:
        with suppress(PermissionError):
            os.kill(process, 0)  # signal 0 only checks that the process exists
    except ProcessLookupError:
        return False
    return True


@contextmanager
def writing(place: AnyPath) -> Iterator[None]:
    """Turn an OSError into a StorageError of the file that it names, otherwise of `place`."""
    try:
        yield
    except OSError as error:
        raise storage_error(Path(error.filename or place), error) from error


@contextmanager
def naming(path: Path) -> Iterator[Path]:
    """Name a file in an OSError: those of writes name none."""
    try:
        yield path
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def storage_error(path: AnyPath, error: OSError) -> StorageError:
    """Return the StorageError for a file that cannot be written."""
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


def damaged(
    where: AnyPath, expected: str, found: str, advice: str = "the store is damaged"
) -> FormatError:
    """Return the error of a file or a store that is damaged, or whose parts do not fit each
    other.
    """
    return FormatError(where, expected=expected, found=found, advice=advice)


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically, as one line, like the published params.json."""
    write_atomic(path, to_json(value))


def to_json(value: Any) -> bytes:
    """Return `value` as the bytes of a JSON file."""
    return json.dumps(value).encode()


def csv_text(rows: Iterable[Iterable[Any]]) -> str:
    """Return rows as the text of a CSV file."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue()


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
        FormatError: `where` (the file) is not JSON, is nested too deeply, or has text that is not
            valid Unicode.
    """
    try:
        value = json.loads(data)
        if _HALF.search(data if isinstance(data, bytes) else data.encode()):
            # ValueError: a lone surrogate, which could not be written again
            json.dumps(value, ensure_ascii=False).encode()
        return value
    except (
        ValueError,
        RecursionError,
        TypeError,
    ) as error:  # ValueError: also a number of more than 4,300 digits
        raise FormatError(
            where, expected="JSON", found="something else", advice=describe(error)
        ) from error


def leads_outside(name: str) -> bool:
    """Whether a relative path with "/" may lead out of its folder, on any operating system.

    Names come from untrusted archives and stores. Unsafe are absolute names, and names with a drive
    ("C:"), a part "..", a backslash, a zero byte or a lone surrogate.
    """
    return (
        name.startswith("/")
        or ".." in name.split("/")
        or bool(_DRIVE.match(name) or _NEVER.search(name))
    )


_DRIVE = re.compile(r"[A-Za-z]:")
_NEVER = re.compile("[\\\\\0\ud800-\udfff]")
_HALF = re.compile(rb"\\u[dD][89a-fA-F]")
_PART = ".part"
_FREE_SPACE = "free some space and run again"
_HOST = re.sub(r"[^A-Za-z0-9]", "_", socket.gethostname())

DURABLE = "CARLASC_DURABLE"
"""The environment variable that turns it off.

Worker processes have the environment of the process that starts them.
"""

_POSITION = threading.Lock()  # of open files: Windows cannot write at an offset in one call
_VALUES = {"yes": True, "1": True, "true": True, "no": False, "0": False, "false": False}
_SIDE_BY_SIDE = 16  # files that are synced at the same time
# errors of file systems that cannot sync a folder
_UNSUPPORTED = {
    errno.EINVAL,
    errno.ENOTSUP,
    errno.ENOSYS,
}


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
    """Set whether this process, and the worker processes that it starts from now on, sync files."""
    os.environ[DURABLE] = "yes" if durable else "no"


def sync_file(descriptor: int) -> None:
    """Wait until the bytes of an open file are on the disk. Nothing is done unless `is_durable`."""
    if is_durable():
        _sync(descriptor)


def sync_all(paths: Iterable[Path]) -> None:
    """Wait until files, and the names in folders, are on the disk, each once.

    Nothing is done unless `is_durable`.

    They are synced in parallel: the file system then writes its journal once for several files,
    which takes a quarter of the time.

    Raises:
        OSError: the disk is full or fails; names the path.
    """
    places = list(dict.fromkeys(paths))
    if not is_durable():
        return
    if len(places) < 2:
        for path in places:
            _sync_path(path)
        return
    with ThreadPoolExecutor(min(len(places), _SIDE_BY_SIDE), thread_name_prefix="sync") as pool:
        list(pool.map(_sync_path, places))


def sync_tree(path: Path) -> None:
    """Wait until a file, or a folder with everything below it, is on the disk.

    Nothing is done unless `is_durable`.
    """
    sync_all([path, *path.rglob("*")] if path.is_dir() else [path])


def rename(old: Path, new: Path) -> None:
    """Rename a synced file or folder, and wait until the new name is on the disk.

    An existing file is replaced.
    """
    old.replace(new)
    sync_all([new.parent])


def remove_file(path: Path) -> None:
    """Remove a file, if it exists, and wait until the removal is on the disk.

    For files that the next run reads.
    """
    try:
        path.unlink()
    except FileNotFoundError:
        return
    sync_all([path.parent])


def remove(path: Path) -> None:
    """Remove a file or a folder, if it exists, and wait until the removal is on the disk."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
        sync_all([path.parent])
    else:
        remove_file(path)


def make_folder(folder: Path) -> None:
    """Create a folder and its parents, unless they exist, and wait until the new names are on the
    disk.
    """
    if folder.is_dir():
        return
    new = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    sync_all(place.parent for place in new)


def _sync_path(path: Path) -> None:
    windows = os.name == "nt"  # syncs files that are open for writing, and no folders
    if windows and path.is_dir():
        return
    with naming(path):
        descriptor = os.open(path, os.O_RDWR if windows else os.O_RDONLY)
        try:
            _sync(descriptor)
        except OSError as error:  # such as some network shares
            if not (error.errno in _UNSUPPORTED and path.is_dir()):
                raise
        finally:
            os.close(descriptor)


if sys.platform == "darwin":
    import fcntl

    def _sync(descriptor: int) -> None:
        try:
            # fsync alone leaves the bytes in the drive's own memory
            fcntl.fcntl(descriptor, fcntl.F_FULLFSYNC)
        except OSError:  # not supported by the file system, such as a network share
            os.fsync(descriptor)

else:

    def _sync(descriptor: int) -> None:
        os.fsync(descriptor)


def unfinished(path: Path) -> Path:
    """Return the path of an unfinished store or folder: `<name>.part` beside it."""
    return path.with_name(f"{path.name}.part")


def replaced(path: Path) -> Path:
    """Return the path of an older store until the new one is complete: `<name>.replaced`, a name
    that users are unlikely to choose.
    """
    return path.with_name(f"{path.name}.replaced")
