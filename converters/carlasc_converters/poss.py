"""SemanticPOSS: SemanticKITTI's files, other classes, one LiDAR of 40 channels (FORMAT section 6)."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np

from carlasc.converting import Converter, Recording
from carlasc.core.geometry import Transform
from carlasc.core.tables import REMAPS, SEMANTICPOSS
from carlasc_converters.kitti import KittiRecording, find_sequences

_VALIDATION = "02"  # of 00..05: the part that papers about it test on


class SemanticPoss(Converter):
    """A SemanticPOSS root, or one of its sequences."""

    title: ClassVar[str] = "SemanticPOSS"
    classes = SEMANTICPOSS
    to_carla = REMAPS["semanticposs_to_carla"]
    sensor = "Hesai Pandora, 40 channels"
    min_range_m = 2.5
    max_range_m = 70.0

    def sequences(self) -> list[Recording]:
        """Return the sequences, by number.

        Raises:
            MissingDataError: there is none.
        """
        return [
            PossRecording(folder, f"POSS_{folder.name}", "Val" if folder.name == _VALIDATION else "Train")
            for folder in find_sequences(self.root)
        ]


class PossRecording(KittiRecording):
    """One sequence; where it has a file of poses and no calib.txt they are the LiDAR's own."""

    def _calibration(self, poses: Path, *, force: bool) -> Transform:
        return super()._calibration(poses, force=force) if (self.folder / "calib.txt").is_file() else np.eye(4)
