"""README.md: the card for people.

It begins with YAML that the Hugging Face Hub reads
(https://huggingface.co/docs/hub/datasets-cards).
"""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from carlasc.errors import printable
from carlasc.inspection.cards.facts import CardDetails, Facts, shares
from carlasc.inspection.cards.places import Place, PublishedTable
from carlasc.inspection.cards.responsibility import (
    annotation,
    biases,
    collection,
    how_made,
    limitations,
    preprocessing,
    responsibility,
    uses,
)
from carlasc.inspection.overview import GridOverview, SequenceOverview
from carlasc.inspection.texts import fill, read, say
from carlasc.storage.layout import EVALUATION

_SIZES = (
    (1_000, "n<1K"),
    (10_000, "1K<n<10K"),
    (100_000, "10K<n<100K"),
    (1_000_000, "100K<n<1M"),
    (10**7, "1M<n<10M"),
)
_MOST_SEQUENCES = 60  # rows of the table of sequences


def readme(
    facts: Facts,
    details: CardDetails,
    place: Place,
    tables: Sequence[PublishedTable],
    pictures: Sequence[tuple[str, str]],
) -> bytes:
    """Return the bytes of README.md.

    Args:
        facts: what was read from the data.
        details: what is not in the data; with a name, a description and a date.
        place: the location of the data.
        tables: the tables of a Parquet store.
        pictures: (path below the folder of the card, content) of each picture.
    """
    opening = [
        _text(details.description or ""),
        *(f"![{_text(caption)}]({path})" for path, caption in pictures),
    ]
    text = fill(
        "card.md",
        front_matter=_front_matter(facts, details, place, tables),
        name=_text(details.name or ""),
        opening="\n\n".join(opening),
        glance=_glance(facts, details),
        reading=_opening(facts, place, tables),
        classes=_classes(facts),
        sequences=_sequences(facts),
        making=_making(facts),
        licenses=_licenses(facts),
        limits=_limits(facts, details),
        citation=_citation(facts, details),
    )
    return text.encode()


def _front_matter(
    facts: Facts, details: CardDetails, place: Place, tables: Sequence[PublishedTable]
) -> str:
    names = list(dict.fromkeys(license_.hub for license_ in facts.licenses))
    others = [license_ for license_ in facts.licenses if license_.hub == "other"]
    values: dict[str, Any] = {"license": names[0] if len(names) == 1 else names}
    if others:
        values |= {
            "license_name": re.sub(r"[^a-z0-9.]+", "-", others[0].name.lower()).strip("-"),
            "license_link": others[0].url,
        }
    values |= {
        "pretty_name": details.name,
        "task_categories": ["other"],
        "size_categories": [next((name for most, name in _SIZES if facts.frames < most), "n>10M")],
        "tags": _tags(facts),
    }
    if tables:
        values["configs"] = [
            {
                "config_name": table.name,
                **({"default": True} if place_first else {}),
                "data_files": [
                    {"split": split, "path": [glob.escape(place.published(path)) for path in paths]}
                    for split, paths in sorted(
                        table.files.items(), key=lambda item: _SPLITS.index(item[0])
                    )
                ],
            }
            for place_first, table in ((number == 0, table) for number, table in enumerate(tables))
        ]
    else:
        values["viewer"] = (
            False  # otherwise, the Hub would take the pictures of the card for the data
        )
    return _yaml(values)


_SPLITS = ("train", "validation", "test")


def _tags(facts: Facts) -> list[str]:
    tags = [
        "croissant",
        "carlasc",
        "lidar",
        "3d",
        "voxel-grid",
        "semantic-scene-completion",
        "occupancy-prediction",
        "autonomous-driving",
    ]
    tags += ["scene-flow"] if "flow" in facts.fields else []
    tags += ["simulation", "carla"] if facts.simulated else []
    return tags


def _yaml(value: Any, indent: str = "") -> str:
    """Return plain values as YAML: blocks for lists and objects, and JSON (a subset of YAML) for
    other values.
    """
    lines = []
    for key, entry in value.items() if isinstance(value, Mapping) else enumerate(value):
        head = f"{indent}- " if not isinstance(value, Mapping) else f"{indent}{key}:"
        if isinstance(entry, Mapping) and not isinstance(value, Mapping):
            block = _yaml(entry, indent + "  ")
            lines.append(head + block.removeprefix(indent + "  "))
        elif isinstance(entry, Mapping | list):
            lines.append(f"{head.rstrip()}\n" + _yaml(entry, indent + "  "))
        else:
            lines.append(f"{head.rstrip()} {json.dumps(entry, ensure_ascii=False)}\n")
    return "".join(lines)


