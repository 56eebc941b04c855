"""Are actors that free space shows real? `python docs/studies/actors.py [WORK]` prints the tables.

Simulated drives are given as points and poses only, and the actors that are found are compared with
the instances of the recording, in three worlds: the town and the street of `movers.py`, and a
street with rails, fences and hedges (`railed.py`). Poses are exact, or off by 2 cm and 0.1 degrees
in every frame. WORK keeps the drives; the default is a temporary folder.

An actor that is reported is right if more than half of its points, over all scans, belong to one
mover: an instance that is faster than 1 m/s at some time. A mover counts if it has 50 points or
more in two scans or more. It is found if, in most of these scans, one reported actor holds more
than half of its points. Precision is the share of reported actors that are right, recall that of
movers that are found. Rows are added up over the drives. No criterion is a limit on height; the
rows "no confidence" show what the criteria of the confidence change, because all actors are
reported then.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import study
from movers_drives import MOVES_M_S, SEEDS, Recorded, record
from movers_rows import BARE, NoisyPoses, Only
from numpy.typing import NDArray

from carlasc.groundtruth import FromScans
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.motion import MotionOptions, found_actors
from carlasc.motion.tracks import Track, is_doubtful
from carlasc.storage import Sequence

MANY_CHANNELS = 2  # drives of each world, with 16 and 64 channels
OBSERVE = FromScans(motion=MotionOptions("evidence"), own_path=False)
POSES = {"exact": (0.0, 0.0), "2 cm, 0.1 degrees": (0.02, 0.1)}
MANY_POINTS, SCANS = 50, 2


@dataclass(frozen=True)
class Counts:
    """How many actors were reported, how many of them are right and doubtful, and how many movers
    there are and were found.
    """

    reported: int = 0
    right: int = 0
    doubtful: int = 0
    doubtful_right: int = 0
    movers: int = 0
    found: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(
            *(
                one + more
                for one, more in zip(vars(self).values(), vars(other).values(), strict=True)
            )
        )

    def __str__(self) -> str:
        sure, sure_right = self.reported - self.doubtful, self.right - self.doubtful_right
        shares = ((self.right, self.reported), (sure_right, sure), (self.found, self.movers))
        return " | ".join(
            f"{part / max(whole, 1):.2f} ({part} of {whole})" for part, whole in shares
        )


@dataclass(frozen=True)
class Truth:
    """What a recording tells of its actors.

    Attributes:
        owners: (N,) instance of each point by frame; 0 is none.
        speeds: greatest speed of each instance, m/s.
    """

    owners: Mapping[int, NDArray[np.int64]]
    speeds: Mapping[int, float]

    @classmethod
    def of(cls, sequence: Sequence) -> Truth:
        """Read the instances and the flow of all frames."""
        owners: dict[int, NDArray[np.int64]] = {}
        speeds: dict[int, float] = {}
        for frame in sequence.frames("points").tolist():
            owners[frame] = own = sequence.read("instances", frame).astype(np.int64)
            speed = np.linalg.norm(sequence.read("flow", frame), axis=1)
            for number in np.unique(own[own > 0]).tolist():
                speeds[number] = max(speeds.get(number, 0.0), float(speed[own == number].max()))
        return cls(owners, speeds)

    def moves(self, number: int) -> bool:
        """Whether an instance is a mover."""
        return self.speeds.get(number, 0.0) > MOVES_M_S

    def is_right(self, track: Track) -> bool:
        """Whether an actor is one mover."""
        owners = np.concatenate(
            [self.owners[frame][members] for frame, members in track.members.items()]
        )
        numbers, counts = np.unique(owners, return_counts=True)
        return self.moves(int(numbers[counts.argmax()])) and counts.max() > len(owners) / 2

    def judge(self, tracks: list[Track]) -> Counts:
        """Count what is right of the reported actors, and which movers they are."""
        held: dict[tuple[int, int], int] = {}
        for track in tracks:
            for frame, members in track.members.items():
                numbers, counts = np.unique(self.owners[frame][members], return_counts=True)
                for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
                    held[number, frame] = max(held.get((number, frame), 0), count)
        scans: dict[int, list[bool]] = {}
        for frame, owners in self.owners.items():
            numbers, counts = np.unique(owners[owners > 0], return_counts=True)
            for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
                if count >= MANY_POINTS and self.moves(number):
                    scans.setdefault(number, []).append(held.get((number, frame), 0) > count / 2)
        found = [np.mean(own) > 0.5 for own in scans.values() if len(own) >= SCANS]
        right = [self.is_right(track) for track in tracks]
        doubtful = [is_doubtful(track.confidence) for track in tracks]
        both = sum(one and other for one, other in zip(right, doubtful, strict=True))
        return Counts(len(tracks), sum(right), sum(doubtful), both, len(found), int(sum(found)))


def find(drive: Recorded, errors: tuple[float, float]) -> list[Track]:
    """Return the moving actors that are found without labels, under poses with errors in metres and
    degrees.
    """
    bare: Sequence = Only(drive.sequence, BARE)
    if any(errors):
        bare = bare.with_poses(NoisyPoses(*errors)(drive, 0).poses)
    return list(find_actors(ScanFeed(bare, OBSERVE)).tracks.values())


def drives(given: Namespace) -> Iterator[tuple[str, int, Recorded]]:
    """Yield the world, the channels and the drive of each recording."""
    for world, seed in study.drives(given, SEEDS):
        channels = study.few(
            [32, 16, 64] if seed in getattr(given, world)[:MANY_CHANNELS] else [32]
        )
        for count, drive in zip(channels, record(world, seed, channels, given.work), strict=True):
            yield world, count, drive


def main() -> None:
    """Find the actors of all drives, and print the tables."""
    least = found_actors._LEAST_CONFIDENCE
    rows: dict[tuple[str, int, str], Counts] = {}
    with study.begin(study.options(__doc__, SEEDS)) as given:
        for world, channels, drive in drives(given):
            truth = Truth.of(drive.sequence)
            for rule, confidence in (("", least), (", no confidence", 0.0)):
                found_actors._LEAST_CONFIDENCE = confidence
                for name, errors in POSES.items():
                    counts = truth.judge(find(drive, errors))
                    key = (world, channels, f"{name}{rule}")
                    rows[key] = rows.get(key, Counts()) + counts
                    print(f"{drive.setting}, poses {name}{rule}: {counts}", flush=True)
    print(
        "\n| world | channels | poses | precision | precision of those that are not doubtful | "
        "recall |"
    )
    print("|---|---|---|---|---|---|")
    for (world, channels, name), counts in sorted(rows.items()):
        print(f"| {world} | {channels} | {name} | {counts} |")


if __name__ == "__main__":
    main()
