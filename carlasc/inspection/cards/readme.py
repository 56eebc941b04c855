"""README.md: the card for people.

It begins with YAML that the Hugging Face Hub reads
(https://huggingface.co/docs/hub/datasets-cards).
"""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Sequence
from typing import Any

from carlasc.errors import count, printable
from carlasc.inspection.cards.card_tables import MOST_ROWS, Table
from carlasc.inspection.cards.facts import STATEMENTS, CardDetails, Facts
from carlasc.inspection.cards.places import Place, PublishedTable
from carlasc.inspection.texts import fill, say

_SIZES = {
    "n<1K": 10**3,
    "1K<n<10K": 10**4,
    "10K<n<100K": 10**5,
    "100K<n<1M": 10**6,
    "1M<n<10M": 10**7,
}
_TAGS = (
    "croissant carlasc lidar 3d voxel-grid semantic-scene-completion occupancy-prediction "
    "autonomous-driving"
).split()


def readme(
    facts: Facts,
    details: CardDetails,
    place: Place,
    tables: Sequence[PublishedTable],
    shown: Sequence[Table],
    pictures: Sequence[tuple[str, str]],
) -> bytes:
    """Return the bytes of README.md.

    Args:
        facts: what was read from the data.
        details: what is not in the data; with a name, a description and a date.
        place: the location of the data.
        tables: the tables of a Parquet store.
        shown: the tables of the card.
        pictures: (path below the folder of the card, content) of each picture.
    """
    draft = [f"**{say('draft', names=', '.join(facts.gaps))}**"] if facts.gaps else []
    drawn = [f"![{_text(caption)}]({path})" for path, caption in pictures]
    stated = [f"### {STATEMENTS[name]}\n\n{text}" for name, text in details.statements.items()]
    if details.not_stated:
        stated.append(say("not_stated", names=", ".join(details.not_stated)))
    return fill(
        "card.md",
        front_matter=_front_matter(facts, details, place, tables),
        name=_text(details.name or ""),
        opening="\n\n".join([*draft, _text(details.description or ""), *drawn]),
        glance=_glance(facts, details),
        reading=_opening(facts, place, tables),
        **{name: _section(shown, name) for name in ("classes", "sequences", "grids", "licenses")},
        statements="\n\n".join(stated),
        limits="\n".join(f"- {_text(limit)}" for limit in facts.limits()) or "None.",
        citation=_citation(facts, details),
    ).encode()


def _front_matter(
    facts: Facts, details: CardDetails, place: Place, tables: Sequence[PublishedTable]
) -> str:
    names = list(dict.fromkeys(license_.hub for license_ in facts.licenses))
    values: dict[str, Any] = {"license": names[0] if len(names) == 1 else names}
    if others := [license_ for license_ in facts.licenses if license_.hub == "other"]:
        values["license_name"] = re.sub(r"[^a-z0-9.]+", "-", others[0].name.lower()).strip("-")
        values["license_link"] = others[0].url
    tags = {"scene-flow": "flow" in facts.fields, "simulation": bool(facts.simulated)}
    values |= {
        "pretty_name": details.name,
        "task_categories": ["other"],
        "size_categories": [
            next((name for name, most in _SIZES.items() if facts.frames < most), "n>10M")
        ],
        "tags": [*_TAGS, *(tag for tag, holds in tags.items() if holds)],
    }
    if tables:
        values["configs"] = [
            {
                "config_name": table.name,
                "default": table is tables[0],
                "data_files": [
                    {"split": split, "path": [glob.escape(place.published(path)) for path in paths]}
                    for split, paths in table.in_order()
                ],
            }
            for table in tables
        ]
    else:
        values["viewer"] = False  # The Hub would take the pictures of the card for the data.
    # JSON is a subset of YAML.
    lines = (f"{key}: {json.dumps(value, ensure_ascii=False)}\n" for key, value in values.items())
    return "".join(lines)


