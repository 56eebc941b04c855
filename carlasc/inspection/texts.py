"""The texts of cards and reports: files in `templates/`, with `$names` that are replaced by values.

`string.Template` inserts values unchanged, so that a `$` or a brace in the name of a data set stays
text. The caller escapes values for Markdown or HTML.
"""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.resources import files
from string import Template
from typing import Any


@cache
def read(name: str) -> str:
    """Return the text of a file in `templates/`."""
    return files("carlasc.inspection").joinpath("templates", name).read_text(encoding="utf-8")


@cache
def read_table(name: str) -> dict[str, Any]:
    """Return the content of a TOML file in `templates/`."""
    return tomllib.loads(read(name))


def fill(name: str, /, **values: object) -> str:
    """Return a file in `templates/` with its `$names` filled in."""
    return Template(read(name)).substitute(values)


def say(sentence: str, /, **values: object) -> str:
    """Return a sentence of `card.toml` with its `$names` filled in."""
    return Template(read_table("card.toml")[sentence]).substitute(values)
