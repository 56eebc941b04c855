"""Licences of data: their names, what they permit, and those of the sequences of a data set."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

from carlasc.errors import ArgumentError, CarlascError, FormatError
from carlasc.inspection.texts import read_table
from carlasc.storage import layout
from carlasc.storage.protocol import Sequence

_SCHEME = r"^https?://(?:www\.)?"
_OTHER = "other"  # name at the Hugging Face Hub for all licences that it does not list


@dataclass(frozen=True)
class License:
    """One licence.

    Attributes:
        name: its usual name, such as "CC BY-NC-SA 4.0".
        url: the address of its text.
        hub: its name at the Hugging Face Hub; "other" for one that the Hub does not know.
        derivatives: whether derived data may be published; None if that is not known.
        commercial: whether commercial use is permitted; None if that is not known.
        share_alike: whether derived data must have the same licence; None if that is not known.
    """

    name: str
    url: str
    hub: str
    derivatives: bool | None = True
    commercial: bool | None = True
    share_alike: bool | None = False

    @property
    def conditions(self) -> str:
        """Its conditions, in words."""
        if self.derivatives is None:
            return "read its text"
        demands = {
            "name the authors": self.name.startswith(("CC BY", "ODC-BY")),
            "non-commercial use only": not self.commercial,
            "the same licence for derived data": self.share_alike,
            "no publication of derived data": not self.derivatives,
        }
        return ", ".join(text for text, holds in demands.items() if holds) or "any use"

    @property
    def strictness(self) -> tuple[bool, ...]:
        """A key by which stricter licences sort last."""
        return (not self.derivatives, not self.commercial, self.share_alike is not False)


UNSTATED = License("not stated", "", "unknown", None, None, None)
"""The licence in a draft for which none is given."""


@cache
def _licenses() -> dict[str, License]:
    """Return the licences by name, with all versions of those of Creative Commons."""
    table = read_table("licenses.toml")
    licenses = [License(**entry) for entry in table["license"]]
    for kind, on_hub in table["creative_commons"].items():
        for version in ("1.0", "2.0", "2.5", "3.0", "4.0"):
            url = f"https://creativecommons.org/licenses/{kind}/{version}/"
            hub = f"cc-{kind}-{version}" if version in on_hub else _OTHER
            permits = ("nd" not in kind, "nc" not in kind, "sa" in kind)
            licenses.append(License(f"CC {kind.upper()} {version}", url, hub, *permits))
    return {_key(one.name.lower()): one for one in licenses}


def find_license(text: str) -> License | None:
    """Return the licence of a name such as "CC BY 4.0" or "cc-by-4.0", or of the address of a
    licence's text; None for another text.
    """
    stripped = text.strip()
    licenses = _licenses()
    if re.fullmatch(r"https?://[^\s\"'<>]+", stripped):
        # a deed, /legalcode or a country may follow the address of a licence of Creative Commons
        common = r"creativecommons\.org/licenses/([a-z-]+)/(\d\.\d)\b"
        if deed := re.match(_SCHEME + common, stripped):
            return licenses.get(f"cc-{deed[1]}-{deed[2]}")
        known = (one for one in licenses.values() if _address(one.url) == _address(stripped))
        return next(known, License(stripped, stripped, _OTHER, None, None, None))
    name = stripped.lower().replace("creative commons", "cc")
    key = _key(re.sub(r"\blicen[cs]e\b|\bv(?=\d)", "", name))
    return licenses.get(read_table("licenses.toml")["short"].get(key, key))


def _address(url: str) -> str:
    return re.sub(_SCHEME, "", url).rstrip("/")


def _key(name: str) -> str:
    return re.sub(r"[^a-z0-9.]+", "-", name).strip("-")


def license_given(text: str) -> License:
    """Return the licence that the author of a card names.

    Raises:
        ArgumentError: no licence has this name.
    """
    license_ = find_license(text)
    if license_ is None:
        names = [one.hub for one in _licenses().values()]
        near = difflib.get_close_matches(text.lower(), names, 3, 0.5)
        near = near or ["cc-by-4.0", "cc-by-nc-sa-4.0", "mit"]
        raise ArgumentError(
            "license",
            expected=f"the name of a licence, such as {', '.join(near)}",
            found=repr(text),
            advice="for another licence, give the address of its text (https://...)",
        )
    return license_


@dataclass(frozen=True)
class LicensedPart:
    """The sequences of a data set that come from one source under one licence.

    Attributes:
        source: what they were converted from, as carlasc.json says; None for sequences that were
            not converted.
        license: the licence that holds for them.
        stated: whether the author of the card named the licence, because the data do not name one.
        paths: the sequences.
    """

    source: str | None
    license: License
    stated: bool
    paths: tuple[str, ...]


def licensed_parts(
    sequences: Iterable[Sequence], given: License | None
) -> tuple[LicensedPart, ...]:
    """Return the licences of a data set, the strictest first.

    A converted sequence keeps the licence of its source. `given` is the licence of sequences that
    name none.

    Args:
        sequences: the sequences.
        given: the licence that the author of the card names; None for none.

    Raises:
        FormatError: the licence in carlasc.json is unknown.
        ArgumentError: a licence is given, although all sequences have another one.
        CarlascError: a licence forbids publishing derived data.
    """
    paths_of: dict[tuple[str | None, License | None], list[str]] = {}
    for sequence in sequences:
        license_ = _license_of(sequence)
        source = sequence.metadata.source
        if license_ is not None and license_.derivatives is False:
            raise CarlascError(
                sequence.location,
                expected="a licence that permits publishing derived data",
                found=f"{license_.name} of {source or 'its source'}, which forbids that",
                advice="publish instead how you made the data, so that others can convert their "
                "own copies",
            )
        paths_of.setdefault((source, license_), []).append(sequence.path)
    parts = []
    for (source, license_), paths in paths_of.items():
        parts.append(
            LicensedPart(source, license_ or given or UNSTATED, license_ is None, tuple(paths))
        )
    if given is not None and all(part.license != given for part in parts):
        names = sorted({part.license.name for part in parts})
        raise ArgumentError(
            "license",
            expected=f"{', '.join(names)}, the licence of the source, which also holds for data "
            "that are made from it",
            found=given.name,
        )
    parts.sort(key=lambda part: (part.license.strictness, part.source or ""), reverse=True)
    return tuple(parts)


def _license_of(sequence: Sequence) -> License | None:
    text = sequence.metadata.extra.get("license")
    if text is None:
        return None
    license_ = find_license(text) if isinstance(text, str) else None
    if license_ is None:
        raise FormatError(
            f"{sequence.location}/{layout.METADATA}",
            expected="the name of a licence, or the address of its text, in license",
            found=repr(text),
            advice="look it up, and write its name (CC BY-NC-SA 4.0) or its address (https://...)",
        )
    return license_
