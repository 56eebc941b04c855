"""Extracting a zip into a folder: no file outside of it, each file whole, and continued after an interruption."""

from __future__ import annotations

import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

from carlasc.errors import ConflictError, FormatError, StorageError
from carlasc.storage.files import write_atomic
from carlasc.storage.folders.names import leads_outside


def extract_zip(archive: Path, folder: Path, advance: Callable[[int], None]) -> int:
    """Extract all files of a zip, except those that an earlier run has extracted.

    Args:
        archive: the zip.
        folder: where its files are written.
        advance: called with the number of bytes of each file.

    Returns:
        The number of files in the zip.

    Raises:
        FormatError: the zip is damaged, or a name in it leads out of the folder; nothing is extracted in the latter case.
        ConflictError: another file of the same name exists.
        StorageError: the disk is full, or the folder cannot be written to.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            members = [member for member in opened.infolist() if not member.is_dir()]
            for member in members:
                check_member(member, archive)
            missing = [member for member in members if not _extracted(member, folder / member.filename)]
            check_space(folder, sum(member.file_size for member in missing), f"to extract {archive.name}")
            advance(sum(member.file_size for member in members) - sum(member.file_size for member in missing))
            for member in missing:
                with opened.open(member) as source:
                    write_atomic(folder / member.filename, partial(shutil.copyfileobj, source))
                advance(member.file_size)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
        raise _damaged(archive, error) from error
    return len(members)


def extracted_size(archive: Path) -> int:
    """Return the bytes of the files in a zip.

    Raises:
        FormatError: it is not a zip.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            return sum(member.file_size for member in opened.infolist())
    except zipfile.BadZipFile as error:
        raise _damaged(archive, error) from error


def check_member(member: zipfile.ZipInfo, archive: Path) -> None:
    """Refuse links, and names that lead out of the folder.

    Raises:
        FormatError: names the member.
    """
    name = member.orig_filename  # as written in the zip: zipfile corrects some names by itself
    if leads_outside(name):
        raise FormatError(archive, expected="names inside the folder", found=repr(name), advice="nothing was extracted")
    if stat.S_ISLNK(member.external_attr >> 16):
        raise FormatError(archive, expected="files", found=f"the link {name!r}", advice="nothing was extracted")


def check_space(folder: Path, needed: int, purpose: str) -> None:
    """Check that a disk has enough free space, before anything is written.

    Raises:
        StorageError: it has not.
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
    raise ConflictError(
        path,
        expected=f"nothing, or the zip's file of {member.file_size} bytes",
        found="another file",
        advice="choose another folder",
    )


def _damaged(archive: Path, error: Exception) -> FormatError:
    return FormatError(archive, expected="a whole zip", found=f"a damaged one ({error})", advice="fetch it again")
