"""Where stores are written: a folder on this machine or in an object store. Every file is written whole, or not at all."""

from __future__ import annotations

import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from carlasc.errors import FormatError
from carlasc.storage.files import write_atomic, write_many
from carlasc.storage.folders.names import leads_outside
from carlasc.storage.folders.trees import LocalTree, Tree


class Target(ABC):
    """A folder of files that is written to. Paths in it are relative, their parts joined by "/". It can be pickled.

    Attributes:
        location: its name in errors: a folder or a URL.
        tree: reads what was written.
    """

    location: str
    tree: Tree

    @abstractmethod
    def below(self, folder: str) -> Target:
        """Return a folder in this one.

        Raises:
            FormatError: the path leads out of the folder.
        """

    @abstractmethod
    def put(self, path: str, data: bytes | memoryview, *, create: bool = False) -> bool:
        """Write a whole file, with the folders that it needs.

        Args:
            path: the file; an existing one is replaced unless `create` is given.
            data: its bytes.
            create: write only if the file does not exist. Of several processes that do so at once, exactly one succeeds.

        Returns:
            False if `create` is given and the file exists; True otherwise.

        Raises:
            FormatError: the path leads out of the folder.
            StorageError: it cannot be written; nothing is left behind.
        """

    def put_many(self, *groups: Mapping[str, bytes | memoryview]) -> None:
        """Write several files: those of a group side by side, and each group after those before it."""
        for group in groups:
            for path, data in group.items():
                self.put(path, data)

    @abstractmethod
    def paths(self, folder: str = "") -> Iterator[str]:
        """Yield the paths of all files below a folder, in any order; none if it does not exist."""

    @abstractmethod
    def remove(self, path: str) -> None:
        """Remove a file, or a folder with all files below it, if it exists."""

    def remove_many(self, paths: Iterable[str]) -> None:
        """Remove several files, if they exist; object stores do so with few requests."""
        for path in paths:
            self.remove(path)


class LocalTarget(Target):
    """A folder on this machine."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.location = str(self.folder)
        self.tree = LocalTree(self.folder)

    def below(self, folder: str) -> LocalTarget:
        """Return a folder in this one."""
        return LocalTarget(self._inside(folder))

    def put(self, path: str, data: bytes | memoryview, *, create: bool = False) -> bool:
        """Write a file under a temporary name, then rename it, or link it where only a new file is wanted."""
        return write_atomic(self._inside(path), data, create=create)

    def put_many(self, *groups: Mapping[str, bytes | memoryview]) -> None:
        """Write several files, which are synced together."""
        write_many(*({self._inside(path): data for path, data in group.items()} for group in groups))

    def paths(self, folder: str = "") -> Iterator[str]:
        """Walk the folders; the temporary files of writers are left out."""
        for root, _, names in os.walk(self._inside(folder) if folder else self.folder):
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
        if leads_outside(path):
            raise FormatError(path, expected=f"a path inside {self.folder}", found="one that leads elsewhere")
        return self.folder / path
