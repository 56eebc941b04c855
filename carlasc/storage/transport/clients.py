"""Clients: what can be asked of a server, whatever its kind.

`object_stores` has the client of S3, Google Cloud Storage and Azure, `web` those of web servers and
of the Hugging Face Hub. This module has that of any other file system of fsspec.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any

from carlasc.errors import CarlascError, without_credentials
from carlasc.storage.transport.requests import RemoteSettings

HUB = "hf"
"""The scheme of the URLs of the Hugging Face Hub (`hf://datasets/ORG/NAME/...`)."""

# Names that file systems use for a digest of the content, or the time of the last change.
_CHANGES = ("ETag", "etag", "mtime", "modified", "created", "blob_id")


class Client(ABC):
    """Sends one request at a time to the server of one URL. Several threads may share it.

    It can be pickled; each process opens its own connections.

    Attributes:
        url: the URL, which may contain credentials.
        options: storage options, also those in variables such as FSSPEC_S3_ANON.
        settings: how requests are sent.
        exclusive: whether `put` with a mark succeeds in one process only.
        read_only: what the server is, if it cannot be written to.
    """

    exclusive = False
    read_only = ""

    def __init__(self, url: str, options: Mapping[str, Any]) -> None:
        from fsspec.config import conf

        self.url = url
        self.scheme = url.partition("://")[0]
        self.options = {**conf.get(self.scheme, {}), **options}
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
    def entries(self, url: str) -> dict[str, bool]:
        """Return the names in a folder, mapped to whether they are folders."""

    @abstractmethod
    def files(self, url: str) -> dict[str, tuple[int, str]]:
        """Return what `about` says of all files below a folder by path relative to it, or of the
        file itself under "".
        """

    def put(self, url: str, data: bytes, mark: str | None = None) -> bool:
        """Write a whole file.

        Args:
            url: the file.
            data: its bytes.
            mark: write only if the file does not exist. The text identifies the writer: a put that
                is repeated with the same mark succeeds if the first one did.

        Returns:
            False if the file exists, and `mark` is given; True otherwise.
        """
        raise NotImplementedError(self.read_only)

    def remove(self, urls: Iterable[str]) -> None:
        """Remove files, if they exist."""
        raise NotImplementedError(self.read_only)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_opened": None}


class FileSystemClient(Client):
    """The client of a file system of fsspec, by its public methods."""

    def __init__(self, url: str, options: Mapping[str, Any]) -> None:
        super().__init__(url, options)
        self.exclusive = self.scheme == "memory"

    def open(self) -> Any:
        """Return the file system."""
        from fsspec.core import url_to_fs

        try:
            return url_to_fs(self.url, **self.options)[0]
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
        if info["type"] == "directory":
            return None
        return _described(info)

    def entries(self, url: str) -> dict[str, bool]:
        """List a folder."""
        try:
            listed = self.connection.ls(url, detail=True)
        except (FileNotFoundError, NotADirectoryError):
            return {}
        own = self._own_name(url)
        names = ((entry["name"].strip("/"), entry["type"] == "directory") for entry in listed)
        return {name.rpartition("/")[2]: folder for name, folder in names if name not in ("", own)}

    def _own_name(self, url: str) -> str:
        """Return the name of a folder in listings: some file systems list it among its files."""
        return str(self.connection.unstrip_protocol(url)).partition("://")[2].strip("/")

    def files(self, url: str) -> dict[str, tuple[int, str]]:
        """List all files below a folder."""
        try:
            listed = self.connection.find(url, detail=True)
        except FileNotFoundError:
            return {}
        root = self._own_name(url)
        return {
            name.strip("/").removeprefix(root).lstrip("/"): _described(about)
            for name, about in listed.items()
            if not name.endswith("/")
        }

    def put(self, url: str, data: bytes, mark: str | None = None) -> bool:
        """Write a file."""
        if mark is None:
            self.connection.pipe_file(url, data)
        elif self.exclusive:
            try:
                self.connection.pipe_file(url, data, mode="create")
            except FileExistsError:
                return False
        elif self.about(url) is None:
            self.connection.pipe_file(url, data)
        else:
            return False
        return True

    def remove(self, urls: Iterable[str]) -> None:
        """Remove files, one by one."""
        for url in urls:
            try:
                self.connection.rm_file(url)
            except FileNotFoundError:
                continue


def _described(info: Mapping[str, Any]) -> tuple[int, str]:
    """Return the size of a file, and a text that changes with it."""
    return info["size"], " ".join(str(info[name]) for name in _CHANGES if info.get(name))
