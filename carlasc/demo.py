"""A first look: everything from a simulated capture to pictures of its ground truth, in one go."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from carlasc.core.grids import GridSpec
from carlasc.errors import ConflictError

if TYPE_CHECKING:
    from carlasc.inspection.findings import ValidationResult
    from carlasc.inspection.statistics import Statistics
    from carlasc.viewing import Scene

Progress = Callable[[int, int], None]
Step = Callable[[str], AbstractContextManager[Progress]]

SEQUENCE = Path("Train", "Demo_Heavy")


@dataclass(frozen=True)
class DemoResult:
    """What the demonstration made.

    Attributes:
        sequence: folder of the simulated sequence: its raw capture and its ground truth.
        grids: folders of the grids.
        pictures: pictures of them.
        validation: what reading everything back found.
        statistics: its classes.
        elapsed_s: how long it all took, seconds.
    """

    sequence: Path
    grids: tuple[Path, ...]
    pictures: tuple[Path, ...]
    validation: ValidationResult
    statistics: Statistics
    elapsed_s: float


def demonstrate(
    out: str | os.PathLike[str],
    *,
    frames: int = 4,
    sensors: int = 20,
    seed: int = 0,
    workers: int | None = None,
    step: Step | None = None,
) -> DemoResult:
    """Simulate a short capture, make its ground truth in three grids, read it back, draw it.

    A second run goes on where a first one stopped.

    Args:
        out: folder to write to.
        frames: how many frames to simulate.
        sensors: how many LiDARs.
        seed: of the town.
        workers: processes side by side; all cores if None.
        step: called with the name of each step; returns a context manager that takes its progress.

    Returns:
        What was made.

    Raises:
        ConflictError: the folder holds something else.
        DependencyError: the simulate and render extras are missing.
    """
    from carlasc.captures.town import simulate
    from carlasc.groundtruth import regrid
    from carlasc.inspection.statistics import stats
    from carlasc.inspection.validation import validate
    from carlasc.viewing import render

    start, out, step = time.perf_counter(), Path(out), step or _silently
    sequence = out / SEQUENCE
    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not sequence.is_dir())):
        raise ConflictError(
            out, expected="an empty folder or an earlier demo", found="something else", advice="give another name"
        )

    with step("simulate a town") as progress:
        simulate(
            sequence, frames=frames, sensors=sensors, seed=seed, traffic="heavy", workers=workers, progress=progress
        )
    grids = []
    for name, spec in _demo_grids().items():
        with step(f"ground truth, {name}") as progress:
            made = regrid(sequence, spec, workers=workers, progress=progress)
            if made.failures:
                raise ConflictError(made.failures[0].message)
            grids += [Path(folder) for folder in made.grids]
    with step("read it back") as progress:
        validation = validate(out, every=1, progress=progress)
    with step("count classes") as progress:
        statistics = stats(out, progress=progress)
    pictures = []
    with step("draw") as progress:
        jobs = _pictures(out, grids, frames - 1)
        for number, (path, scene, what, view) in enumerate(jobs, 1):
            render(scene, path, what=what, view=view, overwrite=True)
            pictures.append(path)
            progress(number, len(jobs))
    return DemoResult(sequence, tuple(grids), tuple(pictures), validation, statistics, time.perf_counter() - start)


def _demo_grids() -> dict[str, GridSpec]:
    published = GridSpec.published()
    return {
        "published coarse": published,
        "0.2 m": published.with_resolution(0.2),
        "cylindrical": GridSpec.published("cylindrical"),
    }


def _pictures(out: Path, grids: list[Path], frame: int) -> list[tuple[Path, Scene, str, str]]:
    """Return file, scene, contents and view of each picture."""
    from carlasc.viewing import Scene

    coarse, fine, cylindrical = (Scene(grid, frames=(frame, frame + 1)) for grid in grids)
    return [
        (out / "coarse.png", coarse, "grid", "perspective"),
        (out / "fine.png", fine, "grid", "perspective"),
        (out / "cylindrical.png", cylindrical, "grid", "perspective"),
        (out / "birdseye.png", fine, "grid", "bev"),
        (out / "scan.png", coarse, "scan", "perspective"),
    ]


@contextmanager
def _silently(_: str) -> Iterator[Progress]:
    yield lambda done, total: None