def _glance(facts: Facts, details: CardDetails) -> str:
    rows = [
        ["frames", f"{facts.frames:,} in {facts.sequences_told}"],
        [
            "frames by split",
            ", ".join(f"{name} {frames:,}" for name, (_, frames) in facts.splits.items()),
        ],
        ["fields of scans", ", ".join(facts.fields) or "none"],
        ["grids", "; ".join(_grid(grid) for grid, _, _ in facts.grids) or "none"],
        [
            "sensors",
            ", ".join(facts.sensors) or ("simulated LiDAR" if facts.simulated else "not named"),
        ],
        ["axes", " and ".join(sorted({one.axes for one in facts.overview.sequences})) + "-handed"],
        ["licence", ", ".join(license_.name for license_ in facts.licenses)],
        ["version", f"{details.version}, {details.published}"],
    ]
    rows += [["authors", ", ".join(details.authors)]] if details.authors else []
    rows += [["page", details.url]] if details.url else []
    rows += [["contact", details.contact]] if details.contact else []
    return _table(["", ""], rows)


def _grid(grid: GridOverview) -> str:
    size = " x ".join(map(str, grid.size))
    cells = " x ".join(f"{edge:.3g}" for edge in grid.voxel_size)
    return f"{grid.name} ({grid.coordinates}, {size} voxels of {cells}{' m' if grid.coordinates == 'cartesian' else ''})"


def _opening(facts: Facts, place: Place, tables: Sequence[PublishedTable]) -> str:
    name, first = place.name or ".", facts.overview.sequences[0]
    extra = {"zarr": "[zarr]", "hdf5": "[hdf5]", "parquet": "[parquet]"}.get(
        facts.overview.store, ""
    )
    target = place.repository and f"hf://datasets/{place.repository.partition('/datasets/')[2]}" + (
        f"/{place.name}" if place.name else ""
    )
    text = [
        say("open_folder", extra=extra),
        say(
            "open_python",
            name=json.dumps(name),
            path=json.dumps(first.path),
            reading=_first_read(first),
            samples=_samples(facts, name),
        ),
    ]
    if target:
        text.append(say("open_hub", target=json.dumps(target)))
    if tables:
        config = next((table for table in tables if table.name == "points"), tables[0])
        split = json.dumps(sorted(config.files, key=_SPLITS.index)[0])
        hub = place.repository and json.dumps(place.repository.partition("/datasets/")[2])
        # "." would be a data set without a name
        data = say("data_on_hub", name=hub) if hub else say("data_here")
        text += [
            say("open_tables"),
            say("open_datasets", data=data, split=split, config=json.dumps(config.name)),
            say("order_of_rows"),
            _table(
                ["configuration", "rows", "columns"],
                [[t.name, t.title, ", ".join(t.columns)] for t in tables],
            ),
        ]
        text += [say("whole_numbers", step=f"{facts.lossy_mm:g}")] if facts.lossy_mm else []
    return "\n\n".join(text)


def _first_read(first: SequenceOverview) -> str:
    """Return a line of Python that reads a frame of a sequence."""
    if first.grids:
        grid = first.grids[0]
        return f"grid = sequence.grid({json.dumps(grid.name)}, {first.first})  # labels and counts, arrays of shape {grid.size}"
    return f"scan = sequence.scan({first.first})  # points (N, 4), labels (N,)"


def _samples(facts: Facts, name: str) -> str:
    """Return a line of Python that opens the data for training; "" without scans, or without grids
    of one name.
    """
    if not all("points" in one.fields and one.grids for one in facts.overview.sequences):
        return ""
    common = set.intersection(
        *({grid.name for grid in one.grids} for one in facts.overview.sequences)
    )
    if not common:
        return ""
    chosen = "" if EVALUATION in common else f", grid={json.dumps(min(common))}"
    return f"dataset = carlasc.Dataset({json.dumps(name)}{chosen})  # samples for training\n"


def _classes(facts: Facts) -> str:
    if not facts.statistics:
        return say("no_labels")
    text = []
    for one in facts.statistics:
        rows = [
            [str(index), name, _percent(of_points), _percent(of_voxels)]
            for index, name, of_points, of_voxels in shares(one, one.total)
        ]
        text.append(say("class_table", name=_text(one.classes.name)))
        text.append(_table(["id", "class", "points %", "known voxels %"], rows))
    share = facts.known_share() if any(one.total.grids for one in facts.statistics) else None
    known = "" if share is None else say("known_share", share=f"{share:.1%}")
    text.append(say("class_zero", known=known))
    text += [say("counted_here", every=facts.every)] if facts.every > 1 else []
    return "\n\n".join(text)


