"""The demonstration: a simulated capture, its ground truth, and pictures of it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from carlasc.core.grids import GridSpec
from carlasc.errors import ConflictError
from carlasc.running.spreading import Run

if TYPE_CHECKING:
    from carlasc.inspection.findings import ValidationResult
    from carlasc.inspection.statistics import Statistics
    from carlasc.viewing import CameraOptions, Scene

Progress = Callable[[int, int], None]
"""Takes (done, total)."""

Step = Callable[[str], AbstractContextManager[Progress]]
"""Takes the name of a step, and returns a context manager that gives its progress callback."""

SEQUENCE = Path("Train", "Demo_Heavy")
"""The simulated sequence, relative to the folder of the demonstration."""


@dataclass(frozen=True)
class DemoResult:
    """What the demonstration made.

    Attributes:
        sequence: folder of the simulated sequence, with its raw capture and its ground truth.
        grids: folders of the grids.
        pictures: files of the pictures.
        page: file of the page, which opens in any browser.
        validation: result of validating everything.
        statistics: class statistics.
        elapsed_s: duration, seconds.
    """

    sequence: Path
    grids: tuple[Path, ...]
    pictures: tuple[Path, ...]
    page: Path
    validation: ValidationResult
    statistics: Statistics
    elapsed_s: float


def demonstrate(
    out: str | os.PathLike[str],
    *,
    count: int = 4,
    sensors: int = 20,
    seed: int = 0,
    step: Step | None = None,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> DemoResult:
    """Simulate a short drive, make its ground truth in three grids, validate it, count its classes, and draw it.

    A second run with the same arguments makes only what is missing, and draws the pictures and the page again.

    Args:
        out: folder to write to.
        count: number of frames.
        sensors: number of LiDARs.
        seed: seed of the simulated town.
        step: called with the name of each step. Returns a context manager that gives the step's progress callback.
        run: how the work is spread; `step` is told of its progress.

    Returns:
        What was made.

    Raises:
        ArgumentError: an argument is out of its range.
        ConflictError: `out` holds something else.
        DependencyError: a package of the extras `simulate` or `render` is missing. Nothing is written.
    """
    from carlasc.captures import simulate
    from carlasc.groundtruth import regrid
    from carlasc.inspection.statistics import stats
    from carlasc.inspection.validation import validate
    from carlasc.viewing import Scene, render, view

    start, out, step = time.perf_counter(), Path(out), step or _without_progress
    sequence = out / SEQUENCE
    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not sequence.is_dir())):
        raise ConflictError(
            out, expected="an empty folder or an earlier demo", found="something else", advice="choose another folder"
        )

    with step("simulate a town") as progress:
        simulate(
            sequence, count=count, sensors=sensors, seed=seed, traffic="heavy", run=replace(run, progress=progress)
        )
    grids = []
    published = GridSpec.published()
    specs = {
        "published coarse": published,
        "0.2 m": published.with_resolution(0.2),
        "cylindrical": GridSpec.published("cylindrical"),
    }
    for name, spec in specs.items():
        with step(f"ground truth, {name}") as progress:
            made = regrid(sequence, spec, run=replace(run, progress=progress))
            if made.failures:
                raise ConflictError(made.failures[0].message)
            grids += [Path(folder) for folder in made.grids]
    with step("check every file") as progress:
        validation = validate(out, every=1, run=Run(workers=1, progress=progress))
    with step("count classes") as progress:
        statistics = stats(out, run=Run(workers=1, progress=progress))
    pictures = []
    with step("draw") as progress:
        jobs = _list_pictures(out, grids, count - 1)
        for number, (path, scene, what, camera) in enumerate(jobs, 1):
            render(scene, path, what=what, camera=camera, overwrite=True)
            pictures.append(path)
            progress(number, len(jobs))
    page = out / "page.html"
    with step("write a page for a browser") as progress:
        view(Scene(grids[0]), page, overwrite=True, progress=progress)
    elapsed_s = time.perf_counter() - start
    return DemoResult(sequence, tuple(grids), tuple(pictures), page, validation, statistics, elapsed_s)


def _list_pictures(out: Path, grids: list[Path], frame: int) -> list[tuple[Path, Scene, str, CameraOptions]]:
    """Return file, scene, contents and camera of each picture."""
    from carlasc.viewing import CameraOptions, Scene

    coarse, fine, cylindrical = (Scene(grid, frames=(frame, frame + 1)) for grid in grids)
    return [
        (out / "coarse.png", coarse, "grid", CameraOptions()),
        (out / "fine.png", fine, "grid", CameraOptions()),
        (out / "cylindrical.png", cylindrical, "grid", CameraOptions()),
        (out / "birdseye.png", fine, "grid", CameraOptions(view="bev")),
        (out / "scan.png", coarse, "scan", CameraOptions()),
    ]


@contextmanager
def _without_progress(_: str) -> Iterator[Progress]:
    yield lambda done, total: None
