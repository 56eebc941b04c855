"""What stays of things that move: `python docs/studies/traces.py [WORK]` draws
docs/images/traces.png, and prints what is in it.

A frame of the street of seed 261, made without labels that tell what moves, as in SemanticKITTI and
by carlasc, beside what 40 other sensors saw at the same instant. For each picture: how many voxels
of vehicles are right and wrong, and how many of the reference's are missing, of the voxels known to
both. WORK is the folder of `movers.py`.
"""

from __future__ import annotations

from pathlib import Path

import study
from movers import ActorStore, make
from movers_drives import GRIDS, record, reference
from movers_rows import ROWS
from movers_scores import CLASSES, count
from PIL import Image

from carlasc import Grid
from carlasc.core.tables import CARLA
from carlasc.viewing import ClassColors, Panel, draw_panels, grid_drawing

KIND, SEED, CHANNELS, GRID = "street", 261, 64, "0.2 m"
SHOWN = {
    "tube": "SemanticKITTI's rule (tube)",
    "align, free space": "carlasc, which is not told what moves",
}


def main() -> None:
    """Make the grids, draw them side by side, and print what is right in each."""
    with study.begin(study.options(__doc__)) as given:
        (drive,) = record(KIND, SEED, [CHANNELS], given.work)
        frame, seen = next(
            (f, seen)
            for (grid, f), seen in reference(KIND, SEED, given.work).items()
            if grid == GRID
        )
        store, grids = ActorStore(given.work / "scores" / str(drive.setting) / "actors"), {}
        for row in (row for row in ROWS if row.name in SHOWN):
            ((_, merged, _),) = make(drive, row, GRID, [frame], store)
            grids[SHOWN[row.name]] = merged.grid
        grids["reference: 40 sensors at that instant"] = Grid(
            GRIDS[GRID], seen.labels, seen.judged.astype("uint32")
        )
        print("| picture | right | wrong | missing |\n|---|---:|---:|---:|")
        for title, grid in grids.items():
            right, true, made = count(grid, seen, {}).classes[list(CLASSES).index("Vehicle"), :3]
            print(f"| {title} | {right} | {made - right} | {true - right} |")
        panels = [
            Panel(grid_drawing(grid, ClassColors(CARLA)), title=title)
            for title, grid in grids.items()
        ]
        out = (
            given.work if study.is_tiny() else Path(__file__).parents[1] / "images"
        ) / "traces.png"
        Image.fromarray(draw_panels(panels, size=(1800, 430))).quantize(128).save(
            out, optimize=True
        )
        print(out)


if __name__ == "__main__":
    main()
