"""A local cache for the files of remote stores. Each file is fetched once for all processes.

The name of a cached file contains its URL and its version: its size, and its ETag or modification
time on the server. The modification time of a cached file is the time of the last comparison with
the remote file, its access time that of its last use. This module sets both.
"""

from __future__ import annotations

import hashlib
import os
import stat
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock, Timeout

from carlasc.errors import ArgumentError, MissingDataError, StorageError, check_types
from carlasc.storage.files import AnyPath, sync_file, write_at
from carlasc.storage.transport.remote_tree import RemoteTree
from carlasc.storage.transport.trees import LocalTree, Tree

_PIECE = 4 << 20  # bytes of a range that is requested
_AT_ONCE = 4  # ranges of a file that are requested in parallel; all of them are in memory
_LARGEST_SHARE = 4  # files above 1/4 of the cache size are read without the cache
_PART = ".part"
_LOCKS = ".locks"  # the folder of locks
_FULL_S = 60.0  # pause of fetching after the disk was full

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Cache:
    """A cache folder for files of remote stores. Several stores and processes may share it.

    When the folder would become larger than `max_bytes`, the least recently used files are removed.
    An incomplete file of a killed process is never read. Locks are those of the operating system,
    so the folder should be on a local disk.

    Attributes:
        folder: the folder; it is created when a store is opened.
        max_bytes: maximum total size of its files, bytes.

    Raises:
        ArgumentError: `max_bytes` is not positive.
    """

    folder: AnyPath
    max_bytes: int = 64 << 30

    def __post_init__(self) -> None:
        check_types(Cache, vars(self))
        if self.max_bytes <= 0:
            raise ArgumentError(
                "max_bytes", expected="a number of bytes above 0", found=self.max_bytes
            )

    def create(self) -> None:
        """Create the folder.

        Raises:
            StorageError: it cannot be created or written to.
        """
        try:
            (Path(self.folder) / _LOCKS).mkdir(parents=True, exist_ok=True)
            with suppress(Timeout), self._lock("").acquire(blocking=False):
                pass
        except OSError as error:
            raise StorageError(
                self.folder,
                problem=f"cannot be used as a cache: {error.strerror or error}",
                advice="choose another folder",
            ) from error

    def path(self, name: str) -> Path:
        """Return the path of a cached file."""
        return Path(self.folder) / name[:2] / name

    def _lock(self, name: str) -> FileLock:
        """Return the lock of a cached file; for "", that under which files are counted.

        The operating system releases a lock when its process ends for any reason.
        """
        return FileLock(Path(self.folder) / _LOCKS / f"{name}.lock")

    def find(self, key: str, since: float) -> str | None:
        """Return the name of the cached file with a key, if it was compared with the remote file
        after `since`; otherwise None.
        """
        for path in self.path(key).parent.glob(f"{key}-*[0-9]"):  # not those of which a part exists
            with suppress(FileNotFoundError):  # removed meanwhile
                if _is_whole(path) and path.stat().st_mtime >= since:
                    return path.name
        return None

    def add(self, name: str, fill: Callable[[int], None], *, wait: bool = True) -> bool:
        """Add a file unless it exists. One process writes it, other processes wait.

        Args:
            name: name of the file, which ends in its size.
            fill: writes the content to a file descriptor.
            wait: wait for another process that is writing the file.

        Returns:
            Whether the file exists. It does not if another process is writing it and `wait` is
            False, or if files that are being written leave no room for it.

        Raises:
            OSError: the disk is full.
        """
        path = self.path(name)
        part = path.with_name(f"{name}{_PART}")
        path.parent.mkdir(parents=True, exist_ok=True)
        if _is_whole(path):
            return True
        with suppress(Timeout), self._lock(name).acquire(blocking=wait):
            if _is_whole(path):  # another process has written it meanwhile
                return True
            try:
                with part.open("wb", buffering=0) as file:  # discards the bytes of a killed process
                    if not self._make_room(file.fileno(), _size_of(name)):
                        return False
                    fill(file.fileno())
                    # its full size is already set: after a power failure it could hold zeros
                    sync_file(file.fileno())
                part.replace(path)
            finally:
                part.unlink(missing_ok=True)
            return True
        return False

    def touch(self, name: str, *, compared: bool = False) -> None:
        """Record that a file is used, and whether it was `compared` with the remote file.

        Raises:
            FileNotFoundError: it was removed to make room.
        """
        path = self.path(name)
        now = time.time_ns()
        with suppress(PermissionError):  # it belongs to another user: its times cannot be set
            os.utime(path, ns=(now, now if compared else path.stat().st_mtime_ns))

    def _make_room(self, descriptor: int, size: int) -> bool:
        """Remove the oldest files as needed, and set the size of a new file.

        Return whether there is room for it.
        """
        with self._lock(""):
            files = []
            for path in Path(self.folder).glob("??/*"):
                with suppress(FileNotFoundError):  # renamed meanwhile
                    about = path.stat()
                    if stat.S_ISREG(about.st_mode):
                        files.append((about.st_atime_ns, about.st_size, path))
            excess = sum(length for _, length, _ in files) + size - self.max_bytes
            for _, length, path in sorted(files):
                if excess <= 0:
                    break
                if self._remove(path):
                    excess -= length
            if excess <= 0:
                os.truncate(descriptor, size)  # from now on, other processes count its size
            return excess <= 0

    def _remove(self, path: Path) -> bool:
        """Remove a file, unless a process is writing it. Return whether it was removed."""
        lock = self._lock(path.name.removesuffix(_PART))
        with suppress(Timeout), lock.acquire(blocking=False):
            path.unlink(missing_ok=True)
            with suppress(PermissionError):  # Windows keeps files that are open
                Path(lock.lock_file).unlink(missing_ok=True)
            return True
        return False


