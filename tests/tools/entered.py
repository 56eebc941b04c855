"""`PYTHONPATH=tests:tests/tools python -m entered [CASE ...]`: how many files and functions of
`carlasc` and its converters make one frame, and how deeply they call each other.

What is loaded or compiled once is left out: each case runs once before it is counted. A call counts
if its code is in a file of these packages, that of a compiled loop too where Numba tells of it.
Comprehensions, generator expressions and lambdas count like functions; from Python 3.12 on, most
comprehensions are no calls, so a version before it counts more. A generator is as deep as the call
that resumes it.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import carlasc_converters
from helpers.converters import bags

import carlasc
from carlasc import Dataset, FromCapture, FromScans, GridSpec, Run, regrid
from carlasc.captures import Lidar
from carlasc.converting import convert
from carlasc.core.compiling import cache_folder
from carlasc.groundtruth import GridOptions
from carlasc.testing import SimulatedDrive

PACKAGES = {
    str(Path(package.__file__ or "").parent) + os.sep: f"{package.__name__}/"
    for package in (carlasc, carlasc_converters)
}
COMPILED = str(cache_folder()) + os.sep  # here are the copies of the sources of compiled loops
SPEC = GridSpec.published().with_size((32, 32, 8))
LIDAR = Lidar(channels=16, points=4000)
FRAMES = 6
ONE = Run(workers=1)


@dataclass
class Entered:
    """What was entered while a function ran.

    Attributes:
        functions: the functions, as `file:name`, with the paths of files from their package on.
        deepest: the longest chain of them that were in progress at one time, the caller first.
    """

    functions: set[str] = field(default_factory=set)
    deepest: tuple[str, ...] = ()

    @property
    def depth(self) -> int:
        """Greatest number of functions in progress at one time."""
        return len(self.deepest)

    @property
    def files(self) -> set[str]:
        """The files of these functions."""
        return {function.partition(":")[0] for function in self.functions}

    def __str__(self) -> str:
        return f"{len(self.files)} files, {len(self.functions)} functions, {self.depth} deep"


def file_of(code: CodeType) -> str | None:
    """Return the path of the file of some code from its package on; None if it is in no package."""
    path = code.co_filename
    if path.startswith(COMPILED):
        module, _, _ = path.removeprefix(COMPILED).partition(os.sep)[0].rpartition(".")
        return module.replace(".", "/") + ".py"
    for root, package in PACKAGES.items():
        if path.startswith(root):
            return package + path.removeprefix(root)
    return None


def entered(function: Callable[[], object]) -> Entered:
    """Run a function, and return what of the packages it entered in this thread."""
    found, stack = Entered(), list[str]()

    def profile(frame: FrameType, event: str, _: Any) -> None:
        if event not in ("call", "return") or (file := file_of(frame.f_code)) is None:
            return
        if event == "return":
            stack.pop()
            return
        stack.append(f"{file}:{frame.f_code.co_qualname}")
        found.functions.add(stack[-1])
        if len(stack) > found.depth:
            found.deepest = tuple(stack)

    before = sys.getprofile()
    sys.setprofile(profile)
    try:
        function()
    finally:
        sys.setprofile(before)
    return found


def cases(folder: Path) -> dict[str, Callable[[], object]]:
    """Write small simulated data into a folder, and return what is counted, by name.

    Each call does the work anew.

    One frame of a capture and of scans is made, each with its tracks, its report and all other
    files of a run; a bag of 8 frames is converted, with a grid for each.
    """
    carlasc.simulate(folder / "capture", count=FRAMES, sensors=3, lidar=LIDAR, bev=False, run=ONE)
    regrid(folder / "capture", SPEC, folder / "grids", run=ONE)
    middle = (FRAMES // 2, FRAMES // 2 + 1)
    dataset = Dataset(folder / "grids", grid="evaluation_32x32x8")

    def into(write: Callable[[Path], object]) -> Callable[[], object]:
        def case() -> object:
            with tempfile.TemporaryDirectory(dir=folder) as out:
                return write(Path(out) / "out")

        return case

    def one_frame(source: str, observe: FromScans | FromCapture) -> Callable[[], object]:
        return into(
            lambda out: regrid(folder / source, SPEC, out, observe=observe, frames=middle, run=ONE)
        )

    return {
        "regrid from scans": one_frame("grids", FromScans()),
        "regrid of a capture": one_frame("capture", FromCapture()),
        "Dataset[1]": lambda: dataset[1],
        "evaluate": lambda: carlasc.evaluate(folder / "grids", folder / "grids", run=ONE),
        "view": into(lambda out: carlasc.view(folder / "grids", out.with_suffix(".html"))),
        "convert bag": into(_converting_a_bag(folder)),
    }


def _converting_a_bag(folder: Path) -> Callable[[Path], object]:
    drive, store = SimulatedDrive(8, channels=12, columns=120), bags.Messages("mcap")
    bag = bags.write_bag(folder, "mcap", bags.drive_messages(store, drive, "odometry"), store=store)
    return lambda out: convert("bag", bag, out, grids=GridOptions(SPEC), run=ONE)


def count_case(case: Callable[[], object]) -> Entered:
    """Return what a case enters the second time that it runs."""
    case()
    return entered(case)


def main() -> None:
    """Print what each case enters; of the cases that are named, the functions and the deepest chain
    too.
    """
    with tempfile.TemporaryDirectory() as folder:
        found = {name: count_case(case) for name, case in cases(Path(folder)).items()}
    for name, own in found.items():
        print(f"{name}: {own}")
        if name in sys.argv[1:]:
            print(*sorted(own.functions), sep="\n")
            print(
                *(f"{'  ' * level}{function}" for level, function in enumerate(own.deepest)),
                sep="\n",
            )


if __name__ == "__main__":
    main()
