"""Who makes ground truth how well, and does an audit by held-out rays alone say so?

`python docs/studies/makers.py [WORK]`; `--sweep` compares the settings of each rival on drives
apart (seeds 51 to 54), and WORK keeps drives and results.

Simulated drives of moving actors. Every 5th scan is left out of every maker, and the makers' grids
at the frames of some of these scans are scored three times: by the held-out rays (the formula S of
docs/studies/makers.md), by the depth along these rays, and by a reference of 40 sensors (truth: the
mean of the IoU of occupied space and of Vehicle). Prints a table with intervals over drives, the
times, and Kendall's tau of the orders, by drive.

Other programs take part if they are installed: `pip install dufomap dynamic-object-removal
pyoctomap`. SurroundOcc's recipe is written from its paper: the points of static things are stacked
by the poses, those of each object in its own box; voxels with a point are occupied. Its completion
by Poisson's method is left out; boxes are the tracks of the instances.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from importlib.metadata import version
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import study
from carlasc_recorders import SimulatedCapture, TownDrive
from makers_rivals import JUDGED, RIVALS, SPEC, WINDOW, Drive, Rival, Settings

import carlasc
from carlasc import Grid, Run
from carlasc.captures import Lidar
from carlasc.core.geometry import invert, transform_points
from carlasc.core.tables import CARLA
from carlasc.groundtruth import Observation, count_votes
from carlasc.inspection.heldout_scores import depth_errors
from carlasc.metrics import score_truth

SEEDS = {"town": range(61, 71)}
APART = range(51, 55)  # on which the formula and the settings were chosen
FRAMES, FIRST, EVERY, SENSORS = 41, 30, 5, 40
LIDAR = Lidar(channels=32, points=30_000)
MEASURES = ("S", "depth_m", "truth", "all", "known", "seconds")


def held_out(drive: Drive, grids: dict[int, Grid]) -> float:
    """Return S: the IoU that follows from precision where the frame's own rays look, and recall of
    what stands where they do not.
    """
    counts = np.zeros((2, 2))  # (precision, recall) x (right, all)
    for frame, grid in grids.items():
        own = evidence(drive, frame, frame)
        occupied = grid.known & (grid.labels > 0)
        tested = occupied & own.known
        behind = (
            grid.known
            & ~own.known
            & np.logical_or.reduce(
                [evidence(drive, frame, o).labels > 0 for o in others(drive, frame)]
            )
        )
        counts += [
            [(tested & (own.labels > 0)).sum(), tested.sum()],
            [(behind & occupied).sum(), behind.sum()],
        ]
    precision, recall = counts[:, 0] / counts[:, 1]
    return float(1 / (1 / precision + 1 / recall - 1))


def others(drive: Drive, frame: int) -> list[int]:
    """Return the other held-out scans in the window of a frame."""
    return [f for f in drive.hidden if WINDOW[0] <= f - frame <= WINDOW[1] and f != frame]


def observed(drive: Drive, frame: int, other: int) -> Observation:
    """Return a held-out scan, seen from a frame; of scans at other times, only what cannot move."""
    scan = drive.whole.scan(other, ("labels",))
    labels = study.labels_of(scan)
    keep = labels > 0
    if other != frame:
        keep &= ~np.isin(labels, sorted(CARLA.movable))
    motion = invert(drive.whole.read_pose(frame)) @ drive.whole.read_pose(other)
    return Observation(scan.points[keep], labels[keep], motion)


def evidence(drive: Drive, frame: int, other: int) -> Grid:
    """Return what a held-out scan alone shows in the grid of a frame."""
    return count_votes([observed(drive, frame, other)], SPEC, CARLA).to_grid()


def depth_error(drive: Drive, grids: dict[int, Grid]) -> float:
    """Return the mean of the depth errors of the frames' own scans, which are held out, and of
    static returns of the other held-out scans, in metres.
    """
    found = []
    for frame, grid in grids.items():
        for other in (frame, *others(drive, frame)):
            seen = observed(drive, frame, other)
            points = transform_points(seen.grid_T_sensor, seen.points)
            points = points[SPEC.flat_index(points) >= 0]
            origins = np.broadcast_to(seen.grid_T_sensor[:3, 3], points.shape)
            occupied = grid.known & (grid.labels > 0)
            found.append(depth_errors(occupied, SPEC, origins, points).mean())
    return float(np.mean(found))


def truth_of(grids: Mapping[int, Grid], references: Mapping[int, Grid]) -> float:
    """Return the mean of the IoU of occupied space and of vehicles."""
    total = carlasc.metrics.ConfusionMatrix(CARLA.num_channels)
    for frame, grid in grids.items():
        total += score_truth(grid, references[frame], CARLA.num_channels).matrix
    return (total.completeness().iou + float(total.iou[CARLA.id_of("Vehicle")])) / 2


def known_share(grids: Mapping[int, Grid], references: Mapping[int, Grid]) -> float:
    """Return the share of the voxels of the references that a maker does not call unknown."""
    both = sum(int((grid.known & references[f].known).sum()) for f, grid in grids.items())
    return both / sum(int(references[f].known.sum()) for f in grids)


def everywhere(grid: Grid) -> Grid:
    """Return a grid whose unknown voxels are free, so that what is occupied there is missed."""
    return Grid(grid.spec, np.where(grid.known, grid.labels, 0), np.ones(grid.spec.size))


def kendall(one: list[float], other: list[float]) -> float:
    """Return Kendall's tau (b) of two orders: ties count as neither."""
    pairs = [
        (np.sign(one[i] - one[j]), np.sign(other[i] - other[j]))
        for i, j in combinations(range(len(one)), 2)
    ]
    norm = np.sqrt(sum(a != 0 for a, _ in pairs) * sum(b != 0 for _, b in pairs))
    return float(sum(a * b for a, b in pairs) / norm)


