"""A drive that grows while it is converted: what is made meanwhile is provisional, and in the end the
output has the bytes of a run on the finished drive.
"""

import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.converters.scan_writers import write_scan
from helpers.errors import raises
from typer.testing import CliRunner

import carlasc
from carlasc import FromScans, GridSpec, Run
from carlasc.cli import app
from carlasc.converting import LayoutOptions, convert, follow
from carlasc.core.frames import FrameRange
from carlasc.errors import ArgumentError, ConflictError, MissingDataError
from carlasc.groundtruth import GridOptions
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.options import Voting
from carlasc.groundtruth.provisional import make_provisional
from carlasc.inspection.staleness import changed_inputs
from carlasc.storage.layout import grid_folder
from carlasc.storage.opening import as_sink
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
    """A sensor: at each look at the folder, it has written some more scans. An event comes instead,
    when so many scans are there.
    """

    def __init__(self, folder: Path, frames: int, each: int = 4, **events) -> None:
        self.folder, self.frames, self.each, self.said = folder, frames, each, list[str]()
        self.next, self.events = 0, {int(name[1:]): event for name, event in events.items()}

    def wait(self, seconds: float) -> None:
        if self.events.get(self.next):
            self.events[self.next].pop(0)()
            return
        for _ in range(min(self.each, self.frames - self.next)):
            write(self.folder, self.next)
            self.next += 1

    def follow(self, out: Path, **options) -> None:
        self.folder.mkdir(exist_ok=True)
        settings = {"idle_s": 4, "grids": None, "wait": self.wait}
        follow("scans", self.folder, out, say=self.said.append, **settings | options)

    def has_said(self, text: str) -> bool:
        return any(text in line for line in self.said)


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
    assert {one.frame for one in final.failures} == {one.frame for one in fresh.failures}
    assert files(out) == files(out.with_name("fresh"))
    again = convert("scans", feed.folder, out, **options)
    assert (again.made, again.skipped) == (0, fresh.made)
    assert not any("made again" in note for note in again.notes)


def test_scans_are_taken_as_they_appear(tmp_path):
    feed = Feed(tmp_path / "scans", 14)
    feed.follow(tmp_path / "out")
    (sequence,) = carlasc.open(tmp_path / "out").values()
    assert len(sequence.frames("points")) == len(sequence.poses) == len(sequence.times) == 14
    check_final(feed, tmp_path / "out")


def nothing() -> None:
    pass


def crash() -> None:
    raise RuntimeError


def interrupt() -> None:
    raise KeyboardInterrupt


@pytest.mark.slow
def test_grids_are_provisional_until_the_drive_ends(tmp_path):
    out = tmp_path / "out"
    feed = Feed(tmp_path / "scans", 18, s12=[interrupt])
    feed.follow(out, grids=GRIDS)
    assert feed.has_said("the drive was ended")
    feed.follow(out, grids=GRIDS)
    (sequence,) = carlasc.open(out).values()
    (grid,) = sequence.grids
    made = sequence.frames(f"{grid}/labels")
    assert len(made) and made[-1] < 15 and not feed.has_said("no grid")
    assert "provisional" in changed_inputs(sequence, grid)
    check_final(feed, out, grids=GRIDS)
    (sequence,) = carlasc.open(out).values()
    assert len(sequence.frames(f"{grid}/labels")) == 18
    assert not changed_inputs(sequence, grid)


@pytest.mark.slow
def test_grids_follow_the_scans(tmp_path):
    """A call goes on where the last one ended, and reads poses that came since."""
    feed, sink = Feed(tmp_path / "scans", 0), as_sink(tmp_path / "out")
    grid = grid_folder(SPEC)
    plan, numbers = GridPlan(SPEC, grid, GRIDS.observe, Voting(), FrameRange()), list[int]()
    for known in (12, *range(15, 37, 3)):  # twelve scans wait, then every scan is taken
        feed.frames = known
        feed.follow(tmp_path / "out")
        (path,) = sink.source().sequences()
        made, problems = make_provisional("a drive", sink, path, sink.sequence(path), plan)
        numbers += made
        assert not problems and all(number + 3 < known for number in made)
    (sequence,) = sink.source().sequences().values()
    assert numbers == sequence.frames(f"{grid}/labels").tolist() == sorted(set(numbers))
    assert len(numbers) >= 3 and numbers[-1] > 20
    # what the last scans show of a street is what all of them show
    convert(
        "scans",
        feed.folder,
        tmp_path / "fresh",
        grids=replace(GRIDS, follow_ground=False),
        run=Run(1),
    )
    (final,) = carlasc.open(tmp_path / "fresh").values()
    for number, least in ((numbers[0], 0.5), (numbers[-1], 0.8)):
        one, other = (s.read(f"{grid}/labels", number) > 0 for s in (sequence, final))
        assert (one & other).sum() > max(least * other.sum(), 0.95 * one.sum())


