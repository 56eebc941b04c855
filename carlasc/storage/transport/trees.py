"""Trees of files, which list folders and read ranges of bytes, and targets, which write files.

Trees keep no handles open, so they can be pickled, and used on both sides of a fork.
"""

from __future__ import annotations

import mmap
import os
import shutil
import stat
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from carlasc.errors import CarlascError, FormatError, MissingDataError
from carlasc.storage.files import AnyPath, leads_outside, write_atomic, write_many

# Opening a pipe would hang without a writer; Windows would change the ends of lines.
_READING = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)

_Data = TypeVar("_Data", bound=bytes | memoryview)


class Tree(ABC):
    """A folder of files. Paths in it are relative, with "/" between parts; "" is the folder itself.

    A kind of tree has `read` or `read_many`, and `read_range` or `read_ranges`; each of them calls
    the other.

    Attributes:
        location: its name in errors: a folder, a zip, a URL.
    """

    location: str

    @abstractmethod
    def entries(self, folder: str = "") -> Mapping[str, bool]:
        """Return the names in a folder, mapped to whether they are folders; empty if the folder
        does not exist.
        """

    def read(self, path: str, size: int | None = None) -> bytes | memoryview:
        """Return a file's bytes.

        Args:
            path: the file.
            size: expected size in bytes; None if it is not known. A compressed file of another size
                is not decompressed.

        Raises:
            MissingDataError: the file does not exist.
            FormatError: the file cannot be read, or is damaged.
        """
        return self.read_many([path], size)[0]

    def read_range(self, path: str, start: int, end: int) -> bytes | memoryview:
        """Return the bytes [start, end) of a file.

        If start is negative, both are counted from the end of the file.

        Raises:
            MissingDataError: the file does not exist.
            FormatError: the file is shorter.
        """
        return self.read_ranges([(path, start, end)])[0]

    def is_file(self, path: str) -> bool:
        """Whether a file exists."""
        folder, _, name = path.rpartition("/")
        return self.entries(folder).get(name) is False

    def read_many(self, paths: Sequence[str], size: int | None = None) -> list[bytes | memoryview]:
        """Return the bytes of several files, each of `size` (see `read`).

        Remote trees request all of them at once.
        """
        return [self.read(path, size) for path in paths]

    def read_ranges(self, ranges: Sequence[tuple[str, int, int]]) -> list[bytes | memoryview]:
        """Return several ranges; remote trees request all of them at once."""
        return [self.read_range(*part) for part in ranges]

    def states(self, paths: Sequence[str]) -> dict[str, str]:
        """Return a text for each file that changes with the file, or most of them: its size and its
        time, or the version of an object; empty if it is not known.
        """
        return dict.fromkeys(paths, "")

    def refresh(self) -> None:  # noqa: B027 (most trees remember nothing)
        """Discard cached listings, because other processes may have written files."""

    def where(self, path: str) -> str:
        """Return the name of a file of the tree in errors."""
        return f"{self.location}/{path}" if path else self.location


class LocalTree(Tree):
    """A folder on this machine."""

    def __init__(self, root: AnyPath, *, mapped: bool = True) -> None:
        """Create the tree of a folder.

        Args:
            root: the folder.
            mapped: whether `read` maps files into memory, so that only the used parts are read.
                Files must then not be changed in place.
        """
        self.root = Path(root)
        self.mapped = mapped
        self.location = str(self.root)

    def below(self, folder: str) -> LocalTree:
        """Return the tree of a folder in this one."""
        return LocalTree(self.root / folder, mapped=self.mapped)

    def entries(self, folder: str = "") -> Mapping[str, bool]:
        """List the folder."""
        try:
            with os.scandir(self.root / folder) as entries:
                return {entry.name: entry.is_dir() for entry in entries}
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except OSError as error:
            raise CarlascError(
                self.where(folder), problem=f"cannot be listed: {error.strerror or error}"
            ) from error

    def is_file(self, path: str) -> bool:
        """Whether the file exists, without listing its folder."""
        return (self.root / path).is_file()

    def states(self, paths: Sequence[str]) -> dict[str, str]:
        """Return the size of each file, and the time of its last modification in nanoseconds."""
        found = dict.fromkeys(paths, "")
        for path in paths:
            with suppress(OSError):
                about = os.stat(f"{self.location}/{path}")
                found[path] = f"{about.st_size} {about.st_mtime_ns}"
        return found

    def read_many(self, paths: Sequence[str], size: int | None = None) -> list[bytes | memoryview]:
        """Read the files, or map them into memory."""
        contents: list[bytes | memoryview] = []
        for path in paths:
            with self._opened(path) as descriptor:
                length = os.fstat(descriptor).st_size
                # an empty file, such as an empty scan, cannot be mapped
                contents.append(
                    memoryview(mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ))
                    if self.mapped and length
                    else os.read(descriptor, length)
                )
        return contents

    def read_range(self, path: str, start: int, end: int) -> bytes | memoryview:
        """Read the range."""
        with self._opened(path) as descriptor:
            size = os.fstat(descriptor).st_size
            start, end = from_start(start, end, size)
            os.lseek(descriptor, min(start, size), os.SEEK_SET)
            # the range may come from a damaged table, and be larger than the memory
            data = os.read(descriptor, max(0, min(end, size) - start))
        return check_length(data, end - start, self.where(path))

    @contextmanager
    def _opened(self, path: str) -> Iterator[int]:
        path = f"{self.location}/{path}" if path else self.location
        try:
            descriptor = os.open(path, _READING)
            try:
                if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                    raise FormatError(path, expected="a file", found="a folder, a pipe or a device")
                yield descriptor
            finally:
                os.close(descriptor)
        except (FileNotFoundError, NotADirectoryError) as error:
            raise MissingDataError(path, expected="a file", found="nothing") from error
        except OSError as error:
            raise FormatError(path, problem=f"cannot be read: {error.strerror or error}") from error


