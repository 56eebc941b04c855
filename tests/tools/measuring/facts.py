"""Numbers on pages that nothing writes, and why they are right: most are constants of the code, and
a test compares them.

A constant that a page shows has a comment with the name of the fact, on one of its lines or alone
on the line before, wherever it stands:

    _BELONGS = 0.75  # with a smaller share they do not belong together; fact: NAME
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

FACTS = ("docs/format.md", "docs/packed-format.md")
"""Pages that define files: their numbers are the format."""

SOURCES = ("carlasc", "converters", "tests/tools")
"""Folders whose constants may be facts."""

# page -> number as it stands there -> fact, or fact[place] of a constant of several numbers
CONSTANTS: dict[str, dict[str, str]] = {
    "docs/commands/audit.md": {
        "0.06 s": "same-time",
        "75%": "belongs",
        "2%": "alike",
        "1.3 times": "fewer-conflicts",
        "6%": "audit-free",
        "40%": "audit-free-class",
        "3%": "audit-phantom",
        "20%": "audit-phantom-class",
        "10%": "trail",
        "5%": "doubled",
        "30%": "own-class",
    },
    "docs/commands/capture.md": {"0.1 s": "frame-period"},
    "docs/commands/convert.md": {
        "5%": "below-grid",
        "3 s": "longest-frame",
        "0.25 s": "pose-reach",
        "1 s": "pose-gap",
    },
    "docs/commands/demo.md": {"240 MB": "demo-size"},
    "docs/commands/evaluate.md": {
        "0.05 s": "forecast-time",
        "2,000 times": "draws",
    },
    "docs/commands/regrid.md": {"2 GB": "large-frame"},
    "docs/commands/validate.md": {
        "0.1%": "far-points",
        "10%": "empty-grids",
    },
    "docs/commands/view.md": {
        "10 frames per second": "film-rate",
        "0.1 s": "frame-period",
    },
    "docs/design.md": {"5%": "room-growth"},
    "docs/ground-truth.md": {
        "5 s": "horizon",
        "0.5 s": "smooth-boxes",
        "0.85 s": "deformable",
        "0.95": "doubtful",
        "0.75": "doubtful[1]",
        "0.05": "ground-per-m",
        "0.15": "solid-per-m",
        "0.02": "outlier-per-m",
    },
    "docs/howto/converter.md": {"0.1 s": "frame-period"},
    "docs/howto/many-machines.md": {
        "10 s": "cluster-connect",
        "10 minutes": "cluster-workers",
    },
    "docs/reliability.md": {
        "10 s": "fault-case",
        "1 GiB": "fault-memory",
        "30 s": "fault-limit",
        "256 MiB": "largest-frame",
        "64 MiB": "small-array",
    },
    "docs/sets/argoverse2.md": {
        "1.35": "argoverse2-lidar",
        "1.58": "argoverse2-lidar[2]",
    },
    "docs/sets/bag.md": {
        "4 ms": "scan-duration",
        "0.6 s": "scan-duration[1]",
        "3 s": "longest-scan",
    },
    "docs/sets/carlaocc.md": {"0.1 s": "carlaocc-period"},
    "docs/sets/kitti-tracking.md": {"0.1033 s": "kitti-tracking-period"},
    "docs/sets/scans.md": {
        "4 ms": "scan-duration",
        "0.6 s": "scan-duration[1]",
        "0.1 s": "frame-period",
    },
    "docs/sets/semanticposs.md": {"0.1 s": "frame-period"},
    "docs/studies/scale.md": {
        "0.25 s": "backoff",
        "0.25": "backoff",
        "10 s": "longest-wait",
    },
    "docs/sets/synthcity.md": {"0.1 s": "frame-period"},
}

# (page, number or heading of a section) -> why it is right; at most 20
EXCEPTIONS: dict[tuple[str, str], str] = {
    ("docs/performance.md", "20 minutes"): "what a run of `make figures` is allowed to take",
    ("docs/start.md", "0.7 GB"): "the size of a download of torch",
    (
        "docs/commands/audit.md",
        "0.25",
    ): "the step of a list of turns, which the code writes as a range",
    ("docs/commands/audit.md", "95%"): "the kind of an interval",
    ("docs/sets/argoverse2.md", "15 s"): "how long a drive of the data set is, by its authors",
    ("docs/sets/argoverse2.md", "200 MB"): "the size of a download",
    ("docs/sets/carlaocc.md", "0.10"): "a version of CARLA",
    ("docs/sets/kitti-raw.md", "10 s"): "how long a drive of the data set is, by its authors",
    ("docs/sets/kitti-raw.md", "0.1 s"): "how long the scanner needs for a turn, by its maker",
    ("docs/sets/nuscenes.md", "20 s"): "how long a drive of the data set is, by its authors",
    ("docs/storage.md", "100 MiB"): "from where on objects are sent in parts",
    ("docs/studies/networks.md", "## Published results"): "the numbers of the paper",
}

_UNITS = {
    "ms": 1e-3,
    "s": 1,
    "m": 60,
    "minutes": 60,
    "%": 0.01,
    "kB": 1e3,
    "MB": 1e6,
    "GB": 1e9,
    "KiB": 2**10,
    "MiB": 2**20,
    "GiB": 2**30,
}
_COMMENT = re.compile(r"#.*\bfact: ([a-z0-9-]+)$")


@cache
def facts() -> dict[str, list[float]]:
    """Return the numbers of each constant beside a fact, in seconds, bytes or as they are.

    Raises:
        ValueError: two constants have one name, or a comment stands beside no constant.
    """
    held: dict[str, list[float]] = {}
    root = Path(__file__).parents[3]
    for path in (path for folder in SOURCES for path in sorted((root / folder).rglob("*.py"))):
        lines = path.read_text().splitlines()
        names = {
            row: found[1] for row, line in enumerate(lines, 1) if (found := _COMMENT.search(line))
        }
        for node in ast.walk(ast.parse("\n".join(lines))) if names else ():
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                last = node.end_lineno or node.lineno
                for row in [row for row in names if node.lineno - 1 <= row <= last]:
                    before = lines[row - 1].lstrip().startswith("#")
                    if row >= node.lineno or before:
                        name = names.pop(row)
                        if name in held:
                            raise ValueError(f"{path}:{row}: a second constant is fact {name}")
                        held[name] = list(_numbers(node.value))
        if names:
            raise ValueError(f"{path}: no constant beside the facts {', '.join(names.values())}")
    return held


def _numbers(node: ast.AST) -> Iterator[float]:
    """Yield the numbers of an expression, in their order."""
    if isinstance(node, ast.Constant):
        yield value_of_text(node.value) if isinstance(node.value, str) else float(node.value)
    elif isinstance(node, ast.BinOp):
        yield float(eval(ast.unparse(node), {}))
    else:
        for part in ast.iter_child_nodes(node):
            if isinstance(part, ast.expr | ast.keyword):
                yield from _numbers(part)


def value_of(fact: str) -> float:
    """Return a constant of the code, in seconds, bytes or as it is."""
    name, place = re.fullmatch(r"([\w-]+)(?:\[(\d+)\])?", fact).groups()  # type: ignore[union-attr]
    if name not in facts():
        raise KeyError(f"no constant has the comment `fact: {name}`")
    return facts()[name][int(place or 0)]


def value_of_text(text: str) -> float:
    """Return a number of a page, in seconds, bytes, or as it is."""
    number, unit = re.fullmatch(r"([\d.,]+) ?(.*)", text).groups()  # type: ignore[union-attr]
    return float(number.replace(",", "")) * _UNITS.get(unit, 1)


def is_right(text: str, name: str) -> bool:
    """Return whether a number of a page is the constant of the code, or what it leaves of one."""
    shown, value = value_of_text(text), value_of(name)
    plain = float(re.split(r"[ %]", text)[0].replace(",", ""))
    return any(math.isclose(number, value) for number in (shown, plain, 1 - shown))
