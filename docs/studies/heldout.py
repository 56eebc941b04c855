"""Held-out rays of drives under several rules: the tables of the page of `carlasc validate`.

    python docs/studies/heldout.py DRIVE... [--res R]

The drives are folders of sequences with scans and poses. Scores of all drives are added.
"""

from __future__ import annotations

import argparse
from functools import reduce

from clock import Clock

from carlasc import FromScans, GridSpec
from carlasc.groundtruth import Dynamic
from carlasc.inspection import HeldOutScores, RayShares, holdout

RULES: tuple[Dynamic, ...] = ("tube", "align", "current")
SHOWN = ("Vehicle", "Pedestrian", "Road", "Building", "Pole")


def main() -> None:
    """Print one table per resolution."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("drives", nargs="+")
    parser.add_argument("--res", type=float, help="size of a voxel, metres; default: the published grid")
    arguments = parser.parse_args()
    spec = GridSpec.published() if arguments.res is None else GridSpec.published().with_resolution(arguments.res)
    clock = Clock()
    for rule in RULES:
        results = [holdout(drive, spec, observe=FromScans(dynamic=rule)).total for drive in arguments.drives]
        scores = reduce(HeldOutScores.merge, [total for total in results if total is not None])
        by_class = scores.by_class()
        print(f"{rule}: {scores.frames} scans left out, swept volume {show(scores.swept_share)}")
        for name, shares in {"all": scores.all, **{name: by_class[name] for name in SHOWN if name in by_class}}.items():
            print(f"  {name:12s} {describe(shares)}", flush=True)
        clock(rule)


def describe(shares: RayShares) -> str:
    """Return the figures of some rays in one line."""
    parts = {"free": shares.free, "unknown": shares.unknown, "passed objects": shares.passed_object}
    text = "  ".join(f"{name} {show(value)}" for name, value in parts.items())
    return f"{shares.returns:8d} returns  {text}  errors {shares.error_median_m} m, 90% {shares.error_90_m} m"


def show(share: float | None) -> str:
    """Return a share as text."""
    return "-" if share is None else f"{share:.2%}"


if __name__ == "__main__":
    main()
