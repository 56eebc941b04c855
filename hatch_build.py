"""What the metadata of the package takes from `[tool.carlasc]` of pyproject.toml: the addresses,
and a README whose links lead there.

`repository` is empty until the first release. Then it is the address of the repository, such as
"https://github.com/ORG/carlasc", and nothing else has to be changed: links of the README, of the
documentation and of the package index follow.
"""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


def urls(repository: str) -> dict[str, str]:
    """Return the addresses that the package index shows; none without a repository."""
    if not repository:
        return {}
    return {
        "Documentation": f"{repository}/blob/main/docs/index.md",
        "Source": repository,
        "Changelog": f"{repository}/blob/main/CHANGELOG.md",
        "Issues": f"{repository}/issues",
    }


def absolute(readme: str, repository: str) -> str:
    """Return a README whose relative links lead to the repository, which has one."""
    if not repository:
        return readme
    pictures = (".png", ".svg", ".webp")
    return re.sub(
        r"\]\((?!https?:|#)([^)\s]+)\)",
        lambda link: (
            f"]({repository}/{'raw' if link[1].endswith(pictures) else 'blob'}/main/{link[1]})"
        ),
        readme,
    )


class CustomMetadataHook(MetadataHookInterface):
    """Adds the addresses and the README."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Add what does not stand in pyproject.toml."""
        repository = self.config["repository"]
        readme = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        metadata["urls"] = urls(repository)
        metadata["readme"] = {
            "content-type": "text/markdown",
            "text": absolute(readme, repository),
        }
