"""A drive that grows while it is converted: what is made meanwhile is provisional, and in the end the
output has the bytes of a run on the finished drive.
"""

from pathlib import Path

import numpy as np
import pytest
from helpers.converters.scan_writers import write_scan
from helpers.errors import raises

import carlasc
from carlasc import FromScans, GridSpec, Run
from carlasc.converting import LayoutOptions, convert, follow
from carlasc.errors import ArgumentError, ConflictError, MissingDataError
from carlasc.groundtruth import GridOptions
from carlasc.inspection import validate
from carlasc.testing import SimulatedDrive

pytestmark = pytest.mark.needs("kiss_icp")
SPEC = GridSpec("cartesian", (32, 32, 8), (-12.8, -12.8, -2.0), (12.8, 12.8, 1.2))
GRIDS = GridOptions(SPEC, FromScans(window=(-3, 3)))
DRIVE = SimulatedDrive(40, channels=16, columns=180)


def write(folder: Path, frame: int, name: str = "") -> None:
    scan = DRIVE.scan(frame)
    fields = dict(zip(("x", "y", "z", "intensity"), scan.points.T, strict=True))
    write_scan(folder / (name or f"{frame:06d}.npy"), fields)


class Feed:
    """A sensor: at each look at the folder, it has written some more scans."""

    def __init__(self, folder: Path, frames: int, each: int = 4) -> None:
        self.folder, self.frames, self.each, self.said = folder, frames, each, list[str]()
        self.next, self.events = 0, dict[int, object]()

    def wait(self, seconds: float) -> None:
        self.folder.mkdir(exist_ok=True)
        if event := self.events.pop(self.next, None):
            event()
            return
        for _ in range(self.each):
            if self.next < self.frames:
                write(self.folder, self.next)
                self.next += 1

    def follow(self, out: Path, **options) -> None:
        self.folder.mkdir(exist_ok=True)
        settings = {"idle_s": 2, "grids": None, "run": Run(2), "wait": self.wait}
        follow("scans", self.folder, out, say=self.said.append, **settings | options)


def files(out: Path) -> dict[str, bytes]:
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and ".carlasc" not in path.parts
    }


def check_final(feed: Feed, out: Path, **options) -> None:
    """Compare what a run makes of the followed output with a run into an empty folder."""
    options = {"grids": None, "run": Run(1)} | options
    final = convert("scans", feed.folder, out, **options)
    fresh = convert("scans", feed.folder, out.with_name("fresh"), **options)
    assert not final.failures
    assert files(out) == files(out.with_name("fresh"))
    again = convert("scans", feed.folder, out, **options)
    assert (again.made, again.skipped) == (0, fresh.made)
    assert not any("again" in note for note in again.notes)


def test_scans_are_taken_as_they_appear(tmp_path):
    feed = Feed(tmp_path / "scans", 16)
    feed.follow(tmp_path / "out")
    (sequence,) = carlasc.open(tmp_path / "out").values()
    assert len(sequence.frames("points")) == len(sequence.poses) == len(sequence.times) == 16
    check_final(feed, tmp_path / "out")
