"""A conversion: every recording of another data set becomes a sequence of the layout, frame by frame, side by side."""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

import carlasc
from carlasc.converting.frames import MIRROR, Block, FrameJob, Target, convert_block, scan_fields, write_fields
from carlasc.converting.protocol import Converter, Recording
from carlasc.converting.registry import load_converter
from carlasc.converting.results import ConvertResult, Failure, Progress, Steps
from carlasc.converting.trajectory import (
    KISS_ICP,
    PoseSource,
    check_poses,
    estimate_poses,
    first_line_times,
    read_poses,
)
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, ConflictError, MissingDataError
from carlasc.running.processes import count_workers, run_all
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.folders.folder import FolderSink
from carlasc.storage.metadata import Metadata
from carlasc.storage.protocol import SequenceWriter, Sink

if TYPE_CHECKING:
    from carlasc.groundtruth.options import FromScans
    from carlasc.groundtruth.voting.ballot import VoteRule

Grids = Literal["scans", "voxels", "none"]
Flow = Literal["instances", "none"]
FrameName = Literal["carlasc", "kitti"]
SplitName = Literal["train", "val", "test", "all"]

_BLOCK = 8  # frames that a worker converts in one go


@dataclass
class _Plan:
    """One recording, and where it goes."""

    recording: Recording
    writer: SequenceWriter
    poses: NDArray[np.float64] | None  # right-handed, first_T_sensor; None: to be estimated
    times: NDArray[np.float64]
    fields: tuple[str, ...]
    missing: list[int] = field(default_factory=list)  # indices of frames whose scan is not there yet


