"""`convert`: writes each recording of another data set as a sequence of the layout, and makes grids
from these sequences.
"""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Mapping
from collections.abc import Sequence as Series
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from carlasc.converting.assembling import LayoutOptions
from carlasc.converting.clips import convert_clips
from carlasc.converting.plans import (
    CONVERSION,
    KISS_ICP,
    RecordingPlan,
    SplitName,
    choose_recordings,
    is_provisional,
    plan_recording,
    sequence_path,
)
from carlasc.converting.protocol import Converter, Failure, Recording, check_outside
from carlasc.converting.registry import find_recordings, open_converter
from carlasc.converting.stages import Conversion
from carlasc.core.choices import CompareInputs
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, MissingDataError, check_choice, check_types, only
from carlasc.groundtruth.inputs import remove_provisional
from carlasc.groundtruth.options import FromScans, GridOptions, Voting, fit_to_ground, fit_to_reach
from carlasc.groundtruth.run import regrid
from carlasc.inspection.findings import Finding
from carlasc.motion.box_table import ONE_FRAME
from carlasc.motion.ground import Ground, joined
from carlasc.motion.options import PoseOptions
from carlasc.running.processes import one_pool
from carlasc.running.spreading import Part, Run, StepCounter, check_shared
from carlasc.storage.files import AnyPath
from carlasc.storage.inputs import (
    PROVISIONAL,
    MadeFrom,
    changed_names,
    combined,
    folder_states,
    made_again,
)
from carlasc.storage.layout import METADATA, Metadata, place_of
from carlasc.storage.opening import as_sink
from carlasc.storage.protocol import Sequence, Sink, Source
from carlasc.storage.transport.trees import LocalTarget

Grids = GridOptions | Literal["voxels"] | None
_GAP = "gap"  # in the record: a frame that failed, and others were finished without it
_UNKNOWN = "there was no record of what frames were made from, so all were compared"
_LOOKED_AT = (
    3  # number of sequences, and of scans of each, in which points outside of the grid are counted
)
_MANY = 0.05  # share of the points between the sides of a grid: more points above it give a note


@dataclass(frozen=True)
class ConvertResult:
    """The result of `convert`.

    Attributes:
        sequences: locations of the sequences that were written.
        made: number of frames that were converted.
        skipped: number of frames that existed before.
        failures: frames that could not be converted, or whose grid could not be made.
        grids: locations of the grids that were made from scans.
        notes: remarks about the result, one line each.
        findings: what is probably wrong; carlasc.json of each sequence has them, too.
        elapsed_s: duration in seconds.
    """

    sequences: tuple[str, ...]
    made: int
    skipped: int
    failures: tuple[Failure, ...]
    grids: tuple[str, ...]
    notes: tuple[str, ...]
    findings: tuple[Finding, ...]
    elapsed_s: float


