"""The HTML of a page: the template with the style, three.js, the scripts, the frames, and the description of the scene."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Callable, Iterator, Mapping
from importlib.resources import files
from typing import Any

SCRIPTS = (
    "interface.js",
    "decode.js",
    "store.js",
    "modes.js",
    "voxels.js",
    "points.js",
    "path.js",
    "panels.js",
    "divider.js",
    "plot.js",
    "keys.js",
    "viewer.js",
)


def compose(name: str, describe: Callable[[], Mapping[str, Any]], blocks: Iterator[bytes] | None) -> Iterator[bytes]:
    """Yield a page piece by piece.

    Args:
        name: title of the page.
        describe: returns the description of the scene. It is called after the last block was taken.
        blocks: the frames, which become part of the page; None if a browser fetches each from the page's folder.
    """
    assets = files("carlasc.viewing.page").joinpath("assets")

    def read(asset: str) -> str:
        return assets.joinpath(asset).read_text("utf-8")

    def frames() -> Iterator[str]:
        for number, block in enumerate(blocks or ()):
            text = base64.b64encode(block).decode()
            yield f'<script type="application/octet-stream" id="frame{number}">{text}</script>\n'

    def scene() -> Iterator[str]:
        described = {**describe(), "embedded": blocks is not None}
        yield json.dumps(described, separators=(",", ":")).replace("<", "\\u003c")

    scripts = "\n".join(read(script) for script in SCRIPTS)
    parts: dict[str, Callable[[], Iterator[str]]] = {
        "TITLE": lambda: iter([html.escape(name)]),
        "STYLE": lambda: iter([read("style.css")]),
        "CONNECT": lambda: iter(["'none'" if blocks is not None else "'self'"]),
        "FRAMES": frames,
        "SCENE": scene,
        "LICENCE": lambda: iter([html.escape(read("vendor/three.LICENSE")).replace("--", "- -")]),
        "THREE": lambda: iter([read("vendor/three.min.js")]),
        "SCRIPTS": lambda: iter([f'"use strict";\n{scripts}']),
    }
    head, *rest = read("template.html").split("{{")
    yield head.encode()
    for piece in rest:
        part, text = piece.split("}}", 1)
        for found in parts[part]():
            yield found.encode()
        yield text.encode()
