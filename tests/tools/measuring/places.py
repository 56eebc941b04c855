"""Places in pages that are filled in from figures. A place holds its own template, in a comment, and the text that was made of it.

    <!-- figures {loading.ratio} times -->16 to 27 times<!-- figures end -->

A template of several lines makes a block, such as a table. A page is never edited between the end of the comment and `figures end`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

_PLACE = re.compile(r"<!-- figures(\s.*?)-->(.*?)<!-- figures end -->", re.DOTALL)
_KEY = re.compile(r"\{([\w.-]+)\}")
_CODE = re.compile(r"^```.*?^```$|^    .*$|`[^`\n]*`", re.DOTALL | re.MULTILINE)
_NUMBER = r"(?<![\w.,-])\d[\d,.]*(?: (?:to|and|or) \d[\d.,]*)?"
_TYPED = re.compile(
    rf"{_NUMBER}(?: ?(?:ms|us|s|MB|MiB|GB|kB|KiB|MB/s|GB/s)(?![\w/])| (?:seconds?|minutes?|hours?|times)\b| ?x(?! ?\d)\b)"
)
_SHARE = re.compile(rf"{_NUMBER} ?%")


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


def typed_by_hand(page: str, *, shares: bool = False) -> list[str]:
    """Return what looks like a measured time, size or ratio and is not in a place: numbers with such a unit, outside of code.

    Args:
        page: the text of the page.
        shares: whether percentages count, which on most pages are scores.
    """
    parts = _CODE.split(_PLACE.sub("", page))
    patterns = [_TYPED, _SHARE] if shares else [_TYPED]
    return [found[0] for part in parts for pattern in patterns for found in pattern.finditer(part)]