def _glance(facts: Facts, details: CardDetails) -> str:
    sequences = facts.overview.sequences
    rows = {
        "frames": f"{facts.frames:,} in {count(len(sequences), 'sequence')}",
        "fields of scans": ", ".join(f"{name} {n:,}" for name, n in facts.fields.items()),
        "sensors": ", ".join(sorted({one.sensor for one in sequences if one.sensor}))
        or "not named",
        "axes": " and ".join(sorted({one.axes for one in sequences})) + "-handed",
        "poses": facts.said("poses"),
        "labels": facts.said("labels"),
        "simulated": facts.simulated,
        "place": details.place,
        "licence": ", ".join(license_.name for license_ in facts.licenses),
        "version": f"{details.version}, {details.published}",
        "authors": ", ".join(details.authors),
        "page": details.url,
        "contact": details.contact,
    }
    return _table(["", ""], [pair for pair in rows.items() if pair[1]])


def _opening(facts: Facts, place: Place, tables: Sequence[PublishedTable]) -> str:
    name = place.name or "."
    first = facts.overview.sequences[0]
    store = facts.overview.store
    on_hub = place.repository and place.repository.partition("/datasets/")[2]
    read = f"scan = sequence.scan({first.first})  # points (N, 4), labels (N,)"
    if first.grids:
        grid = first.grids[0]
        read = f"grid = sequence.grid({json.dumps(grid.name)}, {first.first})"
        read += f"  # labels and counts, arrays of shape {grid.size}"
    # Samples for training need scans in all sequences, and grids of one name.
    grids = (
        {grid.name for grid in one.grids if "points" in one.fields}
        for one in facts.overview.sequences
    )
    samples = ""
    if common := set.intersection(*grids):
        grid_name = json.dumps(min(common))
        samples = f"dataset = carlasc.Dataset({json.dumps(name)}, grid={grid_name})  # samples\n"
    path = json.dumps(first.path)
    text = [
        say("open_folder", extra=f"[{store}]" if store in ("zarr", "hdf5", "parquet") else ""),
        say("open_python", name=json.dumps(name), path=path, reading=read, samples=samples),
    ]
    if on_hub:
        target = f"hf://datasets/{on_hub}/{place.name}".rstrip("/")
        text.append(say("open_hub", target=json.dumps(target)))
    if tables:
        config = next((table for table in tables if table.name == "points"), tables[0])
        split = json.dumps(config.in_order()[0][0])
        # "." would be a data set without a name
        data = say("data_on_hub", name=json.dumps(on_hub)) if on_hub else say("data_here")
        rows = [[table.name, table.title, ", ".join(table.columns)] for table in tables]
        text += [
            say("open_tables"),
            say("open_datasets", data=data, split=split, config=json.dumps(config.name)),
            say("order_of_rows"),
            _table(["configuration", "rows", "columns"], rows),
        ]
        text += [say("whole_numbers", step=f"{facts.lossy_mm:g}")] if facts.lossy_mm else []
    return "\n\n".join(text)


def _section(tables: Sequence[Table], name: str) -> str:
    text = []
    for _, _, title, rows in (table for table in tables if table.section == name):
        shown = [list(row.values()) for row in rows[:MOST_ROWS]]
        text += [_text(title), _table([*rows[0]], shown)]
        if len(rows) > MOST_ROWS:
            text.append(say("more_rows", count=len(rows) - MOST_ROWS))
    return "\n\n".join(text) or "None."


def _citation(facts: Facts, details: CardDetails) -> str:
    text = []
    if details.citation:
        runs = (len(run) for run in re.findall("`+", details.citation))
        fence = "`" * max(3, 1 + max(runs, default=0))
        text.append(f"{fence}bibtex\n{details.citation.strip()}\n{fence}")
    papers = [
        say("cite_source", source=source, paper=paper or "see the page of its publishers")
        for source, paper in facts.citations.items()
    ]
    text += ["\n".join(map(_text, papers))] if papers else []
    return "\n\n".join([*text, say("cite_layout")])


def _table(header: Sequence[str], rows: Sequence[Sequence[str | int | float | None]]) -> str:
    """Return a table; floats are shares, and None is an empty cell."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(map(_cell, line)) + " |" for line in lines)


def _cell(value: str | int | float | None) -> str:
    if isinstance(value, float):
        return f"{value:.2%}"
    return "" if value is None else _text(str(value)).replace("|", "\\|")


def _text(text: str) -> str:
    """Return a text, escaped for Markdown: names come from data, and must not start a tag, link or
    heading.
    """
    shown = printable(" ".join(text.split()))
    if re.search(r"[`*\[\]<>\\]", shown):
        return re.sub(r"([\\`*_\[\]<>])", r"\\\1", shown)
    return shown
