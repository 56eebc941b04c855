"""Are vehicles that manoeuvre found, and where do they point?

`python docs/studies/manoeuvres.py [WORK]` prints a table: what is found of each kind of vehicle of
`manoeuvring.py`, by flow and without any hint. A LiDAR of 32 channels records while everything
moves; `--instant` sees all at one instant. WORK keeps the drives. All constants were chosen on seeds
401 to 405.

| column | meaning |
|---|---|
| found | share of the moving points within 25 m that belong to an actor that was found |
| actors | found actors that hold a tenth of its points or more, per vehicle |
| heading | error of the actor that holds most of its points, degrees: median, 90% quantile |
| reversed | share of the scans in which its heading is wrong by more than 90 degrees |
| IoU | of its box and the true one, seen from above: median, share of at least 0.5 |
| trail | occupied share of the empty voxels of 0.2 m that it passed at other times |
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import dense
import numpy as np
import study
from carlasc_recorders.town.actors import EGO_ID
from manoeuvring import ManoeuvreDrive, Vehicle
from movers_drives import Recorded, Setting, record_all
from movers_rows import EVIDENCE, FLOW

from carlasc.core.geometry import invert
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.motion import BODY_MARGIN_M
from carlasc.motion.tracks import MovingActors

SEEDS = {"manoeuvres": range(461, 466)}
HINTS = {"flow": FLOW, "free space": EVIDENCE}
FRAMES = (30, 45, 60)  # whose trails are measured
_MOVES_M_S = 1.0  # a vehicle is judged in scans in which it moves faster, or did so before
_POINTS = 30  # least number of points in a scan
_PART = 0.1  # of a vehicle's points, that an actor holds


@dataclass
class Scores:
    """What was found of one kind of vehicle.

    Attributes:
        points: number of its moving points within 25 m.
        found: those of actors that were found.
        actors: for each vehicle, the number of actors that hold a part of it.
        headings: errors of the heading, radians, one for each scan.
        overlaps: with the true box, seen from above, one for each scan.
        trail: occupied voxels that it passed, and all that it passed.
    """

    points: int = 0
    found: int = 0
    actors: list[int] = field(default_factory=list)
    headings: list[float] = field(default_factory=list)
    overlaps: list[float] = field(default_factory=list)
    trail: list[tuple[int, int]] = field(default_factory=list)

    def add(self, other: Scores) -> None:
        """Add the scores of another drive."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)

    def cells(self) -> list[str]:
        """Return the cells of its row."""
        if not self.headings:
            return ["", f"{self.found / max(self.points, 1):.0%}"]
        degrees = np.degrees(self.headings)
        middle, most = np.quantile(degrees, (0.5, 0.9))
        passed = np.sum(self.trail, axis=0)
        overlaps = np.array(self.overlaps)
        return [
            f"{self.found / max(self.points, 1):.0%}",
            f"{np.mean(self.actors):.1f}",
            f"{middle:.1f}, {most:.0f}",
            f"{(degrees > 90).mean():.0%}",
            f"{np.median(overlaps):.2f}, {(overlaps >= 0.5).mean():.0%}",
            f"{100 * passed[0] / max(passed[1], 1):.1f}%",
        ]


def judge(drive: Recorded, actors: MovingActors, square: ManoeuvreDrive) -> dict[str, Scores]:
    """Compare found actors with the vehicles of the square."""
    vehicles = {EGO_ID + k: vehicle for k, vehicle in enumerate(square.manoeuvres.movers)}
    scores = {vehicle.name: Scores() for vehicle in vehicles.values()}
    held = {number: Counter[int]() for number in vehicles}
    sequence, began = drive.sequence, set[int]()
    sequence_T_world = invert(square.sensor_poses(0, 1)[0])
    for frame in sequence.frames("points").tolist():
        points = sequence.read("points", frame)[:, :3]
        owner = sequence.read("instances", frame).astype(np.int64)
        speed = np.linalg.norm(sequence.read("flow", frame), axis=1)
        near = np.hypot(points[:, 0], points[:, 1]) < dense.NEAR_M
        track_of = np.full(len(points), -1)
        for number, track in actors.tracks.items():
            track_of[track.members.get(frame, [])] = number
        for number in np.unique(owner[near & (owner > 0)]).tolist():
            own = near & (owner == number)
            one, vehicle = scores[vehicles[number].name], vehicles[number]
            if speed[own].max() > _MOVES_M_S:
                began.add(number)
                one.points += int(own.sum())
                one.found += int((track_of[own] >= 0).sum())
            if number not in began or own.sum() < _POINTS:
                continue
            of_track = Counter(track_of[own][track_of[own] >= 0].tolist())
            held[number].update(of_track)
            if not of_track:
                one.overlaps.append(0.0)
                continue
            track = actors.tracks[of_track.most_common(1)[0][0]]
            pose, true = track.pose(frame), sequence_T_world @ vehicle.pose(frame)
            assert pose is not None
            turn = (invert(true) @ pose)[:2, 0]
            one.headings.append(abs(float(np.arctan2(turn[1], turn[0]))))
            size = np.array([vehicle.kind.length_m, vehicle.kind.width_m, 1.0])
            one.overlaps.append(
                study.overlap_above(pose, true, track.size - 2 * BODY_MARGIN_M, size)
            )
    for number, counts in held.items():
        if number in began:
            parts = [count for count in counts.values() if count > _PART * counts.total()]
            scores[vehicles[number].name].actors.append(len(parts))
    return scores


def measure(setting: Setting, hint: str, work: Path) -> dict[str, Scores]:
    """Return the scores of a drive, which is recorded unless it was."""
    (drive,) = record_all([setting], work)
    feed = ScanFeed(drive.sequence, HINTS[hint])
    actors, square = find_actors(feed), ManoeuvreDrive(setting.seed)
    scores = judge(drive, actors, square)
    for frame in (4,) if study.is_tiny() else FRAMES:
        grid = dense.make_grid(feed, actors, frame)
        for name, own in scores.items():
            numbers = [
                EGO_ID + k for k, one in enumerate(square.manoeuvres.movers) if one.name == name
            ]
            own.trail.append(dense.trail(grid, drive, frame, square.manoeuvres, numbers))
    return scores


def main() -> None:
    """Measure all drives, and print the table."""
    parser = study.options(__doc__, SEEDS)
    parser.add_argument("--instant", action="store_true")
    parser.add_argument("--hint", choices=tuple(HINTS), action="append")
    with study.begin(parser) as given:
        lidars = 0 if given.instant else 1
        print("| vehicle | motion by | found | actors | heading | reversed | IoU | trail |")
        print("|---|---|---:|---:|---:|---:|---:|---:|")
        for hint in given.hint or HINTS:
            total: dict[str, Scores] = {}
            for seed in study.few(given.manoeuvres):
                for name, own in measure(
                    Setting("manoeuvres", seed, 32, lidars), hint, given.work
                ).items():
                    total.setdefault(name, Scores()).add(own)
            for name, own in total.items():
                if own.points:
                    print(f"| {name} | {hint} | {' | '.join(own.cells())} |", flush=True)


if __name__ == "__main__":
    main()
