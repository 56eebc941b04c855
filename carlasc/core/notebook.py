"""Display of objects: HTML tables with a small picture for notebooks, and pandas tables."""

from __future__ import annotations

import base64
import html
import struct
import zlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from carlasc.core.arrays import Uint8Array
from carlasc.errors import DependencyError

if TYPE_CHECKING:
    import pandas


def describe(title: str, rows: Mapping[str, object], picture: Uint8Array | None = None) -> str:
    """Return HTML with a title, a table, and an optional picture, (H, W, 3) uint8 RGB."""
    lines = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th><td "
        f"style='text-align:left'>{html.escape(str(value))}</td></tr>"
        for name, value in rows.items()
    )
    image = (
        ""
        if picture is None
        else f"<img alt='seen from above' src='data:image/png;base64,{_png(picture)}'>"
    )
    return f"<div><b>{html.escape(title)}</b><table>{lines}</table>{image}</div>"


def data_frame(rows: Iterable[Mapping[str, object]], index: str) -> pandas.DataFrame:
    """Return rows as a pandas DataFrame. pandas is not a dependency of carlasc.

    Args:
        rows: the values of each row by column.
        index: the column that names the rows.

    Raises:
        DependencyError: pandas is not installed.
    """
    try:
        import pandas
    except ImportError as error:
        raise DependencyError(
            "pandas is not installed", advice="install it with `pip install pandas`"
        ) from error
    table = pandas.DataFrame(list(rows))
    return table if table.empty else table.set_index(index)


def _png(rgb: Uint8Array) -> str:
    """Return an (H, W, 3) picture as a PNG file in base64, without Pillow, which is optional."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    height, width, _ = rgb.shape
    rows = b"".join(b"\0" + row.tobytes() for row in rgb)
    parts = (
        (b"IHDR", struct.pack(">2I5B", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    )
    return base64.b64encode(
        b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)
    ).decode()
