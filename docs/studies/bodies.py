"""How large are vehicles that are found?

`python docs/studies/bodies.py [WORK]` prints a table: the errors of length, width and height of the
moving vehicles of the drives of `movers.py`, by the source of motion and by the faces that scans
saw, and how often the true size is in the interval that the table of boxes gives. WORK keeps
drives, as that of `movers.py` does.

The truth is the mesh that was simulated, without its mirrors. Vehicles with fewer than 100 points
in all scans together are left out.
"""

from __future__ import annotations

from collections.abc import Iterator

import movers_drives
import numpy as np
import study
from carlasc_recorders.town.shapes import VEHICLE_KINDS
from movers_drives import VEHICLE, Recorded, Setting, record_all
from movers_rows import EVIDENCE, FLOW
from numpy.typing import NDArray

from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.motion import BODY_MARGIN_M
from carlasc.motion.tracks import MovingActors

SEEDS = {kind: movers_drives.SEEDS[kind] for kind in ("town", "street")}
HINTS = {"flow": FLOW, "free space": EVIDENCE}
FACES = {"one": (1, 1), "two or more": (2, 4)}
_MOST_POINTS = 100  # of vehicles that are left out
_OWN = 0.9  # share of the points of a track that must be on one vehicle
_WIDTHS = {kind.length_m: kind.width_m for kind in VEHICLE_KINDS}  # without mirrors


def sizes_of(
    drive: Recorded, actors: MovingActors
) -> Iterator[tuple[int, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
    """Yield the number of faces that were seen, the size that was found, the true one, (3,) metres,
    and the interval of the true one, (2, 3), of each moving vehicle that was found.
    """
    sequence, sizes = drive.sequence, dict[int, NDArray[np.float64]]()
    frames = sequence.frames("instances").tolist()
    numbers = {frame: sequence.read("instances", frame) for frame in frames}
    for frame in frames:
        boxes = sequence.boxes(frame)
        if boxes is not None:
            cars = boxes.select(boxes.labels == VEHICLE)
            sizes |= dict(zip(cars.tracks.tolist(), cars.sizes, strict=True))
    for track in actors.tracks.values():
        points = np.concatenate([numbers[frame][own] for frame, own in track.members.items()])
        found, counts = np.unique(points, return_counts=True)
        number, count = int(found[counts.argmax()]), int(counts.max())
        if number in sizes and count >= max(_OWN * len(points), _MOST_POINTS):
            length, _, height = sizes[number].tolist()
            width = _WIDTHS.get(round(length, 2))
            if width is not None:  # two-wheelers have no mirrors, and few points
                true = np.array([length, width, height])
                size = track.size - 2 * BODY_MARGIN_M
                yield sum(track.extent.faces), size, true, track.interval()


def main() -> None:
    """Print the table."""
    parser = study.options(__doc__, SEEDS)
    with study.begin(parser) as given:
        errors = {(hint, seen): list[NDArray[np.float64]]() for hint in HINTS for seen in FACES}
        inside = {key: list[NDArray[np.bool_]]() for key in errors}
        for kind, seed in study.drives(given, SEEDS):
            (drive,) = record_all([Setting(kind, seed, 32)], given.work)
            for hint, observe in HINTS.items():
                actors = find_actors(ScanFeed(drive.sequence, observe))
                for faces, size, true, (least, most) in sizes_of(drive, actors):
                    for seen, (fewest, all_seen) in FACES.items():
                        if fewest <= faces <= all_seen:
                            errors[hint, seen].append(np.abs(size - true))
                            inside[hint, seen].append((least <= true) & (true <= most))
        print("| motion by | sides seen | vehicles | length | width | height | in the interval |")
        print("|---|---|---:|---:|---:|---:|---:|")
        for (hint, seen), rows in errors.items():
            of_axis = np.array(rows).reshape(-1, 3)
            quantiles = (
                np.quantile(of_axis, (0.5, 0.9), axis=0) if rows else np.full((2, 3), np.nan)
            )
            cells = [f"{half:.2f}, {most:.2f}" for half, most in quantiles.T.tolist()]
            held = (
                np.array(inside[hint, seen]).reshape(-1, 3).mean(axis=0) if rows else [np.nan] * 3
            )
            cells.append(", ".join(f"{share:.0%}" for share in held))
            print(f"| {hint} | {seen} | {len(rows)} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
