"""Large data: time and memory per frame, sequence, point and voxel stay flat.

Each case runs a command on data of three sizes, each twice as large as the one before, with one
worker. From the second doubling on, an item may not cost more than in the first. At the least
sizes, calls of functions stand for time: other work on the processor does not change them.
"""

from __future__ import annotations

import cProfile
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from carlasc.storage import FolderSink, layout
from carlasc.storage.files import set_durable
from faults.commands import MESSAGES, start
from faults.outcome import Measured, Outcome

_WORSE = 1.5  # times the cost of an item in the first doubling; more is a fault
_NOISE_S, _NOISE_CALLS, _NOISE_KB = 0.5, 50_000, 20_000  # in each difference
_CALLS = "calls.txt"
_PARTS = 4  # the smallest size is so many times smaller than the largest


@dataclass(frozen=True)
class Large:
    """A command on data that grow.

    Attributes:
        name: what grows.
        write: writes data of a size into a folder.
        commands: the arguments of commands, one after the other; "{n}" is the size.
        full: the largest size.
        quick: the largest size of a run of minutes.
        least: the largest size in the slow tests.
        kilobytes: memory that an item may need.
    """

    name: str
    write: Callable[[Path, int], None]
    commands: tuple[str, ...]
    full: int
    quick: int
    least: int
    kilobytes: float


def write_frames(
    root: Path, frames: int, points: int = 60, name: str = "Drive", period_s: float = 0.1
) -> None:
    """Write a sequence of tiny scans along a straight road, at 5 m/s."""
    set_durable(False)
    writer = FolderSink(root).sequence(f"Train/{name}/cartesian")
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = 5 * period_s * np.arange(frames)
    writer.write_document(layout.POSES, layout.encode_poses(poses))
    writer.write_document(layout.TIMES, layout.encode_times(period_s * np.arange(frames)))
    rng = np.random.default_rng(0)
    scan = np.zeros((points, 4), np.float32)
    scan[:, :3] = rng.uniform((-10, -10, -1.9), (10, 10, 1), (points, 3))
    labels = rng.integers(1, 9, points).astype(np.uint32)
    for frame in range(frames):
        fields = {"points": scan, "labels": labels, "flow": np.zeros((points, 3), np.float32)}
        writer.write_frames({frame: fields})


def _sequences(root: Path, sequences: int) -> None:
    for number in range(sequences):
        write_frames(root, 1, name=f"Drive{number:05d}")


def _seconds(root: Path, seconds: int) -> None:
    write_frames(root, seconds, 200, period_s=1.0)


def _points(root: Path, points: int) -> None:
    write_frames(root, 2, points)


def _one(root: Path, size: int) -> None:
    write_frames(root, 1, 2000)


_TINY = "--size 8,8,4 --observe scans --window -1:1 --dynamic tube --refine never --force"
LARGE = (
    Large(
        "frames",
        write_frames,
        (
            f"regrid data {_TINY} --workers 1",
            f"regrid data {_TINY} --workers 1",
            "info data",
            "stats data --workers 1",
            "pack data out.zarr --workers 1",
        ),
        20_000,
        1_200,
        160,
        8,
    ),
    Large(
        "sequences",
        _sequences,
        ("info data", f"regrid data {_TINY} --workers 1", "pack data out.zarr --workers 1"),
        5_000,
        320,
        48,
        60,
    ),
    Large(
        "seconds of a drive",
        _seconds,
        (
            "map data out.ply --cell 0.5 --workers 1",
            "refine data -o out --refine always --workers 1",
        ),
        7_200,
        900,
        120,
        12,
    ),
    Large(
        "points of a scan",
        _points,
        (f"regrid data {_TINY} --workers 1", "info data"),
        2_000_000,
        400_000,
        200_000,
        0.6,
    ),
    Large(
        "voxels along x and y",
        _one,
        (
            "regrid data --size {n},{n},80 --bounds -50,50,-50,50,-2,6 --yes --observe scans "
            "--dynamic tube --refine never --force --workers 1",
        ),
        1_000,
        240,
        160,
        4_000,  # a row of voxels
    ),
)


def run(count: int, seed: int, folder: Path) -> Outcome:
    """Let data grow.

    Args:
        count: 1,000 for the full sizes, fewer for those of minutes, 0 for the least.
        seed: not used: nothing is random.
        folder: an empty folder to work in.
    """
    began, found, measured = time.monotonic(), list[str](), list[Measured]()
    for large in LARGE:
        size = large.full if count >= 1000 else large.quick if count else large.least
        count_calls = not count
        sizes = [size * part // _PARTS for part in (1, 2, 4)]
        if count_calls:  # the first run compiles
            _costs(large, sizes[0], folder / large.name, count_calls)
        costs = [_costs(large, part, folder / large.name, count_calls) for part in sizes]
        for command, *cost in zip(large.commands, *costs, strict=True):
            name = command.split()[0]
            found += _judge(f"{name}, {size:,} {large.name}", large, size, count_calls, *cost)
            seconds, kilobytes = zip(*cost, strict=True)
            measured.append((name, f"{size:,} {large.name}", seconds, kilobytes))
    seconds_in_all = time.monotonic() - began
    return Outcome("large", len(measured), found, seconds_in_all, measured=measured)


Cost = tuple[float, float]
"""CPU time, seconds, or calls; and the largest memory, kilobytes."""


def _costs(large: Large, size: int, folder: Path, count_calls: bool) -> list[Cost]:
    """Return the cost of each command on data of a size."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    large.write(folder / "data", size)
    costs = []
    for command in large.commands:
        argv, profile = command.replace("{n}", str(size)).split(), cProfile.Profile()
        if count_calls:

            def keep(profile: cProfile.Profile = profile) -> None:
                profile.disable()
                calls = sum(entry.callcount for entry in profile.getstats())  # type: ignore[attr-defined]
                (folder / _CALLS).write_text(str(calls))

            child = start(argv, folder, profile.enable, keep)
        else:
            child = start(argv, folder)
        _, status, used = os.wait4(child, 0)
        if status:
            raise RuntimeError(f"{command}: {status}: {(folder / MESSAGES).read_text()[-2000:]}")
        work = (
            float((folder / _CALLS).read_text()) if count_calls else used.ru_utime + used.ru_stime
        )
        costs.append((work, float(used.ru_maxrss)))
    shutil.rmtree(folder)
    return costs


def _judge(
    name: str,
    large: Large,
    size: int,
    count_calls: bool,
    small: Cost,
    middle: Cost,
    whole: Cost,
) -> list[str]:
    found, unit = [], "calls" if count_calls else "s of CPU"
    noise = _NOISE_CALLS if count_calls else _NOISE_S
    # voxels grow by the square of the size, everything else by the size
    factor = 4 if "voxels" in large.name else 2
    first, second = middle[0] - small[0], whole[0] - middle[0]
    if second > _WORSE * factor * max(first, 0) + noise * factor:
        found.append(f"{name}: {small[0]:,.1f}, {middle[0]:,.1f}, {whole[0]:,.1f} {unit}")
    grown = whole[1] - middle[1]
    if grown > large.kilobytes * size / 2 + _NOISE_KB:
        found.append(f"{name}: {middle[1] / 1e3:.0f} MB, then {whole[1] / 1e3:.0f} MB")
    print(
        f"{name}: {small[0]:,.1f}, {middle[0]:,.1f}, {whole[0]:,.1f} {unit}; "
        f"{small[1] / 1e3:.0f}, {middle[1] / 1e3:.0f}, {whole[1] / 1e3:.0f} MB",
        flush=True,
    )
    return found