class CachedTree(Tree):
    """A remote tree whose files are read through a cache, as whole files.

    One process compares a file with the remote file, once after the store was opened. Later changes
    are not detected. If a file is too large for the cache, or the disk is full, its ranges are read
    from the server.
    """

    def __init__(self, remote: RemoteTree, cache: Cache) -> None:
        """Create the folder of the cache. No request is sent yet.

        Raises:
            StorageError: the folder cannot be created or written to.
        """
        cache.create()
        self.remote = remote
        self.cache = cache
        self.location = remote.location
        self._opened = time.time()
        self._forget()

    def _forget(self) -> None:
        # path -> name in the cache; None if the file is too large for it
        self._names: dict[str, str | None] = {}
        self._full_until = 0.0

    def entries(self, folder: str = "") -> Mapping[str, bool]:
        """List the remote folder."""
        return self.remote.entries(folder)

    def states(self, paths: Sequence[str]) -> dict[str, str]:
        """Return the states of the remote files."""
        return self.remote.states(paths)

    def is_file(self, path: str) -> bool:
        """Whether the file exists."""
        return path in self._names or self.remote.is_file(path)

    def read(self, path: str, size: int | None = None) -> bytes | memoryview:
        """Map the cached file into memory."""
        return self._use(path, lambda tree, name: tree.read(name))

    def read_range(self, path: str, start: int, end: int) -> bytes | memoryview:
        """Read the range of the cached file."""
        return self._use(path, lambda tree, name: tree.read_range(name, start, end))

    def fetch(self, path: str, *, wait: bool = True) -> bool:
        """Fetch a file into the cache, or record that it will be used.

        Args:
            path: the file.
            wait: wait for another process that is fetching it.

        Returns:
            Whether it is in the cache.

        Raises:
            CarlascError: the file does not exist, or the server does not answer.
        """
        return self._use(path, lambda tree, _: tree is not self.remote, wait)

    def _use(self, path: str, use: Callable[[Tree, str], _Result], wait: bool = True) -> _Result:
        """Call `use` with a tree and the name of a file in it: the cached file, whose use is
        recorded, or the remote file if it must be read without the cache.
        """
        for _ in range(2):
            try:
                if (name := self._find(path, wait)) is None:
                    break
                result = use(_CacheFolder(self.cache.path(name).parent, self.where(path)), name)
                self.cache.touch(name)
                return result
            except (MissingDataError, FileNotFoundError):
                if self._names.pop(path, None) is None:
                    raise  # the remote file does not exist
                # removed to make room: fetched again
        return use(self.remote, path)

    def _find(self, path: str, wait: bool) -> str | None:
        """Return the name of a file in the cache, fetching it if necessary; None if it must be read
        without the cache.
        """
        if path not in self._names:
            key = self._key(path)
            name = self.cache.find(key, self._opened)
            if name is None:
                size, version = self.remote.version(path)
                if size > self.cache.max_bytes // _LARGEST_SHARE:
                    self._names[path] = None
                    return None
                name = f"{key}-{_digest(version)[:16]}-{size}"
                if not self._add(path, name, size, wait):
                    return None
                self._names[path] = name
                self.cache.touch(name, compared=True)
            self._names[path] = name
        return self._names[path]

    def _add(self, path: str, name: str, size: int, wait: bool) -> bool:
        if time.monotonic() < self._full_until:
            return _is_whole(self.cache.path(name))
        try:
            return self.cache.add(name, partial(self._fill, path, size), wait=wait)
        except OSError:  # the disk is full: the file is read from the server
            self._full_until = time.monotonic() + _FULL_S
            return False

    def _fill(self, path: str, size: int, descriptor: int) -> None:
        starts = range(0, size, _PIECE)
        for first in range(0, len(starts), _AT_ONCE):
            pieces = [
                (path, start, min(start + _PIECE, size))
                for start in starts[first : first + _AT_ONCE]
            ]
            for (_, start, _), data in zip(pieces, self.remote.read_ranges(pieces), strict=True):
                write_at(descriptor, data, start)

    def _key(self, path: str) -> str:
        options = self.remote.client.options
        more = options.get("client_kwargs", {})
        endpoint = options.get("endpoint_url") or more.get("endpoint_url", "")
        return _digest(f"{endpoint}\n{self.location}\n{path}")[:32]

    def __getstate__(self) -> dict[str, Any]:
        own = ("_names", "_full_until")
        return {name: value for name, value in self.__dict__.items() if name not in own}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._forget()


class _CacheFolder(LocalTree):
    """A folder of the cache. Its errors name the remote file."""

    def __init__(self, root: Path, named: str) -> None:
        super().__init__(root)
        self._named = named

    def where(self, path: str) -> str:
        return f"{self._named} (its copy {path})"


def _size_of(name: str) -> int:
    """Return the size of a complete file, which is the end of its name."""
    return int(name.rpartition("-")[2])


def _is_whole(path: Path) -> bool:
    """Whether a file exists and has the size in its name.

    A power failure can leave a shorter file.
    """
    try:
        return path.stat().st_size == _size_of(path.name)
    except FileNotFoundError:
        return False


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
