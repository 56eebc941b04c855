"""Writing the card of a data set: README.md, croissant.json and pictures."""

from __future__ import annotations

import datetime
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from carlasc.errors import (
    ArgumentError,
    ConflictError,
    DependencyError,
    FormatError,
    MissingDataError,
    check_types,
    count,
)
from carlasc.inspection.cards.card_tables import tables_of_card
from carlasc.inspection.cards.croissant import croissant, vocabulary
from carlasc.inspection.cards.facts import CardDetails, Facts, gather
from carlasc.inspection.cards.places import place_of, tables_of
from carlasc.inspection.cards.readme import readme
from carlasc.inspection.texts import say
from carlasc.running.spreading import Run
from carlasc.storage import as_source
from carlasc.storage.files import AnyPath, parse_json, write_output
from carlasc.storage.parquet.parquet_source import ParquetSource
from carlasc.storage.protocol import Source

README = "README.md"
CROISSANT = "croissant.json"
PICTURES = "images"
_PICTURED: tuple[Literal["grid", "scan"], ...] = ("grid", "scan")
_SIZE = (960, 540)  # of a picture, pixels


@dataclass(frozen=True)
class CardResult:
    """What was written.

    Attributes:
        folder: the folder of the card.
        files: the files, README.md first.
        frames: number of frames of the data set.
        sequences: number of its sequences.
        licenses: names of the licences that hold, the strictest first.
        notes: what is missing in the card, and why.
        failures: (file, message) of each file that could not be read.
    """

    folder: Path
    files: tuple[Path, ...]
    frames: int
    sequences: int
    licenses: tuple[str, ...]
    notes: tuple[str, ...] = ()
    failures: tuple[tuple[str, str], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        return asdict(self) | {"folder": str(self.folder), "files": list(map(str, self.files))}


def card(
    source: AnyPath | Source,
    out: AnyPath | None = None,
    *,
    about: CardDetails = CardDetails(),  # noqa: B008 (frozen)
    pictures: bool = True,
    draft: bool = False,
    every: int = 1,
    sample: int | None = None,
    overwrite: bool = False,
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
) -> CardResult:
    """Write the card of a data set: README.md with the YAML that the Hugging Face Hub reads,
    croissant.json, and pictures.

    Counts, classes, splits, sensors, licences, sources, settings and limits are read from the data.
    All other details are given in `about`, and what neither says is named as not stated.

    Args:
        source: a path or URL that `carlasc.open` knows, or a Source at such a place.
        out: folder of the card, the root folder of the publication. None: the source, if it is a
            folder or a Parquet store; otherwise the folder that contains it.
        about: details that are not in the data: their name, authors, licence, and how to cite them.
        pictures: draw a grid and a scan (needs the extra `render`).
        draft: write the card although licence, personal data, place or citation are not stated, and
            name the gaps in it.
        every: count the classes of every N-th frame.
        sample: number of sequences whose classes are counted, evenly spaced. None: all.
        overwrite: replace an existing card.
        run: how the counting is spread, with a callback for progress.

    Returns:
        What was written. Frames that could not be read are listed in `failures`.

    Raises:
        MissingDataError: there is no data set, or it has no sequences.
        ArgumentError: a licence, a version or a date is not valid; the licence contradicts that of
            the source; or something that only the author can state is missing, and this is no
            draft: the licence, and for data that do not say that they were simulated, personal
            data, place and citation.
        FormatError: the data do not have the format, or the licence in carlasc.json is not known.
        CarlascError: the licence of the source forbids publishing derived data.
        ConflictError: a card exists, and `overwrite` is not given.
        StorageError: the folder cannot be written to.
    """
    check_types(card, locals())
    opened = as_source(source)
    place, folder = place_of(source, None if out is None else Path(out), about.url)
    overwrite = _check_free(folder, overwrite, pictures)
    facts = gather(opened, about, every, sample, run, draft=draft)
    tables = tables_of(opened) if isinstance(opened, ParquetSource) else []
    shown = list(tables_of_card(facts))
    part = "" if facts.simulated == "all" else f"{facts.simulated} "
    made = say("simulated", part=part) if facts.simulated else ""
    made += say("converted", sources=", ".join(facts.citations)) if facts.citations else ""
    frames = count(facts.frames, "LiDAR frame")
    sequences = count(len(facts.sequences), "sequence")
    summary = say("summary", frames=frames, sequences=sequences, made=made)
    details = replace(
        about,
        name=about.name or place.title,
        description=about.description or summary,
        published=about.published or datetime.datetime.now(datetime.UTC).date().isoformat(),
    )
    write_output(folder / CROISSANT, croissant(facts, details, place, tables, shown))
    drawn, notes = _draw(facts, folder, overwrite) if pictures else ([], [])
    if facts.gaps:
        notes.append(say("draft", names=", ".join(facts.gaps)))
    if details.not_stated:
        notes.append(say("not_stated", names=", ".join(details.not_stated)))
    images = [(path.relative_to(folder).as_posix(), text) for path, text in drawn]
    write_output(folder / README, readme(facts, details, place, tables, shown, images))
    return CardResult(
        folder,
        (folder / README, folder / CROISSANT, *(path for path, _ in drawn)),
        facts.frames,
        len(facts.sequences),
        tuple(one.name for one in facts.licenses),
        tuple(notes),
        tuple(facts.failures),
    )


def _check_free(folder: Path, overwrite: bool, pictures: bool) -> bool:
    """Check that no card exists, before anything is counted; return whether files may be replaced.

    croissant.json is the first file of a card, and README.md the last: a folder with the first one
    only is from a run that was killed.
    """
    if folder.exists() and not folder.is_dir():
        raise ArgumentError("out", expected="a folder", found=f"the file {folder}")
    replaces = overwrite or (not (folder / README).exists() and _is_ours(folder / CROISSANT))
    drawn = [folder / PICTURES / f"{what}.png" for what in _PICTURED] if pictures else []
    for path in (folder / README, folder / CROISSANT, *drawn):
        if path.exists() and not replaces:
            advice = "choose another folder, or replace it with `overwrite=True`"
            raise ConflictError(path, problem="exists already", advice=advice)
    return replaces


def _is_ours(path: Path) -> bool:
    """Whether a file is a croissant.json that carlasc wrote."""
    try:
        writer = parse_json(path.read_bytes(), str(path)).get("sdPublisher")
    except (OSError, FormatError):
        return False
    return bool(writer == vocabulary()["dataset"]["sdPublisher"])


def _draw(facts: Facts, folder: Path, overwrite: bool) -> tuple[list[tuple[Path, str]], list[str]]:
    """Draw a grid and a scan; return (file, content) of each picture, and a note for each picture
    that could not be drawn.
    """
    from carlasc.viewing import Scene, StyleOptions, render

    drawn = []
    notes = []
    for what in _PICTURED:
        for path, sequence in facts.sequences.items():
            grid = next(iter(sequence.grids), None) if what == "grid" else None
            field = "points" if what == "scan" else f"{grid}/labels"
            if field not in sequence.fields():
                continue
            frames = sequence.frames(field)
            frame = int(frames[len(frames) // 2])
            target = folder / PICTURES / f"{what}.png"
            style = StyleOptions(size=_SIZE)
            try:
                scene = Scene(sequence, frames=(frame, frame + 1), grid=grid)
                result = render(scene, target, what=what, style=style, overwrite=overwrite)
                drawn.append((result.out, f"Frame {frame} of {path or sequence.name}: {what}"))
            except (DependencyError, MissingDataError) as error:
                notes.append(f"no picture of a {what}: {error}")
            break
    return drawn, notes
