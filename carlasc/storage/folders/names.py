"""The check of names that come from archives and stores, which anybody may have made."""

from __future__ import annotations

import re

_DRIVE = re.compile(r"[A-Za-z]:")
_NEVER = re.compile("[\\\\\0\ud800-\udfff]")


def leads_outside(name: str) -> bool:
    """Whether a name with parts joined by "/" may lead out of the folder that it is relative to, on any system.

    Such are absolute names, names with a drive ("C:"), with a part "..", with a backslash, and with a zero byte or half a character, which no
    file can have.
    """
    return name.startswith("/") or ".." in name.split("/") or bool(_DRIVE.match(name) or _NEVER.search(name))
