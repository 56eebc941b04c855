"""Remote folders and files: a tree of files at a URL, and a remote file as a file object."""

from __future__ import annotations

import copy
import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

from carlasc.errors import CarlascError, MissingDataError, without_credentials
from carlasc.storage.transport.clients import HUB, Client, FileSystemClient, HubClient
from carlasc.storage.transport.failures import WrongAnswerError, fail
from carlasc.storage.transport.object_stores import SCHEMES, ObjectStoreClient
from carlasc.storage.transport.requests import send
from carlasc.storage.transport.trees import LocalTree, Tree, check_length, is_url
from carlasc.storage.transport.web import WebClient

_BLOCK = 1 << 18  # bytes per block of a remote file
_KEPT = 64  # blocks

_Answer = TypeVar("_Answer")


def _client(url: str, options: Mapping[str, Any]) -> Client:
    scheme = url.partition("://")[0]
    if scheme in SCHEMES:
        return ObjectStoreClient(url, options)
    if scheme in ("http", "https"):
        return WebClient(url, options)
    return (HubClient if scheme == HUB else FileSystemClient)(url, options)


class RemoteTree(Tree):
    """A folder, or a single file (path ""), at any URL: object stores, http, and all others that
    fsspec supports.

    A folder is listed once. `size`, `read` and `paths` send a request each time.

    Attributes:
        client: sends the requests.
    """

    def __init__(self, url: str, options: Mapping[str, Any] | None = None) -> None:
        """Keep the URL and the fsspec storage options. No request is sent yet.

        Raises:
            DependencyError: the URL needs a package that is not installed.
        """
        base, mark, query = url.partition("?") if url.startswith("http") else (url, "", "")
        # a signed URL: the signature follows each path
        self._base, self._query = (
            base.rstrip("/"),
            mark + query,
        )
        self.location = without_credentials(self._base)
        self.client = _client(url.rstrip("/"), options or {})
        self._listed: dict[str, dict[str, bool]] = {}
        self._sizes: dict[str, int] = {}  # sizes of files in listed folders

    def url(self, path: str = "") -> str:
        """Return the URL of a file.

        It may contain credentials, so it must not be shown; use `where` for messages.
        """
        return f"{self._base}/{path}{self._query}" if path else self._base + self._query

    def below(self, folder: str) -> RemoteTree:
        """Return the tree of a folder in this one."""
        tree = copy.copy(self)
        tree._base, tree.location = (
            f"{place}/{folder}" if folder else place for place in (self._base, self.location)
        )
        tree._listed, tree._sizes = {}, {}
        return tree

    def entries(self, folder: str = "") -> Mapping[str, bool]:
        """List the folder, once."""
        if folder not in self._listed:
            listed: dict[str, bool] = {}
            for name, size in self._ask(folder, self.client.entries, self.url(folder)).items():
                base = name.rstrip("/")
                listed[base] = name != base
                if size is not None:
                    self._sizes[f"{folder}/{base}" if folder else base] = size
            self._listed[folder] = listed
        return self._listed[folder]

    def _ask(self, path: str, function: Callable[..., _Answer], *arguments: Any) -> _Answer:
        """Send one request. An error names the path."""
        (answer,) = send([partial(function, *arguments)], self.client.settings)
        if isinstance(answer, Exception):
            fail(self.where(path), answer)
        return answer

    def refresh(self) -> None:
        """Discard cached listings, because other processes may have written files."""
        self._listed, self._sizes = {}, {}

    def note(self, path: str, size: int | None) -> None:
        """Update the listing of a folder after this process wrote a file of `size` bytes, or
        removed it (None).
        """
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
        """Whether the file exists, from the listing of its folder, or from the server if folders
        cannot be listed (http).
        """
        return (
            self.size(path) is not None if self._base.startswith("http") else super().is_file(path)
        )

    def paths(self, folder: str = "") -> Iterator[str]:
        """Yield the paths of all files below a folder, or the path itself if it is a file, in any
        order.
        """
        yield from self.sizes(folder)

    def sizes(self, folder: str = "") -> dict[str, int]:
        """Return the sizes of all files below a folder, or of the file itself, by path."""
        files = self._ask(folder, self.client.files, self.url(folder))
        return {"/".join(filter(None, (folder, name))): size for name, size in files.items()}

    def read(self, path: str, size: int | None = None) -> bytes | memoryview:
        """Fetch the file."""
        return self.read_many([path])[0]

    def read_range(self, path: str, start: int, end: int) -> bytes:
        """Fetch the range."""
        return bytes(self.read_ranges([(path, start, end)])[0])

    def read_many(self, paths: Sequence[str], size: int | None = None) -> list[bytes | memoryview]:
        """Fetch the files, several at a time.

        Their lengths are checked if their folder has been listed.
        """
        answers: dict[str, bytes | Exception] = {}
        missing = list(paths)
        for _ in range(2):
            asked = [partial(self._get, path) for path in missing]
            answers |= zip(missing, send(asked, self.client.settings), strict=True)
            missing = [path for path in missing if isinstance(answers[path], WrongAnswerError)]
            for path in missing:  # the files may have been replaced since the listing
                self._sizes[path] = self._size(path)
        return [self._data(path, answers[path]) for path in paths]

    def _get(
        self, path: str, start: int | None = None, end: int | None = None, size: int | None = None
    ) -> bytes:
        """Send one request, and check the length of the answer, if it is known."""
        data = self.client.get(self.url(path), start, end)
        expected = self._sizes.get(path) if start is None else size
        if expected is not None and len(data) != expected:
            raise WrongAnswerError(f"{len(data)} bytes instead of {expected}")
        return data

    def _data(self, path: str, answer: bytes | Exception) -> bytes:
        if isinstance(answer, Exception):
            fail(self.where(path), answer)
        return answer

    def read_ranges(self, ranges: Sequence[tuple[str, int, int]]) -> list[bytes | memoryview]:
        """Fetch the ranges, several at a time."""
        sizes = {
            path: self._size(path) for path in {path for path, start, _ in ranges if start < 0}
        }
        wanted = [
            (p, max(0, sizes[p] + s), sizes[p] + e) if s < 0 else (p, s, e) for p, s, e in ranges
        ]
        asked = [part for part in wanted if part[1] < part[2]]
        answers = iter(send([partial(self._get, *part) for part in asked], self.client.settings))
        return [self._checked(part, next(answers)) if part[1] < part[2] else b"" for part in wanted]

    def _checked(self, part: tuple[str, int, int], answer: bytes | Exception) -> bytes:
        """Return an answer of the right length.

        After a short answer the request is sent again, unless the file ends there.
        """
        path, start, end = part
        data = self._data(path, answer)
        if len(data) != end - start and self._size(path) >= end:
            data = self._ask(path, self._get, *part, end - start)
        return check_length(data, end - start, self.where(path))

    def open(self, path: str) -> Any:
        """Open a file as a file object, which fetches blocks on demand.

        For libraries that take file objects.
        """
        return RemoteFile(partial(self.read_range, path), self._size(path))

    def size(self, path: str = "") -> int | None:
        """Return a file's size in bytes; None if it does not exist or is a folder (or a page that
        lists one).
        """
        about = self._ask(path, self.client.about, self.url(path))
        return None if about is None else about[0]

    def version(self, path: str) -> tuple[int, str]:
        """Return the size of a file in bytes, and a text that changes with the file, if the server
        reports changes.

        A request is sent each time, regardless of listings.

        Raises:
            MissingDataError: the file does not exist.
        """
        about = self._ask(path, self.client.about, self.url(path))
        if about is None:
            raise MissingDataError(self.where(path), expected="a file", found="nothing")
        return about

    def _size(self, path: str) -> int:
        return self.version(path)[0]

    def check_ranges(self, path: str = "") -> None:
        """Request one byte to check for range requests: without them, each read would transfer the
        whole file.

        Raises:
            CarlascError: the server does not support range requests.
        """
        if not self._base.startswith("http"):
            return
        (answer,) = send([partial(self._get, path, 0, 1)], self.client.settings, attempts=2)
        if isinstance(answer, WrongAnswerError):
            raise CarlascError(
                self.where(path),
                expected="a server that supports range requests",
                found="a server without them",
                advice="download the file first",
            )
        self._data(path, answer)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_listed": {}, "_sizes": {}}  # a worker process lists folders again


