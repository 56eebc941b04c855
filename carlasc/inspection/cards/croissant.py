"""croissant.json: the card for programs, in Croissant 1.1 with the RAI vocabulary 1.0
(https://docs.mlcommons.org/croissant).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from carlasc.inspection.cards.facts import CardDetails, Facts, shares
from carlasc.inspection.cards.places import Place, PublishedTable, split_of
from carlasc.inspection.cards.responsibility import collection, made, responsibility
from carlasc.inspection.texts import read
from carlasc.storage import layout

Json = dict[str, Any]

WRITER = "carlasc"
"""The `sdPublisher` of the file: the program that wrote it."""
CONFORMS_TO = ("http://mlcommons.org/croissant/1.1", "http://mlcommons.org/croissant/RAI/1.0")
KEYWORDS = (
    "LiDAR",
    "voxel grid",
    "semantic scene completion",
    "semantic mapping",
    "occupancy",
    "scene flow",
)
_PARQUET = "application/x-parquet"
_ENCODINGS = {".h5": "application/x-hdf5", ".hdf5": "application/x-hdf5", ".zip": "application/zip"}


def croissant(
    facts: Facts, details: CardDetails, place: Place, tables: Sequence[PublishedTable]
) -> bytes:
    """Return the bytes of croissant.json."""
    licenses = [license_.url for license_ in facts.licenses]
    content: Json = {
        "@context": _vocabulary()["context"],
        "@type": "sc:Dataset",
        "conformsTo": list(CONFORMS_TO),
        "name": details.name,
        "description": details.description,
        "license": licenses[0] if len(licenses) == 1 else licenses,
        "version": details.version,
        "datePublished": details.published,
        "citeAs": details.citation or _papers(facts),
        "keywords": list(KEYWORDS),
        "isLiveDataset": False,
        "sdPublisher": {"@type": "sc:Organization", "name": WRITER},
    }
    if details.url:
        content["url"] = details.url
    if details.authors:
        content["creator"] = [
            {"@type": "sc:Organization", "name": name} for name in details.authors
        ]
    content |= {f"rai:{name}": value for name, value in responsibility(facts, details).items()}
    content["prov:wasDerivedFrom"] = facts.sources or ["no other data set: recorded in a simulator"]
    content["prov:wasGeneratedBy"] = [
        _activity("Data collection", " ".join(collection(facts))),
        _activity("Ground truth", " ".join(made(facts))),
    ]
    content["distribution"] = [*_files(facts, place, tables)]
    content["recordSet"] = [
        *_classes(facts),
        _sequences(facts),
        *(_record_set(table) for table in tables),
    ]
    return (json.dumps(content, indent=2, ensure_ascii=False) + "\n").encode()


@cache
def _vocabulary() -> Json:
    """Return the context of Croissant, its types by their names in pyarrow, and what columns mean."""
    found: Json = json.loads(read("croissant.json"))
    return found


def _papers(facts: Facts) -> str:
    """Return what to cite: the papers of the sources, or the paper that introduced CarlaSC."""
    papers = list(dict.fromkeys(filter(None, facts.citations.values())))
    return "; ".join(papers) if papers and not facts.simulated else read("motionsc.bib").strip()


def _id(name: str) -> str:
    """Return a name as a part of an IRI: names of grids, class tables and sequences come from data."""
    return quote(name, safe="/._-")


def _activity(label: str, text: str) -> Json:
    return {"@type": "prov:Activity", "prov:label": label, "sc:description": text}


def _files(facts: Facts, place: Place, tables: Sequence[PublishedTable]) -> Iterable[Json]:
    """Yield the files: each whole file with its checksum, and sets of files by their patterns."""
    inside: Json = {}
    if place.repository:
        inside = {"containedIn": {"@id": "repository"}}
        yield {
            "@type": "cr:FileObject",
            "@id": "repository",
            "name": "repository",
            "description": "The git repository at the Hugging Face Hub.",
            "contentUrl": place.repository,
            "encodingFormat": "git+https",
            # The same text as in the files of the Hub: a repository has no checksum.
            "sha256": "https://github.com/mlcommons/croissant/issues/80",
        }
    for table in tables:
        for path in table.paths:
            yield _file_object(place, path, _PARQUET)
        yield {
            "@type": "cr:FileSet",
            "@id": f"{_id(table.name)}-files",
            "name": f"{table.name}-files",
            "description": f"The tables of {table.name}: {table.title}.",
            "encodingFormat": _PARQUET,
            "includes": [place.published(path) for path in table.paths],
        } | inside
    if tables:
        return
    if place.is_file:
        yield _file_object(
            place, "", _ENCODINGS.get(Path(place.name).suffix.lower(), "application/octet-stream")
        )
    elif facts.overview.store == "zarr":
        if place.local is not None:
            yield _file_object(place, "zarr.json", "application/json")
        yield (
            _file_set(
                "zarr",
                "The chunks of a zarr store of version 3.",
                "application/vnd.zarr",
                [place.published("*")],
            )
            | inside
        )
    else:
        for name, pattern, encoding, meaning in _patterns(facts):
            yield _file_set(name, meaning, encoding, [place.published(pattern)]) | inside


def _patterns(facts: Facts) -> Iterable[tuple[str, str, str, str]]:
    """Yield name, pattern, encoding and meaning of the files of each field of the published layout."""
    names = [
        *facts.fields,
        *dict.fromkeys(f"{g.name}/{part}" for g, _, _ in facts.grids for part in g.parts),
    ]
    for name in names:
        entry = layout.field_named(name)
        encoding = "image/jpeg" if entry.kind == "picture" else "application/octet-stream"
        yield (
            name.replace("/", "_"),
            f"*{entry.folder}/*{entry.suffix}",
            encoding,
            f"{entry.meaning}.",
        )
    yield "text", "*.txt", "text/plain", "Poses and times, one line per frame."
    yield (
        "passports",
        "*.json",
        "application/json",
        "The axes, classes and source of a sequence, and how its grids were made.",
    )


def _file_set(name: str, meaning: str, encoding: str, includes: list[str]) -> Json:
    head = {
        "@type": "cr:FileSet",
        "@id": f"{_id(name)}-files",
        "name": f"{name}-files",
        "description": meaning,
    }
    return head | {"encodingFormat": encoding, "includes": includes}


def _file_object(place: Place, path: str, encoding: str) -> Json:
    """Return a file with its size and checksum."""
    found: Json = {
        "@type": "cr:FileObject",
        "@id": _id(place.published(path)),
        "name": place.published(path).rpartition("/")[2],
        "contentUrl": place.address(path),
        "encodingFormat": encoding,
    }
    size, checksum = place.measure(path)
    return found | {"contentSize": f"{size} B", "sha256": checksum}


def _classes(facts: Facts) -> Iterable[Json]:
    """Yield the class tables, with the shares of the classes, as records in the file itself."""
    for one in facts.statistics:
        name = _id(f"classes-{one.classes.name}")
        rows = [
            {f"{name}/id": index, f"{name}/name": label}
            | {
                f"{name}/points": round(of_points or 0.0, 6),
                f"{name}/voxels": round(of_voxels or 0.0, 6),
            }
            for index, label, of_points, of_voxels in shares(one, one.total)
        ]
        fields = (
            (
                "id",
                "sc:Integer",
                "number of the class; 0 is unlabelled on points and free in voxels",
            ),
            ("name", "sc:Text", "name of the class"),
            ("points", "sc:Float", "share of the points"),
            ("voxels", "sc:Float", "share of the known voxels"),
        )
        yield _inline(
            name,
            f"The classes of {one.classes.name} that occur, and their shares.",
            fields,
            rows,
            "id",
        )


def _sequences(facts: Facts) -> Json:
    rows: list[Json] = [
        {
            "sequences/path": path or facts.sequences[path].name,
            "sequences/split": split_of(facts.sequences[path]),
            "sequences/source": part.source or "simulator",
            "sequences/license": part.license.name,
        }
        for part in facts.parts
        for path in part.paths
    ]
    fields = (
        ("path", "sc:Text", "path of the sequence"),
        ("split", "sc:Text", "split of the sequence"),
        ("source", "sc:Text", "what the sequence was made from"),
        ("license", "sc:Text", "licence of the sequence"),
    )
    rows.sort(key=lambda row: row["sequences/path"])
    return _inline("sequences", "The sequences, with the licence of each.", fields, rows, "path")


def _inline(
    name: str, meaning: str, fields: Sequence[tuple[str, str, str]], rows: list[Json], key: str
) -> Json:
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": meaning,
        "key": {"@id": f"{name}/{key}"},
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{name}/{part}",
                "name": part,
                "description": text,
                "dataType": type_,
            }
            for part, type_, text in fields
        ],
        "data": rows,
    }


def _record_set(table: PublishedTable) -> Json:
    """Return the record set of a table: one field per column."""
    return {
        "@type": "cr:RecordSet",
        "@id": _id(table.name),
        "name": table.name,
        "description": table.title[0].upper() + table.title[1:] + ".",
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{_id(table.name)}/{_id(column)}",
                "name": column,
                "description": _vocabulary()["columns"].get(column, column),
                **_type_of(type_),
                "source": {
                    "fileSet": {"@id": f"{_id(table.name)}-files"},
                    "extract": {"column": column},
                },
            }
            for column, type_ in table.columns.items()
        ],
    }


def _type_of(type_: str) -> Json:
    """Return the type of a column; a list of fixed length is an array."""
    if type_.startswith("fixed_size_list"):
        length = type_.rpartition("[")[2].rstrip("]")
        return {"dataType": "cr:Float64", "isArray": True, "arrayShape": length}
    return {"dataType": _vocabulary()["types"].get(type_, "sc:Text")}
