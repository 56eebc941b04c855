"""Ground truth of a converted SemanticKITTI drive, with and without ghost trails: `python
docs/studies/kitti.py`.

A simulated drive in heavy traffic is written as SemanticKITTI's files (right-handed, camera poses,
moving classes, instances, no flow) and converted, and each rule's grids are scored against what 60
other sensors see at the same instant. `tube` is the rule by which SemanticKITTI's own voxels were
made. Prints the table, and draws docs/images/kitti.png: one scene by both rules beside the
reference.
"""

from __future__ import annotations

import sys
from functools import reduce
from operator import add
from pathlib import Path

import study
from carlasc_recorders import TownDrive
from PIL import Image

import carlasc
from carlasc import Grid, GridSpec, Run
from carlasc.captures import Lidar
from carlasc.converting import FlowSource, LayoutOptions, convert
from carlasc.core.choices import Dynamic
from carlasc.core.geometry import invert
from carlasc.core.tables import CARLA
from carlasc.groundtruth import FromScans, Observation, count_votes, regrid
from carlasc.metrics import TruthScore, score_truth
from carlasc.viewing import ClassColors, Panel, draw_panels, grid_drawing

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from helpers.datasets.kitti import write_kitti

IMAGES = Path(__file__).parents[1] / "images"
SEED, FRAMES, JUDGED = 1, range(101), (10, 30, 50, 70, 90)
GRIDS = {"coarse": GridSpec.published(), "0.2 m": GridSpec.published().with_resolution(0.2)}
CLASSES = ("Vehicle", "Pedestrian", "Road", "Building", "Sidewalk")
VEHICLE = CARLA.id_of("Vehicle")
# name: rule for what moves, and whether the converter estimates flow
RUNS: dict[str, tuple[Dynamic, FlowSource]] = {
    "tube": ("tube", "none"),
    "align, by instances": ("align", "none"),
    "align, by instances and their estimated flow": ("align", "auto"),
}


def judged() -> tuple[int, ...]:
    """Return the judged frames."""
    return (3,) if study.is_tiny() else JUDGED


def reference(drive: TownDrive, frame: int) -> dict[str, Grid]:
    """Return what 60 sensors see at the instant of a frame, in each grid of the ego sensor."""
    grid_T_world = invert(drive.sensor_poses(frame, 1)[0])
    seen = drive.reference_observations(frame, 2 if study.is_tiny() else 60)
    observations = [
        Observation(r.scan.points, study.labels_of(r.scan), grid_T_world @ r.world_T_sensor)
        for r in seen
    ]
    return {name: count_votes(observations, spec).to_grid() for name, spec in GRIDS.items()}


def make(folder: Path, rule: Dynamic, name: str) -> dict[int, Grid]:
    """Make the judged frames of a converted drive by one rule."""
    grid = f"{rule}_{name.replace(' ', '')}"
    for frame in judged():
        result = regrid(
            folder,
            GRIDS[name],
            observe=FromScans(dynamic=rule),
            frames=(frame, frame + 1),
            name=f"{grid}_{frame}",
            run=Run(workers=1),
        )
        if result.failures:
            raise SystemExit(result.failures[0].message)
    (sequence,) = carlasc.open(folder).sequences().values()
    return {frame: sequence.grid(f"{grid}_{frame}", frame) for frame in judged()}


def row(name: str, run: str, total: TruthScore) -> str:
    """Return a row of the table."""
    matrix = total.matrix
    cells = [f"{matrix.iou[CARLA.id_of(label)]:.3f}" for label in CLASSES]
    return (
        f"| {name} | {run} | "
        + " | ".join(
            [*cells, f"{matrix.recall[VEHICLE]:.2f}", str(matrix.false_positives[VEHICLE])]
        )
        + " |"
    )


def main() -> None:
    """Convert, make grids by each rule, score them, draw one scene."""
    clock = study.Clock()
    lines = [
        f"| grid | rule | {' | '.join(CLASSES)} | Vehicle recall | false Vehicle voxels |",
        "|---|---|" + "---:|" * 7,
    ]
    with study.begin(study.options(__doc__)) as given:
        drive = TownDrive(SEED, "heavy", Lidar(points=8_000) if study.is_tiny() else Lidar())
        write_kitti(given.work / "in", drive, study.few(FRAMES, 7), voxels_every=0)
        flows: tuple[FlowSource, ...] = ("none", "auto")
        for flow in flows:
            layout = LayoutOptions("carla", flow=flow)
            convert(
                "kitti",
                given.work / "in",
                given.work / flow,
                layout=layout,
                grids=None,
                run=Run(workers=1),
            )
        clock("conversion")
        truths = {frame: reference(drive, frame) for frame in judged()}
        clock("reference")
        print("\n".join(lines), flush=True)
        for name in study.few(GRIDS):
            made = {}
            for run, (rule, flow) in RUNS.items():
                made[run] = make(given.work / flow, rule, name)
                scores = (
                    score_truth(grid, truths[frame][name], CARLA.num_channels)
                    for frame, grid in made[run].items()
                )
                print(row(name, run, reduce(add, scores)), flush=True)
                clock(f"{run}, {name}")
        out = given.work if study.is_tiny() else IMAGES
        draw(made, {frame: truth[name] for frame, truth in truths.items()}, out / "kitti.png")


def draw(made: dict[str, dict[int, Grid]], truths: dict[int, Grid], path: Path) -> None:
    """Draw the frame with the longest tubes: tube, align and reference side by side."""
    tubes = made["tube"]
    frame = max(
        tubes,
        key=lambda f: int(
            score_truth(tubes[f], truths[f], CARLA.num_channels).matrix.false_positives[VEHICLE]
        ),
    )
    grids = {
        "SemanticKITTI's rule (tube)": tubes[frame],
        "carlasc convert (align)": made["align, by instances"][frame],
        "reference: 60 sensors at that instant": truths[frame],
    }
    panels = [
        Panel(grid_drawing(grid, ClassColors(CARLA)), title=title) for title, grid in grids.items()
    ]
    picture = Image.fromarray(draw_panels(panels, size=(1800, 640)))
    picture.quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    main()
