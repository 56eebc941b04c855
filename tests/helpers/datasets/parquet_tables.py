"""Changing the tables of a Parquet store, as somebody would who also puts the checksums right."""

from __future__ import annotations

import json
from pathlib import Path

from carlasc.storage.parquet.parquet_source import footer_checksums


def seal_tables(folder: Path) -> None:
    """Write the checksums of the footers that the tables of a sequence have now."""
    about = json.loads((folder / "sequence.json").read_bytes())
    (folder / "sequence.json").write_text(json.dumps(about | {"footers": footer_checksums(folder)}))
