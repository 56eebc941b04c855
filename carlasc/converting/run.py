"""`convert`: writes each recording of another data set as a sequence of the layout, and makes grids
from these sequences.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from collections.abc import Sequence as Series
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from carlasc.converting.assembling import LayoutOptions
from carlasc.converting.plans import SplitName, choose_recordings, plan_recording, sequence_path
from carlasc.converting.protocol import Converter, Failure, Recording, check_outside
from carlasc.converting.registry import find_recordings, open_converter
from carlasc.converting.sources import SourceFiles
from carlasc.converting.stages import Conversion
from carlasc.core.choices import CompareInputs
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, MissingDataError, check_choice, check_types
from carlasc.groundtruth.options import FromScans, GridOptions, Voting, fit_to_ground
from carlasc.groundtruth.run import regrid
from carlasc.inspection.findings import Finding
from carlasc.motion.ground import Ground, joined
from carlasc.motion.options import PoseOptions
from carlasc.running.processes import one_pool
from carlasc.running.spreading import Part, Run, StepCounter
from carlasc.storage.files import AnyPath
from carlasc.storage.layout import Metadata
from carlasc.storage.opening import as_sink
from carlasc.storage.protocol import Sequence, Sink, Source
from carlasc.storage.transport.remote_tree import check_shared
from carlasc.storage.transport.trees import LocalTarget

Grids = GridOptions | Literal["voxels"] | None
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
    compare_inputs: CompareInputs = "fast",
    allow_gaps: bool = False,
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
        layout: how sequences are written: their classes, their axes, and whether they get flow.
        poses: where poses come from, and whether poses are accepted if scans do not overlap under
            them, or if a calibration is missing.
        grids: the grids that are made from scans merged over time; "voxels" takes the data set's
            own voxels, with count 0 where they are unknown; None writes no grids.
        options: options of the converter, by name; text is parsed as the type of the option (see
            `option_declarations`).
        compare_inputs: how it is found out whether the data set changed: "fast": by the names,
            sizes and times of its files; "content": all frames are made again and compared;
            "never": existing frames are kept.
        allow_gaps: finish frames that take labels, motion or votes from a frame that failed.
            Otherwise they wait until it is repaired.
        run: how the work is spread. A part converts whole recordings, because poses and motion are
            estimated along each of them. Grids then keep their height, because the ground of the
            other recordings is not known.

    Returns:
        What was written, what was skipped, and what failed.

    Raises:
        ArgumentError: an argument has a wrong value, or no converter has that name.
        MissingDataError: `source`, a sequence or the poses do not exist.
        FormatError: poses or times do not fit the frames, or the scans.
        ConflictError: `out` lies inside `source`, or holds other data.
        StorageError: the output cannot be written. The files written so far are complete.
    """
    check_types(convert, locals())
    start = time.perf_counter()
    root = Path(source)
    converter = open_converter(name, root, options)
    target, sink = layout.of(converter), as_sink(out, part=run.part)
    check_shared(sink.location, run)
    _check(root, sink, split, grids, run.part)

    check_choice("compare_inputs", compare_inputs, CompareInputs)
    found = find_recordings(converter)
    recordings = choose_recordings(found, root, sequences, split)
    recordings = _deal(recordings, run.part)
    if isinstance(grids, GridOptions):
        _check_rays(recordings)
    has_flow, has_voxels = layout.flow == "auto", isinstance(grids, str)
    plans = []
    for one in recordings:
        planned = plan_recording(
            one,
            converter,
            sink,
            target,
            poses,
            frames=FrameRange.of(frames),
            level=layout.level,
            flow=has_flow,
            voxels=has_voxels,
        )
        plans.append(planned)
    sources = SourceFiles.of(root, found, options, compare_inputs)
    records = [sources.begin(plan) for plan in plans]
    origin = f"{name if isinstance(name, str) else name.__name__} {root.name}"
    ranges = converter.min_range_m, converter.max_range_m
    said = {name: getattr(converter, name) for name in ("license", "citation", "simulated")}
    known = {key: value for key, value in said.items() if value not in (None, False)}
    metadata = Metadata(layout.axes, target.classes, converter.sensor, *ranges, origin, known)

    steps = StepCounter(run.progress, sum(len(plan.recording.frames) for plan in plans))
    with one_pool(run) as pooled:
        conversions = [
            Conversion(plan, converter, target, layout.images, pooled, steps, allow_gaps)
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
            alone = replace(pooled, part=Part(), progress=steps.stage())
            # without the motion that some frames wait for, grids would be made in another way
            converted = [one for one in conversions if one.has_scans and not one.waits]
            if converted:  # otherwise every frame failed, and is reported
                scans = _ConvertedScans(sink, converted)
                spec, observe, cut = _plan_grids(grids, converted, scans, poses)
                voting = grids.voting or Voting()
                made = regrid(
                    scans,
                    spec,
                    out,
                    observe=observe,
                    voting=voting,
                    compare_inputs=compare_inputs,
                    run=alone,
                )
                made = replace(made, notes=(*cut, *made.notes))

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


class _ConvertedScans(Source):
    """The sequences that some conversions wrote to a sink."""

    def __init__(self, sink: Sink, conversions: Series[Conversion]) -> None:
        self.location, self._source = sink.location, sink.source()
        self._chosen = {sequence_path(one.plan.recording): one for one in conversions}

    def sequences(self) -> dict[str, Sequence]:
        found = self._source.sequences()
        chosen = {path: found[path] for path in found if path in self._chosen}
        for path, sequence in chosen.items():
            conversion = self._chosen[path]
            sequence.awaited = frozenset() if conversion.allow_gaps else conversion.failed
        return chosen


def _plan_grids(
    grids: GridOptions, conversions: Series[Conversion], scans: Source, poses: PoseOptions
) -> tuple[GridSpec, FromScans, list[str]]:
    """Return the grid of the converted sequences, how scans are merged, and notes for the user.

    All grids have the same bounds, so that they can be in one training set: the bounds of the
    options, moved to the height of the ground if `follow_ground` is set.
    """
    spec, notes = grids.spec or GridSpec.published(), list[str]()
    if grids.follow_ground:
        spec, notes = _fit(
            spec, [one.ground for one in conversions if one.ground is not None], scans.location
        )
    observe = replace(
        grids.observe if isinstance(grids.observe, FromScans) else FromScans(),
        poses=replace(poses, source="file"),
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


def _check(source: Path, sink: Sink, split: str, grids: Grids, part: Part) -> None:
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
                found=str(grids.observe),
            )
        if not sink.is_readable:
            raise ArgumentError(
                "grids",
                expected=f"none with {sink.location}, which cannot be read while it is written",
                found="scans",
                advice="convert to a folder or a .zarr store",
            )
        if part.count > 1 and grids.follow_ground:
            raise ArgumentError(
                "follow_ground",
                expected="False, or `grids=None`, because a part does not know the ground of all "
                "recordings",
                found="True",
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
