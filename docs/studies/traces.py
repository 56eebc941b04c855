"""Do merged scans leave traces of what moves? `python docs/studies/traces.py [FOLDER [SEED ...]]` prints the tables and draws the picture.

A simulated drive of 100 frames in heavy traffic; ten frames spread over it are made from the ego sensor's scans alone, by each rule for
what moves, and compared with what 60 sensors around the scene see at that very instant, over the voxels known to both.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from functools import reduce
from operator import add
from pathlib import Path

import numpy as np
from PIL import Image

import carlasc
from carlasc import Grid, GridSpec
from carlasc.captures import Drive
from carlasc.core.geometry import invert, relative_to
from carlasc.core.tables import CARLA
from carlasc.groundtruth import FromScans, Observation, Voting, count_votes, regrid
from carlasc.metrics import TruthScore, score_truth
from carlasc.storage import FolderSink, layout
from carlasc.viewing import ClassColors, Panel, draw_panels, grid_drawing

FRAMES = 101
JUDGED = [int(frame) for frame in np.linspace(0, FRAMES - 1, 10)]
GRIDS = {"coarse": GridSpec.published(), "0.2 m": GridSpec.published().with_resolution(0.2)}
CLASSES = ("Vehicle", "Pedestrian", "Road", "Building", "Sidewalk", "Vegetation", "Pole")
VEHICLE = CARLA.id_of("Vehicle")


@dataclass(frozen=True)
class Run:
    """One way to make the ground truth."""

    name: str
    field: str  # what tells how things move
    observe: FromScans
    voting: Voting = Voting()  # noqa: RUF009 (frozen)


RUNS = (
    Run("tube", "flow", FromScans(dynamic="tube")),
    Run("current", "flow", FromScans(dynamic="current")),
    Run("current, plain votes", "flow", FromScans(dynamic="current"), Voting("sensor")),
    Run("align", "flow", FromScans()),
    Run("align, by instances", "instances", FromScans()),
)


def record_drive(drive: Drive, folder: Path) -> None:
    """Write the ego scans of a drive twice: with flow, and with instances instead."""
    writers = {field: FolderSink(folder).sequence(f"{field}/cartesian") for field in ("flow", "instances")}
    poses = np.stack([drive.sensor_poses(frame, 1)[0] for frame in range(FRAMES)])
    for writer in writers.values():
        writer.write_document(layout.POSES, layout.encode_poses(relative_to(poses[0], poses)))
        writer.write_document(layout.TIMES, layout.encode_times(np.arange(FRAMES) * layout.FRAME_PERIOD_S))
    for frame in range(FRAMES):
        scan = drive.scan(frame)
        points = np.column_stack([scan.points, np.zeros(len(scan), np.float32)])
        for field, writer in writers.items():
            writer.write("points", frame, points)
            writer.write("labels", frame, scan.labels)
            writer.write(field, frame, getattr(scan, field))


def reference(drive: Drive, frame: int, spec: GridSpec) -> Grid:
    """Return what 60 sensors see at the instant of a frame, in the ego sensor's grid."""
    grid_T_world = invert(drive.sensor_poses(frame, 1)[0])
    seen = drive.reference_observations(frame, 60)
    observations = [Observation(r.scan.points, r.scan.labels, grid_T_world @ r.world_T_sensor) for r in seen]
    return count_votes(observations, spec).to_grid()


def make(run: Run, folder: Path) -> dict[str, dict[int, Grid]]:
    """Make the judged frames in one way: by grid, by frame."""
    out = folder / run.name
    for name, spec in GRIDS.items():
        for frame in JUDGED:
            regrid(
                folder / run.field,
                spec,
                out,
                observe=run.observe,
                voting=run.voting,
                frames=(frame, frame + 1),
                name=name.replace(" ", ""),
                workers=1,
            )
    (sequence,) = carlasc.open(out).sequences().values()
    return {name: {frame: sequence.grid(name.replace(" ", ""), frame) for frame in JUDGED} for name in GRIDS}


def score(grids: dict[int, Grid], truths: dict[int, Grid]) -> TruthScore:
    """Score grids against the references of their frames."""
    return reduce(add, (score_truth(grids[frame], truths[frame], CARLA.num_channels) for frame in JUDGED))


def row(name: str, total: TruthScore, tube: TruthScore) -> str:
    """Return a row of the table."""
    matrix, iou = total.matrix, total.matrix.iou
    wrong = int(matrix.false_positives[VEHICLE])
    ratio = int(tube.matrix.false_positives[VEHICLE]) / max(wrong, 1)
    cells = [f"{iou[CARLA.id_of(label)]:.3f}" for label in CLASSES]
    cells += [f"{matrix.recall[VEHICLE]:.2f}", f"{wrong} (1/{ratio:.0f})", f"{total.coverage:.1%}"]
    return f"| {name} | " + " | ".join(cells) + " |"


def study(seed: int, folder: Path, out: Path) -> list[str]:
    """Return the tables of one drive; draw its picture."""
    drive = Drive(seed, "heavy")
    record_drive(drive, folder)
    made = {run.name: make(run, folder) for run in RUNS}
    lines = []
    for name, spec in GRIDS.items():
        truths = {frame: reference(drive, frame, spec) for frame in JUDGED}
        scores = {run: score(grids[name], truths) for run, grids in made.items()}
        lines += ["", f"Seed {seed}, {name}:", ""]
        lines += [
            f"| rule | {' | '.join(CLASSES)} | Vehicle recall | wrongly Vehicle | coverage |",
            "|---|" + "---:|" * 10,
        ]
        lines += [row(run, total, scores["tube"]) for run, total in scores.items()]
        if name == "0.2 m":
            draw({run: grids[name] for run, grids in made.items()}, truths, out / f"traces_{seed}.png")
    return lines


def draw(made: dict[str, dict[int, Grid]], truths: dict[int, Grid], path: Path) -> None:
    """Draw the frame with the longest tubes: tube, align and reference side by side."""
    tubes = made["tube"]
    wrong = {
        f: int(((tubes[f].labels == VEHICLE) & (truths[f].labels != VEHICLE) & truths[f].known).sum()) for f in JUDGED
    }
    frame = max(JUDGED, key=lambda f: wrong[f])
    grids = {
        "SemanticKITTI's rule (tube)": tubes[frame],
        "carlasc (align)": made["align"][frame],
        "reference: 60 sensors at that instant": truths[frame],
    }
    panels = [Panel(grid_drawing(grid, ClassColors(CARLA)), title=title) for title, grid in grids.items()]
    Image.fromarray(draw_panels(panels, size=(1800, 430))).quantize(128).save(path, optimize=True)


def main(out: Path, seeds: list[int]) -> None:
    """Study each drive."""
    out.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            lines = study(seed, Path(folder), out)
        print("\n".join(lines), flush=True)
        (out / f"traces_{seed}.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images"), [int(seed) for seed in sys.argv[2:]] or [1, 2])
