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
        demands = [
            text
            for text, holds in (
                ("name the authors", self.name.startswith(("CC BY", "ODC-BY"))),
                ("non-commercial use only", not self.commercial),
                ("the same licence for derived data", self.share_alike),
                ("no publication of derived data", not self.derivatives),
            )
            if holds
        ]
        return ", ".join(demands) or "any use"

    @property
    def strictness(self) -> tuple[bool, bool, bool]:
        """A key by which stricter licences sort last."""
        return (
            self.derivatives is not True,
            self.commercial is not True,
            self.share_alike is not False,
        )


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
    return {re.sub(r"[^a-z0-9.]+", "-", one.name.lower()): one for one in licenses}


def find_license(text: str) -> License | None:
    """Return the licence of a name such as "CC BY 4.0" or "cc-by-4.0", or of the address of a
    licence's text; None for another text.
    """
    stripped = text.strip()
    if re.fullmatch(r"https?://[^\s\"'<>]+", stripped):
        if deed := re.match(
            r"https?://(?:www\.)?creativecommons\.org/licenses/([a-z-]+)/(\d\.\d)\b", stripped
        ):
            # /deed.en, /legalcode or a country may follow
            return _licenses().get(f"cc-{deed[1]}-{deed[2]}")
        address = re.sub(r"^https?://(www\.)?", "", stripped).rstrip("/")
        known = (
            one
            for one in _licenses().values()
            if re.sub(r"^https://(www\.)?", "", one.url).rstrip("/") == address
        )
        return next(known, License(stripped, stripped, _OTHER, None, None, None))
    key = re.sub(
        r"\blicen[cs]e\b|\bv(?=\d)", "", stripped.lower().replace("creative commons", "cc")
    )
    key = re.sub(r"[^a-z0-9.]+", "-", key).strip("-")
    return _licenses().get(read_table("licenses.toml")["short"].get(key, key))


def license_given(text: str) -> License:
    """Return the licence that the author of a card names.

    Raises:
        ArgumentError: no licence has this name.
    """
    license_ = find_license(text)
    if license_ is None:
        near = difflib.get_close_matches(
            text.lower(), [one.hub for one in _licenses().values()], 3, 0.5
        )
        raise ArgumentError(
            "license",
            expected=f"the name of a licence, such as "
            f"{', '.join(near or ['cc-by-4.0', 'cc-by-nc-sa-4.0', 'mit'])}",
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
    sequences: Iterable[Sequence], given: License | None, location: str
) -> tuple[LicensedPart, ...]:
    """Return the licences of a data set, the strictest first.

    A converted sequence keeps the licence of its source. `given` is the licence of sequences that
    name none.

    Args:
        sequences: the sequences.
        given: the licence that the author of the card names; None for none.
        location: the data set, for errors.

    Raises:
        FormatError: the licence in carlasc.json is unknown.
        ArgumentError: a sequence has no licence, and none is given; or one is given, although all
            sequences have a licence.
        CarlascError: a licence forbids publishing derived data.
    """
    paths_of: dict[tuple[str | None, License | None], list[str]] = {}
    for sequence in sequences:
        license_, source = _license_of(sequence), sequence.metadata.source
        if license_ is not None and license_.derivatives is False:
            raise CarlascError(
                sequence.location,
                expected="a licence that permits publishing derived data",
                found=f"{license_.name} of {source or 'its source'}, which forbids that",
                advice="publish instead how you made the data, so that others can convert their "
                "own copies",
            )
        paths_of.setdefault((source, license_), []).append(sequence.path)
    known = {license_ for _, license_ in paths_of if license_ is not None}
    without = sorted({source or "" for source, license_ in paths_of if license_ is None})
    if without and given is None:
        of = " and ".join(source for source in without if source)
        raise ArgumentError(
            "license",
            expected=f"the licence of {of}" if of else "the licence of these data",
            found=f"none given, and none in {layout.METADATA} of {location}",
            advice="name it with `license`, such as cc-by-4.0",
        )
    if given is not None and not without and given not in known:
        raise ArgumentError(
            "license",
            expected=f"{', '.join(sorted(one.name for one in known))}, the licence of the source, "
            f"which also holds for data that are made from it",
            found=given.name,
        )
    parts = []
    for (source, license_), paths in paths_of.items():
        holds = given if license_ is None else license_
        assert holds is not None  # checked above
        parts.append(LicensedPart(source, holds, license_ is None, tuple(paths)))
    return tuple(
        sorted(parts, key=lambda part: (part.license.strictness, part.source or ""), reverse=True)
    )


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
