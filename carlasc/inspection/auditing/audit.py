"""`audit`: compares grids with the scans that they belong to, and reports what is wrong with the
grids.
"""

from __future__ import annotations

import io
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from collections.abc import Sequence as Series
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from hashlib import sha256
from itertools import groupby
from pathlib import Path

import numpy as np

from carlasc.core.arrays import Uint8Array
from carlasc.core.frames import Frames
from carlasc.errors import (
    ArgumentError,
    CarlascError,
    MissingDataError,
    check_types,
    reading,
    tried_twice,
)
from carlasc.groundtruth import FromScans
from carlasc.groundtruth.from_scans.feed import ScanFeed, WithoutScans
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.inspection.auditing.counting import OCCUPIED, FrameCounter
from carlasc.inspection.auditing.geometry import judge_geometry
from carlasc.inspection.auditing.judging import judge_contents
from carlasc.inspection.auditing.matching import MatchedGrids, match_grids
from carlasc.inspection.auditing.verdicts import (
    AuditFailure,
    AuditResult,
    Stretches,
    Sums,
    Verdict,
    add,
)
from carlasc.metrics.pairs import Place
from carlasc.motion.options import MotionOptions
from carlasc.motion.tracks import MovingActors
from carlasc.running.processes import one_pool, run_all
from carlasc.running.spreading import Part, Run, StepCounter
from carlasc.storage import FolderSink, as_source, layout
from carlasc.storage.inputs import SequenceFiles, combined, content_digests
from carlasc.storage.protocol import SequenceWriter, Source
from carlasc.storage.resuming import derived_key, read_derived
from carlasc.storage.shares import Share, source_in

_VERSION = 2  # version of the counts: it changes when the same input gives other sums
# frames of a stretch, and least number of stretches of a sequence
_STRETCH = 8
_STRETCHES = 10
_DRAWN = 50  # largest number of stretches to draw from: with more, neighbours are drawn together
_SHOWN = 4  # number of frames in pictures
_REACH = 30  # frames before and after a stretch in which actors matter
_BLOCK = 400  # frames for which actors are found together
# name of the files of sums, and of other entries in them
_SUMS = "audit"
_WORST = "worst"
_KEY = "key"
_PARTS = f"{layout.DERIVED}/parts"  # folder with a file of each finished part

# a wrong frame: path, frame of the grid, frame of the scan, wrong voxels
_Row = tuple[str, int, int, int]


@dataclass(frozen=True)
class _Stretch:
    """Some successive frames of a sequence, which a worker counts, and the place of their sums."""

    matched: MatchedGrids
    window: tuple[int, int] | None
    frames: tuple[tuple[int, int], ...]
    writer: SequenceWriter | None
    scans: str  # digest
    actors: MovingActors = field(default_factory=MovingActors)

    @cached_property
    def key(self) -> str:
        """The name of the sums, which differs for other grids, other scans or another window."""
        one = self.matched
        content = sha256()
        for number, _ in self.frames:
            # an error is reported when the frame is counted
            for part in tried_twice(partial(one.read, number)) or ():
                content.update(b"" if part is None else part.tobytes())
        about = (one.path, one.spec, self.frames, self.window, self.scans)
        return sha256(repr((_VERSION, *about, content.digest())).encode()).hexdigest()

    def read(self) -> Sums | None:
        """Return the sums of another run or part."""
        if self.writer is None:
            return None
        return read_derived(self.writer, _SUMS, self.key, _sums_from)

    def count(self) -> tuple[Sums, list[AuditFailure]]:
        """Count the frames, unless another run did; return those that cannot be read."""
        if (kept := self.read()) is not None:
            return kept, []
        counter = FrameCounter(self.matched, self.actors, self.window)
        sums = Sums()
        worst = []
        failures = []
        for number, frame in self.frames:
            try:
                kinds = counter.add_frame(sums, number, frame)
            except (CarlascError, OSError) as error:
                failures.append(self.failure(number, str(error)))
            else:
                worst.append((number, frame, np.count_nonzero(kinds > OCCUPIED)))
        sums[_WORST] = np.array(worst, np.int64).reshape(-1, 3)
        if self.writer is not None and not failures:
            buffer = io.BytesIO()
            entries = {_KEY: np.array(self.key), **sums}
            np.savez_compressed(buffer, **entries)  # type: ignore[arg-type]
            self.writer.write_document(layout.derived(_SUMS, self.key), buffer.getvalue())
        return sums, failures

    def failure(self, number: int, message: str) -> AuditFailure:
        """Return why a frame could not be counted."""
        return AuditFailure(self.matched.path, self.matched.grids.name_of(number), message)


