"""The facts of a card, as values: read from the data, or given by the author."""

from __future__ import annotations

import datetime
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.groundtruth.reporting import Report
from carlasc.inspection.cards.licenses import License, LicensedPart, licensed_parts
from carlasc.inspection.overview import GridOverview, Overview, info
from carlasc.inspection.statistics import Histogram, Statistics, stats
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.packed.stores import PackedSource
from carlasc.storage.protocol import Sequence as StoredSequence
from carlasc.storage.protocol import Source
from carlasc.storage.views import ChosenSequences


@dataclass(frozen=True)
class CardDetails:
    """Details of a data set that are not in the data.

    Attributes:
        name: name of the data set; None takes that of the source.
        description: a sentence or two; None makes one from the data.
        authors: names of the people or groups that publish it.
        license: licence of the sequences whose carlasc.json names none, such as "cc-by-4.0", or the
            address of its text. Converted sequences keep the licence of their source.
        citation: how to cite the data (BibTeX); the paper that introduced CarlaSC is always named,
            too.
        url: address of the page where the data are published, such as
            "https://huggingface.co/datasets/ORG/NAME".
        contact: a name or an address for questions.
        version: version of the data.
        published: date of the publication, YYYY-MM-DD; None takes today.

    Raises:
        ArgumentError: a version, a date or an address is not valid.
    """

    name: str | None = None
    description: str | None = None
    authors: Sequence[str] = ()
    license: str | None = None
    citation: str | None = None
    url: str | None = None
    contact: str | None = None
    version: str = "1.0.0"
    published: str | None = None

    def __post_init__(self) -> None:
        if not re.fullmatch(r"\d+(\.\d+){0,2}([-+][0-9A-Za-z.-]+)?", self.version):
            raise ArgumentError(
                "version", expected="a version such as 1.0.0", found=repr(self.version)
            )
        try:
            datetime.date.fromisoformat(self.published or "2000-01-01")
        except ValueError:
            raise ArgumentError(
                "published", expected="a date YYYY-MM-DD", found=repr(self.published)
            ) from None
        if self.url is not None and not re.fullmatch(r"https?://[^\s\"'<>]+", self.url):
            raise ArgumentError(
                "url", expected="an address that begins with https://", found=repr(self.url)
            )


@dataclass(frozen=True)
class Facts:
    """The facts that were read from the data.

    Attributes:
        overview: the result of `info`.
        sequences: the sequences, by path.
        parts: sources and licences, the strictest first.
        statistics: the counts of classes, one for each class table; none without labels.
        every: every N-th frame was counted.
        reports: the reports beside the grids, by sequence and grid.
        lossy_mm: step to which coordinates of points were rounded, millimetres; None for exact
            ones.
    """

    overview: Overview
    sequences: Mapping[str, StoredSequence] = field(repr=False)
    parts: tuple[LicensedPart, ...]
    statistics: tuple[Statistics, ...]
    every: int
    reports: Mapping[str, Report]
    lossy_mm: float | None

    @cached_property
    def frames(self) -> int:
        """Number of frames of all sequences."""
        return sum(sequence.frames for sequence in self.overview.sequences)

    @property
    def sequences_told(self) -> str:
        """The number of sequences, in words."""
        count = len(self.overview.sequences)
        return "1 sequence" if count == 1 else f"{count} sequences"

    @cached_property
    def splits(self) -> dict[str, tuple[int, int]]:
        """Number of sequences and of frames of each split, in the order of the layout; "none" for
        sequences without a split.
        """
        order = {name: place for place, name in enumerate((*layout.SPLITS, "none"))}
        found: dict[str, tuple[int, int]] = {}
        for sequence in sorted(
            self.overview.sequences, key=lambda one: order.get(one.split or "none", 9)
        ):
            count, frames = found.get(sequence.split or "none", (0, 0))
            found[sequence.split or "none"] = (count + 1, frames + sequence.frames)
        return found

    @cached_property
    def fields(self) -> dict[str, int]:
        """Number of frames of each field, without the fields of grids."""
        found: Counter[str] = Counter()
        for sequence in self.overview.sequences:
            found.update(sequence.fields)
        return dict(sorted(found.items()))

    @cached_property
    def grids(self) -> list[tuple[GridOverview, int, int]]:
        """Each kind of grid, with its number of sequences and of frames.

        Grids of one kind differ only in their sequence.
        """
        kinds: dict[tuple[object, ...], list[GridOverview]] = {}
        for sequence in self.overview.sequences:
            for grid in sequence.grids:
                key = (
                    grid.name,
                    grid.coordinates,
                    grid.size,
                    grid.lower,
                    grid.upper,
                    grid.parts,
                    str(grid.made),
                )
                kinds.setdefault(key, []).append(grid)
        return [
            (grids[0], len(grids), sum(grid.frames for grid in grids)) for grids in kinds.values()
        ]

    @cached_property
    def licenses(self) -> list[License]:
        """The licences, the strictest first."""
        return list(dict.fromkeys(part.license for part in self.parts))

    @cached_property
    def sources(self) -> list[str]:
        """What sequences were converted from."""
        return sorted({part.source for part in self.parts if part.source is not None})

    @property
    def simulated(self) -> bool:
        """Whether some sequences were not converted: they were recorded in a simulator."""
        return any(part.source is None for part in self.parts)

    @property
    def synthetic(self) -> bool:
        """Whether some sequences were recorded in a simulator, by us or by others."""
        return self.simulated or any(
            one.metadata.extra.get("simulated") is True for one in self.sequences.values()
        )

    @cached_property
    def citations(self) -> dict[str, str]:
        """What to cite for each source; "" if carlasc.json does not name it."""
        said = {
            one.metadata.source: one.metadata.extra.get("citation")
            for one in self.sequences.values()
        }
        return {
            source: text if isinstance(text := said.get(source), str) else ""
            for source in self.sources
        }

    @cached_property
    def sensors(self) -> list[str]:
        """The sensors, as carlasc.json names them."""
        return sorted({sequence.sensor for sequence in self.overview.sequences if sequence.sensor})

    @cached_property
    def versions(self) -> list[str]:
        """The versions of carlasc that made the grids, as their reports say."""
        return sorted(
            {str(report.versions.get("carlasc", "?")) for report in self.reports.values()}
        )

    @cached_property
    def gaps(self) -> int:
        """Number of places where frame numbers are missing."""
        return sum(sequence.gaps for sequence in self.overview.sequences)

    @property
    def failures(self) -> list[tuple[str, str]]:
        """(file, message) of each file that could not be read."""
        return [failure for one in self.statistics for failure in one.failures]

    def known_share(self) -> float | None:
        """Share of the voxels that are known; None without grids."""
        total = sum(one.total.unknown + int(one.total.voxels.sum()) for one in self.statistics)
        return (
            sum(int(one.total.voxels.sum()) for one in self.statistics) / total if total else None
        )


