"""Class tables and remaps that a user gives: by the name of a built-in one, or in a JSON or YAML
file.
"""

from __future__ import annotations

from pathlib import Path

from carlasc.core.classes import ClassTable, Remap
from carlasc.core.tables import REMAPS, TABLES, classes_from
from carlasc.errors import ArgumentError, FormatError, import_extra, reading
from carlasc.storage.files import AnyPath, parse_json

FILES = (".json", ".yaml", ".yml")
"""Suffixes of files of classes."""


def read_classes(
    classes: AnyPath | ClassTable, name: str = "classes"
) -> tuple[ClassTable, Remap | None]:
    """Return a class table, and its map from the ids of another table.

    Args:
        classes: a table, the name of a table in `carlasc.core.TABLES`, or a JSON or YAML file: a
            class table in the form of carlasc.json, which may have a `map`, or a carlasc.json.
        name: name of the argument, for errors.

    Returns:
        The table, and the remap to it if a file has one, otherwise None.

    Raises:
        ArgumentError: `classes` is neither a known name nor a file.
        FormatError: the file holds no class table.
        DependencyError: the file is YAML, and pyyaml is not installed.
    """
    if isinstance(classes, ClassTable):
        return classes, None
    if str(classes) in TABLES:
        return TABLES[str(classes)], None
    path = Path(classes)
    if path.suffix.lower() not in FILES or not path.is_file():
        raise ArgumentError(
            name,
            expected=f"one of {', '.join(TABLES)}, or a JSON or YAML file",
            found=repr(str(classes)),
        )
    if path.suffix.lower() == ".json":
        values = parse_json(path.read_bytes(), str(path))
    else:
        yaml = import_extra("yaml", "scans")
        with reading(path, "a class table in YAML"):
            values = yaml.safe_load(path.read_text("utf-8"))
        if not isinstance(values, dict):
            found = type(values).__name__
            raise FormatError(path, expected="a class table in YAML", found=found)
    return classes_from(values.get("classes", values), str(path))


def read_remap(remap: AnyPath) -> Remap:
    """Return the remap with a name in `carlasc.core.REMAPS`, or that of a JSON or YAML file of
    classes with a `map` (see `read_classes`).

    Raises:
        ArgumentError: it is neither a known name nor such a file.
        FormatError: the file holds no class table.
    """
    if str(remap) in REMAPS:
        return REMAPS[str(remap)]
    found = read_classes(remap, "remap")[1] if Path(remap).suffix.lower() in FILES else None
    if found is None:
        raise ArgumentError(
            "remap",
            expected=f"one of {', '.join(REMAPS)}, or a JSON or YAML file of classes with a map",
            found=repr(str(remap)),
        )
    return found
