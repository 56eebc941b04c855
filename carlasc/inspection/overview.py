"""The contents of a data set: splits, sequences, frames, fields and grids, from listings and text
files only.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from carlasc.captures.raw import Capture, find_captures
from carlasc.core.arrays import IntArray
from carlasc.core.notebook import data_frame
from carlasc.errors import CarlascError, MissingDataError, check_types, without_credentials
from carlasc.inspection.staleness import changed_inputs
from carlasc.storage import as_source, layout
from carlasc.storage.files import AnyPath
from carlasc.storage.folder import FolderSequence
from carlasc.storage.layout import Metadata
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.shares import sample_of, source_in

if TYPE_CHECKING:
    import pandas

    from carlasc.metrics.results import Interval

_SIZED = 3  # the size of a field is estimated from this number of files


@dataclass(frozen=True)
class GridOverview:
    """One grid of a sequence.

    Attributes:
        name: its folder.
        coordinates: "cartesian" or "cylindrical".
        size: number of voxels per axis.
        lower: lower bound per axis; metres, radians for azimuth.
        upper: upper bound per axis.
        voxel_size: size of a voxel per axis.
        frames: number of frames.
        parts: which of labels, counts and votes exist.
        made: the record of how the grid was made; None for published data.
        stale: what changed of its inputs since it was made; empty if nothing is known to have
            changed.
    """

    name: str
    coordinates: str
    size: tuple[int, int, int]
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    voxel_size: tuple[float, float, float]
    frames: int
    parts: tuple[str, ...]
    made: Mapping[str, Any] | None
    stale: str = ""


@dataclass(frozen=True)
class SequenceOverview:
    """One sequence.

    Attributes:
        path: its path in the Source.
        split: "Train", "Val", "Test", or None.
        name: its name.
        coordinates: "cartesian" or "cylindrical".
        frames: number of frames.
        first: number of the first frame; None if there is no frame.
        last: number of the last frame.
        gaps: number of places where frame numbers are missing.
        fields: number of frames by field, without the fields of grids.
        documents: names of its text files.
        grids: its grids.
        axes: "left" (y to the right) or "right" (y to the left).
        classes: class table of its labels.
        sensor: the sensor that recorded the scans; None if it is not known.
        source: what the sequence was made from; None if it is not known.
        bytes: estimated size; None for stores other than folders.
        problem: the error because of which a part could not be read; None without one.
    """

    path: str
    split: str | None
    name: str
    coordinates: str
    frames: int
    first: int | None
    last: int | None
    gaps: int
    fields: Mapping[str, int]
    documents: tuple[str, ...]
    grids: tuple[GridOverview, ...]
    axes: str
    classes: str
    sensor: str | None
    source: str | None
    bytes: int | None
    problem: str | None = None


@dataclass(frozen=True)
class CaptureOverview:
    """One raw capture: its path below the source, its number of sensors, and its frames as in
    SequenceOverview.
    """

    path: str
    sensors: int
    frames: int
    first: int
    last: int
    gaps: int


@dataclass(frozen=True)
class Overview:
    """What `info` found.

    Attributes:
        location: the source.
        level: kind of the source: "data set", "split", "sequences", "sequence", "coordinates" (one
            `<coordinates>` folder) or "capture".
        store: how it is stored: "folder", "published" (a zip or a remote folder), or a kind of
            packed store.
        sequences: in sorted order.
        captures: in sorted order.
        bytes: size of the file, if the source is one file; None for folders.
        places: number of folders of sequences by split; empty if all were looked at.
    """

    location: str
    level: str
    store: str
    sequences: tuple[SequenceOverview, ...]
    captures: tuple[CaptureOverview, ...]
    bytes: int | None
    places: Mapping[str, int] = field(default_factory=dict)

    def total(self, name: str) -> Interval:
        """Return the sum of "frames" or "bytes" over all sequences, with its interval if only some
        were looked at.
        """
        from carlasc.metrics.results import estimate  # compiles loops, for scores

        return estimate([getattr(one, name) or 0 for one in self.sequences], self.places)

    @property
    def splits(self) -> dict[str, int]:
        """Number of sequences by split; "none" counts sequences without a split in their path."""
        counted = Counter(sequence.split or "none" for sequence in self.sequences)
        return dict(self.places or counted)

    def to_pandas(self) -> pandas.DataFrame:
        """Return a row per sequence, with the attributes of `SequenceOverview`; fields, documents
        and grids as their names.

        Raises:
            DependencyError: pandas is not installed.
        """
        rows = (
            vars(one) | {"fields": [*one.fields], "grids": [grid.name for grid in one.grids]}
            for one in self.sequences
        )
        return data_frame(rows, "path")

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        return asdict(self) | {"splits": self.splits}


def info(
    source: AnyPath | Source, *, sample: int | None = None, sequences_from: AnyPath | None = None
) -> Overview:
    """List the contents of a data set. No frame is read.

    Args:
        source: a path or URL that `carlasc.open` knows, a raw capture, or a Source.
        sample: number of sequences to look at, evenly spaced, if there are more. None: all.
        sequences_from: file with the folders of the sequences, one per line, which is written if it
            does not exist. None: the source is listed.

    Raises:
        ArgumentError: `sample` is less than 1.
        MissingDataError: the source holds neither a sequence nor a capture.
    """
    check_types(info, locals())
    chosen, places = sample_of(as_source(source), sample, sequences_from)
    captures: dict[str, Capture] = {}
    if not isinstance(source, Source):
        with suppress(MissingDataError):
            captures = find_captures(source, chosen)
    recorded = tuple(_describe_capture(path, capture) for path, capture in captures.items())
    sequences: dict[str, Sequence] = {}
    try:
        opened = as_source(source)
        # raw/ has a bev/ folder, like a sequence, but is a capture
        sequences = {
            path: s
            for path, s in source_in(opened, chosen).sequences().items()
            if s.fields() or path not in captures
        }
    except MissingDataError:
        if not captures:
            raise
    if not sequences:
        return Overview(without_credentials(str(source)), "capture", "folder", (), recorded, None)
    location = Path(opened.location)
    return Overview(
        opened.location,
        _level(opened.location, list(sequences)),
        type(opened).__name__.removesuffix("Source").lower(),
        tuple(_describe(sequence) for sequence in sequences.values()),
        recorded,
        location.stat().st_size if location.is_file() else None,
        places,
    )


def _level(location: str, paths: list[str]) -> str:
    """Return the kind of the folder, by the paths of its sequences."""
    parts = [path.split("/") for path in paths]
    if paths == [""]:
        return "coordinates"
    if all(len(p) == 1 for p in parts) and all(p[0] in layout.COORDINATES for p in parts):
        return "sequence"
    names = {split.lower() for split in layout.SPLITS}
    if any(part.lower() in names for p in parts for part in p[:-1]):
        return "data set"
    return "split" if Path(location).name.lower() in names else "sequences"


def _describe(sequence: Sequence) -> SequenceOverview:
    fields = {name: len(sequence.frames(name)) for name in sorted(sequence.fields())}
    numbers = set[int]().union(*(sequence.frames(name).tolist() for name in fields))
    frames = np.array(sorted(numbers), np.int64)
    metadata = Metadata()
    problem = None
    grids: tuple[GridOverview, ...] = ()
    try:
        metadata = sequence.metadata
        grids = tuple(_describe_grid(sequence, name, fields) for name in sequence.grids)
    except CarlascError as error:
        problem = str(error)
    return SequenceOverview(
        sequence.path,
        sequence.split,
        sequence.name,
        sequence.coordinates,
        len(frames),
        int(frames[0]) if len(frames) else None,
        int(frames[-1]) if len(frames) else None,
        _gaps(frames),
        {name: count for name, count in fields.items() if "/" not in name},
        tuple(name for name in sequence.documents() if "/" not in name),
        grids,
        metadata.axes,
        metadata.classes.name,
        metadata.sensor,
        metadata.source,
        _estimate_bytes(sequence, fields),
        problem,
    )


def _describe_grid(sequence: Sequence, name: str, fields: Mapping[str, int]) -> GridOverview:
    spec = sequence.grids[name]
    parts = tuple(part for part in layout.GRID_FIELDS if f"{name}/{part}" in fields)
    x, y, z = spec.voxel_size.tolist()
    return GridOverview(
        name,
        spec.coordinates,
        spec.size,
        spec.lower,
        spec.upper,
        (x, y, z),
        fields.get(f"{name}/labels", 0),
        parts,
        sequence.params(name).get("carlasc"),
        changed_inputs(sequence, name),
    )


def _estimate_bytes(sequence: Sequence, fields: Mapping[str, int]) -> int | None:
    """Return the size of a sequence, estimated from a few files of each field; None for stores
    other than folders.
    """
    if not isinstance(sequence, FolderSequence):
        return None
    total = 0.0
    for name, count in fields.items():
        frames = sequence.frames(name)
        some = frames[np.linspace(0, count - 1, min(count, _SIZED)).astype(int)]
        files = [sequence.folder / layout.field_named(name).file(int(number)) for number in some]
        total += count * float(np.mean([file.stat().st_size for file in files]))
    return round(total)


def _describe_capture(path: str, capture: Capture) -> CaptureOverview:
    frames = capture.frames
    return CaptureOverview(
        path, len(capture.sensors), len(frames), int(frames[0]), int(frames[-1]), _gaps(frames)
    )


def _gaps(frames: IntArray) -> int:
    return int(np.count_nonzero(np.diff(frames) > 1))