def gather(source: Source, license_: License | None, every: int, run: Run) -> Facts:
    """Read the facts of a card.

    Raises:
        MissingDataError: the source has no sequences.
        FormatError: a sequence cannot be described.
        ArgumentError, FormatError, CarlascError: see `licensed_parts` and `stats`.
    """
    sequences = {path: one for path, one in source.sequences().items() if one.fields()}
    if not sequences:
        raise MissingDataError(
            source.location,
            expected="sequences",
            found="none",
            advice="make them with `carlasc regrid`",
        )
    parts = licensed_parts(sequences.values(), license_, source.location)
    reports = {}
    for path, sequence in sequences.items():
        for grid in sequence.grids:
            name = layout.report_file(grid)
            if name in sequence.documents():
                where = f"{sequence.location}/{name}"
                reports[f"{path}/{grid}" if path else grid] = Report.from_json(
                    sequence.read_document(name), where
                )
    overview = info(source)
    for one in overview.sequences:
        # otherwise, a grid that cannot be described would be missing from the card without a
        # message
        if one.problem:
            raise FormatError(one.path or source.location, problem=one.problem)
    return Facts(
        overview,
        sequences,
        parts,
        _count(source.location, sequences, every, run),
        every,
        reports,
        source.lossy_mm if isinstance(source, PackedSource) else None,
    )


def _count(
    location: str, sequences: Mapping[str, StoredSequence], every: int, run: Run
) -> tuple[Statistics, ...]:
    """Count the classes, separately for each class table; sequences without labels are left out."""
    if every < 1:
        raise ArgumentError("every", expected="1 or more", found=str(every))
    tables: dict[str, dict[str, StoredSequence]] = {}
    for path, sequence in sequences.items():
        if "labels" in sequence.fields() or any(
            name.endswith("/labels") for name in sequence.fields()
        ):
            tables.setdefault(sequence.metadata.classes.name, {})[path] = sequence
    counted = []
    for chosen in tables.values():
        try:
            counted.append(
                stats(ChosenSequences(location, chosen), remap=None, every=every, run=run)
            )
        except MissingDataError:  # several grids without the published one
            continue
    return tuple(counted)


def shares(
    statistics: Statistics, histogram: Histogram
) -> list[tuple[int, str, float | None, float | None]]:
    """Return id, name, share of the points and share of the known voxels of each class that occurs."""
    points, voxels = int(histogram.points.sum()), int(histogram.voxels.sum())
    rows = []
    for index, name in statistics.classes.names.items():
        if statistics.total.points[index] or statistics.total.voxels[index]:
            of_points = float(histogram.points[index]) / points if points else None
            of_voxels = float(histogram.voxels[index]) / voxels if voxels else None
            rows.append((index, name, of_points, of_voxels))
    return rows
