"""Unpacking a zip into a folder: no file outside it, no half file in it, and again after an interruption."""

from __future__ import annotations

import re
import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath

from carlasc.errors import CarlascError, ConflictError, FormatError
from carlasc.storage.files import write_atomic


def extract(archive: Path, folder: Path, advance: Callable[[int], None]) -> int:
    """Unpack all files of a zip; those already there, whole, are passed over.

    Args:
        archive: the zip.
        folder: where its files go.
        advance: called with the number of bytes of each file.

    Returns:
        The number of files.

    Raises:
        FormatError: the zip is damaged, or a name in it leads out of the folder: nothing is unpacked then.
        ConflictError: another file of that name is there.
        CarlascError: the disk is full.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            members = [member for member in opened.infolist() if not member.is_dir()]
            for member in members:
                check_member(member, archive)
            missing = [member for member in members if not _is_there(member, folder / member.filename)]
            check_space(folder, sum(member.file_size for member in missing), f"to unpack {archive.name}")
            advance(sum(member.file_size for member in members) - sum(member.file_size for member in missing))
            for member in missing:
                with opened.open(member) as source:
                    write_atomic(folder / member.filename, partial(shutil.copyfileobj, source))
                advance(member.file_size)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
        raise FormatError(
            archive, expected="a whole zip", found="a damaged one", advice=f"{error}: fetch it again"
        ) from error
    return len(members)


def unpacked_size(archive: Path) -> int:
    """Return the bytes that a zip's files have.

    Raises:
        FormatError: it is no zip.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            return sum(member.file_size for member in opened.infolist())
    except zipfile.BadZipFile as error:
        raise FormatError(
            archive, expected="a whole zip", found="a damaged one", advice=f"{error}: fetch it again"
        ) from error


def check_member(member: zipfile.ZipInfo, archive: Path) -> None:
    """Refuse a name that leads out of the folder, and links.

    Raises:
        FormatError: names the member.
    """
    name = member.orig_filename  # as it stands in the file: zipfile mends some names by itself
    parts = PurePosixPath(name).parts
    if name.startswith(("/", "\\")) or "\\" in name or "\0" in name or ".." in parts or re.match(r"[A-Za-z]:", name):
        raise FormatError(archive, expected="names inside the folder", found=f"{name!r}", advice="nothing was unpacked")
    if stat.S_ISLNK(member.external_attr >> 16):
        raise FormatError(archive, expected="files", found=f"the link {name!r}", advice="nothing was unpacked")


def check_space(folder: Path, needed: int, purpose: str) -> None:
    """Check that a disk has room, before anything is written.

    Raises:
        CarlascError: it has not.
    """
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    if needed > free:
        raise CarlascError(
            folder,
            expected=f"{needed / 1e9:.1f} GB of free space {purpose}",
            found=f"{free / 1e9:.1f} GB",
            advice="free some, or choose another disk",
        )


def _is_there(member: zipfile.ZipInfo, path: Path) -> bool:
    if not path.exists():
        return False
    if path.is_file() and path.stat().st_size == member.file_size:
        return True  # files are renamed into place, so one of the right size is whole
    raise ConflictError(
        path,
        expected=f"nothing or the file of {member.file_size} bytes",
        found="another",
        advice="choose another folder",
    )
