"""Where the data lie that a card is about: on this machine, and beside the card once both are published."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from carlasc.errors import ArgumentError
from carlasc.storage.protocol import Source
from carlasc.storage.transport.remote_tree import RemoteTree
from carlasc.storage.transport.trees import is_url

_BLOCK = 1 << 22  # bytes that are read at a time for a checksum
_HUB = "https://huggingface.co/datasets/"


@dataclass(frozen=True)
class Place:
    """The place of the data.

    Attributes:
        location: the source, as it was given.
        local: its path on this machine; None for a URL.
        name: its path below the folder of the card; "" if that is the folder itself.
        is_file: whether it is a single file.
        repository: the address of the data at the Hugging Face Hub; None if they are not published there.
    """

    location: str
    local: Path | None
    name: str
    is_file: bool
    repository: str | None

    @property
    def title(self) -> str:
        """A name for the data set: that of its file or folder, without the ending of a store."""
        name = PurePosixPath(self.location.partition("://")[2]).name if self.local is None else self.local.name
        return re.sub(r"\.(parquet|zarr|h5|hdf5|zip)$", "", name) or "data"

    def published(self, path: str) -> str:
        """Return the path of a file of the data below the folder of the card."""
        return str(PurePosixPath(self.name) / path) if self.name or path else ""

    def address(self, path: str) -> str:
        """Return the address of a file: its URL where that is known, else its path below the folder of the card."""
        published = self.published(path)
        return f"{self.repository}/resolve/main/{published}" if self.repository else published

    def measure(self, path: str) -> tuple[int, str]:
        """Return the bytes of a file and its SHA-256, 64 hexadecimal digits. The file is read once."""
        digest, size = hashlib.sha256(), 0
        for block in self._blocks(path):
            digest.update(block)
            size += len(block)
        return size, digest.hexdigest()

    def _blocks(self, path: str) -> Iterator[bytes]:
        if self.local is None:
            tree = RemoteTree(self.location)
            size = tree.size(path) or 0
            for start in range(0, size, _BLOCK):
                yield tree.read_range(path, start, min(start + _BLOCK, size))
            return
        with (self.local / path if path else self.local).open("rb") as file:
            while block := file.read(_BLOCK):
                yield block


def place_of(source: str | os.PathLike[str] | Source, out: Path | None, url: str | None) -> tuple[Place, Path]:
    """Return the place of the data, and the folder of the card.

    A folder of sequences and a Parquet store have the card inside, which is where the Hugging Face Hub looks for it; other stores have it beside
    them. A source that is not below the folder of the card is described as if it lay there under its own name.

    Raises:
        ArgumentError: the source is a URL or no path, and no folder is given.
    """
    location = source.location if isinstance(source, Source) else os.fspath(source)
    repository = url.rstrip("/") if url and url.startswith(_HUB) else None
    if is_url(location):
        if out is None:
            raise ArgumentError("out", expected=f"a folder for the card of {location}", found="none")
        tree = RemoteTree(location)
        name = PurePosixPath(location.partition("://")[2].partition("?")[0]).name
        return Place(location, None, name, tree.size() is not None, repository), out
    given = Path(location.removeprefix("file://"))
    if not given.exists():
        raise ArgumentError("source", expected="data on this machine, or their URL", found=location)
    beside = given.is_file() or (given / "zarr.json").is_file()
    chosen = out or (given.parent if beside else given)
    local, folder = given.resolve(), chosen.resolve()
    name = local.relative_to(folder).as_posix() if local.is_relative_to(folder) else local.name
    return Place(location, local, "" if name == "." else name, local.is_file(), repository), chosen
