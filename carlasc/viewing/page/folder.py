"""The folder of a page: written under another name, and renamed when it is whole."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from carlasc.errors import ConflictError
from carlasc.storage.durability import make_folder, sync_all
from carlasc.storage.files import writing
from carlasc.storage.packed.output import remove

FRAMES = "frames"
_MARK = b'<meta name="generator" content="carlasc">'


def check_folder(out: Path, overwrite: bool) -> None:
    """Check that the folder of a page can be written: it does not exist, is empty, or is a page that may be replaced.

    Raises:
        ConflictError: something else exists there, or `overwrite` is not given.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not _is_page(out):
        found = "a folder with other files" if out.is_dir() else "a file"
        advice = "choose another name; one that ends in .html writes a page in one file"
        raise ConflictError(out, expected="the folder of a page, or a new one", found=found, advice=advice)
    if not overwrite:
        raise ConflictError(
            out, problem="the page exists", advice="choose another name, or replace it with `overwrite=True`"
        )


class NewFolder:
    """A folder that is being written.

    Attributes:
        size_bytes: size of the files so far.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._written: list[Path] = []
        self.size_bytes = 0

    def write(self, name: str, data: bytes) -> None:
        """Write a file, with the folders that it needs."""
        path = self._path / name
        make_folder(path.parent)
        path.write_bytes(data)
        self._written.append(path)
        self.size_bytes += len(data)

    def sync(self) -> None:
        """Wait until the files and their names are on the disk."""
        sync_all(self._written)
        sync_all({path.parent for path in self._written})


@contextmanager
def writing_folder(out: Path) -> Iterator[NewFolder]:
    """Yield a folder that gets its name when the block ends, and that is removed if it fails.

    What is in its place is removed only then; `check_folder` says whether it may be.

    Raises:
        StorageError: it cannot be written; nothing is left behind.
    """
    out = out.resolve()  # "." has no name
    part, old = (out.with_name(f".{out.name}.{ending}") for ending in ("part", "old"))
    try:
        with writing(out):
            remove(part)  # what a killed run left
            make_folder(part)
            folder = NewFolder(part)
            yield folder
            folder.sync()
            if out.exists():
                remove(old)
                out.rename(old)
            part.rename(out)
            sync_all([out.parent])
            remove(old)
    finally:
        remove(part)
        if old.exists() and not out.exists():
            old.rename(out)


def _is_page(path: Path) -> bool:
    index = path / "index.html"
    return index.is_file() and _MARK in index.read_bytes()[:2000] and (path / FRAMES).is_dir()