def convert(
    name: str | type[Converter],
    source: AnyPath,
    out: AnyPath | Sink,
    *,
    sequences: Collection[str] | None = None,
    frames: Frames = None,
    split: SplitName = "all",
    layout: LayoutOptions = LayoutOptions(),  # noqa: B008 (frozen)
    poses: PoseOptions = PoseOptions(),  # noqa: B008 (frozen)
    grids: Grids = GridOptions(),  # noqa: B008 (frozen)
    options: Mapping[str, Any] | None = None,
    scratch: str = "20GB",
    run: Run = Run(),  # noqa: B008 (frozen)
) -> ConvertResult:
    """Write another data set as sequences of the CarlaSC layout: the same files, axes and classes;
    then make their grids, as `regrid` does.

    A second run skips the frames that exist, unless files of the data set changed since then: the
    frames of the recordings that may have been read from these are made again, and those that
    differ are replaced. A frame that cannot be read is reported in the result,
    and the others are converted. Worker processes import the main module again: scripts call this
    under `if __name__ == "__main__":`, or with `run=Run(workers=1)`.

    Args:
        name: the converter: "kitti", "argoverse2", ..., or one of another distribution (see
            `converter_names`); or a class that inherits `Converter`.
        source: folder of the data set, or of one of its sequences.
        out: where to write: a folder or a `.zarr` store, on this machine or in an object store; or
            any Sink, with grids if it can be read while it is written.
        sequences: which ones, by their names or the last part of them ("00"); None converts all.
        frames: numbers of the frames to convert, of every sequence; None converts all.
        split: "train", "val" or "test": only sequences of this split; "all" converts every split.
        layout: how sequences are written: their classes, their axes, whether they get flow, and
            how changes of the data set are noticed.
        poses: where poses come from, and whether poses are accepted if scans do not overlap under
            them, or if a calibration is missing.
        grids: the grids that are made from scans merged over time; "voxels" takes the data set's
            own voxels, with count 0 where they are unknown; None writes no grids.
        options: options of the converter, by name; text is parsed as the type of the option (see
            `option_declarations`).
        scratch: with a list of clips: largest size of what is fetched and not deleted yet.
        run: how the work is spread. A part converts whole recordings, because poses and motion are
            estimated along each of them. Grids then keep their height, because the ground of the
            other recordings is not known. `sequences_from` lists clips, each with recordings of its
            own: URLs, or paths below `source`. Each is fetched, converted, and deleted; one that
            fails is reported, and tried again by the next call.

    Returns:
        What was written, what was skipped, and what failed.

    Raises:
        ArgumentError: an argument has a wrong value, or no converter has that name.
        MissingDataError: `source`, a sequence or the poses do not exist.
        FormatError: poses or times do not fit the frames, or the scans.
        ConflictError: `out` lies inside `source`, or holds other data.
        StorageError: the output cannot be written. The files written so far are complete.
    """
    arguments = dict(locals())
    check_types(convert, arguments)
    start = time.perf_counter()
    if run.is_share and isinstance(grids, GridOptions) and grids.follow_ground:
        raise ArgumentError(
            "follow_ground",
            expected="False, or `grids=None`, because a part does not know the ground of all "
            "recordings",
            found="True",
        )
    if run.sequences_from is not None and layout.boxes is not None:
        raise ArgumentError("boxes", expected="one recording", found="a list of clips")
    if run.sequences_from is not None and not isinstance(out, Sink):
        places = {"source", "out", "run", "scratch"}
        given = {key: arguments[key] for key in sorted(arguments.keys() - places)}
        results = convert_clips(convert, source, out, given, scratch, run)
        return _joined(results, time.perf_counter() - start)
    root = Path(source)
    converter = open_converter(name, root, options)
    target = layout.of(converter)
    sink = as_sink(out, part=run.part)
    check_shared(sink.location, run)
    check_arguments(root, sink, split, grids)
    compare = layout.compare_inputs
    found = find_recordings(converter)
    every = choose_recordings(found, root, sequences, split)
    if layout.boxes is not None:
        only("boxes", {one.name: one for one in every}, ONE_FRAME)
    recordings = _deal(every, run.part)
    if isinstance(grids, GridOptions):
        _check_rays(recordings)
    has_voxels = isinstance(grids, str)
    chosen = FrameRange.of(frames)
    plans = []
    for one in recordings:  # in Python 3.11, a comprehension is a level of calls
        planned = plan_recording(
            one, converter, sink, layout, poses, frames=chosen, voxels=has_voxels
        )
        plans.append(planned)
    if isinstance(grids, GridOptions) and isinstance(grids.observe, FromScans):
        for plan in plans:
            plan.max_range_m = grids.observe.max_range_m
    read = {**(options or {}), "boxes": layout.boxes}
    states = None if compare == "never" else source_states(root, found, read)
    records = []
    for plan in plans:
        own = None if states is None else states[None] | states.get(plan.recording.location, {})
        records.append(_ConvertedFrom(plan, own))
        records[-1].begin(compare)
    metadata = describe(converter, name, layout)

    scans = sum(len(plan.recording.frames) for plan in plans)
    in_grids = scans if isinstance(grids, GridOptions) else 0
    steps = StepCounter(run.progress, scans + in_grids)
    with one_pool(run) as pooled:
        conversions = [
            Conversion(plan, converter, target, layout.images, pooled, steps, layout.allow_gaps)
            for plan in plans
        ]
        with ExitStack() as writers:
            for conversion in conversions:
                writers.enter_context(conversion.plan.writer)
                conversion.run(metadata)
            for conversion, record in zip(conversions, records, strict=True):
                record.finish(conversion)
        if sink is not out:
            sink.finish(incomplete=True)  # missing frames could not be read, and are reported
        made = None
        if isinstance(grids, GridOptions):
            alone = replace(pooled, part=Part(), progress=steps.stage(in_grids))
            # without the motion that some frames wait for, grids would be made in another way
            converted = [one for one in conversions if one.has_scans and not one.waits]
            if converted:  # otherwise every frame failed, and is reported
                written = _ConvertedScans(sink, converted)
                spec, observe, cut = plan_grids(grids, converted, written, poses)
                voting = grids.voting or Voting()
                made = regrid(
                    written,
                    spec,
                    out,
                    observe=observe,
                    voting=voting,
                    compare_inputs=compare,
                    run=alone,
                )
                made = replace(made, notes=(*cut, *made.notes))
                for sequence in written.values():
                    remove_provisional(sink.sequence(sequence.path), sequence)

    failures = [failure for conversion in conversions for failure in conversion.failures]
    notes = [note for record in records for note in record.notes]
    notes += [note for conversion in conversions for note in conversion.notes]
    if made is not None:
        failures += [Failure(one.sequence, one.frame, one.message) for one in made.failures]
        notes += made.notes
    return ConvertResult(
        tuple(sink.place(sequence_path(recording)) for recording in recordings),
        sum(conversion.made for conversion in conversions),
        sum(conversion.skipped for conversion in conversions),
        tuple(failures),
        () if made is None else made.grids,
        tuple(notes),
        tuple(finding for plan in plans for finding in plan.findings),
        time.perf_counter() - start,
    )


