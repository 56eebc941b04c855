"""Who makes ground truth how well, and does an audit by held-out rays alone say so?

`python docs/studies/makers.py`.

Simulated drives of moving actors. Every 5th scan is left out of every maker, and the makers' grids
at the frames of some of these scans are scored twice: by the held-out rays (the formula S of
docs/studies/makers.md) and by a reference of 40 sensors (truth: the mean of the IoU of occupied
space and of Vehicle). Prints a table with intervals over drives, the times, and Kendall's tau of
both orders, by drive.

DUFOMap, dynamic-object-removal and OctoMap take part if `dufomap`, `dynamic_object_removal` and
`pyoctomap` can be imported. SurroundOcc's recipe is written from its paper: the points of static
things are stacked by the poses, those of each object in its own box; voxels with a point are
occupied. Its completion by Poisson's method is left out; boxes are the tracks of the instances.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import combinations

import numpy as np
import study
from carlasc_recorders import SimulatedCapture, TownDrive

import carlasc
from carlasc import FromScans, Grid, GridSpec, Run, Voting
from carlasc.captures import Lidar
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import invert, transform_points
from carlasc.core.grids import most_frequent
from carlasc.core.tables import CARLA
from carlasc.groundtruth import Observation, count_votes
from carlasc.groundtruth.from_scans.feed import ScanFeed, WithoutScans
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.groundtruth.inputs import GridPlan
from carlasc.metrics import score_truth
from carlasc.motion import MotionOptions
from carlasc.storage.views import SequenceView

SEEDS = {"town": range(61, 66)}  # the formula was chosen on 51 to 54
FRAMES, FIRST, EVERY, WINDOW, SENSORS = 41, 30, 5, (-10, 10), 40
JUDGED = (12, 17, 22, 27)
SPEC, LIDAR = GridSpec.published(), Lidar(channels=32, points=30_000)
Maker = Callable[["Drive"], dict[int, Grid]]


@dataclass
class Drive:
    """A drive without the scans that are left out."""

    whole: carlasc.storage.Sequence
    hidden: tuple[int, ...]

    @property
    def frames(self) -> list[int]:
        """The frames of the drive."""
        return self.whole.frames("points").tolist()

    @property
    def scans(self) -> WithoutScans:
        """The scans that makers may use."""
        return WithoutScans(self.whole, self.hidden)

    def window(self, frame: int) -> list[int]:
        """Return the frames whose scans a maker may merge into a frame."""
        return [
            f
            for f in range(frame + WINDOW[0], frame + WINDOW[1] + 1)
            if f in self.frames and f not in self.hidden
        ]


class Cleaned(SequenceView):
    """Scans without the points that a filter took away."""

    def __init__(self, whole: carlasc.storage.Sequence, keep: dict[int, np.ndarray]) -> None:
        super().__init__(whole)
        self.keep = keep

    def read(self, field: str, frame: int) -> np.ndarray:
        """Read a field of a frame, without the points that were taken away."""
        values = self.whole.read(field, frame)
        per_point = field in ("points", "labels", "flow", "instances") and frame in self.keep
        return values[self.keep[frame]] if per_point else values


def merged(observe: FromScans) -> Maker:
    """Return our maker with some options."""
    return lambda drive: merge(drive.scans, observe)


def merge(scans: carlasc.storage.Sequence, observe: FromScans) -> dict[int, Grid]:
    """Return our grids at the judged frames."""
    feed = ScanFeed(scans, observe)
    plan = GridPlan(SPEC, "evaluation", observe, Voting(), FrameRange.of(None))
    actors = find_actors(feed)
    return {
        f: merge_frame(plan, feed, actors, f, feed.reaching(f, SPEC)).grid
        for f in study.few(JUDGED)
    }


def in_world(drive: Drive) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return (N, 3) points and (4, 4) pose of each scan that is left, by frame."""
    poses = {f: drive.whole.read_pose(f) for f in drive.frames if f not in drive.hidden}
    return {
        f: (transform_points(pose, drive.whole.scan(f, ()).points), pose)
        for f, pose in poses.items()
    }


