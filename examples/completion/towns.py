"""Simulated towns with their ground truth, as a data set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from carlasc import GridSpec, Run, regrid, simulate
from carlasc.captures import Lidar, TrafficLevel


@dataclass(frozen=True)
class Town:
    """A drive through a town.

    Attributes:
        name: name of the sequence, without the first frame, which is appended.
        split: "Train", "Val" or "Test".
        seed: seed of town, traffic, sensors and noise.
        traffic: "light", "medium" or "heavy".
        first_frame: first frame of the drive that is used. The drive starts at rest with frame 0.
    """

    name: str
    split: str
    seed: int
    traffic: TrafficLevel
    first_frame: int = 0

    @property
    def path(self) -> str:
        """Folder of the sequence in the data set."""
        return f"{self.split}/{self.name}_{self.first_frame:04d}"


def build_towns(
    out: Path,
    towns: Sequence[Town],
    *,
    frames: int,
    sensors: int = 20,
    points: int = 130_000,
    spec: GridSpec | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Simulate each town and make its ground truth. Frames that exist are skipped.

    Args:
        out: root of the data set.
        towns: the towns.
        frames: number of frames of each town, 0.1 s apart.
        sensors: number of LiDARs per frame, the ego LiDAR included.
        points: number of rays per scan.
        spec: the grid; the published one if None.
        workers: number of processes; None uses all cores.
        progress: called with the number of finished towns and the number of all towns.
    """
    for done, town in enumerate(towns, 1):
        folder = out / town.path
        simulate(
            folder,
            count=frames,
            first_frame=town.first_frame,
            sensors=sensors,
            lidar=Lidar(points=points),
            seed=town.seed,
            traffic=town.traffic,
            bev=False,
            run=Run(workers=workers),
        )
        regrid(folder, spec or GridSpec.published(), name="evaluation", run=Run(workers=workers))
        if progress:
            progress(done, len(towns))
