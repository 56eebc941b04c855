"""A copy of a data set with refined poses: poses.txt is new, and all other files are hard links to
those of the source.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from carlasc.core.arrays import FloatArray, IntArray
from carlasc.core.geometry import invert, multiply
from carlasc.errors import ArgumentError, check_types
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import (
    pose_notes,
    refine_sequence,
    with_refined_poses,
)
from carlasc.groundtruth.from_scans.sequences import (
    check_trajectory,
    must_estimate,
    with_estimated_poses,
)
from carlasc.groundtruth.options import FromScans
from carlasc.motion.mounting import Mounting, find_mounting
from carlasc.motion.options import PoseOptions
from carlasc.motion.refinement import RefinedPoses
from carlasc.relabelling.copies import timed, write_in_stages
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import as_source, layout
from carlasc.storage.derived_copies import (
    CopyResult,
    DerivedCopy,
    DerivedSequence,
    sequences_with_scans,
)
from carlasc.storage.files import AnyPath
from carlasc.storage.inputs import digest_of_bytes
from carlasc.storage.protocol import Sequence, SequenceWriter, Source
from carlasc.storage.shares import Share

_RUN = 60  # number of scans in a run, for the mounting of the sensor
# words for poses in carlasc.json
_ESTIMATED = "kiss-icp"
_REFINED = "refined"
_LEFT = "left as given"


@dataclass
class RefineResult(CopyResult):
    """The result of `refine`.

    Attributes:
        refined: paths of the sequences whose poses were refined.
        scans: number of scans with a changed motion.
        notes: what was done to the poses of each sequence, one line each.
    """

    refined: list[str] = field(default_factory=list)
    scans: int = 0
    notes: list[str] = field(default_factory=list)


def refine(
    source: AnyPath | Source,
    out: AnyPath,
    *,
    poses: PoseOptions = PoseOptions(),  # noqa: B008 (frozen)
    overwrite: bool = False,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> RefineResult:
    """Write a copy of a data set with poses that are changed so that neighbouring scans agree.

    The source is not changed.

    Good poses do not change. Poses of another point of the vehicle, and late poses, are corrected
    first, as far as the drive determines the correction. Sequences without scans are left out.
    Grids are left out too, because they were made with other poses. Files that do not change are
    hard links to those of the source, where both are folders of one file system: do not edit such
    files in place (carlasc never does). An interrupted run leaves `<out>.part`; the same call again
    finishes it.

    Args:
        source: the data set with the points: anything that `carlasc.open` takes, or a source.
        out: the folder to write: a path, or a URL of an object store.
        poses: where poses come from, and when they are refined. Estimated poses, of sequences that
            have none, are refined too.
        overwrite: replace a data set at `out` that `refine` has made.
        run: how the work is spread. Steps of progress are scans, then files. Each part refines the
            poses of its own sequences.

    Returns:
        The files that were written, and what was done to the poses of each sequence.

    Raises:
        ArgumentError: `poses.refine` is "never".
        ConflictError: something exists at `out`, or `out` lies inside `source`, or an interrupted
            run had other options.
        MissingDataError: there are no scans, or no poses and `poses.source` is "file".
        FormatError: poses or times are not valid.
        DependencyError: poses have to be estimated, and kiss-icp is not installed.
        StorageError: the files cannot be written.
    """
    check_types(refine, locals())
    began = time.perf_counter()
    if poses.refine == "never":
        raise ArgumentError("refine", expected="auto or always", found="'never'")
    share = Share(as_source(source), run)
    options = FromScans(poses=poses)
    given = sequences_with_scans(share)
    for one in given.values():
        if not must_estimate(one, options):
            check_trajectory(one, options)
    texts = [
        f"{path}/{name}\0".encode(errors="surrogateescape") + one.read_document(name)
        for path, one in given.items()
        for name in sorted(one.documents())
        if "/" not in name
    ]
    copy = DerivedCopy(
        share,
        out,
        {"poses": vars(poses), "texts": digest_of_bytes(b"\0".join(texts)).hex()},
        kind="refined poses",
        is_kind=lambda metadata: (
            str(metadata.extra.get("poses")).rpartition(", ")[2] in (_REFINED, _LEFT)
        ),
        overwrite=overwrite,
        run=run,
    )

    def find(
        path: str, writer: SequenceWriter | None, pool: Run, step: StepCounter
    ) -> _RefinedSequence:
        return _refine(given[path], options, writer, pool, step)

    scans = sum(len(one.frames("points")) for one in given.values())
    refined, copied = write_in_stages(copy, given, find, share.run, scans=scans)
    return RefineResult(
        **timed(copied, began),
        refined=[path for path, one in refined.items() if one.scans],
        scans=sum(one.scans for one in refined.values()),
        notes=[f"{path or one.name or one.location}: {one.note}" for path, one in refined.items()],
    )


class _RefinedSequence(DerivedSequence):
    """A sequence with refined poses, or with its own poses if these are good.

    Attributes:
        scans: number of scans with a changed motion.
        note: what was done to the poses, in a line.
    """

    def __init__(
        self,
        whole: Sequence,
        posed: Sequence,
        change: RefinedPoses,
        corrected: str = "",
        turned: str = "",
    ) -> None:
        estimated = posed is not whole and not corrected
        self.scans = len(change.refined) if corrected else int(change.refined.sum())
        notes = [corrected] if corrected else []
        words = str(whole.metadata.extra.get("poses", _LEFT)).split(", ")
        if estimated:
            notes = [f"poses were estimated from the scans ({_ESTIMATED})"]
            words = [_ESTIMATED]
        words = [word for word in words if word != _LEFT]
        if _REFINED not in words:
            words.append(_REFINED if self.scans else _LEFT)
        notes += _notes(change, whole.frames("points"))
        if turned:
            notes.append(f"the sensor is turned in their frame, which was not changed: {turned}")
        self.note = "; ".join(notes)
        extra = {**whole.metadata.extra, "poses": ", ".join(words)}
        texts = {layout.METADATA: replace(whole.metadata, extra=extra).to_json()}
        if self.scans or estimated or corrected:
            texts[layout.POSES] = layout.encode_poses(_poses(posed, change))
        super().__init__(whole, texts)


def _refine(
    sequence: Sequence,
    options: FromScans,
    writer: SequenceWriter | None,
    run: Run,
    step: StepCounter,
) -> _RefinedSequence:
    """Refine the poses of a sequence, or read the result that an interrupted run kept with
    `writer`.
    """
    posed = sequence
    if estimated := must_estimate(sequence, options):
        posed = with_estimated_poses(sequence, options)
        check_trajectory(posed, options)
    feed = ScanFeed(posed, options)
    change = refine_sequence(feed, writer, run, step)
    # estimated poses are poses of the sensor
    mounting = None if estimated else _mounting(feed, change)
    turned = "" if mounting is None else _named(mounting, slice(3, 6))
    if mounting is None or not mounting.is_moved:
        return _RefinedSequence(sequence, posed, change, turned=turned)
    seconds = np.array(list(feed.times.values()))
    mounted = replace(
        change, poses=mounting.correct(change.given, seconds), refined=np.ones_like(change.refined)
    )
    corrected = with_refined_poses(posed, feed.frames, mounted)
    change = refine_sequence(feed.with_poses_of(corrected), writer, run)
    moved = ", ".join(filter(None, (_named(mounting, slice(3)), _named(mounting, slice(6, 7)))))
    note = f"poses were corrected for the sensor in their frame: {moved}"
    return _RefinedSequence(sequence, corrected, change, note, turned)


def _named(mounting: Mounting, rows: slice) -> str:
    """Return the wrong ones of some values, in words."""
    values = list(zip(mounting.describe().items(), mounting.wrong, strict=True))[rows]
    return ", ".join(f"{name} {value}" for (name, value), is_wrong in values if is_wrong)


def _mounting(feed: ScanFeed, change: RefinedPoses) -> Mounting | None:
    """Return the mounting of the sensor in the frame of the given poses; None if it cannot be
    estimated.
    """
    runs = [
        (row, change.poses[row : min(row + _RUN, last + 1)])
        for first, last, refined in change.stretches()
        if refined
        for row in range(first, last + 1, _RUN)
    ]
    return find_mounting(change.given, np.array(list(feed.times.values())), runs)


def _poses(posed: Sequence, change: RefinedPoses) -> FloatArray:
    """Return the lines of poses.txt.

    The pose of the first scan stays: it is the origin of the others.
    """
    if not change.refined.any():
        return posed.poses
    frames = posed.frames("points")
    poses = with_refined_poses(posed, frames, change).poses
    poses = multiply(change.given[0], invert(change.poses[0]), poses)
    poses[posed.line_of(int(frames[0]), len(poses), layout.POSES)] = change.given[0]
    return poses


def _notes(change: RefinedPoses, frames: IntArray) -> list[str]:
    """Return the first note on the result of a refinement, and that on loops, or one on poses that
    did not change.
    """
    if notes := list(pose_notes(change, frames)):
        return notes[: 2 if len(change.loops) else 1]
    before, _ = change.disagreements_m
    what = "the distance between neighbouring scans is unknown"
    if before is not None:
        what = f"neighbouring scans disagree by {100 * before:.1f} cm"
    return [f"poses left as they are: {what}"]
