"""Places in pages that are filled in from figures.

A place holds its own template, in a comment, and the text that was made of it.

    <!-- figures {loading.ratio} times -->16 to 27 times<!-- figures end -->

A template of several lines makes a block, such as a table. A page is never edited between the end
of the comment and `figures end`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

_PLACE = re.compile(r"<!-- figures(\s.*?)-->(.*?)<!-- figures end -->", re.DOTALL)
_KEY = re.compile(r"\{([\w.-]+)\}")
_CODE = re.compile(
    r"^```.*?^```$|^    .*$|`[^`\n]*`|<!--.*?-->|\]\([^)\s]*\)", re.DOTALL | re.MULTILINE
)
_GENERATED = re.compile(r"<!-- generated: .*?<!-- generated end -->", re.DOTALL)
_COMMAND = re.compile(r"(?:docs/studies|examples|tests/benchmarks)/\w+\.py")
_NUMBER = r"(?<![\w.,/-])\d[\d,.]*(?: (?:to|and|or|of) \d[\d.,]*)?"
_MEASURED = re.compile(
    rf"{_NUMBER}(?: ?(?:ms|us|s|MB|MiB|GB|GiB|kB|KiB|MB/s|GB/s|%)(?![\w/])| "
    rf"(?:seconds?|minutes?|hours?|times|(?:frames|scans)(?:/s| per second))\b"
    r"| ?x(?! ?\d)\b)"  # with the unit of a time, a size, a rate, a share or a ratio
    # a score
    r"|(?<![\w.,/-])[01]\.\d\d+(?![\d.,]*\d| (?:to|and|or) |,? ?(?:m|cm|mm|degrees?|rad|m/s|Hz)\b)"
)
_CELL = re.compile(
    r"[*±~$]*\d[\d,]*(?:\.\d+| ?%| (?:ms|s|MB|GB))(?! ?(?:m|cm|mm|degrees)\b)\**"
    r"(?: ?(?:±|to |\(|/ ?|/s).*)?"
)


def keys(page: str) -> set[str]:
    """Return the keys that the templates of a page name."""
    return {key for place in _PLACE.finditer(page) for key in _KEY.findall(place[1])}


def fill(page: str, figures: Mapping[str, str]) -> str:
    """Return a page with the text of each of its places made again.

    Args:
        page: the text of the page.
        figures: the text of each figure, by its key.

    Raises:
        KeyError: a template names a figure that there is not.
    """

    def made(place: re.Match[str]) -> str:
        text = _KEY.sub(lambda key: figures[key[1]], place[1]).strip()
        text = f"\n\n{text}\n\n" if "\n" in place[1] else text
        return f"<!-- figures{place[1]}-->{text}<!-- figures end -->"

    return _PLACE.sub(made, page)


def sections(page: str) -> list[str]:
    """Return what stands before the first heading of the second level of a page, and under each of
    them; code is left out of nothing, tables that the code writes are.
    """
    return re.split(r"^(?=## )", _GENERATED.sub("", page), flags=re.MULTILINE)


def commands(section: str) -> set[str]:
    """Return the studies and examples that a section names: they make its numbers."""
    return set(_COMMAND.findall(section))


def typed_by_hand(page: str) -> list[str]:
    """Return the numbers of a page that nothing writes.

    These are times, sizes, rates, shares, ratios and scores in its text, and the cells of its
    tables with a fraction, a share or such a unit. Numbers in places of figures, in code and in
    links do not count, and neither do those of a section that names the study or the example that
    makes them. Lengths, angles, speeds and numbers of things are what is measured with, and count
    in tables only.
    """
    found: list[str] = []
    for section in sections(_PLACE.sub("", page)):
        if not commands(section):
            for line in _CODE.sub("`", section).splitlines():
                for cell in map(str.strip, line.split("|")):
                    is_number = line.startswith("|") and _CELL.fullmatch(cell)
                    found += (
                        [cell]
                        if is_number
                        else [match[0].strip(" .,") for match in _MEASURED.finditer(cell)]
                    )
    return found
