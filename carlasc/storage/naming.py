"""What the path of a sequence says of it."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import cast

from carlasc.core.choices import Coordinates
from carlasc.storage.layout import COORDINATES, SPLITS


def identity_of(path: str) -> tuple[str | None, str, Coordinates]:
    """Return the split, the name and the coordinates of a sequence from its path.

    The path is that of the `<coordinates>` folder, absolute or relative; leading parts may be missing. If the last part is not the
    name of coordinates, it is the name of the sequence, whose coordinates are then Cartesian.
    """
    parts = [part for part in PurePosixPath(path.replace("\\", "/")).parts if part not in ("/", ".")]
    coordinates = parts.pop() if parts and parts[-1] in COORDINATES else "cartesian"
    name = parts.pop() if parts else ""
    split = next((split for split in SPLITS if parts and parts[-1].lower() == split.lower()), None)
    return split, name, cast(Coordinates, coordinates)