def _sequences(facts: Facts) -> str:
    rows = [[name, str(count), f"{frames:,}"] for name, (count, frames) in facts.splits.items()]
    text = [_table(["split", "sequences", "frames"], rows)]
    licenses = {path: part.license.name for part in facts.parts for path in part.paths}
    rows = [
        [
            one.path or one.name,
            str(one.frames),
            one.source or "simulator",
            licenses.get(one.path, ""),
            one.classes,
        ]
        for one in facts.overview.sequences
    ]
    text.append(
        _table(["sequence", "frames", "made from", "licence", "classes"], rows[:_MOST_SEQUENCES])
    )
    if len(rows) > _MOST_SEQUENCES:
        text.append(say("more_sequences", count=len(rows) - _MOST_SEQUENCES))
    return "\n\n".join(text)


def _making(facts: Facts) -> str:
    text = [_text(" ".join([*collection(facts), *annotation(facts), *preprocessing(facts)]))]
    rows = [
        [grid.name, str(count), f"{frames:,}", how_made(grid.made)]
        for grid, count, frames in facts.grids
    ]
    if rows:
        text.append(_table(["grid", "sequences", "frames", "how it was made"], rows))
    if facts.reports:
        rows = [
            [
                name,
                _percent(one.coverage.known_share),
                _percent(one.coverage.occupied_share),
                "" if one.convergence is None else _percent(one.convergence.changed_share),
                ", ".join(f"{what} {version}" for what, version in one.versions.items()),
            ]
            for name, one in facts.reports.items()
        ]
        text.append(say("from_reports"))
        header = [
            "grid",
            "known voxels %",
            "occupied of these %",
            "changed with a tenth fewer scans %",
            "made with",
        ]
        text.append(_table(header, rows[:_MOST_SEQUENCES]))
    text += [say("settings")] if facts.grids else []
    return "\n\n".join(text)


def _licenses(facts: Facts) -> str:
    rows = [
        [
            part.source or "simulated sequences",
            f"[{part.license.name}]({part.license.url})",
            part.license.conditions,
            str(len(part.paths)),
            "the author of this card" if part.stated else "carlasc.json of the sequences",
        ]
        for part in facts.parts
    ]
    text = [_table(["source", "licence", "conditions", "sequences", "named by"], rows, links=True)]
    text += [say("several_licenses")] if len(facts.licenses) > 1 else []
    text += [say("license_of_source")] if facts.sources else []
    return "\n\n".join(text)


def _limits(facts: Facts, details: CardDetails) -> str:
    told = responsibility(facts, details)
    personal = told["personalSensitiveInformation"]
    items = [
        "Made for: " + "; ".join(uses(facts)) + ".",
        *limitations(facts),
        *biases(facts),
        f"Personal data: {personal[0] if isinstance(personal, list) else personal}",
        str(told["dataSocialImpact"]),
    ]
    return "\n".join(f"- {_text(item)}" for item in items)


def _citation(facts: Facts, details: CardDetails) -> str:
    text = [_code(details.citation)] if details.citation else []
    if facts.sources:
        papers = [
            f"{source}: {paper or 'see the page of its publishers'}"
            for source, paper in facts.citations.items()
        ]
        text.append(say("cite_sources"))
        text.append("\n".join(f"- {_text(line)}" for line in papers))
    if details.citation or not facts.simulated:
        text.append(say("cite_layout"))
    text += [_code(read("motionsc.bib")), say("cite_software")]
    return "\n\n".join(text)


def _code(text: str) -> str:
    fence = "`" * max(3, 1 + max((len(run) for run in re.findall("`+", text)), default=0))
    return f"{fence}bibtex\n{text.strip()}\n{fence}"


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.2f}"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], *, links: bool = False) -> str:
    """Return a table; with `links`, cells may hold links and are not escaped."""
    lines = [header, ["---"] * len(header), *rows]
    cells = [[cell if links else _text(cell) for cell in line] for line in lines]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in cells
    )


def _text(text: str) -> str:
    """Return a text, escaped for Markdown: names come from data, and must not start a tag, link or
    heading.
    """
    shown = printable(" ".join(text.split()))
    return (
        re.sub(r"([\\`*_\[\]<>])", r"\\\1", shown) if re.search(r"[`*\[\]<>\\]", shown) else shown
    )
