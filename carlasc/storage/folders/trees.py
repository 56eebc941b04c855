"""Trees of files: a local folder or a remote one. They list folders and read ranges of bytes.

No tree keeps a handle open, so that all of them can be pickled, and used on both sides of a fork.
"""

from __future__ import annotations

import mmap
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from carlasc.errors import CarlascError, FormatError, MissingDataError, import_extra

# Bytes from which on a range is mapped. Reading the megabyte of a scan is faster than touching its mapped pages.
_MAPPED = 1 << 22
_EXTRAS = {"http": "aiohttp", "https": "aiohttp", "s3": "s3fs", "s3a": "s3fs"}  # packages of the extra `remote`


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
    def read(self, path: str) -> bytes | memoryview:
        """Return a file's bytes.

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

    def read_many(self, paths: Sequence[str]) -> list[bytes | memoryview]:
        """Return several files' bytes; remote trees request all of them at once."""
        return [self.read(path) for path in paths]

    def read_ranges(self, ranges: Sequence[tuple[str, int, int]]) -> list[bytes | memoryview]:
        """Return several ranges; remote trees request all of them at once."""
        return [self.read_range(*part) for part in ranges]

    def where(self, path: str) -> str:
        """Return the name of a file of the tree in errors."""
        return f"{self.location}/{path}" if path else self.location


class LocalTree(Tree):
    """A folder on this machine."""

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self.root = Path(root)
        self.location = str(self.root)

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

    def read(self, path: str) -> bytes | memoryview:
        """Map the file into memory: its bytes are read when they are used."""
        with self._opened(path) as descriptor:
            if os.fstat(descriptor).st_size == 0:
                return b""  # an empty file, such as an empty scan, cannot be mapped
            return memoryview(mmap.mmap(descriptor, 0, prot=mmap.PROT_READ))

    def read_range(self, path: str, start: int, end: int) -> bytes | memoryview:
        """Read the range, or map it into memory if it is large."""
        with self._opened(path) as descriptor:
            if start < 0:
                size = os.fstat(descriptor).st_size
                start, end = max(0, size + start), size + end
            if end - start >= _MAPPED:
                return _map_range(descriptor, start, end, self.where(path))
            data = os.pread(descriptor, end - start, start)
        return check_length(data, end - start, self.where(path))

    @contextmanager
    def _opened(self, path: str) -> Iterator[int]:
        path = f"{self.location}/{path}" if path else self.location
        try:
            descriptor = os.open(path, os.O_RDONLY)
            try:
                yield descriptor
            finally:
                os.close(descriptor)
        except (FileNotFoundError, NotADirectoryError) as error:
            raise MissingDataError(path, expected="a file", found="nothing") from error
        except OSError as error:
            raise FormatError(path, problem=f"cannot be read: {error.strerror or error}") from error