def _sums_from(data: bytes, where: str) -> tuple[Sums, str]:
    with (
        reading(where, "sums of an audit"),
        np.load(io.BytesIO(data), allow_pickle=False) as arrays,
    ):
        return {name: arrays[name] for name in arrays.files if name != _KEY}, str(arrays[_KEY])


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
    """Compare grids with the scans that they belong to, and report what is wrong with the grids.

    Nothing is written, except to `keep`. A frame that cannot be read is listed in `failures`.

    Args:
        grids: anything that `evaluate` reads: a data set, the folder of a grid, or files of
            SemanticKITTI, SSCBench, Occ3D, OpenOccupancy or CarlaOcc.
        scans: a recording in CarlaSC's layout, with scans; poses, labels, boxes, instances and flow
            are used if they exist.
        grid: name of the grids. None: evaluation, or the only grid.
        made_from: first and last scan that each grid was made from, in frames relative to its
            frame. None: not known.
        frames: frames of the grids; None for all.
        keep: folder for intermediate counts: an interrupted audit continues there, and parts of a
            run need it to be joined.
        run: how the work is spread, with a callback for progress. A part needs `keep`; the last
            part gives the verdicts.

    Returns:
        The verdict of each check, with its number, interval and place.

    Raises:
        ArgumentError: a part without `keep`, or a window that does not hold the frame itself.
        MissingDataError: there are no grids, no scans, or none that belong together.
        FormatError: the geometry of the grids is not known.
    """
    given = dict(locals())
    check_types(audit, given)
    start = time.perf_counter()
    if made_from is not None and not made_from[0] <= 0 <= made_from[1]:
        raise ArgumentError(
            "made_from", expected="a range that contains 0, such as -30:30", found=made_from
        )
    if run.part.count > 1 and keep is None:
        raise ArgumentError(
            "part", expected="`keep`, a folder in which parts are joined", found="no folder"
        )
    places = tuple(one.location if isinstance(one, Source) else str(one) for one in (grids, scans))
    share = Share(as_source(scans), run)
    matched = list[MatchedGrids]()
    try:
        matched += match_grids(_grids_of(grids, share), share, grid, frames)
    except MissingDataError:
        if not share.others:
            raise
    notes = [f"{one.path}: {note}" for one in matched for note in one.notes]
    stretches = [part for one in matched for part in _stretches_of(one, made_from, keep)]
    with one_pool(share.run) as spread:
        sums, worst, failures = _count_all(share.run.part.take(stretches), spread, notes)
    verdicts = {}
    if keep is None or run.part.count == 1:
        verdicts = {one.path: _judge(Stretches(sums[one.path]), one, made_from) for one in matched}
    else:
        about = combined(*places, grid, made_from, str(frames), run.part.count)
        target = FolderSink(keep).target
        target.put(f"{_PARTS}/{about}-{run.part.number}", b"done")
        done = [name for name in target.tree.entries(_PARTS) if name.startswith(f"{about}-")]
        if len(done) == run.part.count:  # all that is counted is kept
            return audit(**{**given, "run": replace(run, part=Part())})
    return AuditResult(
        places[0],
        places[1],
        verdicts,
        {one.path: len(one.frames) for one in matched},
        {one.path: one.frame_name for one in matched},
        tuple(sorted(worst, key=lambda row: -row[3])[:_SHOWN]),
        tuple(dict.fromkeys(notes)),
        tuple(failures),
        grid,
        time.perf_counter() - start,
    )


def _grids_of(grids: Place, share: Share) -> Place:
    """Return the grids of the sequences of a part, if they are in the folders of these."""
    if not share.others:
        return grids
    opened = as_source(grids)
    return source_in(opened, share.own) if {*share.own} <= {*opened.places()} else grids


def voxels_of(
    result: AuditResult, path: str, number: int, frame: int
) -> tuple[MatchedGrids, Uint8Array]:
    """Count a frame of an audit again: return its grids, and the states of its voxels (see
    `FrameCounter.add_frame`).
    """
    matched = match_grids(result.grids, result.scans, result.grid, None)
    one = next(one for one in matched if one.path == path)
    counter = FrameCounter(one, _actors_of(one, frame, frame, Run(workers=1), []))
    return one, counter.add_frame({}, number, frame)


