"""Check that nothing is missing for a release: `python tests/tools/release.py [TAG]`.

Prints a line for each thing that is missing, and ends with exit code 1 if there is one.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def missing(root: Path, tag: str = "") -> list[str]:
    """Return what a release of a checkout lacks.

    Args:
        root: folder of the checkout.
        tag: tag of the release, such as "v0.1.0"; empty if it is not tagged yet.
    """

    def read(name: str) -> str:
        return (root / name).read_text()

    project = tomllib.loads(read("pyproject.toml"))
    repository = project["tool"]["hatch"]["metadata"]["hooks"]["custom"]["repository"]
    (version,) = re.findall(r'^__version__ = "(.+)"$', read("carlasc/__init__.py"), re.MULTILINE)
    found = []
    if not re.fullmatch(r"https://[^/]+/[^/]+/[^/]+", repository):
        found.append("pyproject.toml: repository is empty, or is not the address of a repository")
    if tag and tag != f"v{version}":
        found.append(f"carlasc/__init__.py: the version is {version}, the tag is {tag}")
    if f'"{version}"' not in read("recipe/meta.yaml"):
        found.append(f"recipe/meta.yaml: the version is not {version}")
    if not re.search(rf"^version: {re.escape(version)}$", read("CITATION.cff"), re.MULTILINE):
        found.append(f"CITATION.cff: the version is not {version}")
    if "\ndate-released:" not in read("CITATION.cff"):
        found.append("CITATION.cff: date-released is missing")
    if not re.search(rf"^## {re.escape(version)}\b", read("CHANGELOG.md"), re.MULTILINE):
        found.append(f"CHANGELOG.md: no section {version}: rename Unreleased")
    return found


if __name__ == "__main__":
    problems = missing(ROOT, *sys.argv[1:2])
    print("\n".join(problems) or "nothing is missing")
    sys.exit(1 if problems else 0)