def convert(
    name: str,
    src: str | os.PathLike[str],
    out: str | os.PathLike[str] | Sink,
    *,
    sequences: Collection[str] | None = None,
    split: SplitName = "all",
    labels: str = "carla",
    frame: FrameName = "carlasc",
    grids: Grids = "scans",
    spec: GridSpec | None = None,
    merging: FromScans | None = None,
    vote: VoteRule | None = None,
    poses: PoseSource = "auto",
    flow: Flow = "instances",
    allow_unknown: bool = False,
    force: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> ConvertResult:
    """Write another data set as sequences of the layout: the same files, frame and classes.

    A second run skips the frames that are there. A frame that cannot be read is reported in the result and the others go on.
    Work is done in processes that import the main module again: scripts call this under `if __name__ == "__main__":`, or with `workers=1`.

    Args:
        name: the converter: "kitti", "poss", or one of another distribution (`converter_names`).
        src: the data set, or one of its sequences.
        out: folder to write to, or any Sink (then without grids).
        sequences: which ones, by the last part of their names ("00"); all if None.
        split: which ones, by split.
        labels: "carla", or the converter's name to keep the data set's own class ids.
        frame: "carlasc" mirrors y into CarlaSC's left-handed frame; "kitti" keeps the right-handed one.
        grids: "scans": regridded from scans merged over time; "voxels": the data set's own voxels, unknown ones with count 0; "none".
        spec: with "scans": the grid; the published coarse one if None.
        merging: with "scans": which scans are merged, and what becomes of moving points.
        vote: with "scans": how votes are counted.
        poses: "file", "kiss-icp" (estimated from the scans), or "auto": the file where there is one.
        flow: "instances" estimates the velocity of every moving actor from its points; "none" writes no flow. Without labels there is none.
        allow_unknown: take class ids that the table does not know for unlabelled.
        force: go on with poses that do not put the scans on each other, or lack a calibration.
        workers: how many frames are converted side by side; all cores if None.
        executor: does the work instead of processes of our own; it is left open.
        progress: called with the number of finished steps and of all.

    Returns:
        What was written, what was there, what failed.

    Raises:
        ArgumentError: an argument makes no sense, or no converter is called so.
        MissingDataError: there is no such sequence, or no poses.
        FormatError: poses or times do not fit the frames, or the scans.
        ConflictError: `out` lies inside `src`, or holds something else.
        StorageError: the output cannot be written to. What was written is whole.
    """
    start, workers = time.perf_counter(), count_workers(workers)
    converter = load_converter(name)
    _check(name, converter, labels=labels, frame=frame, grids=grids, split=split, poses=poses, flow=flow)
    source = Path(src)
    sink = out if isinstance(out, Sink) else FolderSink(out)
    _check_sink(source, sink, grids)
    recordings = _choose(converter(source).sequences(), source, sequences, split)
    remap = converter.to_carla if labels == "carla" else None
    grid = layout.grid_folder(converter.voxels) if grids == "voxels" and converter.voxels is not None else None
    target = Target(converter.classes, remap, frame == "carlasc", allow_unknown, grid)
    metadata = Metadata(
        "left" if frame == "carlasc" else "right",
        target.classes,
        converter.sensor,
        converter.min_range_m,
        converter.max_range_m,
        f"{name} {source.name}",
    )

    plans = [_plan(recording, converter, sink, poses, flow, force=force) for recording in recordings]
    for plan in plans:
        _check_grid(plan, target, converter)
    steps = Steps(progress, sum(len(plan.recording.frames) for plan in plans))
    failures, notes, made = [], [], 0
    with ExitStack() as writers:
        for plan in plans:
            writers.enter_context(plan.writer)
            _write_documents(plan, target, converter, metadata, steps)
            velocities = _actor_velocities(plan, target, workers, executor, steps)
            without = 0
            blocks = _blocks(plan, target, velocities)
            steps(len(plan.recording.frames) - sum(len(block.jobs) for block in blocks))
            with closing(run_all(convert_block, blocks, workers=workers, executor=executor)) as results:
                for result in results:
                    for number, outputs in result.outputs.items():
                        write_fields(plan.writer, number, outputs)
                    failures += [Failure(plan.recording.location, *failure) for failure in result.failures]
                    without += result.without_flow
                    steps(len(result.block.jobs))
            failed = {f.frame for f in failures if f.sequence == plan.recording.location}
            made += sum(plan.recording.frames[i].number not in failed for i in plan.missing)
            failures += [Failure(plan.recording.location, *problem) for problem in plan.recording.problems()]
            notes += _notes(plan, without, flow)
    grid_paths, more = (
        _regrid(plans, spec, merging, vote, force, workers, executor, steps, failures) if grids == "scans" else ((), [])
    )
    return ConvertResult(
        tuple(plan.writer.location for plan in plans),
        made,
        sum(len(plan.recording.frames) - len(plan.missing) for plan in plans),
        tuple(failures),
        grid_paths,
        tuple(notes + more),
        time.perf_counter() - start,
    )


def _check(name: str, converter: type[Converter], **given: str) -> None:
    allowed: dict[str, tuple[str, ...]] = {
        "labels": ("carla", name),
        "frame": get_args(FrameName),
        "grids": get_args(Grids),
        "split": get_args(SplitName),
        "poses": get_args(PoseSource),
        "flow": get_args(Flow),
    }
    for option, value in given.items():
        if value not in allowed[option]:
            raise ArgumentError(option, expected=f"one of {', '.join(allowed[option])}", found=f"{value!r}")
    if given["grids"] == "voxels" and converter.voxels is None:
        raise ArgumentError(
            "grids", expected="scans or none", found="voxels", advice=f"{name} has no voxel grids of its own"
        )


def _check_sink(source: Path, sink: Sink, grids: Grids) -> None:
    if not isinstance(sink, FolderSink):
        if grids != "none":
            raise ArgumentError(
                "grids",
                expected=f"none with {sink.location}",
                found=f"{grids}",
                advice="convert to a folder, then pack it",
            )
        return
    place, origin = sink.folder.resolve(), source.resolve()
    if place == origin or place.is_relative_to(origin):
        raise ConflictError(
            sink.folder,
            expected=f"a place outside {source}",
            found="one inside it",
            advice="choose another, the source is never written to",
        )


def _choose(
    recordings: list[Recording], source: Path, wanted: Collection[str] | None, split: SplitName
) -> list[Recording]:
    """Return the recordings that are asked for.

    Raises:
        MissingDataError: one is not there, or none is left; says which ones are.
    """
    short = {recording.name.rpartition("_")[2]: recording for recording in recordings}
    if wanted is not None and (unknown := [number for number in wanted if number not in short]):
        raise MissingDataError(
            source, expected=f"the sequences {', '.join(unknown)}", found=f"only {', '.join(short) or 'none'}"
        )
    chosen = [
        recording
        for number, recording in short.items()
        if (wanted is None or number in wanted) and split in ("all", recording.split.lower())
    ]
    chosen = [recording for recording in chosen if recording.frames or recording.problems()]
    if not chosen:
        found = ", ".join(f"{number} ({r.split}, {len(r.frames)} scans)" for number, r in short.items())
        raise MissingDataError(
            source, expected=f"sequences with scans of the split {split}", found=f"{found or 'none'}"
        )
    if empty := [recording for recording in chosen if not recording.frames]:
        raise MissingDataError(f"{empty[0].location}/velodyne", expected="scans", found="none", advice="copy them")
    return chosen


def _plan(
    recording: Recording, converter: type[Converter], sink: Sink, wanted: PoseSource, flow: Flow, *, force: bool
) -> _Plan:
    """Read what stands once in a recording, and check it, before anything is written."""
    writer = sink.sequence(f"{recording.split}/{recording.name}/cartesian")
    poses = read_poses(recording, wanted, force=force)
    if poses is not None and not force and writer.read_document(layout.POSES) is None:
        check_poses(recording, converter, poses)
    fields = scan_fields(labelled=recording.has_labels, flow=flow == "instances" and recording.has_labels)
    missing = [
        index
        for index, handle in enumerate(recording.frames)
        if not all(writer.has(name, handle.number) for name in fields)
    ]
    return _Plan(recording, writer, poses, first_line_times(recording), fields, missing)


def _check_grid(plan: _Plan, target: Target, converter: type[Converter]) -> None:
    from carlasc.storage.resuming import (
        check_grid,  # here: workers import this file, and Numba takes longer than they
    )

    if target.grid is not None:
        frames = [handle.number for handle in plan.recording.frames]
        check_grid(plan.writer, target.grid, _voxel_params(target, converter), frames, overwrite=False)


def _voxel_params(target: Target, converter: type[Converter]) -> dict[str, object]:
    spec = converter.voxels or GridSpec.published()
    record = {"version": carlasc.__version__, "source": "voxels"}
    return spec.to_params(target.classes.num_channels) | {"carlasc": record}


def _write_documents(plan: _Plan, target: Target, converter: type[Converter], metadata: Metadata, steps: Steps) -> None:
    """Write poses, times, carlasc.json and the voxel grid's params.json; estimate poses where there are none.

    Estimated poses that are there already are taken as they are: a second estimate might differ in its last digits.
    """
    from carlasc.storage.resuming import agree_metadata, agree_poses, agree_times

    how = "file" if plan.poses is not None else KISS_ICP
    metadata = Metadata(**{**vars(metadata), "extra": {"poses": how}})
    there = plan.writer.read_document(layout.METADATA)
    before = None if there is None else Metadata.from_json(there, f"{plan.writer.location}/{layout.METADATA}")
    if before is not None and before.extra.get("poses") != how:
        raise ConflictError(
            f"{plan.writer.location}/{layout.METADATA}",
            expected=f"poses from {how}",
            found=f"{before.extra.get('poses', 'others')}",
            advice="write to another place",
        )
    documents = {layout.METADATA: agree_metadata(plan.writer, metadata)}
    estimated = plan.writer.read_document(layout.POSES) if plan.poses is None else None
    if estimated is not None:
        stored = layout.decode_poses(estimated, f"{plan.writer.location}/{layout.POSES}")
        plan.poses = _mirror(stored) if target.mirrored else stored
    elif plan.poses is None:
        steps.expect(len(plan.recording.frames))
        plan.poses = estimate_poses(plan.recording, converter, steps)
    documents[layout.POSES] = agree_poses(plan.writer, _mirror(plan.poses) if target.mirrored else plan.poses)
    documents[layout.TIMES] = agree_times(plan.writer, plan.times)
    if target.grid is not None:
        documents[layout.params_file(target.grid)] = to_json(_voxel_params(target, converter))
    for document, data in documents.items():
        if data is not None:
            plan.writer.write_document(document, data)


def _mirror(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Take poses to the frame with the other handedness: both their frames are mirrored."""
    mirrored: NDArray[np.float64] = MIRROR @ poses @ MIRROR
    return mirrored


def _actor_velocities(
    plan: _Plan, target: Target, workers: int, executor: Executor | None, steps: Steps
) -> dict[int, dict[int, tuple[float, float, float]]] | None:
    """Return the velocity of each moving actor by frame and actor; None where no flow is to be written."""
    if "flow" not in plan.fields:
        return None
    if not plan.missing:
        return {}
    from carlasc.converting.actors import estimate_actor_velocities

    assert plan.poses is not None
    return estimate_actor_velocities(
        plan.recording, plan.poses, plan.times, target.source, workers=workers, executor=executor, steps=steps
    )


def _blocks(
    plan: _Plan, target: Target, velocities: dict[int, dict[int, tuple[float, float, float]]] | None
) -> list[Block]:
    """Return the frames to convert: those that lack a field; all of them where each may have voxels."""
    missing = set(plan.missing)
    jobs = [
        FrameJob(handle, index in missing, None if velocities is None else velocities.get(handle.number, {}))
        for index, handle in enumerate(plan.recording.frames)
        if index in missing or target.grid is not None
    ]
    return [Block(tuple(jobs[i : i + _BLOCK]), target, plan.writer) for i in range(0, len(jobs), _BLOCK)]


def _notes(plan: _Plan, without_flow: int, flow: Flow) -> list[str]:
    notes, where = [], plan.writer.location
    if not plan.recording.has_labels:
        notes.append(f"{where}: scans have no labels: neither labels, instances nor flow were written")
    if without_flow:
        notes.append(
            f"{where}: {without_flow} moving points belong to no numbered actor: their flow is unknown and was left 0"
        )
    gaps = plan.recording.frames[-1].number + 1 - len(plan.recording.frames)
    if gaps:
        notes.append(f"{where}: {gaps} of {gaps + len(plan.recording.frames)} frames have no scan")
    return notes


def _regrid(
    plans: Sequence[_Plan],
    spec: GridSpec | None,
    merging: FromScans | None,
    vote: VoteRule | None,
    force: bool,
    workers: int,
    executor: Executor | None,
    steps: Steps,
    failures: list[Failure],
) -> tuple[tuple[str, ...], list[str]]:
    """Make grids of the converted scans, each frame's from the scans around it in time."""
    from carlasc.groundtruth import FromScans, Voting, regrid

    paths: list[str] = []
    notes: list[str] = []
    for plan in plans:
        folder = Path(plan.writer.location)
        last = 0
        steps.expect(len(plan.recording.frames))

        def advance(done: int, total: int) -> None:
            nonlocal last
            steps(done - last)
            last = done

        result = regrid(
            folder,
            spec or GridSpec.published(),
            folder.parent,
            observe=replace(merging or FromScans(), force=force),
            voting=Voting(vote),
            workers=workers,
            executor=executor,
            progress=advance,
        )
        paths += result.grids
        notes += result.notes
        failures += [Failure(f.sequence, f.frame, f.message) for f in result.failures]
    return tuple(paths), notes
