"""The location of the data of a card, on this machine and after publication; and the tables of a
Parquet store, with their names in `datasets.load_dataset`.
"""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from carlasc.errors import ArgumentError
from carlasc.storage import layout
from carlasc.storage.files import AnyPath
from carlasc.storage.parquet.parquet_source import FRAMES, ParquetSource, opened
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.transport.remote_tree import RemoteTree
from carlasc.storage.transport.trees import is_url

HUB_SPLITS = {"Train": "train", "Val": "validation", "Test": "test"}
"""The names of the splits at the Hugging Face Hub. A data set without splits is `train` there."""


@dataclass(frozen=True)
class PublishedTable:
    """The tables of one field of all sequences.

    Attributes:
        name: its name as a configuration: `points`, `evaluation_labels`; `frames` for the table of
            frames.
        title: what a row is.
        columns: type of each column, as pyarrow names it.
        files: paths of the files below the store, by split.
    """

    name: str
    title: str
    columns: dict[str, str]
    files: dict[str, list[str]] = field(default_factory=dict)

    @property
    def paths(self) -> list[str]:
        """All files."""
        return [path for paths in self.files.values() for path in paths]

    def in_order(self) -> list[tuple[str, list[str]]]:
        """Return each split with its files, in the order of the layout."""
        return [(name, self.files[name]) for name in HUB_SPLITS.values() if name in self.files]


def split_of(sequence: Sequence) -> str:
    """Return the split of a sequence by its name at the Hub."""
    return HUB_SPLITS.get(sequence.split or "", "train")


def tables_of(source: ParquetSource) -> list[PublishedTable]:
    """Return the tables, that of frames first.

    Sequences whose tables have other columns (no times, or two bytes per label where others have
    one) have tables of their own.

    Raises:
        FormatError: a table is damaged.
    """
    tables: dict[tuple[str, str], PublishedTable] = {}
    for path, sequence in source.sequences().items():
        names = {"frames": FRAMES} | {name: f"{name}.parquet" for name in sorted(sequence.fields())}
        for name, file in names.items():
            place = str(PurePosixPath(source.nodes[path]) / file)
            with opened(source.tree, place) as opening:
                columns = {column.name: str(column.type) for column in opening.schema_arrow}
            key = (name, str(columns))
            if key not in tables:
                others = sum(other == name for other, _ in tables)
                suffix = f"_{others + 1}" if others else ""
                tables[key] = PublishedTable(name.replace("/", "_") + suffix, _title(name), columns)
            tables[key].files.setdefault(split_of(sequence), []).append(place)
    return sorted(tables.values(), key=lambda table: (table.name != "frames", table.name))


def _title(name: str) -> str:
    if name == "frames":
        return "one row per frame: its sequence, pose, time and figures"
    entry = layout.field_named(name)
    rows = {"scan": "frame"}.get(entry.per, entry.per)
    return f"one row per {rows}: {entry.meaning}"


_HUB = "https://huggingface.co/datasets/"


@dataclass(frozen=True)
class Place:
    """The location of the data.

    Attributes:
        location: the source, as it was given.
        local: its path on this machine; None for a URL.
        name: its path below the folder of the card; "" if that is the folder itself.
        is_file: whether it is a single file.
        repository: the address of the data at the Hugging Face Hub; None if they are not published
            there.
    """

    location: str
    local: Path | None
    name: str
    is_file: bool
    repository: str | None

    @property
    def title(self) -> str:
        """A name for the data set: that of its file or folder, without the ending of a store."""
        name = PurePosixPath(self.local or self.location.partition("://")[2]).name
        return re.sub(r"\.(parquet|zarr|h5|hdf5|zip)$", "", name) or "data"

    def published(self, path: str) -> str:
        """Return the path of a file of the data below the folder of the card."""
        return str(PurePosixPath(self.name) / path) if self.name or path else ""

    def measure(self, path: str) -> tuple[str, int]:
        """Return the SHA-256 of a file, 64 hexadecimal digits, and its bytes."""
        if self.local is None:
            opened = RemoteTree(self.location).open(path)
        else:
            opened = (self.local / path).open("rb")
        with opened as file:
            return hashlib.file_digest(file, "sha256").hexdigest(), file.tell()


def place_of(source: AnyPath | Source, out: Path | None, url: str | None) -> tuple[Place, Path]:
    """Return the location of the data, and the folder of the card.

    The card is inside a folder of sequences or a Parquet store, because the Hugging Face Hub looks
    for it there, and beside other stores. A source that is not below the folder of the card is
    described as if it were there, under its own name.

    Raises:
        ArgumentError: no folder is given, and the source is a URL or no path.
    """
    location = source.location if isinstance(source, Source) else os.fspath(source)
    repository = url.rstrip("/") if url and url.startswith(_HUB) else None
    if is_url(location):
        if out is None:
            raise ArgumentError(
                "out", expected=f"a folder for the card, because {location} is a URL", found="none"
            )
        tree = RemoteTree(location)
        name = PurePosixPath(location.partition("://")[2].partition("?")[0]).name
        return Place(location, None, name, tree.size() is not None, repository), out
    given = Path(location.removeprefix("file://"))
    if not given.exists():
        raise ArgumentError("source", expected="data on this machine, or their URL", found=location)
    beside = given.is_file() or (given / "zarr.json").is_file()
    chosen = out or (given.parent if beside else given)
    local = given.resolve()
    folder = chosen.resolve()
    name = local.relative_to(folder).as_posix() if local.is_relative_to(folder) else local.name
    return Place(location, local, "" if name == "." else name, local.is_file(), repository), chosen
