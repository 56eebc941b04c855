"""Output folders of stores, on this machine or in an object store.

Every file is written whole or not at all.
"""

from __future__ import annotations

import copy
import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.running.spreading import Run
from carlasc.storage.files import AnyPath, leads_outside, write_atomic, write_many
from carlasc.storage.transport.remote_tree import RemoteTree
from carlasc.storage.transport.trees import LocalTree, Tree, is_url

_MOST_REMOVED = 1000  # objects in one request: the limit of S3


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


def check_shared(location: str, run: Run) -> None:
    """Check that all processes of a run can access the output: `memory://` exists in one process
    only.

    Raises:
        ArgumentError: the output is in memory, and the run has several processes.
    """
    if location.startswith("memory://") and not run.is_alone:
        found = "an executor" if run.executor is not None else str(run.processes)
        raise ArgumentError(
            "workers", expected=f"1 with {location}, which exists in one process only", found=found
        )
