"""How true is the flow that `carlasc convert kitti` estimates?

`python docs/studies/flow.py --town 4 5 6 7 8 9` prints the table.

Simulated drives in heavy traffic are written as SemanticKITTI's files, which have no flow, and
converted; the velocity that each sighting of a moving actor was given is compared with the
simulator's.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import study
from carlasc_recorders import TownDrive
from numpy.typing import NDArray

import carlasc
from carlasc.captures import Lidar
from carlasc.converting import LayoutOptions, convert
from carlasc.core.tables import CARLA
from carlasc.running import Run

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from helpers.datasets.kitti import write_kitti

SEEDS, FRAMES = {"town": range(4, 10)}, range(20, 100)
MIRROR = np.array([1, -1, 1])
VEHICLE, PEDESTRIAN = (float(CARLA.id_of(name)) for name in ("Vehicle", "Pedestrian"))
ROWS = {  # name: class, speeds in m/s, numbers of points
    "vehicles at 5 to 12 m/s, 100 points or more": (VEHICLE, (5.0, 12.0), (100, np.inf)),
    "vehicles from 5 m/s, 20 to 99 points": (VEHICLE, (5.0, np.inf), (20, 99)),
    "slower vehicles, 100 points or more": (VEHICLE, (0.3, 5.0), (100, np.inf)),
    "pedestrians, 30 points or more": (PEDESTRIAN, (0.3, np.inf), (30, np.inf)),
}


def compare(seed: int, root: Path) -> NDArray[np.float64]:
    """Return (S, 4) of a drive's sightings of moving actors: class, true speed, number of points,
    end-point error.
    """
    lidar = Lidar(points=8_000) if study.is_tiny() else Lidar()
    drive, found = TownDrive(seed, "heavy", lidar), []
    truth = write_kitti(root / "in", drive, study.few(FRAMES, 8), voxels_every=0)
    convert(
        "kitti",
        root / "in",
        root / "out",
        layout=LayoutOptions("carla"),
        grids=None,
        run=Run(workers=1),
    )
    (sequence,) = carlasc.open(root / "out").sequences().values()
    for number in truth.frames:
        scan, flow = sequence.scan(number), truth.flow[number] * MIRROR
        assert scan.flow is not None and scan.labels is not None and scan.instances is not None
        for actor in np.unique(scan.instances[np.abs(flow).max(axis=1) > 0]).tolist():
            own = np.flatnonzero(scan.instances == actor)
            error = np.linalg.norm(scan.flow[own[0]] - flow[own[0]])
            found.append((scan.labels[own[0]], np.linalg.norm(flow[own[0]]), len(own), error))
    return np.array(found, np.float64)


def main() -> None:
    """Compare the drives one after the other, and print the table."""
    clock, drives = study.Clock(), []
    with study.begin(study.options(__doc__, SEEDS)) as given:
        for seed in study.few(given.town):
            drives.append(compare(seed, given.work / str(seed)))
            clock(f"drive {seed}")
    label, speed, points, error = np.concatenate(drives).T
    print("| | median | 75th percentile | observations |", "|---|---:|---:|---:|", sep="\n")
    for name, (wanted, (slowest, fastest), (fewest, most)) in ROWS.items():
        own = error[
            (label == wanted)
            & (speed >= slowest)
            & (speed < fastest)
            & (points >= fewest)
            & (points <= most)
        ]
        middle, high = np.quantile(own, (0.5, 0.75)) if len(own) else (np.nan, np.nan)
        print(f"| {name} | {middle:.3f} | {high:.3f} | {len(own)} |")


if __name__ == "__main__":
    main()
