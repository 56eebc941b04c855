"""Trees of files: a local folder or a remote one. They list folders and read ranges of bytes.

No tree keeps a handle open, so that all of them can be pickled, and used on both sides of a fork.
"""

from __future__ import annotations

import copy
import mmap
import os
import stat
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from carlasc.errors import CarlascError, FormatError, MissingDataError, without_credentials
from carlasc.storage.folders.blocks import RemoteFile
from carlasc.storage.folders.bodies import WrongAnswerError
from carlasc.storage.folders.ranges import check_length, check_size, map_range, shorter
from carlasc.storage.folders.requests import Request, Requests, bucket_is_missing, fail

# Bytes from which on a range is mapped. Reading the megabyte of a scan is faster than touching its mapped pages.
_MAPPED = 1 << 22

# What file systems call a digest of a file's content, or the time of its last change.
_CHANGES = (
    "ETag",
    "etag",
    "Content-MD5",
    "Digest",
    "md5Hash",
    "Last-Modified",
    "LastModified",
    "last_modified",
    "mtime",
    "created",
    "blob_id",
)


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
                raise shorter(end - start, max(0, size - start), self.where(path))
            if end - start >= _MAPPED:
                return map_range(descriptor, start, end)
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


class RemoteTree(Tree):
    """A folder, or a single file (path ""), at any URL that fsspec knows: http, s3, memory, ...

    A folder is listed once. `size`, `read` and `paths` ask the server each time.
    """

    def __init__(self, url: str, options: Mapping[str, Any] | None = None) -> None:
        """Remember the URL and fsspec's storage options; nothing is requested yet.

        Raises:
            DependencyError: the URL needs a package that is not installed.
        """
        base, mark, query = url.partition("?") if url.startswith("http") else (url, "", "")
        self._base, self._query = base.rstrip("/"), mark + query  # a signed URL: the signature follows each path
        self.location = without_credentials(self._base)
        self.requests = Requests(url.rstrip("/"), options)
        self._listed: dict[str, dict[str, bool]] = {}
        self._sizes: dict[str, int] = {}  # of the files in the folders that were listed

    def url(self, path: str = "") -> str:
        """Return the URL of a file; it may hold credentials, so it must not be shown (see `where`)."""
        return f"{self._base}/{path}{self._query}" if path else self._base + self._query

    def below(self, folder: str) -> RemoteTree:
        """Return the tree of a folder in this one."""
        tree = copy.copy(self)
        tree._base, tree.location = (f"{place}/{folder}" if folder else place for place in (self._base, self.location))
        tree._listed, tree._sizes = {}, {}
        return tree

    def entries(self, folder: str = "") -> Mapping[str, bool]:
        """List the folder, once."""
        if folder not in self._listed:
            url = self.url(folder)
            if url.startswith("http") and not self._query:
                url += "/"
            (found,) = self.requests.send([Request("ls", url, {"detail": True})])
            if isinstance(found, FileNotFoundError | NotADirectoryError) and not bucket_is_missing(found):
                found = []
            elif isinstance(found, Exception):
                fail(self.where(folder), found)
            listed, own = {}, self._own_name(folder)
            for entry in found:
                name = str(entry["name"])
                folder_like = entry["type"] == "directory" or name.endswith("/")
                base = name.rstrip("/").rpartition("/")[2]
                if base and name.strip("/") != own and "?" not in base:
                    listed[base] = folder_like
                    if not folder_like and isinstance(entry.get("size"), int):
                        self._sizes[f"{folder}/{base}" if folder else base] = entry["size"]
            self._listed[folder] = listed
        return self._listed[folder]

    def _own_name(self, folder: str) -> str:
        """Return how listings name the folder itself: object stores list it among its files."""
        place = f"{self._base}/{folder}" if folder else self._base
        return (place if place.startswith("http") else self.requests.fs._strip_protocol(place)).strip("/")

    def refresh(self) -> None:
        """Forget listings: other processes may have written files since."""
        self._listed, self._sizes = {}, {}

    def note(self, path: str, size: int | None) -> None:
        """Remember that this process wrote a file of `size` bytes, or removed it (None), where its folder has been listed."""
        self._sizes.pop(path, None)
        if size is not None:
            self._sizes[path] = size
        name, is_folder = path, False
        while name:
            folder, _, base = name.rpartition("/")
            if folder in self._listed:
                if size is None and not is_folder:
                    self._listed[folder].pop(base, None)
                elif size is not None:
                    self._listed[folder][base] = is_folder
            name, is_folder = folder, True

    def is_file(self, path: str) -> bool:
        """Whether the file exists: asked of the server where folders cannot be listed (http), else of the folder's listing."""
        return self.size(path) is not None if self._base.startswith("http") else super().is_file(path)

    def paths(self, folder: str = "") -> Iterator[str]:
        """Yield the paths of all files below a folder, or that of the file of this name, in any order."""
        yield from self.sizes(folder)

    def sizes(self, folder: str = "") -> dict[str, int]:
        """Return the bytes of all files below a folder, or of the file of this name, by path."""
        (found,) = self.requests.send([Request("find", self.url(folder), {"detail": True})])
        if isinstance(found, FileNotFoundError) and not bucket_is_missing(found):
            return {}
        if isinstance(found, Exception):
            fail(self.where(folder), found)
        root = self.requests.fs._strip_protocol(self._base).rstrip("/") + "/"
        sizes = {}
        for name, about in found.items():
            place = name if name.startswith("/") == root.startswith("/") else f"/{name}"
            if place.startswith(root) and not place.endswith("/"):
                sizes[place.removeprefix(root)] = about["size"]
        return sizes

    def read(self, path: str, size: int | None = None) -> bytes | memoryview:
        """Fetch the file."""
        return self.read_many([path])[0]

    def read_range(self, path: str, start: int, end: int) -> bytes:
        """Fetch the range."""
        return self.read_ranges([(path, start, end)])[0]

    def read_many(self, paths: Sequence[str], size: int | None = None) -> list[bytes | memoryview]:
        """Fetch the files, several at a time. Their lengths are compared with the listing, where their folder has been listed."""
        requests = [Request("get", self.url(path), {}, self._length_check(path)) for path in paths]
        answers = self.requests.send(requests)
        for place, (path, answer) in enumerate(zip(paths, answers, strict=True)):
            if isinstance(answer, WrongAnswerError):  # replaced since it was listed?
                self._sizes[path] = self._size(path)
                (answers[place],) = self.requests.send([Request("get", self.url(path), {}, self._length_check(path))])
            if isinstance(answers[place], Exception):
                fail(self.where(path), answers[place])
        return [bytes(data) for data in answers]

    def _length_check(self, path: str) -> Callable[[bytes], None] | None:
        expected = self._sizes.get(path)
        return None if expected is None else partial(check_size, expected)

    def read_ranges(self, ranges: Sequence[tuple[str, int, int]]) -> list[bytes]:  # type: ignore[override]
        """Fetch the ranges, several at a time."""
        sizes = {path: self._size(path) for path in {path for path, start, _ in ranges if start < 0}}
        wanted = [(p, max(0, sizes[p] + s), sizes[p] + e) if s < 0 else (p, s, e) for p, s, e in ranges]
        asked = [part for part in wanted if part[1] < part[2]]
        answers = iter(self.requests.send([Request("get", self.url(p), {"start": s, "end": e}) for p, s, e in asked]))
        return [self._checked(part, next(answers)) if part[1] < part[2] else b"" for part in wanted]

    def _checked(self, part: tuple[str, int, int], answer: Any) -> bytes:
        """Return an answer of the right length. A short one is asked for again, unless the file ends there."""
        path, start, end = part
        if isinstance(answer, Exception):
            fail(self.where(path), answer)
        if len(answer) != end - start and self._size(path) >= end:
            check = partial(check_size, end - start)
            (answer,) = self.requests.send([Request("get", self.url(path), {"start": start, "end": end}, check)])
            if isinstance(answer, Exception):
                fail(self.where(path), answer)
        return check_length(bytes(answer), end - start, self.where(path))

    def open(self, path: str) -> Any:
        """Open a file, for libraries that take file objects: it fetches blocks as they are needed."""
        return RemoteFile(partial(self.read_range, path), self._size(path))

    def size(self, path: str = "") -> int | None:
        """Return a file's size in bytes; None if it does not exist or is a folder (or a page that lists one)."""
        found = self._about(path)
        return None if found is None else found["size"]

    def version(self, path: str) -> tuple[int, str]:
        """Return a file's size in bytes, and a text that changes when the file does, if the server knows of its changes.

        The server is asked each time, whatever was listed before.

        Raises:
            MissingDataError: the file does not exist.
        """
        self.requests.fs.invalidate_cache(self.url(path))
        found = self._about(path)
        if found is None:
            raise MissingDataError(self.where(path), expected="a file", found="nothing")
        return found["size"], " ".join(str(found[name]) for name in _CHANGES if found.get(name))

    def _about(self, path: str) -> dict[str, Any] | None:
        """Return what the file system says of a file; None if it does not exist or is a folder (or a page that lists one)."""
        (found,) = self.requests.send([Request("info", self.url(path))])
        if isinstance(found, FileNotFoundError | IsADirectoryError) and not bucket_is_missing(found):
            return None
        if isinstance(found, Exception):
            fail(self.where(path), found)
        folder = found.get("type") == "directory" or found.get("mimetype") == "text/html"
        return None if folder else found

    def _size(self, path: str) -> int:
        size = self.size(path)
        if size is None:
            raise MissingDataError(self.where(path), expected="a file", found="nothing")
        return size

    def check_ranges(self, path: str = "") -> None:
        """Request one byte: a server without range requests would send the whole file for each of them.

        Raises:
            CarlascError: the server does not support range requests.
        """
        if not self._base.startswith("http"):
            return
        (answer,) = self.requests.send([Request("get", self.url(path), {"start": 0, "end": 1})], attempts=2)
        if isinstance(answer, WrongAnswerError):
            raise CarlascError(
                self.where(path),
                expected="a server that supports range requests",
                found="one that does not",
                advice="download the file first",
            )
        if isinstance(answer, Exception):
            fail(self.where(path), answer)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_listed": {}, "_sizes": {}}  # a worker lists what it needs


def is_url(place: object) -> bool:
    """Whether a place is a URL of another machine or of fsspec, rather than a path; `file://` is a path."""
    return isinstance(place, str) and "://" in place and not place.startswith("file://")


def tree_of(place: str | os.PathLike[str], *, mapped: bool = True, **storage_options: Any) -> LocalTree | RemoteTree:
    """Return the tree of files at a path or a URL; nothing is read yet.

    Args:
        place: a folder, or its URL.
        mapped: whether files of a local folder are mapped into memory (see `LocalTree`).
        **storage_options: options of fsspec for the URL.
    """
    text = os.fspath(place)
    return RemoteTree(text, storage_options) if is_url(text) else LocalTree(text.removeprefix("file://"), mapped=mapped)
