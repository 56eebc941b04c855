"""Extracting a zip into a folder.

No file is written outside of it, each file is written whole, and an interrupted run can continue.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import BinaryIO

from carlasc.errors import ConflictError, StorageError
from carlasc.storage.arrays import check_ratio
from carlasc.storage.files import remove_stale, write_many
from carlasc.storage.transport.trees import LocalTree
from carlasc.storage.transport.zipped import ZipTree

_TOGETHER = 32  # files that are synced together


def extract_zip(archive: Path, folder: Path, advance: Callable[[int], None]) -> int:
    """Extract all files of a zip. Files that an earlier run extracted are skipped.

    Args:
        archive: the zip.
        folder: folder to write to.
        advance: called with the number of bytes of each file.

    Returns:
        The number of files in the zip.

    Raises:
        FormatError: the zip is damaged, or has a link or a name that leads out of the folder. In
            the latter cases nothing is extracted.
        ConflictError: another file of the same name exists.
        StorageError: the disk is full, or the folder cannot be written to.
    """
    tree = _tree(archive)
    sizes = tree.sizes()
    total = sum(sizes.values())
    check_ratio(total, archive.stat().st_size, str(archive))
    missing = [path for path, size in sizes.items() if not _extracted(folder / path, size)]
    needed = sum(sizes[path] for path in missing)
    check_space(folder, needed, f"to extract {archive.name}")
    advance(total - needed)
    for parent in {(folder / path).parent for path in missing}:
        remove_stale(parent)
    for start in range(0, len(missing), _TOGETHER):
        batch = missing[start : start + _TOGETHER]
        write_many({folder / path: partial(_copy, tree, path) for path in batch})
        advance(sum(sizes[path] for path in batch))
    return len(sizes)


def extracted_size(archive: Path) -> int:
    """Return the bytes of the files in a zip.

    Raises:
        FormatError: it is not a zip, or it is damaged.
    """
    return sum(_tree(archive).sizes().values())


def _tree(archive: Path) -> ZipTree:
    return ZipTree(LocalTree(archive.parent), archive.name)


def _copy(tree: ZipTree, path: str, file: BinaryIO) -> None:
    file.write(tree.read(path))


def check_space(folder: Path, needed: int, purpose: str) -> None:
    """Check that a disk has enough free space, before anything is written.

    Raises:
        StorageError: the free space is too small.
    """
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    if needed > free:
        raise StorageError(
            folder,
            expected=f"{needed / 1e9:.1f} GB of free space {purpose}",
            found=f"{free / 1e9:.1f} GB",
            advice="free some space, or choose another disk",
        )


def _extracted(path: Path, size: int) -> bool:
    if not path.exists():
        return False
    if path.is_file() and (found := path.stat().st_size) in (size, 0):
        # files are renamed into place, so one of the right size is whole; a power failure can
        # leave an empty file
        return found == size
    raise ConflictError(
        path,
        expected=f"no file, or the file of {size} bytes in the zip",
        found="a different file",
        advice="choose another folder",
    )
