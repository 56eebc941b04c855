"""Whether what is said of a mounting is right: `python docs/studies/diagnoses.py` prints the table
of docs/studies/poses.md.

Winding drives get a mounting (none, a lever arm, a rotation, a
delay), and errors of odometry. The aligned poses, from which a mounting is found, have errors of a
few millimetres, and keep a tenth of the errors of the given poses. A value is claimed if
`Mounting.wrong` names it; it is right if the truth lies within its interval. No scans are made, so
that hundreds of drives take minutes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import study
from numpy.typing import NDArray

from carlasc.core.geometry import (
    invert,
    multiply,
    rotation_z,
    slerp,
    small_motions,
    translation,
)
from carlasc.motion.mounting import find_mounting
from carlasc.testing import wrong_poses

FRAMES, RUN, MARGIN = 90, 30, 5  # the drive goes on before and after, for late poses
SEEDS = {"chosen": range(51, 53), "reported": range(61, 63), "fresh": range(81, 83)}
NAMES = ("x", "y", "z", "roll", "pitch", "yaw", "late")
DEGREE = np.deg2rad(1.0)
Poses = NDArray[np.float64]


def winding(seed: int) -> Poses:
    """Return the poses of a vehicle that turns, brakes, rolls and pitches."""
    rng = np.random.default_rng(seed)
    at = 0.1 * np.arange(FRAMES + 2 * MARGIN)
    waves = [
        size * np.sin(rate * at + start)
        for size, rate, start in zip(
            rng.uniform((0.05, 0.5, 0.002, 0.002), (0.4, 4.0, 0.02, 0.02)),
            rng.uniform(0.3, 1.2, 4),
            rng.uniform(0.0, 6.0, 4),
            strict=True,
        )
    ]
    speed = rng.uniform(4.0, 12.0) + waves[1]
    pose, poses = np.eye(4), []
    for frame in range(len(at)):
        poses.append(pose @ _turn(waves[2][frame], waves[3][frame], 0.0))
        pose = pose @ rotation_z(0.1 * waves[0][frame]) @ translation((0.1 * speed[frame], 0, 0))
    return np.stack(poses)


def _turn(roll: float, pitch: float, yaw: float) -> Poses:
    """Return a small rotation, (4, 4)."""
    turned = np.eye(4)
    turned[:3, :3] += [[0, -yaw, pitch], [yaw, 0, -roll], [-pitch, roll, 0]]
    u, _, v = np.linalg.svd(turned[:3, :3])
    turned[:3, :3] = u @ v
    return turned


def drives(seeds: range) -> Iterator[Poses]:
    """Yield true poses of a sensor."""
    for seed in study.few(seeds):
        yield winding(seed)
        yield winding(seed + 1000)


def errors_of(name: str, poses: Poses, seed: int) -> Poses:
    """Return poses with errors of odometry of some kind."""
    motions = multiply(invert(poses[:-1]), poses[1:])
    turns, way = small_motions(motions)[:, 3:], motions[:, :3, 3].copy()
    added = {
        "drift of 1 cm, 0.05 degrees": {"drift_m": 0.01, "drift_rad": 0.05 * DEGREE},
        "drift of 3 cm, 0.15 degrees": {"drift_m": 0.03, "drift_rad": 0.15 * DEGREE},
        "jitter of 3 cm, 0.1 degrees": {"jitter_m": 0.03, "jitter_rad": 0.1 * DEGREE},
        "jitter of 8 cm, 0.3 degrees": {"jitter_m": 0.08, "jitter_rad": 0.3 * DEGREE},
    }
    if name in added:
        return wrong_poses(poses, **added[name], seed=seed)
    if name == "scale of 3%":
        motions[:, :3, 3] = 1.03 * way
    elif name == "distortion in turns":  # short and aslant where the sensor turns
        motions[:, 0, 3] -= 0.1 * np.abs(turns[:, 2]) * np.abs(way[:, 0])
        motions[:, 1, 3] += 0.1 * turns[:, 2] * np.abs(way[:, 0])
    elif name == "short and pitched":  # as KISS-ICP on straight streets
        motions = multiply(motions, _turn(0.0, 0.1 * DEGREE, 0.0)[None])
        motions[:, :3, 3] *= 0.98
    wrong = [poses[0]]
    for motion in motions:
        wrong.append(wrong[-1] @ motion)
    return np.stack(wrong)


ERRORS = (
    "none",
    "jitter of 3 cm, 0.1 degrees",
    "jitter of 8 cm, 0.3 degrees",
    "drift of 1 cm, 0.05 degrees",
    "drift of 3 cm, 0.15 degrees",
    "scale of 3%",
    "distortion in turns",
    "short and pitched",
)


def mountings(seed: int) -> Iterator[NDArray[np.float64]]:
    """Yield the seven values of some mountings."""
    rng = np.random.default_rng(seed)
    yield np.zeros(7)
    for size in (0.3, 1.5):
        yield np.array([*rng.uniform(-size, size, 3), 0, 0, 0, 0])
    yield np.array([0, 0, 0, *(3.0 * DEGREE * rng.uniform(-1, 1, 3)), 0])
    for late in (0.05, 0.2):
        yield np.array([0, 0, 0, 0, 0, 0, rng.choice((-late, late))])


def main() -> None:
    """Print how many values are claimed, and how many of them are right."""
    parser = study.options(__doc__)
    parser.add_argument("--seeds", choices=tuple(SEEDS), default="reported")
    with study.begin(parser) as given:
        print("| errors of the poses | cases | claimed | right | of wrong mountings |")
        print("|---|---:|---:|---:|---:|")
        true = list(drives(SEEDS[given.seeds]))
        all_claimed = all_right = 0
        for name in ERRORS:
            claimed = right = there = named = cases = 0
            missed = []
            for number, whole in enumerate(true):
                sensor = whole[MARGIN:-MARGIN]
                rng = np.random.default_rng(number)
                for values in mountings(number):
                    given_poses = _with_mounting(whole, values, name, number)
                    aligned = sensor.copy()
                    off = small_motions(multiply(invert(sensor), errors_of(name, sensor, number)))
                    for row in range(FRAMES):
                        noise = rng.normal(0, (0.004,) * 3 + (3e-4,) * 3)
                        step = noise + 0.1 * off[row]
                        moved = _turn(*step[3:])
                        moved[:3, 3] = step[:3]
                        aligned[row] = sensor[row] @ moved
                    runs = [(row, aligned[row : row + RUN]) for row in range(0, FRAMES, RUN)]
                    found = find_mounting(
                        given_poses, np.arange(FRAMES, dtype=np.float64) * 0.1, runs
                    )
                    assert found is not None
                    wrong, cases = found.wrong, cases + 1
                    is_right = np.abs(found.values - values) <= found.errors
                    claimed, right = claimed + wrong.sum(), right + (wrong & is_right).sum()
                    big = np.abs(values) > 0.3 * np.array([1, 1, np.inf, 0.1, 0.1, 0.1, 0.1])
                    there, named = there + big.sum(), named + (big & wrong).sum()
                    missed += [NAMES[i] for i in np.flatnonzero(wrong & ~is_right)]
            share = f"{right / claimed:.1%}" if claimed else ""
            print(
                f"| {name} | {cases} | {claimed} | {share} | {named / max(there, 1):.0%} |",
                *(missed if given.seeds == "chosen" else ()),
                flush=True,
            )
            all_claimed, all_right = all_claimed + claimed, all_right + right
        print(f"| all | | {all_claimed} | {all_right / max(all_claimed, 1):.1%} | |")


def _with_mounting(sensor: Poses, values: NDArray[np.float64], name: str, seed: int) -> Poses:
    """Return poses of another point of the vehicle, at other times, with errors."""
    mount = _turn(*values[3:6])
    mount[:3, 3] = values[:3]
    vehicle, seconds = (
        multiply(sensor, invert(mount)),
        np.arange(len(sensor), dtype=np.float64) * 0.1,
    )
    late = slerp(vehicle, seconds, seconds - values[6])
    return errors_of(name, late[MARGIN:-MARGIN], seed)


if __name__ == "__main__":
    main()
