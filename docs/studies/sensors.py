"""Study: does ground truth improve with more sensors?

`python docs/studies/sensors.py` prints the table and draws docs/images/sensors.png.

The reference is the grid of 60 additional sensors at the same instant. Accuracy is computed over
the voxels that are known in both the reference and the grid of one sensor, so that all rows concern
the same voxels. Coverage is the share of the reference's known voxels that are known in a grid.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import study
from carlasc_recorders import TownDrive
from matplotlib.figure import Figure

from carlasc import Grid, GridSpec
from carlasc.captures import Lidar, SensorRecording
from carlasc.core.geometry import invert
from carlasc.core.tables import CARLA
from carlasc.groundtruth import Observation, count_votes
from carlasc.metrics import TruthScore, score_truth

SENSORS = (1, 5, 10, 20, 40)
SEEDS, FRAME = {"town": range(101, 106)}, 60
SPECS = {
    "0.4 m": GridSpec.published().with_resolution(0.4),
    "0.2 m": GridSpec.published().with_resolution(0.2),
}


def sensors() -> tuple[int, ...]:
    """Return the numbers of sensors that are compared."""
    return SENSORS[: 2 if study.is_tiny() else None]


def vote(recordings: Iterable[SensorRecording], grid_T_world: np.ndarray, spec: GridSpec) -> Grid:
    """Return the grid of several recordings."""
    observations = (
        Observation(r.scan.points, study.labels_of(r.scan), grid_T_world @ r.world_T_sensor)
        for r in recordings
    )
    return count_votes(observations, spec).to_grid()


def score_scene(seed: int, frame: int) -> dict[tuple[str, int], TruthScore]:
    """Return the score per resolution and number of sensors in one scene."""
    drive = TownDrive(seed, "heavy", Lidar(points=8_000) if study.is_tiny() else Lidar())
    reference = drive.reference_observations(frame, 3 if study.is_tiny() else 60)
    recordings = [drive.record(frame, sensor) for sensor in range(max(sensors()))]
    grid_T_world = invert(recordings[0].world_T_sensor)
    scores = {}
    for name, spec in SPECS.items():
        truth = vote(reference, grid_T_world, spec)
        alone = vote(recordings[:1], grid_T_world, spec).known
        for count in sensors():
            grid = vote(recordings[:count], grid_T_world, spec)
            same = score_truth(grid, truth, CARLA.num_channels, mask=alone)
            whole = score_truth(grid, truth, CARLA.num_channels)
            scores[name, count] = TruthScore(
                same.matrix, whole.known, whole.known_reference, whole.known_both
            )
    return scores


def main() -> None:
    """Score all scenes, and print and plot the means."""
    clock, scenes = study.Clock(), []
    with study.begin(study.options(__doc__, SEEDS)) as given:
        for seed in study.few(given.town):
            scenes.append(score_scene(seed, FRAME))
            clock(f"scene {seed}")
        show(
            scenes,
            (given.work if study.is_tiny() else Path(__file__).parents[1] / "images")
            / "sensors.png",
        )


def show(scenes: list[dict[tuple[str, int], TruthScore]], picture: Path) -> None:
    """Print the table, and draw its means."""
    lines = ["| voxels | sensors | accuracy | coverage |", "|---|---:|---:|---:|"]
    curves: dict[str, list[tuple[float, float]]] = {}
    for name in SPECS:
        for count in sensors():
            accuracy = [scene[name, count].accuracy for scene in scenes]
            coverage = [scene[name, count].coverage for scene in scenes]
            curves.setdefault(name, []).append((float(np.mean(accuracy)), float(np.mean(coverage))))
            cells = " | ".join(study.interval(values, ".2%") for values in (accuracy, coverage))
            lines.append(f"| {name} | {count} | {cells} |")
    print("\n".join(lines))
    draw(curves, picture)


def draw(curves: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """Plot accuracy and coverage against the number of sensors."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    axes = figure.subplots(1, 2)
    for axis, column, title in ((axes[0], 0, "accuracy"), (axes[1], 1, "coverage")):
        for name, values in curves.items():
            axis.plot(sensors(), [100 * value[column] for value in values], marker="o", label=name)
        axis.set(title=title, xlabel="sensors", ylabel="%", xscale="log")
        axis.set_xticks(sensors(), [str(count) for count in sensors()])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.legend(title="voxels")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
