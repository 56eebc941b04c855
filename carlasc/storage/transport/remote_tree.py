"""Remote folders and files: a tree of files at a URL, and a remote file as a file object."""

from __future__ import annotations

import copy
import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from carlasc.errors import CarlascError, MissingDataError, without_credentials
from carlasc.storage.transport.failures import WrongAnswerError, bucket_is_missing, fail
from carlasc.storage.transport.requests import Request, Requests
from carlasc.storage.transport.servers import check_size
from carlasc.storage.transport.trees import LocalTree, Tree, check_length, is_url

_BLOCK = 1 << 18  # bytes per block of a remote file
_KEPT = 64  # blocks

# Names that file systems use for a digest of the content, or the time of the last change.
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


class RemoteTree(Tree):
    """A folder, or a single file (path ""), at any URL that fsspec supports: http, s3, memory, ...

    A folder is listed once. `size`, `read` and `paths` send a request each time.
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
        self.requests = Requests(url.rstrip("/"), options)
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
            url = self.url(folder)
            if url.startswith("http") and not self._query:
                url += "/"
            (found,) = self.requests.send([Request("ls", url, {"detail": True})])
            if isinstance(found, FileNotFoundError | NotADirectoryError) and not bucket_is_missing(
                found
            ):
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
        """Return the name of the folder itself in its listing: object stores list it among its
        files.
        """
        place = f"{self._base}/{folder}" if folder else self._base
        return (place if place.startswith("http") else self.requests.path_of(place)).strip("/")

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
        (found,) = self.requests.send([Request("find", self.url(folder), {"detail": True})])
        if isinstance(found, FileNotFoundError) and not bucket_is_missing(found):
            return {}
        if isinstance(found, Exception):
            fail(self.where(folder), found)
        root = self.requests.path_of(self._base).rstrip("/") + "/"
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
        """Fetch the files, several at a time.

        Their lengths are checked if their folder has been listed.
        """
        requests = [Request("get", self.url(path), {}, self._length_check(path)) for path in paths]
        answers = self.requests.send(requests)
        for place, (path, answer) in enumerate(zip(paths, answers, strict=True)):
            # the file may have been replaced since the listing
            if isinstance(answer, WrongAnswerError):
                self._sizes[path] = self._size(path)
                (answers[place],) = self.requests.send(
                    [Request("get", self.url(path), {}, self._length_check(path))]
                )
            if isinstance(answers[place], Exception):
                fail(self.where(path), answers[place])
        return [bytes(data) for data in answers]

    def _length_check(self, path: str) -> Callable[[bytes], None] | None:
        expected = self._sizes.get(path)
        return None if expected is None else partial(check_size, expected)

    def read_ranges(self, ranges: Sequence[tuple[str, int, int]]) -> list[bytes]:  # type: ignore[override]
        """Fetch the ranges, several at a time."""
        sizes = {
            path: self._size(path) for path in {path for path, start, _ in ranges if start < 0}
        }
        wanted = [
            (p, max(0, sizes[p] + s), sizes[p] + e) if s < 0 else (p, s, e) for p, s, e in ranges
        ]
        asked = [part for part in wanted if part[1] < part[2]]
        answers = iter(
            self.requests.send(
                [Request("get", self.url(p), {"start": s, "end": e}) for p, s, e in asked]
            )
        )
        return [self._checked(part, next(answers)) if part[1] < part[2] else b"" for part in wanted]

    def _checked(self, part: tuple[str, int, int], answer: Any) -> bytes:
        """Return an answer of the right length.

        After a short answer the request is sent again, unless the file ends there.
        """
        path, start, end = part
        if isinstance(answer, Exception):
            fail(self.where(path), answer)
        if len(answer) != end - start and self._size(path) >= end:
            check = partial(check_size, end - start)
            (answer,) = self.requests.send(
                [Request("get", self.url(path), {"start": start, "end": end}, check)]
            )
            if isinstance(answer, Exception):
                fail(self.where(path), answer)
        return check_length(bytes(answer), end - start, self.where(path))

    def open(self, path: str) -> Any:
        """Open a file as a file object, which fetches blocks on demand.

        For libraries that take file objects.
        """
        return RemoteFile(partial(self.read_range, path), self._size(path))

    def size(self, path: str = "") -> int | None:
        """Return a file's size in bytes; None if it does not exist or is a folder (or a page that
        lists one).
        """
        found = self._about(path)
        return None if found is None else found["size"]

    def version(self, path: str) -> tuple[int, str]:
        """Return the size of a file in bytes, and a text that changes with the file, if the server
        reports changes.

        A request is sent each time, regardless of listings.

        Raises:
            MissingDataError: the file does not exist.
        """
        self.requests.fs.invalidate_cache(self.url(path))
        found = self._about(path)
        if found is None:
            raise MissingDataError(self.where(path), expected="a file", found="nothing")
        return found["size"], " ".join(str(found[name]) for name in _CHANGES if found.get(name))

    def _about(self, path: str) -> dict[str, Any] | None:
        """Return the fsspec info of a file; None if it does not exist or is a folder (or a page
        that lists one).
        """
        (found,) = self.requests.send([Request("info", self.url(path))])
        if isinstance(found, FileNotFoundError | IsADirectoryError) and not bucket_is_missing(
            found
        ):
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
        """Request one byte to check for range requests: without them, each read would transfer the
        whole file.

        Raises:
            CarlascError: the server does not support range requests.
        """
        if not self._base.startswith("http"):
            return
        (answer,) = self.requests.send(
            [Request("get", self.url(path), {"start": 0, "end": 1})], attempts=2
        )
        if isinstance(answer, WrongAnswerError):
            raise CarlascError(
                self.where(path),
                expected="a server that supports range requests",
                found="a server without them",
                advice="download the file first",
            )
        if isinstance(answer, Exception):
            fail(self.where(path), answer)

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
