"""The place of a packed store: what may be overwritten, and how a finished store gets its name."""

from __future__ import annotations

import shutil
from pathlib import Path

from carlasc.errors import ArgumentError, ConflictError, StorageError

TABLES_MARK = "carlasc-tables.json"  # the file that makes a folder a store of tables
UNFINISHED_MARK = "unfinished.json"  # in its place until the store is whole
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Refuse to write over something that exists, and over anything but a packed store even with `overwrite`.

    Raises:
        ArgumentError: the path has no name.
        ConflictError: something exists there that may not be overwritten.
    """
    if not path.name:
        raise ArgumentError("out", expected="the name of a store", found=f"{str(path)!r}")
    if not path.exists():
        return
    kind = "folder" if path.is_dir() else "file"
    if not overwrite:
        raise ConflictError(
            path, expected="nothing there", found=f"a {kind}", advice="choose another name, or give `overwrite=True`"
        )
    if path.is_dir():
        is_store = any((path / mark).is_file() for mark in ("zarr.json", TABLES_MARK))
    else:
        with path.open("rb") as file:
            is_store = file.read(len(HDF5_SIGNATURE)) == HDF5_SIGNATURE
    if not is_store:
        raise ConflictError(
            path, expected="a packed store to overwrite", found=f"another {kind}", advice="choose another name"
        )


def unfinished(path: Path) -> Path:
    """Return where a store or a folder is written until it is whole: `<name>.part` beside it."""
    return path.with_name(f"{path.name}.part")


def put_in_place(finished: Path, path: Path, overwrite: bool) -> None:
    """Rename a finished store to its name; an older one is removed only then.

    Raises:
        ConflictError: something exists there that may not be overwritten.
        StorageError: it cannot be renamed.
    """
    try:
        if path.exists():
            refuse_existing(path, overwrite)
            old = path.with_name(f"{path.name}.old")
            remove(old)
            path.rename(old)
            finished.rename(path)
            remove(old)
        else:
            finished.rename(path)
    except OSError as error:
        raise StorageError(path, problem=f"cannot be put in place: {error.strerror or error}") from error


def remove(path: Path) -> None:
    """Remove a file or a folder, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
