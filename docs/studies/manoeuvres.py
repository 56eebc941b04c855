"""Are vehicles that manoeuvre found, and where do they point?

`python docs/studies/manoeuvres.py [WORK]` prints a table: what is found of each kind of vehicle of
`manoeuvring.py`, by flow and without any hint. A LiDAR of 32 channels records while everything
moves; with `--instant`, it sees all at one instant. WORK keeps the drives. All constants were
chosen on seeds 401 to 405.

| column | meaning |
|---|---|
| found | share of the moving points within 25 m that belong to an actor that was found |
| actors | found actors that hold a tenth of its points or more, per vehicle |
| heading | error of the actor with most points of a part, degrees: median, 90% quantile |
| reversed | share of the scans in which its heading is wrong by more than 90 degrees |
| IoU | of found and true boxes, seen from above: median, share of at least 0.5 |
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
from numpy.typing import NDArray

from carlasc.core.geometry import Transform, invert, rotation_z, transform_points, translation
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.motion import BODY_MARGIN_M
from carlasc.motion.tracks import MovingActors

SEEDS = {"manoeuvres": range(461, 466)}
HINTS = {"flow": FLOW, "free space": EVIDENCE}
FRAME = 45  # whose trail is measured
_MOVES_M_S = 1.0  # a vehicle is judged in scans in which it moves faster, or did so before
_POINTS = 30  # least number of points in a scan
_PART = 0.1  # of a vehicle's points, that an actor holds

Rectangle = tuple[Transform, NDArray[np.float64]]
"""Pose, and length and width, metres."""


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
    """Compare found actors with the vehicles of the square; what one draws belongs to it."""
    vehicles = {EGO_ID + k: vehicle for k, vehicle in enumerate(square.manoeuvres.movers)}
    scores = {vehicle.name: Scores() for vehicle in vehicles.values()}
    held, began = {number: Counter[int]() for number in vehicles}, set[int]()
    sequence, sequence_T_world = drive.sequence, invert(square.sensor_poses(0, 1)[0])
    for frame in sequence.frames("points").tolist():
        points = sequence.read("points", frame)[:, :3]
        owner = sequence.read("instances", frame).astype(np.int64)
        speed = np.linalg.norm(sequence.read("flow", frame), axis=1)
        near = np.hypot(points[:, 0], points[:, 1]) < dense.NEAR_M
        track_of = np.full(len(points), -1)
        for number, track in actors.tracks.items():
            track_of[track.members.get(frame, [])] = number
        for number, parts in groups(vehicles).items():
            own = near & np.isin(owner, parts)
            if not own.any():
                continue
            one, tracked = scores[vehicles[number].name], track_of[own]
            if speed[own].max() > _MOVES_M_S:
                began.add(number)
                one.points += len(tracked)
                one.found += int((tracked >= 0).sum())
            if number not in began or len(tracked) < _POINTS:
                continue
            of_track = Counter(tracked[tracked >= 0].tolist())
            held[number].update(of_track)
            true = [
                (sequence_T_world @ vehicles[part].pose(frame), size_of(vehicles[part]))
                for part in parts
            ]
            found = [
                (actors.tracks[k].world_T_actor[frame - actors.tracks[k].first], body_of(actors, k))
                for k, count in of_track.most_common()
                if count > _PART * len(tracked)
            ]
            one.overlaps.append(shared_area(found, true))
            for part, (pose, _) in zip(parts, true, strict=True):
                of_part = Counter(track_of[near & (owner == part) & (track_of >= 0)].tolist())
                if of_part and of_part.total() >= _POINTS:
                    track = actors.tracks[of_part.most_common(1)[0][0]]
                    turn = (invert(pose) @ track.world_T_actor[frame - track.first])[:2, 0]
                    one.headings.append(abs(float(np.arctan2(turn[1], turn[0]))))
    for number in began:
        counts = held[number]
        several = [count for count in counts.values() if count > _PART * counts.total()]
        scores[vehicles[number].name].actors.append(len(several))
    return scores


def groups(vehicles: dict[int, Vehicle]) -> dict[int, list[int]]:
    """Return the numbers of each vehicle and of what it draws, by its number."""
    found: dict[int, list[int]] = {}
    for number, vehicle in vehicles.items():
        found.setdefault(number - 1 if vehicle.drawn_by else number, []).append(number)
    return found


def size_of(vehicle: Vehicle) -> NDArray[np.float64]:
    """Return (2,) the length and the width of a vehicle, metres."""
    return np.array([vehicle.kind.length_m, vehicle.kind.width_m])


def body_of(actors: MovingActors, number: int) -> NDArray[np.float64]:
    """Return (2,) the length and the width of a found actor, metres."""
    return actors.tracks[number].size[:2] - 2 * BODY_MARGIN_M


def shared_area(found: list[Rectangle], true: list[Rectangle]) -> float:
    """Return the IoU of what some boxes cover together, seen from above, by samples of 0.1 m."""
    corners = np.array([[x, y, 0.0] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    around = np.concatenate(
        [transform_points(pose, corners * (*size, 1.0)) for pose, size in (*found, *true)]
    )
    x, y = (
        np.arange(low, high, 0.1)
        for low, high in zip(around.min(axis=0)[:2], around.max(axis=0)[:2], strict=True)
    )
    places = np.stack(np.meshgrid(x, y, [0.0]), axis=-1).reshape(-1, 3)
    inside = np.zeros((2, len(places)), np.bool_)
    for row, boxes in enumerate((found, true)):
        for pose, size in boxes:
            flat = translation((*pose[:2, 3], 0.0)) @ rotation_z(np.arctan2(pose[1, 0], pose[0, 0]))
            local = transform_points(invert(flat), places)[:, :2]
            inside[row] |= (np.abs(local) < size / 2).all(axis=1)
    return float(inside.all(axis=0).sum() / max(inside.any(axis=0).sum(), 1))


def measure(setting: Setting, hint: str, work: Path) -> dict[str, Scores]:
    """Return the scores of a drive, which is recorded unless it was."""
    (drive,) = record_all([setting], work)
    feed = ScanFeed(drive.sequence, HINTS[hint])
    actors, square = find_actors(feed), ManoeuvreDrive(setting.seed)
    scores = judge(drive, actors, square)
    frame = 4 if study.is_tiny() else FRAME
    grid, population = dense.make_grid(feed, actors, frame), square.manoeuvres
    for name, own in scores.items():
        numbers = [
            EGO_ID + k
            for k, one in enumerate(population.movers)
            if name in (one.name, one.drawn_by and one.drawn_by.name)
        ]
        own.trail.append(dense.trail(grid, drive, frame, population, numbers))
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
