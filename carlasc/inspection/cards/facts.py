"""The facts of a card, as values: read from the data, or given by the author."""

from __future__ import annotations

import datetime
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

from carlasc.errors import ArgumentError, FormatError, MissingDataError, check_types
from carlasc.groundtruth.reporting import Report
from carlasc.inspection.cards.licenses import (
    UNSTATED,
    License,
    LicensedPart,
    license_given,
    licensed_parts,
)
from carlasc.inspection.overview import GridOverview, Overview, info
from carlasc.inspection.reports import report_beside
from carlasc.inspection.statistics import Statistics, stats
from carlasc.inspection.texts import read_table, say
from carlasc.running.spreading import Run
from carlasc.storage.layout import Metadata
from carlasc.storage.packed.stores import PackedSource
from carlasc.storage.protocol import Sequence as StoredSequence
from carlasc.storage.protocol import Source
from carlasc.storage.views import ChosenSequences

STATEMENTS: dict[str, str] = read_table("card.toml")["statements"]
"""What only the author can state: names of fields in croissant.json, and headings in README.md."""

_MOST_LIMITS = 10  # grids with the largest inferred shares


@dataclass(frozen=True)
class CardDetails:
    """Details of a data set that are not in the data.

    Attributes:
        name: name of the data set. None: that of the source.
        description: description in a sentence or two. None: one made from the data.
        authors: people or groups that publish it.
        license: licence of the sequences whose carlasc.json names none: a name such as cc-by-4.0,
            or the URL of its text. Converted sequences keep the licence of their source.
        citation: how to cite the data (BibTeX).
        place: where the data were recorded, such as "Ann Arbor, Michigan, USA".
        statements: what only the author knows, such as personalSensitiveInformation: texts by the
            names of Croissant's RAI fields, of which `STATEMENTS` is the list.
        url: URL where the data are published, such as https://huggingface.co/datasets/ORG/NAME.
        contact: contact for questions, such as an e-mail address.
        version: version of the data.
        published: date of the publication, YYYY-MM-DD. None: today.

    Raises:
        ArgumentError: a version, a date, an address or the name of a statement is not valid.
    """

    name: str | None = None
    description: str | None = None
    authors: Sequence[str] = ()
    license: str | None = None
    citation: str | None = None
    place: str | None = None
    statements: Mapping[str, str] = field(default_factory=dict)
    url: str | None = None
    contact: str | None = None
    version: str = "1.0.0"
    published: str | None = None

    def __post_init__(self) -> None:
        check_types(CardDetails, vars(self))
        version = r"\d+(\.\d+){0,2}([-+][0-9A-Za-z.-]+)?"
        address = r"https?://[^\s\"'<>]+"
        try:
            is_date = bool(datetime.date.fromisoformat(self.published or "2000-01-01"))
        except ValueError:
            is_date = False
        for name, is_valid, expected in (
            ("version", re.fullmatch(version, self.version), "a version such as 1.0.0"),
            ("published", is_date, "a date YYYY-MM-DD"),
            (
                "url",
                self.url is None or re.fullmatch(address, self.url),
                "an address that begins with https://",
            ),
        ):
            if not is_valid:
                raise ArgumentError(name, expected=expected, found=repr(getattr(self, name)))
        for name, text in self.statements.items():
            if name not in STATEMENTS or not isinstance(text, str):
                expected = f"a text for some of {', '.join(STATEMENTS)}"
                raise ArgumentError("statements", expected=expected, found=f"{name} = {text!r}")

    @property
    def not_stated(self) -> list[str]:
        """The headings of the statements that are missing."""
        return [text.lower() for name, text in STATEMENTS.items() if name not in self.statements]


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
        gaps: what only the author can state, and did not.
        lossy_mm: step to which coordinates of points were rounded, millimetres; None for exact
            ones.
    """

    overview: Overview
    sequences: Mapping[str, StoredSequence] = field(repr=False)
    parts: tuple[LicensedPart, ...]
    statistics: tuple[Statistics, ...]
    every: int
    reports: Mapping[str, Report]
    gaps: tuple[str, ...]
    lossy_mm: float | None

    @cached_property
    def frames(self) -> int:
        """Number of frames of all sequences."""
        return sum(sequence.frames for sequence in self.overview.sequences)

    @cached_property
    def fields(self) -> dict[str, int]:
        """Number of frames of each field, without the fields of grids."""
        counts = sum((Counter(one.fields) for one in self.overview.sequences), Counter[str]())
        return dict(sorted(counts.items()))

    @cached_property
    def grids(self) -> list[tuple[GridOverview, int, int]]:
        """Each kind of grid, with its number of sequences and of frames.

        Grids of one kind differ only in their sequence.
        """
        kinds: dict[str, list[GridOverview]] = {}
        for sequence in self.overview.sequences:
            for grid in sequence.grids:
                kinds.setdefault(repr(replace(grid, frames=0)), []).append(grid)
        return [
            (grids[0], len(grids), sum(grid.frames for grid in grids)) for grids in kinds.values()
        ]

    @cached_property
    def licenses(self) -> list[License]:
        """The licences, the strictest first."""
        return list(dict.fromkeys(part.license for part in self.parts))

    @cached_property
    def citations(self) -> dict[str, str]:
        """What to cite for each source of converted sequences; "" if carlasc.json does not say."""
        return {
            about.source: str(about.extra.get("citation") or "")
            for about in self.metadata
            if about.source is not None
        }

    @property
    def metadata(self) -> list[Metadata]:
        """The carlasc.json of each sequence."""
        return [sequence.metadata for sequence in self.sequences.values()]

    @property
    def simulated(self) -> str:
        """The sequences that were recorded in a simulator, as their carlasc.json says: "all", "2 of
        3 sequences", or "" for none.
        """
        number = len(_recorded(self.metadata))
        count = len(self.sequences)
        if number == count:
            return ""
        return f"{count - number} of {count} sequences" if number else "all"

    @property
    def failures(self) -> list[tuple[str, str]]:
        """(file, message) of each file that could not be read."""
        return [failure for one in self.statistics for failure in one.failures]

    def said(self, key: str) -> str:
        """Return the values of a key of carlasc.json, without false ones; "" if none has it."""
        return ", ".join(
            sorted({str(one.extra[key]) for one in self.metadata if one.extra.get(key)})
        )

    def limits(self) -> Iterator[str]:
        """Yield the limits that the data themselves show, one sentence each."""
        known = sum(int(one.total.voxels.sum()) for one in self.statistics)
        if unknown := sum(one.total.unknown for one in self.statistics):
            yield say("unknown", share=f"{unknown / (known + unknown):.1%}")
        if gaps := sum(sequence.gaps for sequence in self.overview.sequences):
            yield say("gaps", places=gaps)
        if self.failures:
            yield say("unreadable", files=len(self.failures))
        inferred = {name: one.inferred_share or 0 for name, one in self.reports.items()}
        for name, share in sorted(inferred.items(), key=lambda row: -row[1])[:_MOST_LIMITS]:
            if share:
                yield say("inferred", share=f"{share:.1%}", grid=name)
        for near, far in sorted({(m.min_range_m, m.max_range_m) for m in self.metadata}, key=str):
            limits = {"nearer": near, "farther": far}
            if shown := [f"{how} than {limit:g} m" for how, limit in limits.items() if limit]:
                yield say("ranges", limits=" or ".join(shown))
        if self.lossy_mm:
            yield say("rounded", step=f"{self.lossy_mm:g}")
        if self.every > 1:
            yield say("counted", every=self.every)
        for one in self.statistics:
            if of := sum(one.places.values()):
                yield say("sampled", counted=len(one.sequences), of=of)


def _recorded(metadata: Iterable[Metadata]) -> list[Metadata]:
    """Return those that do not say that their sequence was recorded in a simulator."""
    return [about for about in metadata if about.extra.get("simulated") is not True]


def _gaps(
    sequences: Iterable[StoredSequence], parts: Iterable[LicensedPart], details: CardDetails
) -> Iterator[str]:
    """Yield the arguments that are missing. Simulated data show no people and no places."""
    recorded = _recorded(one.metadata for one in sequences)
    if unlicensed := [part.source for part in parts if part.license is UNSTATED]:
        named = " and ".join(sorted(filter(None, unlicensed)))
        yield f"license of {named}" if named else "license"
    if recorded and "personalSensitiveInformation" not in details.statements:
        yield "statements (personalSensitiveInformation)"
    if recorded and not details.place:
        yield "place"
    cited = all(about.source and about.extra.get("citation") for about in recorded)
    if not (cited or details.citation):
        yield "citation"


def gather(
    source: Source,
    details: CardDetails,
    every: int,
    sample: int | None,
    run: Run,
    *,
    draft: bool,
) -> Facts:
    """Read the facts of a card.

    Raises:
        MissingDataError: the source has no sequences.
        FormatError: a sequence cannot be described.
        ArgumentError: something that only the author can state is missing, and this is no draft.
        ArgumentError, FormatError, CarlascError: see `licensed_parts` and `stats`.
    """
    if every < 1:
        raise ArgumentError("every", expected="1 or more", found=every)
    sequences = {path: one for path, one in source.sequences().items() if one.fields()}
    if not sequences:
        advice = "make them with `carlasc regrid`"
        raise MissingDataError(source.location, expected="sequences", found="none", advice=advice)
    license_ = None if details.license is None else license_given(details.license)
    parts = licensed_parts(sequences.values(), license_)
    gaps = tuple(_gaps(sequences.values(), parts, details))
    if gaps and not draft:
        raise ArgumentError(
            gaps[0].partition(" ")[0],
            expected=f"{', '.join(gaps)} of {source.location}, which only the author can state",
            found="none",
            advice="state what is missing, or mark the gaps with `draft=True`; carlasc.json of "
            'simulated data has "simulated": true',
        )
    overview = info(source)
    tables: dict[str, dict[str, StoredSequence]] = {}
    reports = {}
    counted = []
    for one in overview.sequences:
        # A grid that cannot be described would be missing from the card without a message.
        if one.problem:
            raise FormatError(one.path or source.location, problem=one.problem)
    for path, sequence in sequences.items():
        for grid in sequence.grids:
            if (report := report_beside(sequence, grid)) is not None:
                reports[f"{path}/{grid}".lstrip("/")] = report
        if any(name.rpartition("/")[2] == "labels" for name in sequence.fields()):
            tables.setdefault(sequence.metadata.classes.name, {})[path] = sequence
    for chosen in tables.values():
        with suppress(MissingDataError):  # several grids without the published one
            one_table = ChosenSequences(source.location, chosen)
            counted.append(stats(one_table, remap=None, every=every, sample=sample, run=run))
    lossy_mm = source.lossy_mm if isinstance(source, PackedSource) else None
    return Facts(overview, sequences, parts, tuple(counted), every, reports, gaps, lossy_mm)
