"""What stays of things that move: `python docs/studies/traces.py [WORK]` draws
docs/images/traces.png, and prints what is in it.

A frame of the street of seed 261, made by SemanticKITTI's rule and by free space, beside what 40
other sensors saw at the same instant. For each picture: how many voxels
of vehicles are right and wrong, and how many of the reference's are missing, of the voxels known to
both. WORK is the folder of `movers.py`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import study
from movers import ActorStore, make
from movers_drives import GRIDS, record, reference
from movers_rows import ROWS
from movers_scores import CLASSES, count
from PIL import Image

from carlasc import Grid
from carlasc.core.tables import CARLA
from carlasc.viewing import ClassColors, Panel, Viewpoint, draw_panels, grid_drawing

KIND, SEED, CHANNELS, GRID = "street", 261, 64, "0.2 m"
SHOWN = {
    "tube": "Scans added up (SemanticKITTI's rule)",
    "align, free space": "carlasc, by free space",
}
# what moves in strong colours, everything else in quiet ones
GREY, STONE, GREEN = (128, 134, 142), (186, 178, 164), (176, 196, 150)
COLORS = {
    "Vehicle": (31, 110, 190), "Pedestrian": (230, 92, 20), "Road": GREY, "RoadLine": GREY,
    "Sidewalk": (205, 205, 200), "Ground": (205, 205, 200), "Terrain": GREEN,
    "Vegetation": (92, 140, 84), "Building": STONE, "Fence": STONE, "Wall": STONE,
    "Pole": (90, 90, 90), "TrafficSign": (90, 90, 90), "TrafficLight": (90, 90, 90),
    "Static": (150, 140, 130),
}  # fmt: skip
QUIET = replace(CARLA, colors={**CARLA.colors, **{CARLA.id_of(n): c for n, c in COLORS.items()}})
SHORT = ("Vehicle", "Pedestrian", "Road", "Sidewalk", "Building", "Terrain")  # of the legend


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
        grids["Truth: 40 sensors at that instant"] = Grid(
            GRIDS[GRID], seen.labels, seen.judged.astype("uint32")
        )
        print("| picture | right | wrong | missing |\n|---|---:|---:|---:|")
        for title, grid in grids.items():
            right, true, made = count(grid, seen, {}).classes[list(CLASSES).index("Vehicle"), :3]
            print(f"| {title} | {right} | {made - right} | {true - right} |")
        colors = ClassColors(QUIET)
        panels = [Panel(grid_drawing(grid, colors), title=title) for title, grid in grids.items()]
        picture = draw_panels(
            panels,
            size=(1500, 460),
            viewpoint=Viewpoint.parse("elevation=44 distance=53 target=0,0,-1.8"),
            legend=colors.entries([CARLA.id_of(name) for name in SHORT]),
            captioned=True,
            font_size=24,
        )
        out = (
            given.work if study.is_tiny() else Path(__file__).parents[1] / "images"
        ) / "traces.png"
        Image.fromarray(picture).quantize(128).save(out, optimize=True)
        print(out)


if __name__ == "__main__":
    main()
