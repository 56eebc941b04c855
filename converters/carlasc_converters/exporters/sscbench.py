"""Sequences of the layout as the files of SSCBench-KITTI-360:
`data_2d_raw/2013_05_28_drive_{XXXX}_sync/voxels/`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from carlasc import storage
from carlasc.converting import Files
from carlasc.core.benchmarks import IGNORED, TO_SSCBENCH
from carlasc.core.grids import GridSpec
from carlasc.core.tables import SEMANTICKITTI, SEMANTICKITTI19, SSCBENCH_TO_RAW
from carlasc.errors import ArgumentError
from carlasc_converters.exporters.grid_exporter import (
    GridExporter,
    number_folders,
    read_points,
    scan_occupancy,
)
from carlasc_converters.kitti_voxels import pack_bits

# The files hold raw ids of SemanticKITTI, which are kept; the set has no outliers.
_KITTI = {label: IGNORED if label == 1 else label for label in SEMANTICKITTI.names}
_RAW = {
    name: {label: SSCBENCH_TO_RAW.get(target, IGNORED) for label, target in mapping.items()}
    for name, mapping in TO_SSCBENCH.items()
} | {
    SEMANTICKITTI.name: _KITTI,
    SEMANTICKITTI19.name: {
        label: SEMANTICKITTI.id_of(name) for label, name in SEMANTICKITTI19.names.items()
    },
}


@dataclass(eq=False)
class SscBenchExporter(GridExporter):
    """Writes grids as SSCBench-KITTI-360 has them: 256 x 256 x 32 voxels of 0.2 m before the LiDAR,
    of every 5th frame.
    """

    title = "SSCBench-KITTI-360: data_2d_raw/DRIVE/voxels/NNNNNN.label, .invalid and .bin"
    target = GridSpec("cartesian", (256, 256, 32), (0.0, -25.6, -2.0), (51.2, 25.6, 4.4))
    maps = _RAW
    kind = "raw"
    free = 0
    slug = "sscbench"

    every: Annotated[int, "Write only frames whose number is a multiple of this."] = field(
        default=5, kw_only=True
    )

    def __post_init__(self) -> None:
        if self.every < 1:
            raise ArgumentError("every", expected="1 or more", found=self.every)

    @property
    def product(self) -> str:
        """Predictions are written to a separate folder."""
        return "predictions" if self.predictions else "data"

    def folders(self, names: Sequence[str]) -> dict[str, str]:
        """Return data_2d_raw/2013_05_28_drive_XXXX_sync for each name: 0003 for KITTI360_0003, and
        the next free number for other names.
        """
        return {
            name: f"data_2d_raw/2013_05_28_drive_{number}_sync"
            for name, number in number_folders(names, "KITTI360_", 4).items()
        }

    def frames(self, sequence: storage.Sequence) -> list[int]:
        """Return every 5th frame that has the grid."""
        return [frame for frame in super().frames(sequence) if frame % self.every == 0]

    def frame_files(self, sequence: storage.Sequence, frame: int) -> tuple[str, ...]:
        """Return labels and masks, or the prediction."""
        if self.predictions:
            return (f"predictions/{frame:06d}.label",)
        return tuple(f"voxels/{frame:06d}{suffix}" for suffix in (".label", ".invalid", ".bin"))

    def make_frame(self, sequence: storage.Sequence, frame: int) -> Files:
        """Return the raw ids, one byte for each unknown voxel, and one bit for each voxel of the
        frame's own scan.
        """
        labels, known = self.read(sequence, frame)
        content: list[bytes] = [np.where(known, labels, 0).astype("<u2").tobytes()]
        if not self.predictions:
            content.append((~known).astype(np.uint8).tobytes())
            content.append(
                pack_bits(scan_occupancy(sequence, read_points(sequence, frame), self.target))
            )
        return dict(zip(self.frame_files(sequence, frame), content, strict=True))
