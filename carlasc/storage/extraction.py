"""Extracting a zip into a folder.

No file is written outside of it, each file is written whole, and an interrupted run can continue.
"""

from __future__ import annotations

import shutil
import stat
import zipfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import BinaryIO

from carlasc.errors import ConflictError, FormatError, StorageError, reading
from carlasc.storage.arrays import check_ratio
from carlasc.storage.files import leads_outside, remove_stale, write_many

_BLOCK = 1 << 20  # bytes per read
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
        FormatError: the zip is damaged, or a name in it leads out of the folder. In the latter case
            nothing is extracted.
        ConflictError: another file of the same name exists.
        StorageError: the disk is full, or the folder cannot be written to.
    """
    with _opened(archive) as opened:
        with _reading(archive):  # zipfile fails for a member without a name
            members = [member for member in opened.infolist() if not member.is_dir()]
        for member in members:
            check_member(member, archive)
        total = _size(members)
        check_ratio(total, archive.stat().st_size, str(archive))
        missing = [member for member in members if not _extracted(member, folder / member.filename)]
        check_space(folder, _size(missing), f"to extract {archive.name}")
        advance(total - _size(missing))
        for parent in {(folder / member.filename).parent for member in missing}:
            remove_stale(parent)
        for start in range(0, len(missing), _TOGETHER):
            batch = missing[start : start + _TOGETHER]
            write_many(
                {
                    folder / member.filename: partial(_copy, opened, member, archive)
                    for member in batch
                }
            )
            advance(_size(batch))
    return len(members)


def extracted_size(archive: Path) -> int:
    """Return the bytes of the files in a zip.

    Raises:
        FormatError: it is not a zip.
    """
    with _opened(archive) as opened:
        return _size(opened.infolist())


def _size(members: list[zipfile.ZipInfo]) -> int:
    return sum(member.file_size for member in members)


def _opened(archive: Path) -> zipfile.ZipFile:
    with _reading(archive):
        return zipfile.ZipFile(archive)


def _reading(archive: Path) -> AbstractContextManager[None]:
    return reading(archive, "a whole zip", "fetch it again")


def _copy(
    opened: zipfile.ZipFile, member: zipfile.ZipInfo, archive: Path, target: BinaryIO
) -> None:
    block = b"-"
    with _reading(archive):
        source = opened.open(member)
    with source:
        while block:
            with _reading(archive):
                block = source.read(_BLOCK)
            target.write(block)  # an error here comes from the disk, not from the zip
    if target.tell() != member.file_size:
        raise FormatError(
            f"{archive}: {member.filename}",
            expected=f"{member.file_size} bytes",
            found=str(target.tell()),
            advice="the zip is damaged: fetch it again",
        )


def check_member(member: zipfile.ZipInfo, archive: Path) -> None:
    """Check that a member is not a link, has a name inside the folder, and has a plausible
    compression ratio.

    Raises:
        FormatError: it is not; the message names the member.
    """
    name = member.orig_filename  # as written in the zip: zipfile corrects some names by itself
    if leads_outside(name):
        raise FormatError(
            archive,
            expected="names inside the folder",
            found=repr(name),
            advice="nothing was extracted",
        )
    if stat.S_ISLNK(member.external_attr >> 16):
        raise FormatError(
            archive, expected="files", found=f"the link {name!r}", advice="nothing was extracted"
        )
    check_ratio(member.file_size, member.compress_size, f"{archive}: {name}")


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


def _extracted(member: zipfile.ZipInfo, path: Path) -> bool:
    if not path.exists():
        return False
    if path.is_file() and path.stat().st_size == member.file_size:
        return True  # files are renamed into place, so one of the right size is whole
    if path.is_file() and path.stat().st_size == 0:
        return False  # a power failure can leave an empty file
    raise ConflictError(
        path,
        expected=f"no file, or the file of {member.file_size} bytes in the zip",
        found="a different file",
        advice="choose another folder",
    )
