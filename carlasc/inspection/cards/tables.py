"""The tables of a packed Parquet store, as `datasets.load_dataset` and Croissant name them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import PurePosixPath

from carlasc.storage import layout
from carlasc.storage.parquet.parquet_source import FRAMES, ParquetSource, opened
from carlasc.storage.protocol import Sequence

HUB_SPLITS = {"Train": "train", "Val": "validation", "Test": "test"}
"""What the Hugging Face Hub calls the splits; a data set without splits is all `train` there."""


@dataclass(frozen=True)
class Table:
    """The tables of one field of all sequences.

    Attributes:
        name: its name as a configuration: `points`, `evaluation_labels`; `frames` for the table of frames.
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


def split_of(sequence: Sequence) -> str:
    """Return the split of a sequence by its name at the Hub."""
    return HUB_SPLITS.get(sequence.split or "", "train")


def tables_of(source: ParquetSource) -> list[Table]:
    """Return the tables, that of frames first.

    Sequences whose tables have other columns (no times, or two bytes per label where others have one) have tables of their own.

    Raises:
        FormatError: a table is damaged.
    """
    found: dict[tuple[str, tuple[tuple[str, str], ...]], Table] = {}
    for path, sequence in source.sequences().items():
        names = {"frames": FRAMES} | {name: f"{name}.parquet" for name in sorted(sequence.fields())}
        for name, file in names.items():
            place = str(PurePosixPath(source.nodes[path]) / file)
            with opened(source.tree, place) as opening:
                columns = {column.name: str(column.type) for column in opening.schema_arrow}
            key = (name, tuple(columns.items()))
            if key not in found:
                others = sum(other == name for other, _ in found)
                suffix = f"_{others + 1}" if others else ""
                found[key] = Table(name.replace("/", "_") + suffix, _title(name), columns)
            found[key].files.setdefault(split_of(sequence), []).append(place)
    return sorted(found.values(), key=lambda table: (table.name != "frames", table.name))


def _title(name: str) -> str:
    if name == "frames":
        return "one row per frame: its sequence, pose, time and figures"
    entry = layout.field_named(name)
    rows = {"scan": "frame", "vote": "vote", "box": "box"}.get(entry.per, entry.per)
    return f"one row per {rows}: {entry.meaning}"
