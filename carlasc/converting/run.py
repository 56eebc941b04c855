"""`convert`: every recording of another data set becomes a sequence of the layout. Frames are converted in parallel."""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from carlasc.converting.places import check_outside
from carlasc.converting.plans import (
    RecordingPlan,
    SplitName,
    check_voxel_grid,
    choose_recordings,
    plan_recording,
    sequence_path,
)
from carlasc.converting.protocol import Converter, Recording
from carlasc.converting.registry import load_converter
from carlasc.converting.regridding import Regridding
from carlasc.converting.results import ConvertResult, Failure, Progress, Steps
from carlasc.converting.stages import Conversion
from carlasc.converting.target import Target
from carlasc.converting.trajectory import PoseSource
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.running.engines import Engine
from carlasc.running.options import Run
from carlasc.running.parts import Part
from carlasc.running.processes import one_pool
from carlasc.storage.metadata import Axes, Metadata
from carlasc.storage.opening import as_sink
from carlasc.storage.sinks import Sink
from carlasc.storage.transport.targets import LocalTarget, check_shared

if TYPE_CHECKING:
    from carlasc.groundtruth import RegridResult
    from carlasc.groundtruth.options import FromScans, Voting

Grids = Literal["scans", "voxels", "none"]
Flow = Literal["auto", "none"]


def convert(
    name: str | type[Converter],
    source: str | os.PathLike[str],
    out: str | os.PathLike[str] | Sink,
    *,
    sequences: Collection[str] | None = None,
    split: SplitName = "all",
    classes: str = "carla",
    axes: Axes = "left",
    grids: Grids = "scans",
    spec: GridSpec | None = None,
    observe: FromScans | None = None,
    voting: Voting | None = None,
    follow_ground: bool = True,
    poses: PoseSource = "auto",
    flow: Flow = "auto",
    options: Mapping[str, str] | None = None,
    allow_unknown: bool = False,
    force: bool = False,
    workers: int | None = None,
    executor: Engine | None = None,
    part: Part = Part(),  # noqa: B008 (frozen)
    progress: Progress | None = None,
) -> ConvertResult:
    """Write another data set as sequences of the CarlaSC layout: the same files, axes and classes.

    A second run skips the frames that exist. A frame that cannot be read is reported in the result, and the others are converted.
    Worker processes import the main module again: scripts call this under `if __name__ == "__main__":`, or with `workers=1`.

    Args:
        name: the converter: "kitti", "argoverse2", ..., or one of another distribution (see `converter_names`); or a class that
            inherits `Converter`.
        source: folder of the data set, or of one of its sequences.
        out: where to write: a folder or a `.zarr` store, on this machine or in an object store; or any Sink, with grids if it can be
            read while it is written.
        sequences: which ones, by their names or the last part of them ("00"); None converts all.
        split: "train", "val" or "test": only sequences of this split; "all" converts every split.
        classes: "carla" maps class ids to CarlaSC's; the name of the data set's own class table ("semantickitti") keeps its ids.
        axes: "left" mirrors y into CarlaSC's left-handed axes; "right" keeps the right-handed ones.
        grids: "scans" makes grids from scans merged over time; "voxels" takes the data set's own voxels, with count 0 where
            they are unknown; "none" writes no grids.
        spec: with "scans": the grid; None takes the published coarse one.
        observe: with "scans": which scans are merged, and how moving points are treated.
        voting: with "scans": how votes are counted.
        follow_ground: with "scans": move the grid up or down by whole voxels where the ground is below it, or far above its lower
            bound; False keeps the bounds of `spec`.
        poses: "file", "kiss-icp" (estimated from the scans), or "auto": the file where it exists, else estimated.
        flow: "auto" gives points the velocity of their actor: from tracked boxes where the data set has them, else estimated from
            the actor's points, if they are numbered; "none" writes no flow.
        options: what the converter takes beside the source, as text: see its page in the documentation.
        allow_unknown: treat class ids that the table does not have as unlabelled.
        force: accept poses under which the scans do not overlap, or whose calibration is missing.
        workers: number of frames that are converted at the same time; None uses all cores.
        executor: runs the work instead of processes of our own; it is not shut down.
        part: converts only this part of the recordings, whole ones, because poses and motion are found along each; other commands
            convert the others. Grids then keep their height: the ground of the other recordings is not known.
        progress: called with the number of finished steps and the number of all steps.

    Returns:
        What was written, what was skipped, and what failed.

    Raises:
        ArgumentError: an argument has a wrong value, or no converter has that name.
        MissingDataError: `source`, a sequence or the poses do not exist.
        FormatError: poses or times do not fit the frames, or the scans.
        ConflictError: `out` lies inside `source`, or holds other data.
        StorageError: the output cannot be written. The files written so far are complete.
    """
    start, run = time.perf_counter(), Run(workers, executor)
    workers = run.processes
    converter = load_converter(name) if isinstance(name, str) else name
    _check(converter, classes=classes, axes=axes, grids=grids, split=split, poses=poses, flow=flow)
    root = Path(source)
    sink = as_sink(out, part=part)
    check_shared(sink.location, run)
    _check_sink(root, sink, grids)
    if not root.exists():
        raise MissingDataError(root, expected="a folder", found="nothing", advice="check the path")
    if part.count > 1 and grids == "scans" and follow_ground:
        raise ArgumentError(
            "follow_ground",
            expected='False, or grids="none", with `part`: the height of grids is found from the ground of all recordings',
            found="True",
        )
    recordings = choose_recordings(converter(root, **(options or {})).sequences(), root, sequences, split)
    recordings = _deal(recordings, part)
    remap = converter.to_carla if classes == "carla" else None
    target = Target(converter.classes, remap, axes == "left", allow_unknown, voxels=grids == "voxels")
    metadata = Metadata(
        axes,
        target.classes,
        converter.sensor,
        converter.min_range_m,
        converter.max_range_m,
        f"{name if isinstance(name, str) else name.__name__} {root.name}",
        _provenance(converter),
    )
    plans = [
        plan_recording(recording, converter, sink, poses, flow=flow == "auto", force=force) for recording in recordings
    ]
    for plan in plans:
        _check_grids(plan, grids)
        check_voxel_grid(plan, target)
    steps = Steps(progress, sum(len(plan.recording.frames) for plan in plans))
    done: list[Conversion] = []
    made: list[RegridResult] = []
    with one_pool(run) as pooled:
        pool = pooled.executor
        with ExitStack() as writers:
            for plan in plans:
                writers.enter_context(plan.writer)
                done.append(Conversion(plan, converter, target, workers, pool, steps))
                done[-1].run(metadata)
        failures = [failure for conversion in done for failure in conversion.failures]
        notes = [note for conversion in done for note in conversion.notes]
        if sink is not out:
            sink.finish(incomplete=True)  # what is missing could not be read, and is reported
        if grids == "scans":
            regridding = Regridding(spec, observe, voting, follow_ground, force, workers, pool, steps)
            fitted, remarks = regridding.fit(done, sink.location)
            notes += remarks
            made = [regridding.run(conversion, fitted, sink) for conversion in done]
            if sink is not out:
                sink.finish(incomplete=True)
    for result in made:
        notes += result.notes
        failures += [Failure(f.sequence, f.frame, f.message) for f in result.failures]
    return ConvertResult(
        tuple(sink.place(sequence_path(plan.recording)) for plan in plans),
        sum(conversion.made for conversion in done),
        sum(len(plan.recording.frames) - len(plan.unfinished) for plan in plans),
        tuple(failures),
        tuple(path for result in made for path in result.grids),
        tuple(notes),
        time.perf_counter() - start,
    )


