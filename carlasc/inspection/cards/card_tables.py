"""The tables of a card: each is a table of README.md and a record set of croissant.json."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from carlasc.inspection.cards.facts import Facts
from carlasc.inspection.cards.places import split_of
from carlasc.inspection.overview import GridOverview
from carlasc.inspection.texts import say


class Table(NamedTuple):
    """A table: its name, the section of README.md, what it lists, its columns, and its rows.

    Floats are shares; None is not known.
    """

    name: str
    section: str
    title: str
    columns: list[str]
    rows: list[tuple[str | int | float | None, ...]]


def tables_of_card(facts: Facts) -> Iterator[Table]:
    """Yield the tables with a row or more."""
    for one in facts.statistics:
        points, voxels = one.total.points, one.total.voxels
        shares = [
            (
                index,
                name,
                float(points[index]) / int(points.sum()) if points.any() else None,
                float(voxels[index]) / int(voxels.sum()) if voxels.any() else None,
            )
            for index, name in one.classes.names.items()
            if points[index] or voxels[index]
        ]
        title = say("classes", name=one.classes.name)
        columns = "id name points voxels".split()
        yield Table(f"classes-{one.classes.name}", "classes", title, columns, [*shares])
    overviews = {one.path: one for one in facts.overview.sequences}
    sequences = sorted(
        (
            path or facts.sequences[path].name,
            split_of(facts.sequences[path]),
            overviews[path].frames,
            part.source or "not named",
            part.license.name,
            overviews[path].classes,
        )
        for part in facts.parts
        for path in part.paths
    )
    columns = "path split frames source license classes".split()
    yield Table("sequences", "sequences", say("sequences"), columns, [*sequences])
    if facts.grids:
        grids = [
            (
                grid.name,
                grid.coordinates,
                " x ".join(map(str, grid.size)),
                " x ".join(f"{edge:.3g}" for edge in grid.voxel_size),
                number,
                frames,
                settings_of(grid),
            )
            for grid, number, frames in facts.grids
        ]
        columns = "grid coordinates size voxel_size sequences frames settings".split()
        yield Table("grids", "grids", say("grids"), columns, [*grids])
    if facts.reports:
        reports = [
            (
                name,
                one.coverage.known_share,
                one.coverage.occupied_share,
                None if one.convergence is None else one.convergence.changed_share,
                ", ".join(f"{what} {version}" for what, version in one.versions.items()),
            )
            for name, one in facts.reports.items()
        ]
        columns = "grid known occupied changed made_with".split()
        yield Table("reports", "grids", say("reports"), columns, [*reports])
    licenses = [
        (
            part.source or "not named",
            part.license.name,
            part.license.url,
            part.license.conditions,
            len(part.paths),
            "the author of this card" if part.stated else "carlasc.json of the sequences",
        )
        for part in facts.parts
    ]
    columns = "source license url conditions sequences named_by".split()
    yield Table("licenses", "licenses", say("licenses"), columns, [*licenses])


def settings_of(grid: GridOverview) -> str:
    """Return the settings that a grid was made with, from the record in its params.json."""
    settings = [
        f"{name} {value}"
        for name, value in (grid.made or {}).items()
        if name != "format" and isinstance(value, str | int | float)
    ]
    return ", ".join(settings) or "published without a record of its settings"