def describe(converter: Converter, name: str | type[Converter], layout: LayoutOptions) -> Metadata:
    """Return the entries of carlasc.json that all recordings of a converter share."""
    origin = f"{name if isinstance(name, str) else name.__name__} {converter.source.name}"
    ranges = converter.min_range_m, converter.max_range_m
    said = {name: getattr(converter, name) for name in ("license", "citation", "simulated")}
    known = {key: value for key, value in said.items() if value not in (None, False)}
    classes = layout.of(converter).classes
    return Metadata(layout.axes, classes, converter.sensor, *ranges, origin, known)


def _joined(results: Series[ConvertResult | Failure], elapsed_s: float) -> ConvertResult:
    """Return the result of several clips, some of which failed as a whole."""
    whole = [one for one in results if isinstance(one, ConvertResult)]
    values: dict[str, Any] = {"elapsed_s": elapsed_s}
    for name in ("made", "skipped"):
        values[name] = sum(getattr(one, name) for one in whole)
    for name in ("sequences", "failures", "grids", "notes", "findings"):
        values[name] = tuple(value for one in whole for value in getattr(one, name))
    values["failures"] += tuple(one for one in results if isinstance(one, Failure))
    return ConvertResult(**values)


@dataclass
class _ConvertedFrom:
    """The states of the files that a recording is converted from, and their record.

    A frame may depend on any file of its recording, because tracks and estimated poses reach over
    all scans, and a converter reads files in its own way. So after a change, all frames of the
    recordings that may have been read from the changed files are made again, and those that differ
    are written.

    Attributes:
        plan: the recording and its output.
        states: the states of its folders now; None if they are not recorded.
        notes: what was made again, and why, one line each.
    """

    plan: RecordingPlan
    states: Mapping[str, str] | None
    notes: list[str] = field(default_factory=list)

    def begin(self, compare: CompareInputs) -> None:
        """Compare the files with those that an earlier output was made from; if they differ, all
        frames are made again.
        """
        plan = self.plan
        states = self.states
        self._before = before = MadeFrom.read(plan.writer, CONVERSION)
        if is_provisional(plan.writer):
            plan.make_again(is_same=True)
            plan.writer.remove_document(METADATA)  # may name another source of poses
            return
        if states is None:
            return
        exists = bool(before.own) or len(plan.missing) < len(plan.recording.frames)
        is_other = before.own != states or _GAP in before.frames.values()
        if exists and (compare == "content" or is_other):
            plan.make_again(is_same=bool(before.own.items() & states.items()))
        else:
            self._write(())

    def finish(self, conversion: Conversion) -> None:
        """Write the record, after the frames were written."""
        if self.plan.again:
            before = self._before
            where = self.plan.writer.location
            conversion.remove_others(map(int, before.frames))
            if before.whole == PROVISIONAL:
                why = "they were provisional"
            else:
                why = changed_names(before.own, self.states or {}) if before.own else _UNKNOWN
            if conversion.changed or why == _UNKNOWN:
                self.notes.append(f"{where}: {made_again(conversion.changed, why)}")
        has_gaps = conversion.allow_gaps or self.plan.pose_source == KISS_ICP
        self._write(conversion.failed if has_gaps else ())

    def _write(self, gaps: Collection[int]) -> None:
        """Write the record of the states of now, unless they are not recorded."""
        if self.states is not None:
            own = dict(self.states)
            numbers = self.plan.recording.frame_numbers
            frames = {str(number): _GAP if number in gaps else "done" for number in numbers}
            MadeFrom(combined(sorted(own.items())), own, frames).write(self.plan.writer, CONVERSION)
        elif self._before.whole == PROVISIONAL:
            MadeFrom().write(self.plan.writer, CONVERSION)


