"""Remote folders and files: trees of files at a URL, remote files as file objects, and output
folders at a URL.
"""

from __future__ import annotations

import copy
import io
import os
import posixpath
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, TypeVar

from carlasc.errors import ArgumentError, MissingDataError, without_credentials
from carlasc.storage.files import AnyPath
from carlasc.storage.transport.clients import HUB, Client, FileSystemClient
from carlasc.storage.transport.failures import WrongAnswerError, fail
from carlasc.storage.transport.object_stores import SCHEMES, ObjectStoreClient
from carlasc.storage.transport.requests import send
from carlasc.storage.transport.trees import (
    LocalTarget,
    LocalTree,
    Target,
    Tree,
    check_length,
    from_start,
    is_url,
)
from carlasc.storage.transport.web import HubClient, WebClient

_BLOCK = 1 << 18  # bytes per block of a remote file
_KEPT = 64  # blocks
_MOST_REMOVED = 1000  # objects in one request: the limit of S3
_CLIENTS: Mapping[str, type[Client]] = {
    **dict.fromkeys(SCHEMES, ObjectStoreClient),
    **dict.fromkeys(("http", "https"), WebClient),
    HUB: HubClient,
}

_Answer = TypeVar("_Answer")


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
        self._base = base.rstrip("/")
        self._query = mark + query
        self.location = without_credentials(self._base)
        kind = _CLIENTS.get(url.partition("://")[0], FileSystemClient)
        self.client = kind(url.rstrip("/"), options or {})
        self._listed: dict[str, dict[str, bool]] = {}

    def url(self, path: str = "") -> str:
        """Return the URL of a file.

        It may contain credentials, so it must not be shown; use `where` for messages.
        """
        return f"{self._base}/{path}{self._query}" if path else self._base + self._query

    def below(self, folder: str) -> RemoteTree:
        """Return the tree of a folder in this one."""
        tree = copy.copy(self)
        if folder:
            tree._base = f"{self._base}/{folder}"
            tree.location = self.where(folder)
        tree._listed = {}
        return tree

    def ask(
        self, function: Callable[..., _Answer], *calls: tuple[Any, ...], writing: bool = False
    ) -> list[_Answer]:
        """Send requests, several at a time, and return their answers.

        Args:
            function: sends one request: a method of the client that takes a URL first.
            calls: its arguments, with a path in the place of the URL.
            writing: whether the requests write the files (see `fail`).

        Raises:
            CarlascError: a request failed; the message names the path (see `fail`).
        """
        requests = [partial(function, self.url(path), *more) for path, *more in calls]
        answers: list[_Answer] = []
        for (path, *_), answer in zip(calls, send(requests, self.client.settings), strict=True):
            if isinstance(answer, Exception):
                fail(self.where(path), answer, writing=writing)
            answers.append(answer)
        return answers

    def entries(self, folder: str = "") -> Mapping[str, bool]:
        """List the folder, once."""
        if folder not in self._listed:
            self._listed[folder] = self.ask(self.client.entries, (folder,))[0]
        return self._listed[folder]

    def refresh(self) -> None:
        """Discard cached listings, because other processes may have written files."""
        self._listed = {}

    def note(self, path: str, exists: bool) -> None:
        """Update listings after this process wrote a file or removed it."""
        name = path
        is_folder = False
        while name:
            folder, _, base = name.rpartition("/")
            listed = self._listed.get(folder, {})
            if exists:
                listed[base] = is_folder
            elif not is_folder:
                listed.pop(base, None)
            name = folder
            is_folder = True

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
        return {path: size for path, (size, _) in self._versions(folder).items()}

    def states(self, paths: Sequence[str]) -> dict[str, str]:
        """Return the size and the version of each file, from one listing of the folder above."""
        if not paths:
            return {}
        known = self._versions(posixpath.commonpath([posixpath.dirname(path) for path in paths]))
        return {
            path: f"{known[path][0]} {known[path][1]}" if known.get(path, (0, ""))[1] else ""
            for path in paths
        }

    def _versions(self, folder: str) -> dict[str, tuple[int, str]]:
        """Return the sizes and versions of all files below a folder, by path."""
        files = self.ask(self.client.files, (folder,))[0]
        return {"/".join(filter(None, (folder, name))): about for name, about in files.items()}

    def read_many(self, paths: Sequence[str], size: int | None = None) -> list[bytes | memoryview]:
        """Fetch the files, several at a time."""
        return [*self.ask(self.client.get, *((path,) for path in paths))]

    def read_ranges(self, ranges: Sequence[tuple[str, int, int]]) -> list[bytes | memoryview]:
        """Fetch the ranges, several at a time."""
        sizes = {path: self.version(path)[0] for path, start, _ in ranges if start < 0}
        wanted = [(p, *from_start(start, end, sizes.get(p, 0))) for p, start, end in ranges]
        asked = [part for part in wanted if part[1] < part[2]]
        answers = iter(self.ask(self._range, *asked))
        parts = [(part, next(answers) if part[1] < part[2] else b"") for part in wanted]
        return [
            check_length(data, max(0, end - start), self.where(path))
            for (path, start, end), data in parts
        ]

    def _range(self, url: str, start: int, end: int) -> bytes:
        """Send the request for a range.

        Raises:
            WrongAnswerError: the answer is short, although the file does not end there.
        """
        data = self.client.get(url, start, end)
        if len(data) != end - start and (about := self.client.about(url)) and about[0] >= end:
            raise WrongAnswerError(f"{len(data)} bytes instead of {end - start}")
        return data

    def open(self, path: str) -> Any:
        """Open a file as a file object, which fetches blocks on demand.

        For libraries that take file objects.
        """
        return RemoteFile(partial(self.read_range, path), self.version(path)[0])

    def size(self, path: str = "") -> int | None:
        """Return a file's size in bytes; None if it does not exist or is a folder (or a page that
        lists one).
        """
        about = self.ask(self.client.about, (path,))[0]
        return None if about is None else about[0]

    def version(self, path: str) -> tuple[int, str]:
        """Return the size of a file in bytes, and a text that changes with the file, if the server
        reports changes.

        A request is sent each time, regardless of listings.

        Raises:
            MissingDataError: the file does not exist.
        """
        about = self.ask(self.client.about, (path,))[0]
        if about is None:
            raise MissingDataError(self.where(path), expected="a file", found="nothing")
        return about

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_listed": {}}  # a worker process lists folders again


