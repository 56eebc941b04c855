"""Sequences of the layout as the files of OpenOccupancy-nuScenes:
`scene_{token}/occupancy/{token}.npy`.
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np

from carlasc import storage
from carlasc.converting import Files, TargetFrame
from carlasc.core.benchmarks import TO_OCC3D
from carlasc.core.grids import GridSpec
from carlasc_converters.exporters.grid_exporter import GridExporter
from carlasc_converters.exporters.occ3d import frame_token, scene_token


class OpenOccupancyExporter(GridExporter):
    """Writes the occupied voxels as OpenOccupancy has them: 512 x 512 x 40 voxels of 0.2 m around
    the LiDAR, x to the right, y forward.

    The classes are those of Occ3D, whose class 0, "others", is noise here. Free and unknown voxels
    are both absent.
    """

    title = "OpenOccupancy-nuScenes: scene_TOKEN/occupancy/TOKEN.npy"
    target = GridSpec("cartesian", (512, 512, 40), (-51.2, -51.2, -5.0), (51.2, 51.2, 3.0))
    maps = TO_OCC3D
    free = 17
    slug = "openoccupancy"

    def frame_of(self, sequence: storage.Sequence) -> TargetFrame:
        """Return the frame of the LiDAR of nuScenes."""
        return TargetFrame(forward="y")

    def folders(self, names: Sequence[str]) -> dict[str, str]:
        """Return scene_TOKEN for each name."""
        return {name: f"scene_{scene_token(name)}" for name in names}

    def frame_files(self, sequence: storage.Sequence, frame: int) -> tuple[str, ...]:
        """Return the occupied voxels of a frame."""
        return (f"occupancy/{frame_token(sequence.name, frame)}.npy",)

    def make_frame(self, sequence: storage.Sequence, frame: int) -> Files:
        """Return rows of z, y, x, class, sorted."""
        codes, _ = self.read_codes(sequence, frame)
        x, y, z = np.unravel_index(np.flatnonzero(codes.reshape(-1) != 0), self.target.size)
        rows = np.column_stack([z, y, x, codes[x, y, z] - 1]).astype(np.uint16)
        rows = rows[np.lexsort((x, y, z))]
        buffer = io.BytesIO()
        np.save(buffer, rows)
        return {self.frame_files(sequence, frame)[0]: buffer.getbuffer()}