def _provenance(converter: type[Converter]) -> dict[str, Any]:
    """Return what carlasc.json says of the data that a sequence was made from, as far as the converter knows it."""
    said = {"license": converter.license, "citation": converter.citation, "simulated": converter.simulated or None}
    return {key: value for key, value in said.items() if value is not None}


def _deal(recordings: Sequence[Recording], part: Part) -> list[Recording]:
    """Return the recordings of a part: those whose middle frame is among its share of all frames."""
    if part.count == 1:
        return list(recordings)
    ends = np.cumsum([len(recording.frames) for recording in recordings])
    middles = ends - np.array([len(recording.frames) for recording in recordings]) / 2
    shares = np.minimum(middles * part.count // max(ends[-1], 1), part.count - 1)
    return [recording for recording, share in zip(recordings, shares, strict=True) if share == part.number - 1]


def _check(converter: type[Converter], **given: str) -> None:
    allowed: dict[str, tuple[str, ...]] = {
        "classes": ("carla", converter.classes.name),
        "axes": get_args(Axes),
        "grids": get_args(Grids),
        "split": get_args(SplitName),
        "poses": get_args(PoseSource),
        "flow": get_args(Flow),
    }
    for option, value in given.items():
        if value not in allowed[option]:
            raise ArgumentError(option, expected=f"one of {', '.join(allowed[option])}", found=repr(value))


def _check_grids(plan: RecordingPlan, grids: Grids) -> None:
    if grids == "scans" and not plan.recording.rays:
        raise ArgumentError(
            "grids",
            expected="voxels or none",
            found=f"scans for {plan.recording.location}",
            advice="nobody knows where its points were seen from, so free space cannot be told from unknown space",
        )


def _check_sink(source: Path, sink: Sink, grids: Grids) -> None:
    target = getattr(sink, "target", None)
    if isinstance(target, LocalTarget):
        check_outside(target.folder, str(source))
    if grids == "scans" and not sink.is_readable:
        raise ArgumentError(
            "grids",
            expected=f"none with {sink.location}, which cannot be read while it is written",
            found=grids,
            advice="convert to a folder or a .zarr store",
        )
