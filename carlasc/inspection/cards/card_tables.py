"""The tables of a card: each is a table of README.md and a record set of croissant.json."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from carlasc.inspection.cards.facts import Facts
from carlasc.inspection.cards.places import split_of
from carlasc.inspection.overview import GridOverview
from carlasc.inspection.texts import say

MOST_ROWS = 60  # of a table in README.md

Row = dict[str, Any]  # text, a number or None


class Table(NamedTuple):
    """A table: its name, the section of README.md, what it lists, and its rows by column.

    Floats are shares; None is not known.
    """

    name: str
    section: str
    title: str
    rows: list[Row]


def tables_of_card(facts: Facts) -> Iterator[Table]:
    """Yield the tables with a row or more."""
    for one in facts.statistics:
        points = one.total.points
        voxels = one.total.voxels
        shares: list[Row] = [
            {
                "id": index,
                "name": name,
                "points": float(points[index] / points.sum()) if points.any() else None,
                "voxels": float(voxels[index] / voxels.sum()) if voxels.any() else None,
            }
            for index, name in one.classes.names.items()
            if points[index] or voxels[index]
        ]
        title = say("classes", name=one.classes.name)
        yield Table(f"classes-{one.classes.name}", "classes", title, shares)
    overviews = {one.path: one for one in facts.overview.sequences}
    sequences: list[Row] = [
        {
            "path": path or facts.sequences[path].name,
            "split": split_of(facts.sequences[path]),
            "frames": overviews[path].frames,
            "source": part.source or "not named",
            "license": part.license.name,
            "classes": overviews[path].classes,
        }
        for part in facts.parts
        for path in part.paths
    ]
    sequences.sort(key=lambda row: str(row["path"]))
    kinds: dict[tuple[object, ...], Row] = {}
    for row in sequences if len(sequences) > MOST_ROWS else ():
        shared = {name: row[name] for name in ("split", "source", "license", "classes")}
        sums = kinds.setdefault((*shared.values(),), {**shared, "sequences": 0, "frames": 0})
        sums |= {"sequences": sums["sequences"] + 1, "frames": sums["frames"] + row["frames"]}
    grids: list[Row] = [
        {
            "grid": grid.name,
            "coordinates": grid.coordinates,
            "size": " x ".join(map(str, grid.size)),
            "voxel_size": " x ".join(f"{edge:.3g}" for edge in grid.voxel_size),
            "sequences": number,
            "frames": frames,
            "settings": settings_of(grid),
        }
        for grid, number, frames in facts.grids
    ]
    reports: list[Row] = [
        {
            "grid": name,
            "known": one.coverage.known_share,
            "occupied": one.coverage.occupied_share,
            "changed": None if one.convergence is None else one.convergence.changed_share,
            "made_with": ", ".join(f"{what} {version}" for what, version in one.versions.items()),
        }
        for name, one in facts.reports.items()
    ]
    licenses: list[Row] = [
        {
            "source": part.source or "not named",
            "license": part.license.name,
            "url": part.license.url,
            "conditions": part.license.conditions,
            "sequences": len(part.paths),
            "named_by": "the author of this card"
            if part.stated
            else "carlasc.json of the sequences",
        }
        for part in facts.parts
    ]
    for name, section, rows in (
        ("splits", "sequences", [*kinds.values()]),
        ("sequences", "sequences", sequences),
        ("grids", "grids", grids),
        ("reports", "grids", reports),
        ("licenses", "licenses", licenses),
    ):
        if rows:
            yield Table(name, section, say(name), rows)


def settings_of(grid: GridOverview) -> str:
    """Return the settings that a grid was made with, from the record in its params.json."""
    settings = [
        f"{name} {value}"
        for name, value in (grid.made or {}).items()
        if name != "format" and isinstance(value, str | int | float)
    ]
    return ", ".join(settings) or "published without a record of its settings"
