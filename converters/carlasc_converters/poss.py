"""SemanticPOSS: the files of SemanticKITTI, with other classes, from one LiDAR of 40 channels."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np

from carlasc.converting import Converter, Recording, Sensor, Split
from carlasc.core.geometry import Transform
from carlasc.core.tables import REMAPS, SEMANTICPOSS
from carlasc_converters.kitti import KittiRecording, find_sequences

_VALIDATION = "02"  # of 00..05: the sequence on which papers report


class SemanticPoss(Converter):
    """Reads SemanticPOSS, or one of its sequences."""

    title: ClassVar[str] = "SemanticPOSS"
    citation = "Y. Pan et al., SemanticPOSS, IV 2020"
    classes = SEMANTICPOSS
    to_carla = REMAPS["semanticposs_to_carla"]
    sensor = "Hesai Pandora, 40 channels"
    min_range_m = 2.5
    max_range_m = 70.0

    def sequences(self) -> list[Recording]:
        """Return the sequences, by number.

        Raises:
            MissingDataError: no sequence exists.
        """
        return [
            PossRecording(
                folder, f"POSS_{folder.name}", "Val" if folder.name == _VALIDATION else "Train"
            )
            for folder in find_sequences(self.source)
        ]


class PossRecording(KittiRecording):
    """One sequence. If it has no calib.txt, its poses are those of the LiDAR."""

    sensors = (Sensor("pandora"),)

    def __init__(self, folder: Path, name: str, split: Split) -> None:
        super().__init__(folder, name, split)
        self.voxels = None

    def _calibration(self, poses: Path, *, force: bool) -> Transform:
        return (
            super()._calibration(poses, force=force)
            if (self.folder / "calib.txt").is_file()
            else np.eye(4)
        )