def tree_of(
    place: str | os.PathLike[str], *, mapped: bool = True, **storage_options: Any
) -> LocalTree | RemoteTree:
    """Return the tree of files at a path or a URL. Nothing is read yet.

    Args:
        place: a folder, or its URL.
        mapped: whether files of a local folder are mapped into memory (see `LocalTree`).
        **storage_options: options of fsspec for the URL.
    """
    text = os.fspath(place)
    return (
        RemoteTree(text, storage_options)
        if is_url(text)
        else LocalTree(text.removeprefix("file://"), mapped=mapped)
    )


class RemoteFile(io.RawIOBase):
    """A remote file as a file object, for libraries that read one: h5py and pyarrow.

    It reads the file block by block, and caches the most recently used blocks.
    """

    def __init__(self, fetch: Callable[[int, int], bytes], size: int) -> None:
        """Create a file of `size` bytes.

        `fetch` returns the bytes [start, end). Nothing is fetched yet.
        """
        self._fetch, self._size, self._place = fetch, size, 0
        self._blocks: dict[int, bytes] = {}  # ordered by last use, the latest at the end

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a position and return it."""
        self._place = max(
            0, offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: self._size}[whence]
        )
        return self._place

    def tell(self) -> int:
        """Return the position in the file."""
        return self._place

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        """Read bytes into a buffer, and return their number."""
        view = memoryview(buffer).cast("B")
        start, end = self._place, min(self._place + len(view), self._size)
        if start >= end:
            return 0
        first, last = start // _BLOCK, (end - 1) // _BLOCK
        self._load(first, last)
        data = b"".join(self._blocks[number] for number in range(first, last + 1))
        view[: end - start] = data[start - first * _BLOCK : end - first * _BLOCK]
        self._place = end
        for number in range(first, last + 1):
            self._blocks[number] = self._blocks.pop(number)
        while len(self._blocks) > _KEPT:
            del self._blocks[next(iter(self._blocks))]
        return end - start

    def _load(self, first: int, last: int) -> None:
        """Fetch the blocks from `first` to `last` that are not cached.

        Adjacent blocks are fetched in one request.
        """
        number = first
        while number <= last:
            if number in self._blocks:
                number += 1
                continue
            stop = number + 1
            while stop <= last and stop not in self._blocks:
                stop += 1
            data = self._fetch(number * _BLOCK, min(stop * _BLOCK, self._size))
            for place in range(number, stop):
                offset = (place - number) * _BLOCK
                self._blocks[place] = data[offset : offset + _BLOCK]
            number = stop
