"""README.md: the card for people, with the YAML that the Hugging Face Hub reads at its head (https://huggingface.co/docs/hub/datasets-cards)."""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from carlasc.errors import printable
from carlasc.inspection.cards.facts import MOTIONSC, Details, Facts, shares
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
from carlasc.storage.layout import EVALUATION

_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"), (10**7, "1M<n<10M"))
_MOST_SEQUENCES = 60  # rows of the table of sequences


def readme(
    facts: Facts,
    details: Details,
    place: Place,
    tables: Sequence[PublishedTable],
    description: str,
    pictures: Sequence[tuple[str, str]],
) -> bytes:
    """Return the bytes of README.md; `pictures` are (path below the folder of the card, what it shows)."""
    sections = [
        f"# {_text(details.name)}",
        _text(description),
        *(f"![{_text(caption)}]({path})" for path, caption in pictures),
        _glance(facts, details),
        "## Open it\n\n" + _opening(facts, place, tables),
        "## Classes\n\n" + _classes(facts),
        "## Splits and sequences\n\n" + _sequences(facts),
        "## How it was made\n\n" + _making(facts),
        "## Licence\n\n" + _licenses(facts),
        "## Uses, limits and biases\n\n" + _limits(facts, details),
        "## Citation\n\n" + _citation(facts, details),
    ]
    return (_front_matter(facts, details, place, tables) + "\n\n".join(sections) + "\n").encode()


def _front_matter(facts: Facts, details: Details, place: Place, tables: Sequence[PublishedTable]) -> str:
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
                    for split, paths in sorted(table.files.items(), key=lambda item: _SPLITS.index(item[0]))
                ],
            }
            for place_first, table in ((number == 0, table) for number, table in enumerate(tables))
        ]
    else:
        values["viewer"] = False  # the Hub would show the pictures of the card as if they were the data
    return f"---\n{_yaml(values)}---\n\n"


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
    """Return plain values as YAML: blocks for lists and objects, and JSON, which is YAML, for the rest."""
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


