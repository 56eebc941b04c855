"""What all studies share: `--size tiny`, the folder they work in, the choice of drives, and a
clock.

A tiny run tries everything a study does in seconds, on a few frames of one drive. Its figures are
not for the pages.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.core.scans import Scan
from carlasc.metrics import interval_of

T = TypeVar("T")
_TINY = ContextVar("tiny", default=False)


def options(
    text: str | None, seeds: Mapping[str, Iterable[int]] | None = None
) -> argparse.ArgumentParser:
    """Return a parser of what every study takes.

    Args:
        text: what the study is.
        seeds: seeds of the drives by their kind; each kind is an option.
    """
    parser = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "work", nargs="?", type=Path, help="keeps drives and results; default: a temporary folder"
    )
    parser.add_argument(
        "--size",
        choices=("tiny", "whole"),
        default="whole",
        help="tiny: try everything, in seconds",
    )
    for kind, own in (seeds or {}).items():
        parser.add_argument(f"--{kind}", nargs="*", type=int, default=list(own), help="seeds")
    return parser


@contextmanager
def begin(parser: argparse.ArgumentParser) -> Iterator[argparse.Namespace]:
    """Yield the options that are given; `work` is a folder.

    Drives are small from now on if the size is tiny.
    """
    given = parser.parse_args()
    token = _TINY.set(given.size == "tiny")
    with tempfile.TemporaryDirectory(prefix="study-") as temporary:
        given.work = (given.work or Path(temporary)) / given.size
        given.work.mkdir(parents=True, exist_ok=True)
        try:
            yield given
        finally:
            _TINY.reset(token)


def is_tiny() -> bool:
    """Return whether the study that runs is a tiny one."""
    return _TINY.get()


def few(things: Iterable[T], count: int = 1) -> list[T]:
    """Return all things, or the first of them in a tiny study."""
    return list(things)[: count if is_tiny() else None]


def drives(given: argparse.Namespace, seeds: Iterable[str]) -> list[tuple[str, int]]:
    """Return the kind and the seed of each drive that was asked for; one street, which is soon
    made, in a tiny study.
    """
    kinds = ["street"] if is_tiny() else list(seeds)
    return few((kind, seed) for kind in kinds for seed in getattr(given, kind))


def do_all(function: Callable[[T], None], tasks: Iterable[T], workers: int) -> None:
    """Call a function for each task, in several processes; in this one in a tiny study."""
    if is_tiny():
        for task in tasks:
            function(task)
        return
    with ProcessPoolExecutor(workers) as pool:
        for done in as_completed([pool.submit(function, task) for task in tasks]):
            done.result()


def labels_of(scan: Scan) -> NDArray[np.unsignedinteger]:
    """Return the class of each point of a scan, which every simulated scan has."""
    if scan.labels is None:
        raise ValueError("the scan has no labels")
    return scan.labels


def interval(values: Iterable[float], shown: str = ".2f") -> str:
    """Return the mean over drives, with its 95% interval by Student's t if there are several."""
    found = np.array([value for value in values if not np.isnan(value)], np.float64)
    if len(found) < 2:
        return f"{found.mean():{shown}}" if len(found) else ""
    degrees = len(found) - 1
    bounds = interval_of(float(found.mean()), (found.var(ddof=1) / len(found), degrees))
    return f"{bounds.value:{shown}} ({bounds.low:{shown}} to {bounds.high:{shown}})"


def overlap_above(
    one: Transform, other: Transform, size: NDArray[np.float64], size_2: NDArray[np.float64]
) -> float:
    """Return the IoU of two boxes seen from above: poses, and sizes in metres; by samples."""
    steps = (np.arange(60) + 0.5) / 60 - 0.5
    samples = np.stack(np.meshgrid(steps, steps, [0.0]), axis=-1).reshape(-1, 3) * size
    inside = np.abs(transform_points(invert(other) @ one, samples)[:, :2]) < size_2[:2] / 2
    areas = float(np.prod(size[:2])), float(np.prod(size_2[:2]))
    shared = float(inside.all(axis=1).mean()) * areas[0]
    return shared / (sum(areas) - shared)


class Clock:
    """Says on standard error how long a study takes, so that the table on standard output can be
    copied as it is.
    """

    def __init__(self) -> None:
        self.start = self.last = time.perf_counter()

    def __call__(self, what: str) -> None:
        """Say what is done, how long it took, and how long everything has taken."""
        now = time.perf_counter()
        print(
            f"{what}: {now - self.last:.0f} s, {now - self.start:.0f} s in all",
            file=sys.stderr,
            flush=True,
        )
        self.last = now
