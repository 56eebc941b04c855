"""Simulated towns with their ground truth, laid out as a data set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from carlasc import GridSpec, regrid, simulate
from carlasc.captures import Lidar, TrafficLevel


@dataclass(frozen=True)
class Town:
    """A drive through a town.

    Attributes:
        name: of the sequence; the first frame is put behind it.
        split: "Train", "Val" or "Test".
        seed: town, traffic, sensors and noise are drawn from it.
        traffic: "light", "medium" or "heavy".
        first_frame: where the drive is joined; it starts, at rest, with frame 0.
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
    """Simulate each town and make its ground truth; what is there already is left as it is.

    Args:
        out: root of the data set.
        towns: what to simulate.
        frames: of each, 0.1 s apart.
        sensors: LiDARs a frame, the ego one among them.
        points: rays a scan.
        spec: the grid; the published one if None.
        workers: processes side by side; all cores if None.
        progress: called with (towns done, towns).
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
            workers=workers,
        )
        regrid(folder, None, spec or GridSpec.published(), name="evaluation", workers=workers)
        if progress:
            progress(done, len(towns))