def dufomap(drive: Drive) -> dict[int, Grid]:
    """Return `tube` after DUFOMap, with the parameters of its authors."""
    cloud, scans = (
        importlib.import_module("dufomap").dufomap(0.1, 0.2, 1, num_threads=1),
        in_world(drive),
    )
    for points, pose in scans.values():
        cloud.run(points.astype(np.float32), pose, cloud_transform=False)
    cloud.oncePropagateCluster(if_propagate=True, if_cluster=False)
    keep = {
        f: np.asarray(cloud.segment(points.astype(np.float32), pose, cloud_transform=False)) == 0
        for f, (points, pose) in scans.items()
    }
    return merge(Cleaned(drive.scans, keep), FromScans(WINDOW, dynamic="tube"))


def removal(drive: Drive) -> dict[int, Grid]:
    """Return `tube` after dynamic-object-removal's cleaner of maps."""
    scans = in_world(drive)
    points = np.concatenate([p for p, _ in scans.values()])
    clean = importlib.import_module("dynamic_object_removal").clean_map_by_fusion
    keep = clean(points, [(p, pose[:3, 3]) for p, pose in scans.values()])[1]
    parts = np.split(keep, np.cumsum([len(p) for p, _ in scans.values()])[:-1])
    return merge(
        Cleaned(drive.scans, dict(zip(scans, parts, strict=True))),
        FromScans(WINDOW, dynamic="tube"),
    )


def octomap(drive: Drive) -> dict[int, Grid]:
    """Return the occupancy of OctoMap, with the most frequent class of the points in each voxel."""
    library, scans, grids = importlib.import_module("pyoctomap"), in_world(drive), {}
    for frame in study.few(JUDGED):
        tree, grid_T_world = (
            library.OcTree(float(SPEC.voxel_size[0])),
            invert(drive.whole.read_pose(frame)),
        )
        for other in drive.window(frame):
            points, pose = scans[other]
            local = transform_points(grid_T_world, points) - np.array(SPEC.lower)
            tree.insertPointCloud(local, (grid_T_world @ pose)[:3, 3] - np.array(SPEC.lower))
        nodes = [
            tree.search(center) for center in SPEC.centers().reshape(-1, 3) - np.array(SPEC.lower)
        ]
        known = np.array([node is not None for node in nodes])
        occupied = np.array([node is not None and tree.isNodeOccupied(node) for node in nodes])
        labels = classes_in(drive, frame, {f: scans[f][0] for f in drive.window(frame)})
        labels = np.where(occupied, np.where(labels > 0, labels, CARLA.geometry_id), 0)
        grids[frame] = Grid(
            SPEC, labels.reshape(SPEC.size).astype(np.uint8), known.reshape(SPEC.size).astype(float)
        )
    return grids


def surroundocc(drive: Drive) -> dict[int, Grid]:
    """Return stacked points, those of objects in their boxes."""
    scans, grids = in_world(drive), {}
    tracks = find_actors(
        ScanFeed(drive.scans, FromScans(motion=MotionOptions("instances")))
    ).tracks.values()
    for frame in study.few(JUDGED):
        placed = {}
        for other in drive.window(frame):
            points = scans[other][0].copy()
            for track in tracks:
                own, then, now = track.members.get(other, ()), track.pose(other), track.pose(frame)
                if len(own) and then is not None:
                    points[own] = (
                        np.nan if now is None else transform_points(now @ invert(then), points[own])
                    )
            placed[other] = points
        labels = classes_in(drive, frame, placed).reshape(SPEC.size)
        grids[frame] = Grid(SPEC, labels.astype(np.uint8), np.ones(SPEC.size))
    return grids


def classes_in(drive: Drive, frame: int, placed: dict[int, np.ndarray]) -> np.ndarray:
    """Return (V,) the most frequent class of the points in each voxel of a frame; 0 where there is
    none.
    """
    grid_T_world = invert(drive.whole.read_pose(frame))
    voxels = np.concatenate(
        [SPEC.flat_index(transform_points(grid_T_world, points)) for points in placed.values()]
    )
    labels = np.concatenate([drive.whole.read("labels", f) for f in placed])
    found = np.zeros(SPEC.num_voxels, np.int64)
    cells, kinds = most_frequent(voxels[voxels >= 0], labels[voxels >= 0])
    found[cells] = kinds
    return found