class RemoteTree(Tree):
    """A folder, or a single file (path ""), at any URL that fsspec knows: http, s3, memory, ..."""

    def __init__(self, url: str, options: Mapping[str, Any] | None = None) -> None:
        """Remember the URL and fsspec's storage options; nothing is requested yet.

        Raises:
            DependencyError: the URL needs a package that is not installed.
        """
        self.location = url.rstrip("/")
        self.options = dict(options or {})
        scheme = url.partition("://")[0]
        if scheme in _EXTRAS:
            import_extra(_EXTRAS[scheme], "remote")
        self._listed: dict[str, dict[str, bool]] = {}

    @property
    def _fs(self) -> Any:
        """The file system of this process: fsspec keeps one for equal arguments, and makes a new one after a fork."""
        from fsspec.core import url_to_fs

        try:
            return url_to_fs(self.location, **self.options)[0]
        except (ValueError, ImportError) as error:
            raise CarlascError(self.location, problem=f"cannot be opened: {error}") from error

    def entries(self, folder: str = "") -> Mapping[str, bool]:
        """List the folder, once."""
        if folder not in self._listed:
            url = self.where(folder)
            try:
                found = self._fs.ls(f"{url}/" if url.startswith("http") else url, detail=True)
            except (FileNotFoundError, NotADirectoryError):
                found = []
            except Exception as error:  # noqa: BLE001 (each file system raises its own types)
                _fail(url, error)
            listed = {}
            for entry in found:
                name = str(entry["name"])
                folder_like = entry["type"] == "directory" or name.endswith("/")
                base = name.rstrip("/").rpartition("/")[2]
                if base and base != url.rpartition("/")[2] and "?" not in base:
                    listed[base] = folder_like
            self._listed[folder] = listed
        return self._listed[folder]

    def is_file(self, path: str) -> bool:
        """Whether the file exists: asked of the server where folders cannot be listed (http), else of the folder's listing."""
        return self.size(path) is not None if self.location.startswith("http") else super().is_file(path)

    def read(self, path: str) -> bytes | memoryview:
        """Fetch the file."""
        return self.read_many([path])[0]

    def read_range(self, path: str, start: int, end: int) -> bytes:
        """Fetch the range."""
        return self.read_ranges([(path, start, end)])[0]

    def read_many(self, paths: Sequence[str]) -> list[bytes | memoryview]:
        """Fetch the files, several at a time."""
        urls = [self.where(path) for path in paths]
        try:
            return [bytes(data) for data in self._fs.cat_ranges(urls, None, None, on_error="raise")]
        except Exception as error:  # noqa: BLE001
            _fail(urls[0] if len(urls) == 1 else self.location, error)

    def read_ranges(self, ranges: Sequence[tuple[str, int, int]]) -> list[bytes]:  # type: ignore[override]
        """Fetch the ranges, several at a time."""
        fs = self._fs
        urls = [self.where(path) for path, _, _ in ranges]
        try:
            sizes = {
                url: fs.size(url) for url in {u for u, (_, start, _) in zip(urls, ranges, strict=True) if start < 0}
            }
            starts = [max(0, sizes[url] + s) if s < 0 else s for url, (_, s, _) in zip(urls, ranges, strict=True)]
            ends = [sizes[url] + e if s < 0 else e for url, (_, s, e) in zip(urls, ranges, strict=True)]
            found = fs.cat_ranges(urls, starts, ends, on_error="raise")
        except Exception as error:  # noqa: BLE001
            _fail(urls[0] if len(set(urls)) == 1 else self.location, error)
        parts = zip(found, starts, ends, urls, strict=True)
        return [check_length(bytes(data), end - start, url) for data, start, end, url in parts]

    def open(self, path: str) -> Any:
        """Open a file, for libraries that take file objects: it fetches blocks as they are needed."""
        try:
            return self._fs.open(self.where(path), "rb", cache_type="blockcache", block_size=1 << 18)
        except Exception as error:  # noqa: BLE001
            _fail(self.where(path), error)

    def size(self, path: str = "") -> int | None:
        """Return a file's size in bytes; None if it does not exist or is a folder (or a page that lists one)."""
        url = self.where(path)
        try:
            found = self._fs.info(url)
        except (FileNotFoundError, IsADirectoryError):
            return None
        except Exception as error:  # noqa: BLE001
            _fail(url, error)
        if found.get("type") == "directory" or found.get("mimetype") == "text/html":
            return None
        return found["size"]

    def check_ranges(self, path: str = "") -> None:
        """Request one byte: a server without range requests would send the whole file for each of them.

        Raises:
            CarlascError: the server does not support range requests.
        """
        url = self.where(path)
        if not url.startswith("http"):
            return
        from fsspec.asyn import sync

        fs = self._fs

        async def status() -> int:
            session = await fs.set_session()
            settings = dict(fs.kwargs)
            headers = {**settings.pop("headers", {}), "Range": "bytes=0-0"}
            async with session.get(fs.encode_url(url), headers=headers, **settings) as answer:
                return int(answer.status)  # the body is not read

        try:
            found = sync(fs.loop, status)
        except Exception as error:  # noqa: BLE001
            _fail(url, error)
        if found != 206:
            raise CarlascError(
                url,
                expected="a server that supports range requests",
                found="one that does not",
                advice="download the file first",
            )

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_listed": {}}  # a worker lists what it needs


def _map_range(descriptor: int, start: int, end: int, where: str) -> memoryview:
    found = os.fstat(descriptor).st_size
    if end > found:
        raise FormatError(where, expected=f"at least {end} bytes", found=str(found), advice="is it truncated?")
    skipped = start % mmap.ALLOCATIONGRANULARITY
    flags = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)  # read all pages at once (Linux only)
    mapped = mmap.mmap(descriptor, end - start + skipped, flags, mmap.PROT_READ, offset=start - skipped)
    return memoryview(mapped)[skipped:]


def check_length(data: bytes, expected: int, where: str) -> bytes:
    """Return `data` if it has the expected length; else the file is truncated, or a server sent another range."""
    if len(data) != expected:
        raise FormatError(
            where, expected=f"{expected} bytes in this range", found=str(len(data)), advice="is the file truncated?"
        )
    return data


def _fail(where: str, error: Exception) -> NoReturn:
    if isinstance(error, CarlascError):
        raise error
    if isinstance(error, FileNotFoundError):
        raise MissingDataError(where, expected="a file", found="nothing") from error
    raise CarlascError(where, problem=f"cannot be read: {type(error).__name__}: {error}") from error