def main() -> None:
    """Make, score and print."""
    parser = study.options(__doc__, SEEDS)
    parser.add_argument("--sweep", action="store_true", help="compare settings on drives apart")
    parser.add_argument("--makers", nargs="+", default=list(RIVALS), help="only these")
    clock, found = study.Clock(), dict[str, list[dict[str, float]]]()
    with study.begin(parser) as given:
        usable = {
            name: rival
            for name, rival in RIVALS.items()
            if name in given.makers and (rival.module is None or find_spec(rival.module))
        }
        missing = [name for name in given.makers if name not in usable]
        print("not installed:", ", ".join(missing) or "nothing")
        for seed in study.few(APART if given.sweep else given.town):
            place = given.work / f"town{seed}"
            drive, references = record(seed, place)
            for name, rival in usable.items():
                for row in rows_of(rival, whole=given.sweep):
                    scores = measure(rival, rival.settings[row], drive, references, place)
                    found.setdefault(title(name, rival, row), []).append(scores)
                clock(f"seed {seed}: {name}")
    show(found, usable)


def rows_of(rival: Rival, *, whole: bool) -> list[int]:
    """Return the places of the settings to measure: all, or the advised and the best ones."""
    return study.few(range(len(rival.settings)) if whole else sorted({0, rival.best}))


def title(name: str, rival: Rival, row: int) -> str:
    """Return the name of a row."""
    if len(rival.settings) == 1:
        return name
    advised = row == 0 and rival.module is not None
    kinds = ["advised"] * advised + ["best of a sweep"] * (row == rival.best)
    return f"{name}; {' and '.join(kinds) or json.dumps(rival.settings[row])}"


def record(seed: int, place: Path) -> tuple[Drive, dict[int, Grid]]:
    """Return a drive, and what other sensors see at its judged frames."""
    lidar = Lidar(channels=32, points=4_000) if study.is_tiny() else LIDAR
    capture = SimulatedCapture(
        count=18 if study.is_tiny() else FRAMES,
        first_frame=FIRST,
        sensors=1,
        seed=seed,
        traffic="heavy",
        lidar=lidar,
        bev=False,
    )
    carlasc.regrid(capture, SPEC, place, run=Run(workers=1))
    whole = next(iter(carlasc.open(place).values()))
    hidden = tuple(f for f in whole.frames("points").tolist() if f % EVERY == EVERY // 2)
    return Drive(whole, hidden), see(TownDrive(seed, "heavy", lidar), place)


def measure(
    rival: Rival,
    settings: Settings,
    drive: Drive,
    references: Mapping[int, Grid],
    place: Path,
) -> dict[str, float]:
    """Return the scores of a maker on a drive; `place` keeps them."""
    name = f"{rival.make.__name__} {json.dumps(settings)} {version(rival.module or 'carlasc')}"
    kept, known = place / "makers.json", dict[str, Any]()
    if kept.exists():
        known = json.loads(kept.read_text())
    if name not in known:
        start = time.process_time()
        grids = rival.make(drive, settings)
        seconds = (time.process_time() - start) / len(grids)
        scores = (held_out(drive, grids), depth_error(drive, grids), truth_of(grids, references))
        whole = truth_of({f: everywhere(grid) for f, grid in grids.items()}, references)
        share = known_share(grids, references)
        known[name] = dict(zip(MEASURES, (*scores, whole, share, seconds), strict=True))
        kept.write_text(json.dumps(known, indent=1))
    return dict(known[name])


def see(town: TownDrive, place: Path) -> dict[int, Grid]:
    """Return what other sensors see at the judged frames; `place` keeps it."""
    references = {}
    for frame in study.few(JUDGED):
        kept = place / f"reference{frame}.npz"
        if kept.exists():
            with np.load(kept) as arrays:
                references[frame] = Grid(SPEC, arrays["labels"], arrays["known"].astype(float))
            continue
        grid_T_world = invert(town.sensor_poses(FIRST + frame, 1)[0])
        seen = town.reference_observations(FIRST + frame, 3 if study.is_tiny() else SENSORS)
        observed = [
            Observation(r.scan.points, study.labels_of(r.scan), grid_T_world @ r.world_T_sensor)
            for r in seen
        ]
        references[frame] = count_votes(observed, SPEC, CARLA).to_grid()
        np.savez(kept, labels=references[frame].labels, known=references[frame].known)
    return references


def show(found: dict[str, list[dict[str, float]]], usable: Mapping[str, Rival]) -> None:
    """Print the measures of each maker over drives, the best in truth first, and how well the
    orders of S and of the depth agree with that of truth.
    """
    print("\n| maker (told) | truth | known | all | S | depth error, m | CPU time |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    means = {name: np.mean([d["truth"] for d in drives]) for name, drives in found.items()}
    for name in sorted(found, key=lambda one: -means[one]):
        truth, whole, score, depth = (
            study.interval([drive[key] for drive in found[name]], ".3f")
            for key in ("truth", "all", "S", "depth_m")
        )
        known = np.mean([drive["known"] for drive in found[name]])
        seconds = np.mean([drive["seconds"] for drive in found[name]])
        told = usable[name.split(";")[0]].told
        cells = (f"{name} ({told})", truth, f"{known:.2f}", whole, score, depth)
        print(f"| {' | '.join(cells)} | {seconds:.2f} s |")
    for key, sign in (("S", 1), ("depth_m", -1)):
        taus = [
            kendall([sign * one[key] for one in drives], [one["truth"] for one in drives])
            for drives in zip(*found.values(), strict=True)
        ]
        print(f"Kendall's tau of {key} and truth: {study.interval(taus)}")


if __name__ == "__main__":
    main()