MAKERS: dict[str, tuple[str | None, Maker]] = {  # name -> (module that it needs, maker)
    "tube": (None, merged(FromScans(WINDOW, dynamic="tube"))),
    "DUFOMap, tube": ("dufomap", dufomap),
    "dynamic-object-removal, tube": ("dynamic_object_removal", removal),
    "OctoMap": ("pyoctomap", octomap),
    "SurroundOcc's recipe": (None, surroundocc),
    "ours, flow": (None, merged(FromScans(WINDOW, motion=MotionOptions("flow")))),
    "ours, instances": (None, merged(FromScans(WINDOW, motion=MotionOptions("instances")))),
    "ours, free space": (None, merged(FromScans(WINDOW, motion=MotionOptions("evidence")))),
}


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


def evidence(drive: Drive, frame: int, other: int) -> Grid:
    """Return what a held-out scan alone shows in the grid of a frame; of scans at other times, only
    what cannot move.
    """
    scan = drive.whole.scan(other, ("labels",))
    labels = study.labels_of(scan)
    keep = labels > 0
    if other != frame:
        keep &= ~np.isin(labels, sorted(CARLA.movable))
    motion = invert(drive.whole.read_pose(frame)) @ drive.whole.read_pose(other)
    return count_votes(
        [Observation(scan.points[keep], labels[keep], motion)], SPEC, CARLA
    ).to_grid()


def truth_of(grids: dict[int, Grid], references: dict[int, Grid]) -> float:
    """Return the mean of the IoU of occupied space and of vehicles."""
    total = carlasc.metrics.ConfusionMatrix(CARLA.num_channels)
    for frame, grid in grids.items():
        total += score_truth(grid, references[frame], CARLA.num_channels).matrix
    return (total.completeness().iou + float(total.iou[CARLA.id_of("Vehicle")])) / 2


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
    clock, rows = study.Clock(), {}
    usable = {
        name: maker
        for name, (module, maker) in MAKERS.items()
        if module is None or find_spec(module)
    }
    print("not installed:", ", ".join(name for name in MAKERS if name not in usable) or "nothing")
    with study.begin(study.options(__doc__, SEEDS)) as given:
        for seed in study.few(given.town):
            place = given.work / f"town{seed}"
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
            drive = Drive(
                whole, tuple(f for f in whole.frames("points").tolist() if f % EVERY == EVERY // 2)
            )
            made, seconds = {}, {}
            for name, maker in usable.items():
                start = time.process_time()
                made[name] = maker(drive)
                seconds[name] = (time.process_time() - start) / len(made[name])
                clock(f"seed {seed}: {name}")
            references = see(TownDrive(seed, "heavy", lidar))
            scores = {name: held_out(drive, grids) for name, grids in made.items()}
            truths = {name: truth_of(grids, references) for name, grids in made.items()}
            rows[seed] = (scores, truths, seconds)
            clock(f"seed {seed}")
    show(rows)


def see(town: TownDrive) -> dict[int, Grid]:
    """Return what other sensors see at the judged frames."""
    references = {}
    for frame in study.few(JUDGED):
        grid_T_world = invert(town.sensor_poses(FIRST + frame, 1)[0])
        seen = town.reference_observations(FIRST + frame, 3 if study.is_tiny() else SENSORS)
        observed = [
            Observation(r.scan.points, study.labels_of(r.scan), grid_T_world @ r.world_T_sensor)
            for r in seen
        ]
        references[frame] = count_votes(observed, SPEC, CARLA).to_grid()
    return references


def show(rows: dict[int, tuple[dict[str, float], dict[str, float], dict[str, float]]]) -> None:
    """Print S, truth and seconds of each maker over drives, and the agreement of the orders of S
    and truth.
    """
    print("\n| maker | S | truth | CPU s per frame |\n|---|---:|---:|---:|")
    for name in next(iter(rows.values()))[0]:
        scores, truths, seconds = ([row[part][name] for row in rows.values()] for part in range(3))
        print(
            f"| {name} | {study.interval(scores, '.3f')} | {study.interval(truths, '.3f')} | "
            f"{np.mean(seconds):.2f} |"
        )
    taus = [
        kendall(list(scores.values()), list(truths.values())) for scores, truths, _ in rows.values()
    ]
    print(
        f"\nKendall's tau: {np.mean(taus):.2f} in the mean of {len(taus)} drives ({min(taus):.2f} "
        f"to {max(taus):.2f})"
    )


if __name__ == "__main__":
    main()
