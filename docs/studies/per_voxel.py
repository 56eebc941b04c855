"""Who is in each voxel, and how fast: `python docs/studies/per_voxel.py [WORK]` prints the table of
docs/ground-truth.md.

The simulated drives of `movers.py` are merged with the fields that a row names, on the coarse grid,
with 32 channels. What 40 sensors saw at the same instant is the truth: the class of each voxel, and
the actor whose box it is in; how fast it moves there follows from the actor's exact poses. Voxels
known to both count. WORK keeps the drives; the default is a temporary folder.

- PQ: panoptic quality of vehicles and people that move faster than 1 m/s, the mean of both classes;
  "of the truth" counts what the grid does not know as free.
- one number: of the movers that half of all scans or more see with 50 points or more, the share
  that has one number in all of these scans.
- velocity: mean length of the difference over the voxels that move in both, m/s; beside it the
  share of the moving voxels that have one.

The tables are means over the drives of each world, with 95% intervals over them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import study
from movers import SEEDS
from movers_drives import GRIDS, KINDS, MOVES_M_S, Recorded, Reference, record, reference
from movers_rows import BARE, Only, noisy_boxes
from numpy.typing import NDArray

from carlasc import GridSpec
from carlasc.captures import Lidar
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import invert, transform_points
from carlasc.core.tables import CARLA
from carlasc.groundtruth import FromScans, Voting
from carlasc.groundtruth.from_scans.actor_voxels import with_numbers
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.voxel_actors import VoxelActors
from carlasc.metrics import PanopticQuality
from carlasc.motion import MotionOptions
from carlasc.motion.tracks import MovingActors
from carlasc.storage import Sequence

MANY_POINTS, SEEN = 50, 0.5
THINGS = frozenset({CARLA.id_of("Vehicle"), CARLA.id_of("Pedestrian")})


ROWS = ("instances", "flow", "exact boxes", "boxes", "free space", "free space, unlabelled")


def merged_from(drive: Recorded, row: str) -> tuple[Sequence, FromScans]:
    """Return what a row merges, and how."""
    source = "boxes" if "boxes" in row else "evidence" if "free space" in row else row
    observe = FromScans(own_path=False, motion=MotionOptions(source))  # type: ignore[arg-type]
    if row == "free space, unlabelled":
        return Only(drive.sequence, BARE), observe
    return Only(
        noisy_boxes(drive, 0) if row == "boxes" else drive.sequence, {source, "points", "labels"}
    ), observe


@dataclass
class Scores:
    """What is added up over the frames of a drive."""

    both: PanopticQuality = field(
        default_factory=lambda: PanopticQuality(CARLA.num_channels, THINGS)
    )
    truth: PanopticQuality = field(
        default_factory=lambda: PanopticQuality(CARLA.num_channels, THINGS)
    )
    one: list[bool] = field(default_factory=list)
    errors: list[NDArray[np.float64]] = field(default_factory=list)
    moving: int = 0

    def add(
        self,
        found: tuple[NDArray[np.integer], NDArray[np.bool_], VoxelActors],
        seen: Reference,
        truth: Truth,
    ) -> None:
        """Add a frame: the classes of the grid, what it knows, and its actors."""
        labels, known, actors = found
        is_mover = np.isin(seen.labels, sorted(THINGS)) & (seen.owner > 0)
        own = np.isin(labels, sorted(THINGS)) & (actors.instance > 0)
        pair = (
            (np.where(own, labels, 0), actors.instance),
            (np.where(is_mover, seen.labels, 0), seen.owner),
        )
        self.both.update(*pair, mask=seen.judged & known)
        self.truth.update(*pair, mask=seen.judged)
        wanted = is_mover & seen.judged & known & (labels > 0)
        velocity = np.full((labels.size, 3), np.nan)
        velocity[actors.velocity["voxel"]] = actors.velocity["velocity"]
        voxels = np.flatnonzero(wanted)
        errors = np.linalg.norm(
            velocity[voxels] - truth.velocity(voxels, seen.owner.reshape(-1)[voxels]), axis=1
        )
        self.moving += len(voxels)
        self.errors.append(errors[~np.isnan(errors)])

    def figures(self) -> tuple[float, ...]:
        """Return the cells of a row of the table."""
        ids = sorted(THINGS)
        pq, whole = (score.compute().pq[ids] for score in (self.both, self.truth))
        errors = np.concatenate(self.errors)
        return (
            float(np.nanmean(pq)),
            *pq.tolist(),
            float(np.nanmean(whole)),
            float(np.mean(self.one)) if self.one else float("nan"),
            float(errors.mean()) if len(errors) else float("nan"),
            len(errors) / max(self.moving, 1),
        )


@dataclass(frozen=True)
class Truth:
    """The exact motion of the actors at a frame.

    Attributes:
        spec: the grid.
        poses: (4, 4) grid_T_actor one frame before and one after, both in the grid of the frame
            itself, and at the frame, by actor.
    """

    spec: GridSpec
    poses: Mapping[int, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]

    @classmethod
    def of(cls, drive: Recorded, frame: int) -> Truth:
        """Make the drive again, and take the poses of its actors."""
        made = KINDS[drive.setting.kind].make(drive.setting.seed, Lidar())
        grid_T_world = invert(made.sensor_poses(frame, 1)[0])
        at = [
            {a.id: grid_T_world @ a.world_T_actor for a in made.actors(f)}
            for f in (frame - 1, frame, frame + 1)
        ]
        return cls(
            GRIDS["coarse"],
            {a: (at[0][a], at[1][a], at[2][a]) for a in at[1] if a in at[0] and a in at[2]},
        )

    def velocity(
        self, voxels: NDArray[np.int64], owners: NDArray[np.integer]
    ) -> NDArray[np.float64]:
        """Return (N, 3) m/s of the centres of voxels in actors."""
        spec, found = self.spec, np.full((len(voxels), 3), np.nan)
        centers = (
            np.stack(np.unravel_index(voxels, spec.size), axis=-1) * spec.voxel_size + spec.lower
        )
        centers = centers + np.array(spec.voxel_size) / 2
        for actor in np.unique(owners).tolist():
            if actor in self.poses:
                before, now, after = self.poses[actor]
                own = owners == actor
                local = transform_points(invert(now), centers[own])
                found[own] = (
                    transform_points(after, local) - transform_points(before, local)
                ) / 0.2
        return found


def numbers_seen(drive: Recorded, actors: MovingActors) -> list[bool]:
    """Return of each mover that is seen throughout whether it has one number in all scans that see
    it.
    """
    frames = drive.sequence.frames("points").tolist()
    found: dict[int, list[int]] = {}
    speeds: dict[int, float] = {}
    for frame in frames:
        owners = drive.sequence.read("instances", frame).astype(np.int64)
        speed = np.linalg.norm(drive.sequence.read("flow", frame), axis=1)
        own = np.zeros(len(owners), np.int64)
        for number, track in actors.tracks.items():
            own[track.members.get(frame, [])] = actors.numbers[number]
        for owner, count in zip(*np.unique(owners[owners > 0], return_counts=True), strict=True):
            mine = own[owners == owner]
            speeds[int(owner)] = max(
                speeds.get(int(owner), 0.0), float(speed[owners == owner].max())
            )
            if count >= MANY_POINTS:
                found.setdefault(int(owner), []).append(int(np.bincount(mine).argmax()))
    # scans in which nothing shows a mover (it stands, or is hidden) have no number, and are another
    # figure
    return [
        len(set(seen) - {0}) == 1
        for owner, seen in found.items()
        if speeds[owner] > MOVES_M_S and len(seen) >= SEEN * len(frames)
    ]


def score_row(
    drive: Recorded, row: str, seen: Mapping[int, Reference], truths: Mapping[int, Truth]
) -> tuple[float, ...]:
    """Make the judged frames of a drive by a row, and return their figures."""
    sequence, observe = merged_from(drive, row)
    feed = ScanFeed(sequence, observe)
    plan = GridPlan(GRIDS["coarse"], "grid", observe, Voting(keep_actors=True), FrameRange())
    actors = with_numbers(find_actors(feed), feed)
    score = Scores(one=numbers_seen(drive, actors))
    for frame, truth in truths.items():
        merged = merge_frame(plan, feed, actors, frame, feed.reaching(frame, plan.spec))
        assert merged.actors is not None  # the plan keeps them
        labels = merged.grid.labels
        # the class is not known: that of the truth, where both are occupied
        if row.endswith("unlabelled"):
            own = np.isin(seen[frame].labels, sorted(THINGS)) | (labels == 0)
            labels = np.where(labels > 0, np.where(own, seen[frame].labels, min(THINGS)), 0)
        score.add((labels, merged.grid.known, merged.actors), seen[frame], truth)
    return score.figures()


def main() -> None:
    """Print a table for each world."""
    parser = study.options(__doc__, SEEDS)
    parser.add_argument("--rows", nargs="*", default=ROWS)
    with study.begin(parser) as given:
        found: dict[str, dict[str, list[tuple[float, ...]]]] = {}
        for kind, seed in study.drives(given, SEEDS):
            (drive,) = record(kind, seed, [32], given.work)
            seen = {
                frame: one
                for (grid, frame), one in reference(kind, seed, given.work).items()
                if grid == "coarse"
            }
            truths = {frame: Truth.of(drive, frame) for frame in seen}
            for row in given.rows:
                figures = score_row(drive, row, seen, truths)
                found.setdefault(kind, {}).setdefault(row, []).append(figures)
                print(kind, seed, row, *(f"{value:.2f}" for value in figures), flush=True)
    for kind, rows in found.items():
        print(
            f"\n{kind}:\n\n| from | PQ | people | vehicles | PQ of the truth | one number | "
            f"velocity, m/s | with velocity |\n|---|---:|---:|---:|---:|---:|---:|---:|"
        )
        for row, drives in rows.items():
            print(
                f"| {row} | "
                f"{' | '.join(study.interval(values) for values in zip(*drives, strict=True))} |"
            )


if __name__ == "__main__":
    main()
