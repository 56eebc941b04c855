"""Clients: what can be asked of a server, whatever its kind.

`object_stores` has the client of S3, Google Cloud Storage and Azure, `web` that of web servers.
This module has the others: the Hugging Face Hub, and any file system of fsspec.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any

from carlasc.errors import CarlascError, import_extra, without_credentials
from carlasc.storage.transport.failures import WrongAnswerError
from carlasc.storage.transport.requests import RemoteSettings

HUB = "hf"
"""The scheme of the URLs of the Hugging Face Hub (`hf://datasets/ORG/NAME/...`)."""

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


class Client(ABC):
    """Sends one request at a time to the server of one URL. Several threads may share it.

    It can be pickled; each process opens its own connections.

    Attributes:
        url: the URL, which may contain credentials.
        options: storage options.
        settings: how requests are sent.
        exclusive: whether `put` with a mark succeeds in one process only.
    """

    exclusive = False

    def __init__(self, url: str, options: Mapping[str, Any]) -> None:
        self.url, self.options = url, dict(options)
        self.scheme = url.partition("://")[0]
        self.settings = RemoteSettings.from_environment()
        self._opened: tuple[int, Any] | None = None

    @abstractmethod
    def open(self) -> Any:
        """Return a new connection: a store or a file system of the library."""

    @property
    def connection(self) -> Any:
        """The connection of this process. A forked process opens a new one."""
        if self._opened is None or self._opened[0] != os.getpid():
            self._opened = (os.getpid(), self.open())
        return self._opened[1]

    @abstractmethod
    def get(self, url: str, start: int | None = None, end: int | None = None) -> bytes:
        """Return the bytes [start, end) of a file, or the whole file.

        The result is shorter if the file ends before the range does.

        Raises:
            FileNotFoundError: the file does not exist.
            WrongAnswerError: the answer does not fit the request.
            Exception: the request failed, with an error of the library.
        """

    @abstractmethod
    def about(self, url: str) -> tuple[int, str] | None:
        """Return the size of a file in bytes, and a text that changes with the file, if the server
        reports changes; None if the file does not exist, or is a folder or a page that lists one.
        """

    @abstractmethod
    def entries(self, url: str) -> dict[str, int | None]:
        """Return the names in a folder with the sizes of files, None for folders and for files
        whose size is not listed (web servers); names of folders end in "/".
        """

    @abstractmethod
    def files(self, url: str) -> dict[str, int]:
        """Return the sizes of all files below a folder by path relative to it, or that of the file
        itself under "".
        """

    @abstractmethod
    def put(self, url: str, data: bytes, mark: str | None = None) -> None:
        """Write a whole file.

        Args:
            url: the file.
            data: its bytes.
            mark: write only if the file does not exist. The text identifies the writer: a put that
                is repeated with the same mark succeeds if the first one did.

        Raises:
            FileExistsError: the file exists, and `mark` is given.
        """

    @abstractmethod
    def remove(self, urls: Iterable[str]) -> None:
        """Remove files, if they exist."""

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_opened": None}


class FileSystemClient(Client):
    """The client of a file system of fsspec, by its public methods."""

    def __init__(self, url: str, options: Mapping[str, Any]) -> None:
        super().__init__(url, options)
        self.exclusive = self.scheme == "memory"

    def open(self, **more: Any) -> Any:
        """Return the file system."""
        from fsspec.core import url_to_fs

        try:
            return url_to_fs(self.url, **(more | self.options))[0]
        except (ValueError, ImportError) as error:
            where = without_credentials(self.url)
            raise CarlascError(where, problem=f"cannot be opened: {error}") from None

    def get(self, url: str, start: int | None = None, end: int | None = None) -> bytes:
        """Return bytes of a file."""
        return bytes(self.connection.cat_file(url, start=start, end=end))

    def about(self, url: str) -> tuple[int, str] | None:
        """Describe a file."""
        try:
            self.connection.invalidate_cache(url)
            info = self.connection.info(url)
        except (FileNotFoundError, IsADirectoryError):
            return None
        if info.get("type") == "directory" or info.get("mimetype") == "text/html":
            return None
        return info["size"], " ".join(str(info[name]) for name in _CHANGES if info.get(name))

    def entries(self, url: str) -> dict[str, int | None]:
        """List a folder."""
        try:
            listed = self.connection.ls(url, detail=True)
        except (FileNotFoundError, NotADirectoryError):
            return {}
        own = self._own_name(url)
        names = {}
        for entry in listed:
            name = str(entry["name"])
            base = name.rstrip("/").rpartition("/")[2]
            if base and name.strip("/") != own and "?" not in base:
                folder = entry["type"] == "directory" or name.endswith("/")
                size = entry.get("size")
                names[f"{base}/" if folder else base] = size if isinstance(size, int) else None
        return names

    def _own_name(self, url: str) -> str:
        """Return the name of a folder in listings: some file systems list it among its files."""
        return str(self.connection.unstrip_protocol(url)).partition("://")[2].strip("/")

    def files(self, url: str) -> dict[str, int]:
        """List all files below a folder."""
        try:
            listed = self.connection.find(url, detail=True)
        except FileNotFoundError:
            return {}
        root = self._own_name(url)
        return {
            name.strip("/").removeprefix(root).lstrip("/"): about["size"]
            for name, about in listed.items()
            if not name.endswith("/")
        }

    def put(self, url: str, data: bytes, mark: str | None = None) -> None:
        """Write a file."""
        if mark is not None and not self.exclusive and self.about(url) is not None:
            raise FileExistsError(url)
        options = {"mode": "create"} if mark is not None and self.exclusive else {}
        self.connection.pipe_file(url, data, **options)

    def remove(self, urls: Iterable[str]) -> None:
        """Remove files, one by one."""
        for url in urls:
            try:
                self.connection.rm_file(url)
            except FileNotFoundError:
                continue


class HubClient(FileSystemClient):
    """The client of the Hugging Face Hub.

    The library lists files. Bytes are fetched here, because it repeats requests by its own rules,
    and does not compare the range that it receives with the one that it requested.
    """

    def __init__(self, url: str, options: Mapping[str, Any]) -> None:
        super().__init__(url, options)
        import_extra("huggingface_hub", "hub")

    def get(self, url: str, start: int | None = None, end: int | None = None) -> bytes:
        """Return bytes of a file with one request."""
        hub = import_extra("huggingface_hub.utils", "hub")
        headers = dict(hub.build_hf_headers(token=self.connection.token))
        if start is not None and end is not None:
            headers["Range"] = f"bytes={start}-{end - 1}"
        answer = hub.get_session().get(
            self.connection.url(url), headers=headers, timeout=self.settings.timeout_s
        )
        if answer.status_code == 416:  # the range starts after the end of the file
            return b""
        if answer.status_code == 404:
            raise FileNotFoundError(url)
        hub.hf_raise_for_status(answer)
        if start is not None:
            if answer.status_code != 206:
                raise WrongAnswerError("the whole file instead of a range")
            check_range(answer.headers.get("Content-Range"), start, end)
        return bytes(answer.content)


def check_range(header: str | None, start: int, end: int | None) -> None:
    """Compare the header Content-Range, "bytes 0-99/1000", with the requested range.

    The file may end before the range does.

    Args:
        header: the header; None if the server sent none.
        start: first requested byte.
        end: end of the requested range, exclusive; None for the end of the file.

    Raises:
        WrongAnswerError: the header has another range.
    """
    first, _, last = (header or "").removeprefix("bytes ").partition("/")[0].partition("-")
    if header is not None and not (
        first == str(start) and last.isdigit() and (end is None or int(last) < end)
    ):
        raise WrongAnswerError("another range of the file")
