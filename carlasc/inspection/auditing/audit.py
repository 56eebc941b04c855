"""`audit`: grids of any format that is read here are compared with the scans that they belong to, and what is wrong is named."""

from __future__ import annotations

import io
import json
import time
import zipfile
from collections.abc import Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, field, replace
from hashlib import sha256
from pathlib import Path

import numpy as np

from carlasc.core.frames import Frames
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, CarlascError, MissingDataError
from carlasc.groundtruth import FromScans
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.inspection.auditing.counting import Sums
from carlasc.inspection.auditing.judging import Stretches, judge_geometry
from carlasc.inspection.auditing.matching import MatchedGrids, match_grids
from carlasc.inspection.auditing.shares import judge_shares
from carlasc.inspection.auditing.tallies import LAGS, FrameCounter, FrameErrors
from carlasc.inspection.auditing.verdicts import AuditFailure, AuditResult, Verdict
from carlasc.metrics.pairs import Place
from carlasc.motion.options import MotionOptions, MotionSource
from carlasc.motion.tracks import MovingActors
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.files import write_output
from carlasc.storage.protocol import Source

_VERSION = 1  # of what is counted: it changes when the same input gives other sums
_STRETCH, _STRETCHES = 8, 10  # frames of a stretch at most, and stretches of a sequence at least
_WORST = 4
_REACH = 30  # frames before and after a stretch in which actors matter


@dataclass(frozen=True)
class _Stretch:
    """Some frames of a sequence, to be counted in a worker, and the file that keeps their sums."""

    counter: FrameCounter
    frames: tuple[tuple[int, int], ...]
    kept: Path | None


@dataclass
class _Counted:
    """What was counted of a stretch."""

    sums: Sums = field(default_factory=dict)
    worst: list[tuple[int, int, int]] = field(
        default_factory=list
    )  # wrong voxels, frame of the grid, frame of the scan
    failures: list[AuditFailure] = field(default_factory=list)

    def to_bytes(self) -> bytes:
        about = {"worst": self.worst, "failures": [astuple(failure) for failure in self.failures]}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **{"about ": np.frombuffer(json.dumps(about).encode(), np.uint8)}, **self.sums)  # type: ignore[arg-type]
        return buffer.getvalue()

    @classmethod
    def read(cls, file: Path) -> _Counted | None:
        """Return what an earlier run kept; None if it kept nothing that can be read."""
        try:
            with np.load(file, allow_pickle=False) as arrays:
                about = json.loads(arrays["about "].tobytes())
                sums = {name: arrays[name] for name in arrays.files if name != "about "}
        except (OSError, ValueError, KeyError, zipfile.BadZipFile):
            return None
        return cls(sums, [tuple(row) for row in about["worst"]], [AuditFailure(*row) for row in about["failures"]])