@pytest.mark.slow
def test_grids_of_another_geometry_go(tmp_path):
    out, finer = tmp_path / "out", GridSpec("cartesian", (64, 64, 8), SPEC.lower, SPEC.upper)
    feed = Feed(tmp_path / "scans", 14)
    feed.follow(out, grids=GridOptions(finer, FromScans(window=(-1, 1)), follow_ground=False))
    assert len(list(out.rglob("evaluation*"))) == 1
    check_final(feed, out, grids=GRIDS)


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on(tmp_path):
    feed = Feed(tmp_path / "scans", 16, s12=[crash])
    with pytest.raises(RuntimeError):
        feed.follow(tmp_path / "out")
    feed.follow(tmp_path / "out")
    (sequence,) = carlasc.open(tmp_path / "out").values()
    assert len(sequence.frames("points")) == len(sequence.poses) == 16
    check_final(feed, tmp_path / "out", layout=LayoutOptions(compare_inputs="never"))


@pytest.mark.slow
def test_a_sensor_that_pauses_and_jumps(tmp_path, monkeypatch):
    scan = DRIVE.scan
    monkeypatch.setattr(type(DRIVE), "scan", lambda self, frame: scan(frame + 18 * (frame > 15)))
    feed = Feed(tmp_path / "scans", 22, s16=[nothing] * 7)
    feed.follow(tmp_path / "out")
    assert feed.has_said("no scan for 3 s") and feed.has_said("scans come again after 3.5 s")
    check_final(feed, tmp_path / "out")


@pytest.mark.slow
def test_files_that_are_not_whole(tmp_path):
    """A scan is read when it does not grow any more; one that cannot be read is left out."""
    folder = tmp_path / "scans"
    half = folder / "000012.npy"

    def begin() -> None:
        write(folder, 12)
        half.write_bytes(half.read_bytes()[:1000])

    def go_on() -> None:
        half.write_bytes(half.read_bytes() + b"x")

    def end() -> None:
        (folder / "000013.npy").write_bytes(b"damaged")
        write(folder, 12)
        feed.next = 14

    feed = Feed(folder, 20, s12=[begin, go_on, go_on, end])
    feed.follow(tmp_path / "out")
    assert [line for line in feed.said if "left out" in line and "000013" in line]
    assert not feed.has_said("000012")
    (sequence,) = carlasc.open(tmp_path / "out").values()
    assert sequence.frames("points").tolist() == [*range(13), *range(14, 20)]
    check_final(feed, tmp_path / "out")


def test_what_is_refused(tmp_path):
    with raises(MissingDataError, expected="a folder"):
        follow("scans", tmp_path / "none", tmp_path / "out")
    with raises(ArgumentError, where="out"):
        follow("scans", tmp_path, tmp_path.with_name("out.zarr"))
    with raises(ConflictError):
        follow("scans", tmp_path, tmp_path / "out")
    with raises(ArgumentError, where="level"):
        follow("scans", tmp_path, tmp_path.with_name("out"), layout=LayoutOptions(level=True))
    feed = Feed(tmp_path / "scans", 4)
    feed.follow(tmp_path / "out")
    for record in (tmp_path / "out").rglob(".carlasc/*"):
        record.unlink()
    with raises(ConflictError, found="other data"):
        feed.follow(tmp_path / "out")


@pytest.mark.slow
def test_a_sensor_in_real_time(tmp_path):
    """The command takes what a sensor writes meanwhile, and ends with what a usual run makes."""
    folder = tmp_path / "scans"
    folder.mkdir()

    def record() -> None:
        for frame in range(24):
            write(folder, frame, f"{frame:06d}.npz")
            time.sleep(0.1)

    sensor = threading.Thread(target=record)
    sensor.start()
    run = ["convert", "scans", str(folder), "--workers", "1", "--window", "-3:3"]
    result = CliRunner().invoke(app, [*run, str(tmp_path / "out"), "--follow", "--idle", "4"])
    sensor.join()
    assert result.exit_code == 0, result.output
    assert "the drive has" in result.stderr and "(24 existed)" in result.output
    assert CliRunner().invoke(app, [*run, str(tmp_path / "fresh")]).exit_code == 0
    assert files(tmp_path / "out") == files(tmp_path / "fresh")
    refused = CliRunner().invoke(app, [*run, str(tmp_path / "out"), "--follow", "--frames", ":3"])
    assert refused.exit_code and "--follow" in refused.stderr