def source_states(
    root: Path, recordings: Series[Recording], options: Mapping[str, Any] | None
) -> dict[str | None, dict[str, str]]:
    """Return the states of the folders of a data set, and of files that options name, by the
    location of the recording that they belong to; by None if they may belong to all.
    """
    places = {"": root}
    for name, value in (options or {}).items():
        if isinstance(value, str | os.PathLike) and str(value) and Path(value).exists():
            places[f"--{name}"] = Path(value)
    owners = {
        Path(one.location).relative_to(root).as_posix(): one.location
        for one in recordings
        if Path(one.location).is_relative_to(root) and Path(one.location) != root
    }
    states: dict[str | None, dict[str, str]] = {None: {}}
    for name, state in folder_states(places).items():
        above = [str(place) for place in (Path(name), *Path(name).parents)]
        owner = next((owners[place] for place in above if place in owners), None)
        states.setdefault(owner, {})[name] = state
    return states


class _ConvertedScans(Source):
    """The sequences that some conversions wrote to a sink."""

    def __init__(self, sink: Sink, conversions: Series[Conversion]) -> None:
        self.location = sink.location
        self._source = sink.source()
        self._chosen = {sequence_path(one.plan.recording): one for one in conversions}

    def sequences(self) -> dict[str, Sequence]:
        found = self._source.sequences_in([*map(place_of, self._chosen)])
        chosen = {path: found[path] for path in found if path in self._chosen}
        for path, sequence in chosen.items():
            conversion = self._chosen[path]
            sequence.awaited = frozenset(() if conversion.allow_gaps else conversion.failed)
        return chosen


def plan_grids(
    grids: GridOptions, conversions: Series[Conversion], scans: Source, poses: PoseOptions
) -> tuple[GridSpec, FromScans, list[str]]:
    """Return the grid of the converted sequences, how scans are merged, and notes for the user.

    All grids have the same bounds, so that they can be in one training set: the bounds of the
    options, fitted to the ground and to the reach of points if `follow_ground` is set.
    """
    spec = grids.spec or GridSpec.published()
    notes = list[str]()
    if grids.follow_ground:
        reach_m = max(one.reach_m for one in conversions)
        whole = spec
        spec = fit_to_reach(spec, reach_m)
        grounds = [one.ground for one in conversions if one.ground is not None]
        spec, notes = _fit(spec, grounds, scans.location)
        if spec.upper[0] != whole.upper[0]:
            notes.append(
                f"{scans.location}: nearly all points are within {reach_m:.1f} m, so grids reach "
                f"{spec.upper[0]:g} m instead of {whole.upper[0]:g} m to each side, with voxels of "
                f"{spec.voxel_size[0]:.2g} m; give --bounds to keep them"
            )
    poses = replace(poses, source="file") if poses.source == KISS_ICP else poses  # now in poses.txt
    observe = replace(
        grids.observe if isinstance(grids.observe, FromScans) else FromScans(), poses=poses
    )
    return spec, observe, notes + _what_is_cut(spec, scans)


