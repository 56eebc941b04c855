"""The checksum of a table's footer.

Parquet has checksums of pages and none of its footer, and one wrong bit there makes pyarrow 26 end the process: an exception of C++ that
nothing catches. So a store says the checksums of its footers, and a footer is compared before pyarrow sees it.
"""

from __future__ import annotations

import zlib
from pathlib import Path

from carlasc.errors import FormatError, MissingDataError
from carlasc.storage.transport.trees import LocalTree, Tree

_END = 8  # bytes: the length of the footer, and "PAR1"
_MARK = b"PAR1"
_LONGEST = 1 << 28  # bytes; a sequence of ten thousand frames has some megabytes


def footer_checksum(tree: Tree, path: str) -> int:
    """Return the CRC-32 of a table's footer, with its length and the mark behind it.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it does not end as a Parquet file does.
    """
    end = bytes(tree.read_range(path, -_END, 0))
    if len(end) != _END or not end.endswith(_MARK):
        raise FormatError(tree.where(path), expected="a Parquet file", found="another end", advice="is it truncated?")
    length = int.from_bytes(end[:4], "little")
    if length > _LONGEST:
        raise FormatError(tree.where(path), expected=f"a footer of at most {_LONGEST} bytes", found=str(length))
    return zlib.crc32(tree.read_range(path, -_END - length, 0))


def footer_checksums(folder: Path) -> dict[str, int]:
    """Return the checksum of each table below a folder on this machine, by its path there."""
    tree = LocalTree(folder, mapped=False)
    paths = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.parquet"))
    return {path: footer_checksum(tree, path) for path in paths}


def check_footer(tree: Tree, path: str, expected: object) -> None:
    """Compare a table's footer with its checksum.

    Raises:
        FormatError: it is another one.
    """
    try:
        found = footer_checksum(tree, path)
    except MissingDataError as error:
        raise FormatError(
            tree.where(path),
            expected="the table that the sequence lists",
            found="none",
            advice="the store is damaged",
        ) from error
    if found != expected:
        raise FormatError(
            tree.where(path),
            problem="the checksum of the footer does not match",
            advice="the store is corrupted: fetch or pack it again",
        )