def tree_of(
    place: AnyPath, *, mapped: bool = True, **storage_options: Any
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

    It reads the file block by block, and caches the most recently used blocks. What is longer than
    a block is read with one request.
    """

    def __init__(self, fetch: Callable[[int, int], bytes | memoryview], size: int) -> None:
        """Create a file of `size` bytes.

        `fetch` returns the bytes [start, end). Nothing is fetched yet.
        """
        self._fetch = fetch
        self._size = size
        self._place = 0
        self._block = lru_cache(_KEPT)(self._fetch_block)

    def _fetch_block(self, number: int) -> bytes | memoryview:
        return self._fetch(number * _BLOCK, min((number + 1) * _BLOCK, self._size))

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

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        """Read bytes into a buffer, and return their number."""
        view = memoryview(buffer).cast("B")
        start = self._place
        end = min(self._place + len(view), self._size)
        if start >= end:
            return 0
        if end - start > _BLOCK:
            data = self._fetch(start, end)
        else:
            first = start // _BLOCK
            last = (end - 1) // _BLOCK
            blocks = b"".join(map(self._block, range(first, last + 1)))
            data = blocks[start - first * _BLOCK : end - first * _BLOCK]
        view[: end - start] = data
        self._place = end
        return end - start


class RemoteTarget(Target):
    """A folder in an object store: a prefix of the keys of a bucket.

    An object exists only after all its bytes have arrived, so an upload is complete or absent.
    Folders need not be created.

    Attributes:
        exclusive: whether the store has a create-only put, as S3 ("If-None-Match: *"), Google
            Cloud Storage and Azure do. In others, `put` with `create` first checks whether the file
            exists, so that two processes may both succeed.
    """

    tree: RemoteTree

    def __init__(self, url: str, options: Mapping[str, Any] | None = None) -> None:
        """Keep the URL of a folder and the fsspec storage options. No request is sent yet.

        Raises:
            ArgumentError: the URL cannot be written to, such as http and the Hugging Face Hub.
            DependencyError: the URL needs a package that is not installed.
        """
        self.tree = RemoteTree(url, options)
        self.location = self.tree.location
        if found := self.tree.client.read_only:
            raise ArgumentError(
                self.location,
                expected="a folder, or a URL of an object store",
                found=found,
                advice="write to a local folder, then upload it (Hub: `hf upload-large-folder`)",
            )
        self.exclusive = self.tree.client.exclusive

    def below(self, folder: str) -> RemoteTarget:
        """Return a folder in this one."""
        target = copy.copy(self)
        target.tree = self.tree.below(self._checked(folder))
        target.location = target.tree.location
        return target

    def put(self, path: str, data: bytes | memoryview, *, create: bool = False) -> bool:
        """Write an object with one request."""
        return all(self._put({path: data}, os.urandom(16).hex() if create else None))

    def put_many(self, *groups: Mapping[str, bytes | memoryview]) -> None:
        """Write the objects of each group in parallel."""
        for group in groups:
            self._put(group)

    def _put(self, files: Mapping[str, bytes | memoryview], mark: str | None = None) -> list[bool]:
        puts = [(self._checked(path), bytes(data), mark) for path, data in files.items()]
        written = self.tree.ask(self.tree.client.put, *puts, writing=True)
        for path in files:
            self.tree.note(path, True)
        return written

    def paths(self, folder: str = "") -> Iterator[str]:
        """List all objects below the folder, 1000 per request."""
        return self.tree.paths(self._checked(folder))

    def remove(self, path: str) -> None:
        """Remove the object of this name, and all objects below it."""
        self.remove_many(self.paths(path))

    def remove_many(self, paths: Iterable[str]) -> None:
        """Remove objects, in S3 1000 per request. Missing objects are ignored."""
        names = [self._checked(path) for path in paths]
        urls = [self.tree.url(name) for name in names]
        batches = [("", urls[i : i + _MOST_REMOVED]) for i in range(0, len(urls), _MOST_REMOVED)]
        self.tree.ask(lambda _, batch: self.tree.client.remove(batch), *batches, writing=True)
        for name in names:
            self.tree.note(name, False)


def target_of(out: AnyPath | Target, **storage_options: Any) -> Target:
    """Return the Target for a path or a URL.

    A Target is returned unchanged. Nothing is written yet.

    Args:
        out: a folder, or the URL of one in an object store.
        **storage_options: options of fsspec for the URL.

    Raises:
        ArgumentError: nothing can be written to the URL.
        DependencyError: the URL needs a package that is not installed.
    """
    if isinstance(out, Target):
        return out
    text = os.fspath(out)
    return (
        RemoteTarget(text, storage_options)
        if is_url(text)
        else LocalTarget(text.removeprefix("file://"))
    )
