"""Are maps of drives clean?

`python docs/studies/maps.py [WORK]` prints SA, DA, AA and HA of maps by `carlasc map`, and of other
programs.

`--draw MAP.npz` draws such a map instead: docs/images/map.png and map_all.png are drives of the
street with `--motion flow` and `none`.

The measures are those of DynamicMap_Benchmark (Q. Zhang et al., ITSC 2023), by points: SA is the
share of the static points within 5 cm of a point of the map, DA the share of the dynamic ones
without such a point, AA the square root of their product, HA their harmonic mean. A point is
dynamic if its actor moves faster than 1 m/s at any time of the drive. Drives are those of
`movers.py`: WORK keeps them, and results; the default is a temporary folder.

The rows of other programs need `pip install dufomap dynamic-object-removal` (DUFOMap: Python 3.12
or older); rows without them are left out. Their settings are those of `makers_rivals.py`: what
their authors advise for few channels, and the best ones on other drives.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import study
from makers_rivals import RIVALS, Settings, kept_by_removal
from movers_drives import MOVES_M_S, Recorded, record
from movers_rows import BARE, Changed, Only, find_static, noisy_boxes
from numpy.typing import NDArray
from PIL import Image

import carlasc
from carlasc import Run
from carlasc.core.geometry import transform_points
from carlasc.core.tables import CARLA
from carlasc.motion import MotionOptions, PoseOptions
from carlasc.storage import Sequence
from carlasc.storage.views import ChosenSequences

CELL_M, NEAR_M = 0.05, 0.05
CHANNELS = 32
SEEDS = {"town": range(61, 66), "street": range(261, 266)}
POSES = PoseOptions("file", "never")  # which are exact
WIDTH, HEIGHT, PIXELS_PER_M = 1200, 560, 15.0
AZIMUTH, ELEVATION = np.radians(-35), np.radians(38)
Keep = dict[int, NDArray[np.bool_]]
# Each program, its maker in makers_rivals.py, settings for maps beside those there, and the best of
# all, by AA on drives apart: `maps.py WORK --town 51 --street 201 --rows all`.
_SHORT = {"free_votes_fraction": 0.7, "free_votes_floor": 3, "void_min_scans": 4}
_FUSION: tuple[Settings, ...] = ({"cleaners": {"fusion": {}}}, {"cleaners": {"fusion": _SHORT}})
PROGRAMS: dict[str, tuple[str, tuple[Settings, ...], int]] = {
    "DUFOMap": ("dufomap", (), 4),
    "dynamic-object-removal": ("removal", _FUSION, 9),
}


@dataclass(frozen=True)
class MapRow:
    """One way to make a map: what is mapped, and what tells what moves."""

    name: str
    motion: MotionOptions
    change: Callable[[Recorded], Sequence] = lambda drive: drive.sequence
    needs: str = ""
    clean: Callable[[NDArray[np.float32], Recorded], NDArray[np.float32]] = lambda points, drive: (
        points
    )


def without(drive: Recorded, kept: Keep) -> Sequence:
    """Return a drive with only some of its points."""
    return Changed(drive.sequence, keep=lambda frame: kept[frame])


def dynamic_points(drive: Recorded) -> Keep:
    """Return which points of each frame are dynamic."""
    sequence, moving = drive.sequence, set[int]()
    frames = sequence.frames("points").tolist()
    for frame in frames:
        fast = np.linalg.norm(sequence.read("flow", frame), axis=1) > MOVES_M_S
        moving |= set(np.unique(sequence.read("instances", frame)[fast]).tolist())
    return {
        frame: np.isin(sequence.read("instances", frame), sorted(moving - {0})) for frame in frames
    }


def by_dufomap(drive: Recorded, settings: Settings) -> Sequence:
    """Return a drive with the points that DUFOMap calls static."""
    return without(drive, find_static(drive, **settings))


def by_dynamic_object_removal(
    points: NDArray[np.float32], drive: Recorded, settings: Settings
) -> NDArray[np.float32]:
    """Return the points of a map that dynamic-object-removal keeps."""
    sweeps = []
    for frame in drive.sequence.frames("points").tolist():
        pose = drive.sequence.read_pose(frame)
        own = transform_points(pose, drive.sequence.read("points", frame)[:, :3].astype(np.float64))
        sweeps.append((own * (1, -1, 1), pose[:3, 3] * (1, -1, 1)))
    return points[kept_by_removal(points.astype(np.float64), sweeps, settings)]


def rivals() -> Iterator[MapRow]:
    """Yield a row of each setting of other programs: the advised one, the best one, and others."""
    for program, (kind, more, best) in PROGRAMS.items():
        (rival,) = [one for one in RIVALS.values() if one.make.__name__ == kind]
        for place, settings in enumerate(rival.settings + more):
            about = {0: "advised", best: "best of a sweep"}.get(place, str(place))
            row = MapRow(f"{program}; {about}", MotionOptions("none"), needs=rival.module or "")
            if kind == "dufomap":
                yield replace(row, change=partial(by_dufomap, settings=settings))
            else:
                clean = partial(by_dynamic_object_removal, settings=settings)
                yield replace(row, change=lambda d: Only(d.sequence, BARE), clean=clean)


ROWS = (
    MapRow("all points", MotionOptions("none"), lambda drive: Only(drive.sequence, BARE)),
    MapRow(
        "exact labels",
        MotionOptions("none"),
        lambda d: without(d, {f: ~own for f, own in dynamic_points(d).items()}),
    ),
    MapRow("carlasc, flow", MotionOptions("flow")),
    MapRow("carlasc, boxes", MotionOptions("boxes"), lambda drive: noisy_boxes(drive, 0)),
    MapRow("carlasc, free space", MotionOptions("evidence")),
    MapRow(
        "carlasc, free space, unlabelled",
        MotionOptions("evidence"),
        lambda drive: Only(drive.sequence, BARE),
    ),
    *rivals(),
)


def measure(row: MapRow, drive: Recorded, dynamic: Keep, folder: Path) -> dict[str, float]:
    """Make a map, and return its SA, DA and AA."""
    from scipy.spatial import cKDTree  # noqa: PLC0415

    start, out = time.perf_counter(), folder / "map.npz"
    source = ChosenSequences(row.name, {"": row.change(drive)})
    carlasc.map(
        source,
        out,
        cell_m=CELL_M,
        motion=row.motion,
        poses=POSES,
        overwrite=True,
        run=Run(workers=1),
    )
    tree = cKDTree(row.clean(np.load(out)["points"], drive))
    seconds = time.perf_counter() - start
    near: dict[bool, list[int]] = {False: [0, 0], True: [0, 0]}
    for frame, moves in dynamic.items():
        points = drive.sequence.read("points", frame)[:, :3].astype(np.float64)
        points = transform_points(drive.sequence.read_pose(frame), points) * (1, -1, 1)
        found = np.isfinite(tree.query(points, distance_upper_bound=NEAR_M)[0])
        for kind in (False, True):
            near[kind][0] += int(found[moves == kind].sum())
            near[kind][1] += int((moves == kind).sum())
    static, moved = (found / count for found, count in near.values())
    return {
        "SA": static,
        "DA": 1 - moved,
        "AA": float(np.sqrt(static * (1 - moved))),
        "seconds": seconds,
    }


def to_markdown(found: dict[str, list[dict[str, Any]]]) -> str:
    """Return the table: means over drives with their intervals, in percent."""
    lines = ["| map | SA | DA | AA | HA |", "|---|---:|---:|---:|---:|"]
    for name, drives in found.items():
        for drive in drives:
            shares = drive["SA"], drive["DA"]
            drive["HA"] = 2 * shares[0] * shares[1] / sum(shares)
        cells = (
            study.interval((100 * drive[key] for drive in drives), ".1f")
            for key in ("SA", "DA", "AA", "HA")
        )
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def draw(path: Path, out: Path) -> None:
    """Draw the points near the middle of a map, the nearer ones over the others, with a little
    shade by height.
    """
    with np.load(path) as made:
        points, labels = made["points"].astype(np.float64), made["label"]
    points = points - np.median(points, axis=0)
    turn = np.array([[np.cos(AZIMUTH), -np.sin(AZIMUTH)], [np.sin(AZIMUTH), np.cos(AZIMUTH)]])
    away, left = turn @ points[:, :2].T
    up = points[:, 2] * np.cos(ELEVATION) + away * np.sin(ELEVATION)
    depth = away * np.cos(ELEVATION) - points[:, 2] * np.sin(ELEVATION)
    columns = np.rint(WIDTH / 2 - left * PIXELS_PER_M).astype(int)
    rows = np.rint(HEIGHT / 2 - up * PIXELS_PER_M).astype(int)
    order = np.argsort(-depth)
    table = np.full((256, 3), 150.0)
    for label, color in CARLA.colors.items():
        table[label] = color
    shade = np.clip(0.75 + 0.05 * points[:, 2], 0.6, 1.0)[:, None]
    picture = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    for down in (0, 1):
        for right in (0, 1):
            row, column = rows[order] + down, columns[order] + right
            seen = (row >= 0) & (row < HEIGHT) & (column >= 0) & (column < WIDTH)
            picture[row[seen], column[seen]] = (table[labels] * shade)[order][seen]
    Image.fromarray(picture).quantize(256).save(out)


def main() -> None:
    """Measure all rows, and print the table."""
    parser = study.options(__doc__, SEEDS)
    parser.add_argument(
        "--rows",
        nargs="+",
        default=[row.name for row in ROWS if not row.name[-1].isdigit()],
        help="only these rows; all: also all settings of other programs",
    )
    parser.add_argument("--draw", type=Path, help="a map")
    with study.begin(parser) as given:
        if given.draw:
            draw(given.draw, given.draw.with_suffix(".png"))
            return
        rows = [
            row
            for row in ROWS
            if (not row.needs or find_spec(row.needs))
            and (row.name in given.rows or given.rows == ["all"])
        ]
        found: dict[str, list[dict[str, Any]]] = {row.name: [] for row in rows}
        for kind, seed in study.drives(given, SEEDS):
            (drive,) = record(kind, seed, [CHANNELS], given.work)
            dynamic = dynamic_points(drive)
            for row in rows:
                kept = drive.folder / f"map {row.name}.json"
                if not kept.exists():
                    kept.write_text(json.dumps(measure(row, drive, dynamic, given.work)))
                found[row.name].append(json.loads(kept.read_text()))
                print(f"{drive.setting.drive}, {row.name}: {found[row.name][-1]}", flush=True)
    print(to_markdown(found))


if __name__ == "__main__":
    main()