def audit(
    grids: Place,
    scans: Place,
    *,
    grid: str | None = None,
    made_from: tuple[int, int] | None = None,
    frames: Frames = None,
    keep: str | Path | None = None,
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
) -> AuditResult:
    """Compare grids with the scans that they belong to, and name what is wrong with the grids.

    Nothing is written but what `keep` asks for. A frame that cannot be read is listed in `failures`.

    Args:
        grids: anything that `evaluate` reads: a data set, the folder of a grid, or files of SemanticKITTI, SSCBench, Occ3D or OpenOccupancy.
        scans: a recording in the layout: scans; poses, labels, and what shows motion are used where they exist.
        grid: name of the grids; None takes `evaluation`, or the only grid of a sequence.
        made_from: first and last scan, relative to its frame, that a grid was made from; None if that is not known.
        frames: frames of the grids; None for all.
        keep: folder for the sums of stretches of frames, so that an interrupted audit goes on, and parts can be put together.
        run: how the work is spread, and who is told of its progress. A part needs `keep`; the last part judges.

    Returns:
        The verdict of each check, with its number, interval and place.

    Raises:
        ArgumentError: a part without `keep`, or a window that does not hold the frame itself.
        MissingDataError: there are no grids, no scans, or none that belong together.
        FormatError: the geometry of the grids is not known.
    """
    start = time.perf_counter()
    if made_from is not None and not made_from[0] <= 0 <= made_from[1]:
        raise ArgumentError("made_from", expected="a range that contains 0, such as -30:30", found=str(made_from))
    if run.part.count > 1 and keep is None:
        raise ArgumentError("part", expected="`keep`, the folder in which parts are put together", found="no folder")
    matched, notes = match_grids(grids, scans, grid, frames), list[str]()
    stretches: list[_Stretch] = []
    for one in matched:
        notes += [f"{one.path}: {note}" for note in one.notes]
        actors = _actors(one, run, notes)
        counter = FrameCounter(one, actors, made_from)
        size = int(np.clip(len(one.frames) // _STRETCHES, 1, _STRETCH))
        for first in range(0, len(one.frames), size):
            part = one.frames[first : first + size]
            near = actors.between(part[0][1] - _REACH, part[-1][1] + _REACH)
            kept = None if keep is None else Path(keep) / f"{_key(counter, part)}.npz"
            stretches.append(_Stretch(replace(counter, actors=near), part, kept))
    own = run.part.take(stretches)
    counted = _count_all(own, run)
    if len(own) < len(stretches):
        read = {id(s): c for s, c in zip(own, counted, strict=True)}
        every = [read.get(id(s)) or (_Counted.read(s.kept) if s.kept else None) for s in stretches]
        if any(c is None for c in every):
            return replace(_result(grids, scans, matched, {}, notes, counted, start), is_whole=False, grid=grid)
        counted = [c for c in every if c is not None]
    verdicts, worst = {}, []
    for one in matched:
        parts = [c for s, c in zip(stretches, counted, strict=True) if s.counter.matched is one]
        worst += [(one.path, number, frame, wrong) for c in parts for wrong, number, frame in c.worst]
        whole = Stretches([c.sums for c in parts if c.sums])
        if not whole.parts:
            raise MissingDataError(
                one.grids.location, expected="a frame that can be read", found=parts[0].failures[0].message
            )
        verdicts[one.path] = _judge(whole, one, made_from)
    worst.sort(key=lambda row: -row[3])
    return replace(_result(grids, scans, matched, verdicts, notes, counted, start), worst=tuple(worst[:_WORST]))


def frame_errors(result: AuditResult, path: str, number: int, frame: int) -> tuple[GridSpec, str, FrameErrors]:
    """Count a frame of an audit again: return the geometry and the handedness of its grid, and its wrong voxels."""
    matched = next(one for one in match_grids(result.grids, result.scans, result.grid, None) if one.path == path)
    counter = FrameCounter(matched, _actors(matched, Run(workers=1), []))
    return matched.spec, matched.axes, counter.add_frame({}, number, frame)


def _judge(whole: Stretches, one: MatchedGrids, window: tuple[int, int] | None) -> tuple[Verdict, ...]:
    scans = [scan for _, scan in one.frames]
    period = (one.seconds(scans[-1]) - one.seconds(scans[0])) / max(scans[-1] - scans[0], 1)
    geometry = list(judge_geometry(whole, one.spec, one.path, period or layout.FRAME_PERIOD_S))
    wrong = next((verdict for verdict in geometry if verdict.state == "fault"), None)
    return (*geometry, *judge_shares(whole, one, window, "" if wrong is None else wrong.check))


def _result(
    grids: Place,
    scans: Place,
    matched: Sequence[MatchedGrids],
    verdicts: dict[str, tuple[Verdict, ...]],
    notes: list[str],
    counted: Sequence[_Counted],
    start: float,
) -> AuditResult:
    names = [place.location if isinstance(place, Source) else str(place) for place in (grids, scans)]
    return AuditResult(
        names[0],
        names[1],
        verdicts,
        {one.path: len(one.frames) for one in matched},
        {one.path: one.frame_name for one in matched},
        notes=tuple(notes),
        failures=tuple(failure for c in counted for failure in c.failures),
        elapsed_s=time.perf_counter() - start,
    )


def _count_all(stretches: Sequence[_Stretch], run: Run) -> list[_Counted]:
    total, done, counted = sum(len(s.frames) for s in stretches), 0, []
    with closing(run_all(_count_stretch, stretches, run, lost=_fail)) as results:
        for stretch, result in zip(stretches, results, strict=True):
            counted.append(result)
            done += len(stretch.frames)
            if run.progress is not None:
                run.progress(done, total)
    return counted


def _count_stretch(stretch: _Stretch) -> _Counted:
    """Count the frames of a stretch, in a worker, or return what an earlier run kept."""
    if stretch.kept is not None and (kept := _Counted.read(stretch.kept)) is not None:
        return kept
    counted, counter = _Counted(), stretch.counter
    for number, frame in stretch.frames:
        try:
            errors = counter.add_frame(counted.sums, number, frame)
        except (CarlascError, OSError) as error:
            failure = AuditFailure(counter.matched.path, counter.matched.grids.name_of(number), str(error))
            counted.failures.append(failure)
            continue
        counted.worst.append((errors.count, number, frame))
    counted.worst = sorted(counted.worst, reverse=True)[:_WORST]
    if stretch.kept is not None and not counted.failures:
        write_output(stretch.kept, counted.to_bytes())
    return counted


def _fail(stretch: _Stretch, message: str) -> _Counted:
    """Return the result of a stretch that no worker could count."""
    matched = stretch.counter.matched
    rows = [AuditFailure(matched.path, matched.grids.name_of(number), message) for number, _ in stretch.frames]
    return _Counted(failures=rows)


def _actors(one: MatchedGrids, run: Run, notes: list[str]) -> MovingActors:
    """Return what moves in a recording: by its fields, and if it has none by free space."""
    if layout.POSES not in one.scans.documents():
        notes.append(f"{one.path}: the scans have no poses: what moves, and drift, cannot be told")
        return MovingActors()
    fields = one.scans.fields()
    names: tuple[MotionSource, ...] = ("boxes", "instances", "flow")
    usable = [name for name in names if name in fields and (name == "boxes" or "labels" in fields)]
    motion = MotionOptions(usable[0] if usable else "evidence")
    feed = ScanFeed(one.scans, FromScans(motion=motion))
    try:
        return find_actors(feed, replace(run, progress=None))
    except CarlascError as error:
        notes.append(f"{one.path}: what moves cannot be told: {error}")
        return MovingActors()


def _key(counter: FrameCounter, frames: Sequence[tuple[int, int]]) -> str:
    """Return a name for the sums of some frames: that of another audit is different."""
    one = counter.matched
    about = [_VERSION, one.grids.location, one.scans.location, one.path, str(one.spec), one.spec.lower, one.spec.upper]
    return sha256(json.dumps([*about, frames, counter.window, LAGS], default=str).encode()).hexdigest()[:24]
