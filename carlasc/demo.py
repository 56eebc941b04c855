"""`carlasc demo`: a simulated capture, its ground truth, and pictures of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from carlasc.core.choices import Preset, TrafficLevel
from carlasc.core.grids import GridSpec
from carlasc.errors import ConflictError, DependencyError, import_extra
from carlasc.running.spreading import Progress, Run
from carlasc.storage.files import AnyPath

if TYPE_CHECKING:
    from carlasc.inspection.findings import ValidationResult
    from carlasc.inspection.statistics import Statistics
    from carlasc.viewing import CameraOptions, Scene

Step = Callable[[str], AbstractContextManager[Progress]]
"""Takes the name of a step, and returns a context manager that gives its progress callback."""

TRAIN, VAL = Path("Train", "Demo_Heavy"), Path("Val", "Demo_Light")
"""The simulated sequences, relative to the folder of the demonstration."""
_MODULES = ("trimesh", "embreex", "PIL", "imageio_ffmpeg")  # required packages of the extra `demo`
_EXTRA_MB = 240  # size of the extra `demo`, measured by docs/studies/sizes.py; fact: demo-size
_VAL_SHARE = 5  # one in five LiDARs records the drive for validation


@dataclass(frozen=True)
class DemoResult:
    """Result of `demonstrate`.

    Attributes:
        sequences: folders of the simulated sequences, with raw captures and ground truth.
        grids: folders of the grids of the first sequence.
        pictures: files of the pictures.
        page: file of the page for a browser.
        validation: result of the validation of all files.
        statistics: class statistics.
        elapsed_s: duration, seconds.
    """

    sequences: tuple[Path, ...]
    grids: tuple[Path, ...]
    pictures: tuple[Path, ...]
    page: Path
    validation: ValidationResult
    statistics: Statistics
    elapsed_s: float


def demonstrate(
    out: AnyPath,
    *,
    count: int = 6,
    sensors: int = 20,
    seed: int = 0,
    step: Step | None = None,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> DemoResult:
    """Simulate two short drives, make their ground truth in the published grids, validate it, count
    classes, and draw pictures.

    One drive is for training, one for validation. A second run with the same arguments makes
    missing files only, and draws the pictures and the page again.

    Args:
        out: folder to write to.
        count: number of frames of each drive, at least 5 to train with stacks of five scans.
        sensors: number of LiDARs of the drive for training; a fifth of them record the drive for
            validation.
        seed: seed of the simulated towns.
        step: called with the name of each step. Returns a context manager that yields the progress
            callback of the step.
        run: how the work is distributed. Progress is reported to `step`.

    Returns:
        Paths of the created files, the validation and the class statistics.

    Raises:
        ArgumentError: an argument is out of its range.
        ConflictError: `out` holds other files.
        DependencyError: a package of the extra `demo` is missing. Nothing is written.
    """
    from carlasc.captures import simulate
    from carlasc.groundtruth import regrid
    from carlasc.inspection.statistics import stats
    from carlasc.inspection.validation import validate
    from carlasc.viewing import Scene, render, view

    _check_packages()
    start = time.perf_counter()
    out = Path(out)
    step = step or _without_progress
    train = out / TRAIN
    val = out / VAL
    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not train.is_dir())):
        raise ConflictError(
            out,
            expected="an empty folder or an earlier demo",
            found="other files",
            advice="choose another folder",
        )

    drives: tuple[tuple[Path, int, TrafficLevel], ...] = (
        (train, sensors, "heavy"),
        (val, max(1, sensors // _VAL_SHARE), "light"),
    )
    for folder, own, traffic in drives:
        with step(f"simulate a town, {folder.parent.name}") as progress:
            spread = replace(run, progress=progress)
            simulate(
                folder,
                count=count,
                sensors=own,
                seed=seed + (folder == val),
                traffic=traffic,
                run=spread,
            )
    grids = []
    for preset in get_args(Preset):
        with step(f"ground truth, {preset}") as progress:
            made = regrid(out, GridSpec.published(preset), run=replace(run, progress=progress))
            if made.failures:
                raise ConflictError(made.failures[0].message)
            grids += [Path(folder) for folder in made.grids if Path(folder).is_relative_to(train)]
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
    return DemoResult(
        (train, val), tuple(grids), tuple(pictures), page, validation, statistics, elapsed_s
    )


def _list_pictures(
    out: Path, grids: list[Path], frame: int
) -> list[tuple[Path, Scene, str, CameraOptions]]:
    """Return the file, the scene, the content and the camera of each picture."""
    from carlasc.viewing import CameraOptions, Scene

    coarse, fine, cylindrical = (Scene(grid, frames=(frame, frame + 1)) for grid in grids)
    return [
        (out / "coarse.png", coarse, "grid", CameraOptions()),
        (out / "fine.png", fine, "grid", CameraOptions()),
        (out / "cylindrical.png", cylindrical, "grid", CameraOptions()),
        (out / "birdseye.png", fine, "grid", CameraOptions(view="bev")),
        (out / "scan.png", coarse, "scan", CameraOptions()),
    ]


def _check_packages() -> None:
    """Raise DependencyError for a missing package, with the size of the extra that installs it."""
    try:
        for module in _MODULES:
            import_extra(module, "demo")
    except DependencyError as error:
        error.advice += f" (about {_EXTRA_MB} MB)"
        raise


@contextmanager
def _without_progress(_: str) -> Iterator[Progress]:
    yield lambda done, total: None
