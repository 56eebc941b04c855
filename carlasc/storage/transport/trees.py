"""Trees of files: a local folder, or one elsewhere. They list folders and read ranges of bytes.

No tree keeps a handle open, so that all of them can be pickled, and used on both sides of a fork.
"""

from __future__ import annotations

import mmap
import os
import stat
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from carlasc.errors import CarlascError, FormatError, MissingDataError

# Bytes from which on a range is mapped. Reading the megabyte of a scan is faster than touching its mapped pages.
_MAPPED = 1 << 22


class Tree(ABC):
    """A folder of files. Paths in it are relative, their parts joined by "/"; "" is the folder itself.

    Attributes:
        location: its name in errors: a folder, a zip, a URL.
    """

    location: str

    @abstractmethod
    def entries(self, folder: str = "") -> Mapping[str, bool]:
        """Return the names in a folder, each with whether it is a folder; empty if the folder does not exist."""

    @abstractmethod
    def read(self, path: str, size: int | None = None) -> bytes | memoryview:
        """Return a file's bytes.

        Args:
            path: the file.
            size: the bytes that it has if it is what it should be; None where nothing says it. A packed file of another size is not
                unpacked.

        Raises:
            MissingDataError: the file does not exist.
            FormatError: it cannot be read, or is damaged.
        """

    @abstractmethod
    def read_range(self, path: str, start: int, end: int) -> bytes | memoryview:
        """Return the bytes [start, end) of a file; if start is negative, both are counted from the file's end.

        Raises:
            MissingDataError: the file does not exist.
            FormatError: the file is shorter.
        """

    def is_file(self, path: str) -> bool:
        """Whether a file exists."""
        folder, _, name = path.rpartition("/")
        return self.entries(folder).get(name) is False

    def read_many(self, paths: Sequence[str], size: int | None = None) -> list[bytes | memoryview]:
        """Return several files' bytes, each of `size` (see `read`); remote trees request all of them at once."""
        return [self.read(path, size) for path in paths]

    def read_ranges(self, ranges: Sequence[tuple[str, int, int]]) -> list[bytes | memoryview]:
        """Return several ranges; remote trees request all of them at once."""
        return [self.read_range(*part) for part in ranges]

    def refresh(self) -> None:  # noqa: B027 (most trees remember nothing)
        """Forget listings: other processes may have written files since."""

    def where(self, path: str) -> str:
        """Return the name of a file of the tree in errors."""
        return f"{self.location}/{path}" if path else self.location


class LocalTree(Tree):
    """A folder on this machine."""

    def __init__(self, root: str | os.PathLike[str], *, mapped: bool = True) -> None:
        """Take a folder.

        Args:
            root: the folder.
            mapped: whether `read` maps files into memory, so that only what is used is read. A file must not be changed in place then.
        """
        self.root, self.mapped = Path(root), mapped
        self.location = str(self.root)

    def below(self, folder: str) -> LocalTree:
        """Return the tree of a folder in this one."""
        return LocalTree(self.root / folder, mapped=self.mapped)

    def entries(self, folder: str = "") -> Mapping[str, bool]:
        """List the folder."""
        try:
            with os.scandir(self.root / folder) as found:
                return {entry.name: entry.is_dir() for entry in found}
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except OSError as error:
            raise CarlascError(self.where(folder), problem=f"cannot be listed: {error.strerror or error}") from error

    def is_file(self, path: str) -> bool:
        """Whether the file exists, without listing its folder."""
        return (self.root / path).is_file()

    def read(self, path: str, size: int | None = None) -> bytes | memoryview:
        """Read the file, or map it into memory: its bytes are read when they are used."""
        with self._opened(path) as descriptor:
            found = os.fstat(descriptor).st_size
            if not self.mapped:
                return os.pread(descriptor, found, 0)
            if found == 0:
                return b""  # an empty file, such as an empty scan, cannot be mapped
            return memoryview(mmap.mmap(descriptor, 0, prot=mmap.PROT_READ))

    def read_range(self, path: str, start: int, end: int) -> bytes | memoryview:
        """Read the range, or map it into memory if it is large."""
        with self._opened(path) as descriptor:
            size = os.fstat(descriptor).st_size
            if start < 0:
                start, end = max(0, size + start), size + end
            if end > size:  # what a damaged table says may be more than fits into memory
                raise _shorter(end - start, max(0, size - start), self.where(path))
            if end - start >= _MAPPED:
                return _map_range(descriptor, start, end)
            data = os.pread(descriptor, end - start, start)
        return check_length(data, end - start, self.where(path))

    @contextmanager
    def _opened(self, path: str) -> Iterator[int]:
        path = f"{self.location}/{path}" if path else self.location
        try:
            # Opening a pipe would wait for a writer, which may never come.
            descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
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


def _map_range(descriptor: int, start: int, end: int) -> memoryview:
    """Map the bytes [start, end) of an open file, which has as many, into memory."""
    skipped = start % mmap.ALLOCATIONGRANULARITY
    flags = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)  # read all pages at once (Linux only)
    mapped = mmap.mmap(descriptor, end - start + skipped, flags, mmap.PROT_READ, offset=start - skipped)
    return memoryview(mapped)[skipped:]


def check_length(data: bytes, expected: int, where: str) -> bytes:
    """Return `data` if it has the expected length; else the file is truncated, or a server sent another range.

    Args:
        data: bytes of a range.
        expected: number of bytes that the range has.
        where: the file, for errors.

    Raises:
        FormatError: there are more or fewer bytes.
    """
    if len(data) != expected:
        raise _shorter(expected, len(data), where)
    return data


def _shorter(expected: int, found: int, where: str) -> FormatError:
    return FormatError(
        where, expected=f"{expected} bytes in this range", found=str(found), advice="is the file truncated?"
    )


def is_url(place: object) -> bool:
    """Whether a place is a URL of another machine or of fsspec, rather than a path; `file://` is a path."""
    return isinstance(place, str) and "://" in place and not place.startswith("file://")
