"""Study: does ground truth improve with more sensors? `python docs/studies/sensors.py [FOLDER]` prints the table and draws the plot.

The reference is the grid of 60 additional sensors at the same instant. Accuracy is computed over the voxels that are known in both the
reference and the grid of one sensor, so that all rows concern the same voxels. Coverage is the share of the reference's known voxels that
are known in a grid.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from clock import Clock
from matplotlib.figure import Figure

from carlasc import Grid, GridSpec
from carlasc.captures import SensorRecording, TownDrive
from carlasc.core.geometry import invert
from carlasc.core.tables import CARLA
from carlasc.groundtruth import Observation, count_votes
from carlasc.metrics import TruthScore, score_truth

SENSORS = (1, 5, 10, 20, 40)
SCENES = [(seed, 60) for seed in range(101, 106)]
SPECS = {"0.4 m": GridSpec.published().with_resolution(0.4), "0.2 m": GridSpec.published().with_resolution(0.2)}


def vote(recordings: Iterable[SensorRecording], grid_T_world: np.ndarray, spec: GridSpec) -> Grid:
    """Return the grid of several recordings."""
    observations = (Observation(r.scan.points, r.scan.labels, grid_T_world @ r.world_T_sensor) for r in recordings)
    return count_votes(observations, spec).to_grid()


def score_scene(seed: int, frame: int) -> dict[tuple[str, int], TruthScore]:
    """Return the score per resolution and number of sensors in one scene."""
    drive = TownDrive(seed, "heavy")
    reference = drive.reference_observations(frame, 60)
    recordings = [drive.record(frame, sensor) for sensor in range(max(SENSORS))]
    grid_T_world = invert(recordings[0].world_T_sensor)
    scores = {}
    for name, spec in SPECS.items():
        truth = vote(reference, grid_T_world, spec)
        alone = vote(recordings[:1], grid_T_world, spec).known
        for count in SENSORS:
            grid = vote(recordings[:count], grid_T_world, spec)
            same = score_truth(grid, truth, CARLA.num_channels, mask=alone)
            whole = score_truth(grid, truth, CARLA.num_channels)
            scores[name, count] = TruthScore(same.matrix, whole.known, whole.known_reference, whole.known_both)
    return scores


def main(folder: Path) -> None:
    """Score all scenes, and print and plot the means."""
    clock, scenes = Clock(), []
    for seed, frame in SCENES:
        scenes.append(score_scene(seed, frame))
        clock(f"scene {seed}")
    lines = ["| voxels | sensors | accuracy | coverage |", "|---|---:|---:|---:|"]
    curves: dict[str, list[tuple[float, float]]] = {}
    for name in SPECS:
        for count in SENSORS:
            accuracy = float(np.mean([scene[name, count].accuracy for scene in scenes]))
            coverage = float(np.mean([scene[name, count].coverage for scene in scenes]))
            curves.setdefault(name, []).append((accuracy, coverage))
            lines.append(f"| {name} | {count} | {accuracy:.2%} | {coverage:.2%} |")
    print("\n".join(lines))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sensors.md").write_text("\n".join(lines) + "\n")
    draw(curves, folder / "sensors.png")


def draw(curves: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """Plot accuracy and coverage against the number of sensors."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    axes = figure.subplots(1, 2)
    for axis, column, title in ((axes[0], 0, "accuracy"), (axes[1], 1, "coverage")):
        for name, values in curves.items():
            axis.plot(SENSORS, [100 * value[column] for value in values], marker="o", label=name)
        axis.set(title=title, xlabel="sensors", ylabel="%", xscale="log")
        axis.set_xticks(SENSORS, [str(count) for count in SENSORS])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.legend(title="voxels")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images"))