def _glance(facts: Facts, details: Details) -> str:
    rows = [
        ["frames", f"{facts.frames:,} in {facts.sequences_told}"],
        ["splits", ", ".join(f"{name} {frames:,}" for name, (_, frames) in facts.splits.items())],
        ["fields of scans", ", ".join(facts.fields) or "none"],
        ["grids", "; ".join(_grid(grid) for grid, _, _ in facts.grids) or "none"],
        ["sensors", ", ".join(facts.sensors) or ("simulated LiDAR" if facts.simulated else "not named")],
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
    return (
        f"{grid.name} ({grid.coordinates}, {size} voxels of {cells}{' m' if grid.coordinates == 'cartesian' else ''})"
    )


def _opening(facts: Facts, place: Place, tables: Sequence[PublishedTable]) -> str:
    name, first = place.name or ".", facts.overview.sequences[0]
    extra = {"zarr": "[zarr]", "hdf5": "[hdf5]", "parquet": "[parquet]"}.get(facts.overview.store, "")
    target = place.repository and f"hf://datasets/{place.repository.partition('/datasets/')[2]}" + (
        f"/{place.name}" if place.name else ""
    )
    text = [
        f"With carlasc (`pip install 'carlasc{extra}'`), in the folder of this file:",
        f"```python\nimport carlasc\n\nsequence = carlasc.open({json.dumps(name)}).sequences()[{json.dumps(first.path)}]\n"
        f"{_first_read(first)}\n{_samples(facts, name)}```",
    ]
    if target:
        text.append(f"Without a download: `carlasc.open({json.dumps(target)})`, with the extra `hub` too.")
    if tables:
        config = next((table for table in tables if table.name == "points"), tables[0])
        split = json.dumps(sorted(config.files, key=_SPLITS.index)[0])
        text.append("With [datasets](https://huggingface.co/docs/datasets), one row per point, voxel or frame:")
        text.append(
            f"```python\n{_data_set(place)}\n"
            f"frames = load_dataset(data, split={split})\n"
            f"one = load_dataset(data, {json.dumps(config.name)}, split={split},\n"
            f'                   filters=[("sequence", "==", frames[0]["sequence"]), ("frame", "==", frames[0]["frame"])])\n'
            'columns = one.with_format("numpy")[:]  # an array for each column\n```'
        )
        text.append(
            "Rows are in the order of the scan's points, and of the grid's voxels (C order), so that tables of one frame belong together row by "
            "row. `sequence` and `frame` name the frame; the configuration `frames` has the path, the pose and the time of each."
        )
        text.append(
            _table(["configuration", "rows", "columns"], [[t.name, t.title, ", ".join(t.columns)] for t in tables])
        )
        if facts.lossy_mm:
            text.append(f"`x`, `y` and `z` are whole numbers of {facts.lossy_mm:g} mm.")
    return "\n\n".join(text)


def _data_set(place: Place) -> str:
    """Return lines of Python that name the data for `load_dataset`: "." would be a data set without a name."""
    if place.repository:
        name = json.dumps(place.repository.partition("/datasets/")[2])
        return f"from datasets import load_dataset\n\ndata = {name}"
    return (
        "from pathlib import Path\n\nfrom datasets import load_dataset\n\n"
        "data = str(Path().resolve())  # the folder of this file; at the Hugging Face Hub, ORG/NAME"
    )


def _first_read(first: SequenceOverview) -> str:
    """Return a line of Python that reads a frame of a sequence."""
    if first.grids:
        grid = first.grids[0]
        return f"grid = sequence.grid({json.dumps(grid.name)}, {first.first})  # labels and counts, arrays of shape {grid.size}"
    return f"scan = sequence.scan({first.first})  # points (N, 4), labels (N,)"


def _samples(facts: Facts, name: str) -> str:
    """Return a line of Python that opens the data for training; "" if they are no scans with grids of one name."""
    if not all("points" in one.fields and one.grids for one in facts.overview.sequences):
        return ""
    common = set.intersection(*({grid.name for grid in one.grids} for one in facts.overview.sequences))
    if not common:
        return ""
    chosen = "" if EVALUATION in common else f", grid={json.dumps(min(common))}"
    return f"dataset = carlasc.Dataset({json.dumps(name)}{chosen})  # samples for training\n"


def _classes(facts: Facts) -> str:
    if not facts.statistics:
        return "The data have no labels."
    text = []
    for one in facts.statistics:
        rows = [
            [str(index), name, _percent(of_points), _percent(of_voxels)]
            for index, name, of_points, of_voxels in shares(one, one.total)
        ]
        text.append(f"The class table is `{_text(one.classes.name)}`; classes that do not occur are left out.")
        text.append(_table(["id", "class", "points %", "known voxels %"], rows))
    share = facts.known_share() if any(one.total.grids for one in facts.statistics) else None
    known = "" if share is None else f" {share:.1%} of the voxels are known; the others have count 0."
    text.append(f"Class 0 is unlabelled on points and free in voxels.{known}")
    if facts.every > 1:
        text.append(f"Counted on every {facts.every}th frame.")
    return "\n\n".join(text)


def _sequences(facts: Facts) -> str:
    rows = [[name, str(count), f"{frames:,}"] for name, (count, frames) in facts.splits.items()]
    text = [_table(["split", "sequences", "frames"], rows)]
    licenses = {path: part.license.name for part in facts.parts for path in part.paths}
    rows = [
        [one.path or one.name, str(one.frames), one.source or "simulator", licenses.get(one.path, ""), one.classes]
        for one in facts.overview.sequences
    ]
    text.append(_table(["sequence", "frames", "made from", "licence", "classes"], rows[:_MOST_SEQUENCES]))
    if len(rows) > _MOST_SEQUENCES:
        text.append(f"{len(rows) - _MOST_SEQUENCES} more sequences: croissant.json lists all of them.")
    return "\n\n".join(text)


def _making(facts: Facts) -> str:
    text = [_text(" ".join([*collection(facts), *annotation(facts), *preprocessing(facts)]))]
    rows = [[grid.name, str(count), f"{frames:,}", how_made(grid.made)] for grid, count, frames in facts.grids]
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
        text.append("From the reports (`carlasc-report.json`) that the runs left beside the grids:")
        header = ["grid", "known voxels %", "occupied of these %", "changed with a tenth fewer scans %", "made with"]
        text.append(_table(header, rows[:_MOST_SEQUENCES]))
    if facts.grids:
        text.append(
            "`params.json` beside each grid has all settings; `carlasc validate` compares the files with their digests."
        )
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
    if len(facts.licenses) > 1:
        text.append(
            "Each sequence keeps the licence of its source. Who uses all of them together keeps the conditions of all of them, of which the first "
            "row has the strictest."
        )
    if facts.sources:
        text.append(
            "The licence of the data that a sequence was converted from holds for what was made from them: name their authors too."
        )
    return "\n\n".join(text)


def _limits(facts: Facts, details: Details) -> str:
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


def _citation(facts: Facts, details: Details) -> str:
    text = [_code(details.citation)] if details.citation else []
    if facts.sources:
        papers = [f"{source}: {paper or 'see the page of its publishers'}" for source, paper in facts.citations.items()]
        text.append("Sequences were converted from these data, which are to be cited as well:")
        text.append("\n".join(f"- {_text(line)}" for line in papers))
    if details.citation or not facts.simulated:
        text.append("The layout and the classes are those of CarlaSC:")
    text.append(_code(MOTIONSC))
    text.append("Made with carlasc; its CITATION.cff says how to cite the software.")
    return "\n\n".join(text)


def _code(text: str) -> str:
    fence = "`" * max(3, 1 + max((len(run) for run in re.findall("`+", text)), default=0))
    return f"{fence}bibtex\n{text.strip()}\n{fence}"


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.2f}"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], *, links: bool = False) -> str:
    """Return a table; where `links`, cells may hold links, and are taken as they are."""
    lines = [header, ["---"] * len(header), *rows]
    cells = [[cell if links else _text(cell) for cell in line] for line in lines]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in cells)


def _text(text: str) -> str:
    """Return a text as Markdown shows it: names come from data, and must start no tag, link or heading."""
    shown = printable(" ".join(text.split()))
    return re.sub(r"([\\`*_\[\]<>])", r"\\\1", shown) if re.search(r"[`*\[\]<>\\]", shown) else shown
