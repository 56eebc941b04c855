"""The output path of a packed store: check for existing files, and rename the finished store into
place.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from carlasc.errors import ArgumentError, ConflictError, FormatError, StorageError
from carlasc.storage.files import (
    AnyPath,
    make_folder,
    remove,
    rename,
    replaced,
    storage_error,
    write_at,
)

TABLES_MARK = "carlasc-tables.json"  # the file that makes a folder a store of tables
UNFINISHED_MARK = "unfinished.json"  # its name until the store is complete
_T = TypeVar("_T")
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Check that an output path is new, or is a packed store and `overwrite` is given.

    Raises:
        ArgumentError: the path has no name.
        ConflictError: existing data may not be overwritten.
    """
    if not path.name:
        raise ArgumentError("out", expected="the name of a store", found=f"{str(path)!r}")
    if not path.exists():
        return
    kind = "folder" if path.is_dir() else "file"
    if not overwrite:
        raise ConflictError(
            path,
            expected="a new path",
            found=f"a {kind}",
            advice="choose another name, remove it, or give `overwrite=True` if the command has "
            "this option",
        )
    if not _is_store(path):
        raise ConflictError(
            path,
            expected="a packed store to overwrite",
            found=f"another {kind}",
            advice="choose another name",
        )


def _is_store(path: Path) -> bool:
    if path.is_dir():
        return any((path / mark).is_file() for mark in ("zarr.json", TABLES_MARK))
    with path.open("rb") as file:
        return file.read(len(HDF5_SIGNATURE)) == HDF5_SIGNATURE


def unfinished_error(where: AnyPath) -> FormatError:
    """Return the error for an unfinished store of any format: it is being written, or the run was
    interrupted.
    """
    return FormatError(
        where,
        expected="a finished store",
        found="an unfinished one: a run is writing it, or was interrupted",
        advice="run the same command again to finish it (`carlasc finish` if all parts of a .zarr "
        "store are written)",
    )


def put_in_place(finished: Path, path: Path, overwrite: bool) -> None:
    """Rename a finished store to its final path. An older store is removed after that.

    Raises:
        ConflictError: something exists there that may not be overwritten.
        StorageError: it cannot be renamed.
    """
    old = replaced(path)
    try:
        if path.exists():
            refuse_existing(path, overwrite)
            remove(old)
            path.rename(old)
        rename(finished, path)
        if overwrite:
            remove(old)  # also removes what a run left that was killed here
    except OSError as error:
        raise StorageError(
            path, problem=f"cannot be put in place: {error.strerror or error}"
        ) from error


class DeferredErrorFile(io.RawIOBase):
    """A new file for libraries that do not handle failed writes.

    After a failed write, h5py crashes, pyarrow prints an error of its destructor, and Foxglove
    ignores it or raises one of its own, also after Ctrl-C. This file keeps the first error and
    drops all later writes; `check` raises the error.
    """

    def __init__(self, path: Path, place: Path | None) -> None:
        """Create the file.

        Args:
            path: the file.
            place: final path of the file, for errors; None if the caller names it: `check` then
                raises the original error.

        Raises:
            StorageError: it cannot be created.
        """
        super().__init__()
        self._path = path
        self._place = place
        self._position = self._size = 0
        self._error: OSError | KeyboardInterrupt | None = None
        self._descriptor = -1  # until it is open
        try:
            make_folder(path.parent)
            # an abandoned writer of this process may still write to the old file
            path.unlink(missing_ok=True)
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        except OSError as error:
            raise storage_error(place or path, error) from error

    def check(self) -> None:
        """Raise the error of the first write that failed.

        Raises:
            StorageError: a write failed.
        """
        if self._error is not None:
            if self._place is None or isinstance(self._error, KeyboardInterrupt):
                raise self._error
            raise storage_error(self._place, self._error) from self._error

    def _unless_failed(self, call: Callable[..., _T], *arguments: Any) -> _T | None:
        """Call a function unless an earlier call failed; None if this one or an earlier one did."""
        if self._error is None:
            try:
                return call(*arguments)
            except (OSError, KeyboardInterrupt) as error:
                self._error = error
        return None

    def readable(self) -> bool:
        """Return True."""
        return True

    def writable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def tell(self) -> int:
        """Return the position."""
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position and return it."""
        self._position = (
            offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        )
        return self._position

    def write(self, data: Any) -> int:
        """Write all bytes at the position."""
        view = memoryview(data).cast("B")
        self._unless_failed(write_at, self._descriptor, view, self._position)
        self._position += len(view)
        self._size = max(self._size, self._position)
        return len(view)

    def readinto(self, buffer: Any) -> int:
        """Read bytes at the position; zeros after an error."""
        view = memoryview(buffer).cast("B")
        self._unless_failed(os.lseek, self._descriptor, self._position, os.SEEK_SET)
        data = self._unless_failed(os.read, self._descriptor, len(view))
        if data is None:
            data = bytes(len(view))
        view[: len(data)] = data
        self._position += len(data)
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """Set the size."""
        self._size = self._position if size is None else size
        self._unless_failed(os.ftruncate, self._descriptor, self._size)
        return self._size

    def close(self) -> None:
        """Close the file, if it is open."""
        if not self.closed:
            super().close()
            try:
                if self._descriptor >= 0:  # Python also calls this if the file could not be created
                    os.close(self._descriptor)
            except OSError as error:  # network file systems may report failed writes here
                self._error = self._error or error
