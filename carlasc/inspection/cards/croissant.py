"""croissant.json: the card for programs, in Croissant 1.1 with the RAI vocabulary 1.0
(https://docs.mlcommons.org/croissant).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from carlasc.inspection.cards.card_tables import Table, settings_of
from carlasc.inspection.cards.facts import CardDetails, Facts
from carlasc.inspection.cards.places import Place, PublishedTable
from carlasc.inspection.texts import read
from carlasc.storage import layout

Json = dict[str, Any]

_PARQUET = "application/x-parquet"
_BYTES = "application/octet-stream"


@cache
def vocabulary() -> Json:
    """Return what all cards have in common: the context of Croissant, what describes each data
    set, its types by their names in pyarrow, and what columns mean.
    """
    content: Json = json.loads(read("croissant.json"))
    return content


def croissant(
    facts: Facts,
    details: CardDetails,
    place: Place,
    tables: Sequence[PublishedTable],
    shown: Sequence[Table],
) -> bytes:
    """Return the bytes of croissant.json, from the arguments of `readme`."""
    licenses = [license_.url for license_ in facts.licenses if license_.url]
    version = f"{details.name}, version {details.version}, {details.published}"
    cited = ", ".join([*details.authors, version])
    stated: Json = {name: [text] for name, text in details.statements.items()}
    stated["dataLimitations"] = [*stated.get("dataLimitations", []), *facts.limits()]
    stated["hasSyntheticData"] = bool(facts.simulated) or None
    collected = details.statements.get("dataCollection")
    made = "; ".join(f"{grid.name}: {settings_of(grid)}" for grid, _, _ in facts.grids)
    content: Json = {
        "@context": vocabulary()["context"],
        **vocabulary()["dataset"],
        "name": details.name,
        "description": details.description,
        "license": licenses[0] if len(licenses) == 1 else licenses,
        "version": details.version,
        "datePublished": details.published,
        "citeAs": details.citation or "; ".join(filter(None, facts.citations.values())) or cited,
        "url": details.url,
        "spatialCoverage": details.place,
        "creativeWorkStatus": "Draft" if facts.gaps else None,
        "creator": [{"@type": "sc:Organization", "name": name} for name in details.authors],
        **{f"rai:{name}": value for name, value in stated.items()},
        "prov:wasDerivedFrom": sorted(facts.citations),
        "prov:wasGeneratedBy": [
            {"@type": "prov:Activity", "prov:label": label, "sc:description": text}
            for label, text in (("Data collection", collected), ("Ground truth", made))
            if text
        ],
        "distribution": [*_files(facts, place, tables)],
        "recordSet": [*map(_inline, shown), *map(_published, tables)],
    }
    known = {name: value for name, value in content.items() if value not in (None, [])}
    return (json.dumps(known, indent=2, ensure_ascii=False) + "\n").encode()


def _id(name: str) -> str:
    """Return a name, which comes from the data, as a part of an IRI."""
    return quote(name, safe="/._-")


def _files(facts: Facts, place: Place, tables: Sequence[PublishedTable]) -> Iterator[Json]:
    """Yield the files: each whole file with its checksum, and sets of files by their patterns."""
    inside: Json = {}
    if place.repository:
        inside = {"containedIn": {"@id": "repository"}}
        yield vocabulary()["repository"] | {"contentUrl": place.repository}
    sets: list[tuple[str, str, str, list[str]]] = []
    for table in tables:
        meaning = f"The tables of {table.name}: {table.title}."
        sets.append((table.name, meaning, _PARQUET, table.paths))
        for path in table.paths:
            yield _file_object(place, path, _PARQUET)
    if not tables and place.is_file:
        encoding = vocabulary()["encodings"].get(Path(place.name).suffix.lower(), _BYTES)
        yield _file_object(place, "", encoding)
    elif not tables and facts.overview.store == "zarr":
        if place.local is not None:
            yield _file_object(place, "zarr.json", "application/json")
        meaning = "The chunks of a zarr store of version 3."
        sets.append(("zarr", meaning, "application/vnd.zarr", ["*"]))
    elif not tables:
        parts = dict.fromkeys(f"{g.name}/{part}" for g, _, _ in facts.grids for part in g.parts)
        for name in [*facts.fields, *parts]:
            entry = layout.field_named(name)
            encoding = "image/jpeg" if entry.kind == "picture" else _BYTES
            pattern = f"*{entry.folder}/*{entry.suffix}"
            sets.append((name.replace("/", "_"), f"{entry.meaning}.", encoding, [pattern]))
        sets += vocabulary()["documents"]
    for name, meaning, encoding, includes in sets:
        yield {
            "@type": "cr:FileSet",
            "@id": f"{_id(name)}-files",
            "name": f"{name}-files",
            "description": meaning,
            "encodingFormat": encoding,
            "includes": [place.published(path) for path in includes],
        } | inside


def _file_object(place: Place, path: str, encoding: str) -> Json:
    """Return a file with its size and checksum."""
    (checksum, size), published = place.measure(path), place.published(path)
    return {
        "@type": "cr:FileObject",
        "@id": _id(published),
        "name": published.rpartition("/")[2],
        "contentUrl": f"{place.repository}/resolve/main/{published}"
        if place.repository
        else published,
        "encodingFormat": encoding,
        "contentSize": f"{size} B",
        "sha256": checksum,
    }


def _record_set(name: str, title: str, fields: Mapping[str, Json], **content: Any) -> Json:
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": title,
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{name}/{_id(column)}",
                "name": column,
                "description": vocabulary()["columns"].get(column, column),
                **about,
            }
            for column, about in fields.items()
        ],
        **content,
    }


def _inline(table: Table) -> Json:
    """Return a table of the card as a record set that holds its records."""
    name = _id(table.name)
    kinds = {str: "sc:Text", int: "sc:Integer"}
    fields = {
        column: {"dataType": kinds.get(type(value), "sc:Float")}
        for column, value in table.rows[0].items()
    }
    records = [{f"{name}/{column}": row[column] for column in row} for row in table.rows]
    return _record_set(name, table.title, fields, data=records)


def _published(table: PublishedTable) -> Json:
    """Return the record set of a table of a store; lists of fixed length are arrays."""
    name = _id(table.name)
    fields = {}
    for column, type_ in table.columns.items():
        about: Json = {"dataType": vocabulary()["types"].get(type_, "sc:Text")}
        if type_.startswith("fixed_size_list"):
            shape = type_.rpartition("[")[2].rstrip("]")
            about = {"dataType": "cr:Float64", "isArray": True, "arrayShape": shape}
        files = {"fileSet": {"@id": f"{name}-files"}, "extract": {"column": column}}
        fields[column] = about | {"source": files}
    return _record_set(name, f"{table.title[0].upper()}{table.title[1:]}.", fields)
