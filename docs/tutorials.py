"""The notebooks as pages of the documentation, with what they show: text, tables and pictures."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

NOTEBOOKS = Path(__file__).parents[1] / "examples" / "notebooks"


def pages(folder: Path = NOTEBOOKS) -> Iterator[tuple[str, str | bytes]]:
    """Yield the path and the content of each page and picture, below the folder of the
    documentation.
    """
    for notebook in sorted(folder.glob("*.ipynb")):
        text, pictures = page(json.loads(notebook.read_text()), notebook.stem)
        yield (
            f"tutorials/{notebook.stem}.md",
            f"{text}\n\n*This page is the notebook `examples/notebooks/{notebook.name}`.*\n",
        )
        yield from ((f"tutorials/{name}", data) for name, data in pictures.items())


def page(notebook: dict[str, Any], stem: str) -> tuple[str, dict[str, bytes]]:
    """Return the Markdown of a notebook, and its pictures by file name."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        parts.extend(_shown(output, stem, pictures) for output in cell.get("outputs", ()))
    return "\n\n".join(filter(None, parts)), pictures


def _shown(output: dict[str, Any], stem: str, pictures: dict[str, bytes]) -> str:
    """Return the Markdown of one output; what it draws is added to `pictures`."""
    data = output.get("data", {})
    if "image/png" in data:
        name = f"{stem}_{len(pictures) + 1}.png"
        pictures[name] = base64.b64decode("".join(data["image/png"]))
        return f"![What the code above draws]({name})"
    if "text/html" in data:
        return "".join(data["text/html"])
    text = "".join(output.get("text", ())) or "".join(data.get("text/plain", ()))
    return f"```text\n{text.rstrip()}\n```" if text.strip() else ""
