"""What an export wrote: a file at the root of the other data set, so that a later run does not mix what does not belong together."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from carlasc import storage
from carlasc.errors import ConflictError
from carlasc.storage.files import has_content, parse_json, to_json, write_atomic

RECORD = "carlasc-export.json"


class ExportRecord:
    """The record of one exporter's product in a folder.

    Args:
        root: folder of the other data set.
        name: name of the exporter.
        product: what it writes.
    """

    def __init__(self, root: Path, name: str, product: str) -> None:
        self._path, self._name, self._product = root / RECORD, name, product
        self._all = parse_json(self._path.read_bytes(), str(self._path)) if has_content(self._path) else {}

    def check(self, sequences: Mapping[str, storage.Sequence], settings: Mapping[str, Any]) -> None:
        """Check that the places of sequences, which are paths in the folder, are new, or hold them, exported with the same settings.

        Raises:
            ConflictError: one holds something else.
        """
        known, wanted = self._all.get(self._name, {}).get(self._product, {}), _plain(settings)
        for place, sequence in sequences.items():
            found = known.get(place)
            if found is None:
                continue
            where = self._path.parent / place
            if found["sequence"] != sequence.path:
                raise ConflictError(
                    where,
                    expected=f"the sequence {sequence.path or '.'}",
                    found=f"{found['sequence'] or '.'}, which was exported earlier",
                    advice="write to another folder, or replace it with `overwrite=True`",
                )
            if found["settings"] != wanted:
                raise ConflictError(
                    where,
                    expected=f"frames that were exported with {_listed(wanted)}",
                    found=_listed(found["settings"]),
                    advice="write to another folder, or replace them with `overwrite=True`",
                )

    def write(self, sequences: Mapping[str, storage.Sequence], settings: Mapping[str, Any]) -> None:
        """Add sequences to the record, by their places."""
        part = self._all.setdefault(self._name, {}).setdefault(self._product, {})
        part |= {place: {"sequence": s.path, "settings": _plain(settings)} for place, s in sequences.items()}
        write_atomic(self._path, to_json(self._all))


def _plain(settings: Mapping[str, Any]) -> Any:
    return json.loads(json.dumps(dict(settings), default=str))


def _listed(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value}" for name, value in settings.items()) or "no options"