class Target(ABC):
    """A folder to write files to.

    Paths in it are relative, with "/" between parts. It can be pickled.

    Attributes:
        location: its name in errors: a folder or a URL.
        tree: reads the written files.
    """

    location: str
    tree: Tree

    @abstractmethod
    def below(self, folder: str) -> Target:
        """Return a folder in this one.

        Raises:
            FormatError: the path leads out of the folder.
        """

    def read(self, path: str) -> bytes | None:
        """Return a file's bytes; None if it does not exist."""
        try:
            return bytes(self.tree.read(path))
        except MissingDataError:
            return None

    @abstractmethod
    def put(self, path: str, data: bytes | memoryview, *, create: bool = False) -> bool:
        """Write a whole file, and create missing folders.

        Args:
            path: the file; an existing one is replaced unless `create` is given.
            data: its bytes.
            create: write only if the file does not exist. If several processes do this at once,
                exactly one succeeds.

        Returns:
            False if `create` is given and the file exists; True otherwise.

        Raises:
            FormatError: the path leads out of the folder.
            StorageError: the file cannot be written; no temporary file remains.
        """

    @abstractmethod
    def put_many(self, *groups: Mapping[str, bytes | memoryview]) -> None:
        """Write several groups of files, one group after the other.

        Files of a group are written in parallel.
        """

    @abstractmethod
    def paths(self, folder: str = "") -> Iterator[str]:
        """Yield the paths of all files below a folder, in any order; nothing if the folder does not
        exist.
        """

    @abstractmethod
    def remove(self, path: str) -> None:
        """Remove a file, or a folder with all files below it, if it exists."""

    def remove_many(self, paths: Iterable[str]) -> None:
        """Remove several files, if they exist. Object stores need few requests for this."""
        for path in paths:
            self.remove(path)

    def _checked(self, path: str) -> str:
        if leads_outside(path):
            raise FormatError(
                path, expected=f"a path inside {self.location}", found="a path that leads out of it"
            )
        return path


class LocalTarget(Target):
    """A folder on this machine."""

    def __init__(self, folder: AnyPath) -> None:
        self.folder = Path(folder)
        self.location = str(self.folder)
        self.tree = LocalTree(self.folder)

    def below(self, folder: str) -> LocalTarget:
        """Return a folder in this one."""
        return LocalTarget(self._inside(folder))

    def put(self, path: str, data: bytes | memoryview, *, create: bool = False) -> bool:
        """Write a file under a temporary name, then rename it, or link it if `create` is given."""
        return write_atomic(self._inside(path), data, create=create)

    def put_many(self, *groups: Mapping[str, bytes | memoryview]) -> None:
        """Write several files, which are synced together."""
        write_many(
            *({self._inside(path): data for path, data in group.items()} for group in groups)
        )

    def paths(self, folder: str = "") -> Iterator[str]:
        """Yield the paths of all files, without temporary files of writers."""
        for root, _, names in os.walk(self._inside(folder)):
            for name in names:
                if not name.startswith("."):
                    yield (Path(root) / name).relative_to(self.folder).as_posix()

    def remove(self, path: str) -> None:
        """Remove a file or a folder."""
        place = self._inside(path)
        if place.is_dir() and not place.is_symlink():
            shutil.rmtree(place)
        else:
            place.unlink(missing_ok=True)

    def _inside(self, path: str) -> Path:
        return self.folder / self._checked(path)


def from_start(start: int, end: int, size: int) -> tuple[int, int]:
    """Return a range counted from the start of a file of `size` bytes (see `Tree.read_range`)."""
    return (max(0, size + start), size + end) if start < 0 else (start, end)


def check_length(data: _Data, expected: int, where: str) -> _Data:
    """Return `data` if it has the expected length.

    Args:
        data: bytes of a range.
        expected: number of bytes of the range.
        where: the file, for errors.

    Raises:
        FormatError: the length is different: the file is truncated, or a server sent another range.
    """
    if len(data) != expected:
        raise FormatError(
            where,
            expected=f"{expected} bytes in this range",
            found=len(data),
            advice="the file may be truncated",
        )
    return data


def is_url(place: object) -> bool:
    """Whether a place is a URL rather than a local path. `file://` URLs count as paths."""
    return isinstance(place, str) and "://" in place and not place.startswith("file://")