def _fit(spec: GridSpec, grounds: Series[Ground], where: str) -> tuple[GridSpec, list[str]]:
    """Return the grid, moved to the height of the ground, and notes for the user.

    `where` is the output.
    """
    fitted = fit_to_ground(spec, joined(grounds)) if grounds else spec
    if fitted == spec:
        return spec, []
    low, high = (f"{pick(ground.below_m for ground in grounds):.2f}" for pick in (min, max))
    heights = f"the sensor is {low} m" if low == high else f"the sensors are {low} to {high} m"
    return fitted, [
        f"{where}: {heights} above the ground, so grids reach from {fitted.lower[2]:g} to "
        f"{fitted.upper[2]:g} m in z instead of {spec.lower[2]:g} to {spec.upper[2]:g} m; give "
        f"--bounds to keep them"
    ]


def _what_is_cut(spec: GridSpec, source: Source) -> list[str]:
    """Return a note on the points above the grid, if there are many, from a few scans of a few
    sequences.

    Points below the grid are noted where the ground is measured.
    """
    within = above = 0
    for sequence in list(source.values())[:_LOOKED_AT]:
        frames = sequence.frames("points")
        for frame in frames[:: max(len(frames) // _LOOKED_AT, 1)][:_LOOKED_AT]:
            axes = spec.to_axes(sequence.read("points", int(frame))[:, :3])
            heights = axes[((axes >= spec.lower) & (axes < spec.upper))[:, :2].all(axis=1), 2]
            within += len(heights)
            above += int(np.count_nonzero(heights >= spec.upper[2]))
    if above <= _MANY * within:
        return []
    return [
        f"{source.location}: {100 * above / within:.0f}% of the points between the sides of the "
        f"grid are above it (z > {spec.upper[2]:g} m);"
        " scans keep these points; give --bounds for a higher grid"
    ]


def _deal(recordings: Series[Recording], part: Part) -> list[Recording]:
    """Return the recordings of a part: those with their middle frame in its share of all frames."""
    if part.count == 1:
        return list(recordings)
    frames = np.array([len(recording.frames) for recording in recordings])
    middles = np.cumsum(frames) - frames / 2
    shares = np.minimum(middles * part.count // max(frames.sum(), 1), part.count - 1)
    return [recordings[index] for index in np.flatnonzero(shares == part.number - 1).tolist()]


def check_arguments(source: Path, sink: Sink, split: str, grids: Grids) -> None:
    """Check the arguments, before recordings are searched for.

    Raises:
        ArgumentError: a value is not allowed, or does not fit the output.
        ConflictError: the output lies inside the source.
        MissingDataError: the source does not exist.
    """
    check_choice("split", split, SplitName)
    if not (isinstance(grids, GridOptions) or grids in ("voxels", None)):
        raise ArgumentError(
            "grids", expected='GridOptions(...), "voxels" or None', found=repr(grids)
        )
    target = getattr(sink, "target", None)
    if isinstance(target, LocalTarget):
        check_outside(target.folder, str(source))
    if isinstance(grids, GridOptions):
        if not isinstance(grids.observe, FromScans | None):
            raise ArgumentError(
                "observe",
                expected="FromScans(...), because scans are converted",
                found=grids.observe,
            )
        if not sink.is_readable:
            raise ArgumentError(
                "grids",
                expected=f"none with {sink.location}, which cannot be read while it is written",
                found="scans",
                advice="convert to a folder or a .zarr store",
            )
    if not source.exists():
        raise MissingDataError(
            source, expected="a folder", found="nothing", advice="check the path"
        )


def _check_rays(recordings: Series[Recording]) -> None:
    for recording in recordings:
        if not recording.rays:
            raise ArgumentError(
                "grids",
                expected="voxels or none",
                found=f"scans for {recording.location}",
                advice="choose voxels or none: its points have no sensor positions, so free space "
                "cannot be distinguished from unknown space",
            )