def _judge(
    sums: Stretches, one: MatchedGrids, window: tuple[int, int] | None
) -> tuple[Verdict, ...]:
    geometry = list(judge_geometry(sums, one))
    wrong = next((verdict.check for verdict in geometry if verdict.state == "fault"), "")
    return (*geometry, *judge_contents(sums, one, window, wrong))


def _stretches_of(
    one: MatchedGrids, window: tuple[int, int] | None, keep: str | Path | None
) -> Iterator[_Stretch]:
    """Yield the stretches of a sequence, without actors."""
    writer = None
    digest = ""
    scans = one.scans.frames("points")
    if keep is not None:
        writer = FolderSink(keep).sequence(one.path)
        digests = content_digests(SequenceFiles(one.scans), scans.tolist(), writer)
        digest = combined(*digests.items())
        if layout.POSES in one.scans.documents():
            digest = derived_key(one.scans, scans, digest)
    size = int(np.clip(len(one.frames) // _STRETCHES, 1, _STRETCH))
    for first in range(0, len(one.frames), size):
        yield _Stretch(one, window, one.frames[first : first + size], writer, digest)


def _with_actors(stretches: Iterable[_Stretch], run: Run, notes: list[str]) -> Iterator[_Stretch]:
    """Yield stretches with the moving actors near them.

    Actors are found for some hundred frames at a time, to bound memory.
    """
    blocks = groupby(stretches, lambda one: (one.matched.path, one.frames[0][1] // _BLOCK))
    for (_, block), parts in blocks:
        actors = None
        for stretch in parts:
            if stretch.read() is not None:
                yield stretch
                continue
            first = stretch.frames[0][1]
            last = stretch.frames[-1][1]
            if actors is None:
                end = (block + 1) * _BLOCK + last - first
                actors = _actors_of(stretch.matched, block * _BLOCK, end, run, notes)
            yield replace(stretch, actors=actors.between(first - _REACH, last + _REACH))


def _actors_of(
    one: MatchedGrids, first: int, last: int, run: Run, notes: list[str]
) -> MovingActors:
    """Return the moving actors near some frames of a recording: by its fields, or without any by
    free space.
    """
    if layout.POSES not in one.scans.documents():
        notes.append(
            f"{one.pair}: the scans have no poses.txt: moving actors and drift are not checked"
        )
        return MovingActors()
    frames = one.scans.frames("points")
    far = frames[(frames < first - 2 * _REACH) | (frames > last + 2 * _REACH)].tolist()
    # If a field names actors, evidence would only add doubtful ones.
    named = [n for n in ScanFeed(one.scans, FromScans()).motion if n != "evidence"]
    motion = MotionOptions(named[0] if named else "evidence")  # type: ignore[arg-type]
    try:
        feed = ScanFeed(WithoutScans(one.scans, far), FromScans(motion=motion))
        return find_actors(feed, run)
    except CarlascError as error:
        notes.append(f"{one.path}: moving actors are not checked: {error}")
        return MovingActors()


def _count_all(
    stretches: Series[_Stretch], run: Run, notes: list[str]
) -> tuple[dict[str, list[Sums]], list[_Row], list[AuditFailure]]:
    """Count stretches: sums by sequence; worst frames; failures."""
    steps = StepCounter(run.progress, sum(len(stretch.frames) for stretch in stretches))
    steps(0)
    lengths = Counter(stretch.matched.path for stretch in stretches)
    sums = {path: [Sums() for _ in range(min(length, _DRAWN))] for path, length in lengths.items()}
    worst = list[_Row]()
    failures = list[AuditFailure]()
    rows = Counter[str]()
    tasks = _with_actors(stretches, run, notes)
    with closing(run_all(_Stretch.count, tasks, run, lost=_fail)) as results:
        for stretch, (counted, failed) in zip(stretches, results, strict=True):
            counts = {**counted}
            path = stretch.matched.path
            steps(len(stretch.frames))
            failures += failed
            rows_of = counts.pop(_WORST, np.empty((0, 3), np.int64)).tolist()
            worst += [(path, number, frame, wrong) for number, frame, wrong in rows_of]
            for name, array in counts.items():
                add(sums[path][rows[path] * len(sums[path]) // lengths[path]], name, array)
            rows[path] += 1
    return sums, worst, failures


def _fail(stretch: _Stretch, message: str) -> tuple[Sums, list[AuditFailure]]:
    """Return the result of a stretch that no worker could count."""
    return {}, [stretch.failure(number, message) for number, _ in stretch.frames]
