"""`carlasc.map`: the map of a drive, or of a recording, which is converted first."""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from carlasc.converting.protocol import Failure, check_outside
from carlasc.converting.registry import (
    find_recordings,
    load_converter,
    open_converter,
    readers_of,
)
from carlasc.converting.run import convert, source_states
from carlasc.core.frames import FrameRange, Frames
from carlasc.errors import ArgumentError, CarlascError, MissingDataError, check_types, only
from carlasc.groundtruth.maps.map_files import MapFiles
from carlasc.groundtruth.maps.mapping import with_neighbours, write_grid, write_map
from carlasc.inspection.findings import Finding
from carlasc.motion.options import MotionOptions, PoseOptions
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import as_source, layout
from carlasc.storage.derived_copies import check_complete
from carlasc.storage.files import AnyPath, remove_stale_of
from carlasc.storage.folder import FolderWriter
from carlasc.storage.inputs import MadeFrom, combined, sequence_states
from carlasc.storage.protocol import Source
from carlasc.storage.transport.trees import is_url

_LEAST_CELL_M = 0.001  # smaller cells are finer than float32 positions
_ANY_LIDAR = "scans"  # the converter of bare scans, which may also read folders of other data sets


@dataclass(frozen=True)
class MapExtras:
    """What is written beside a map.

    Attributes:
        actors: also write the body of each moving actor, in its own frame, to the folder
            OUT_actors, and their poses to actors.json.
        mesh: file of the surface of the occupied cells, with classes as colours: .ply or .glb.
        distance: with `grid`: .npz file of the distance of each voxel from the surface.
        trajectory: file of the pose of the sensor in the map at each scan, in the format of TUM:
            seconds since the first frame, position, quaternion x, y, z, w.
        boxes_out: .csv, .json or .parquet file of the boxes of the moving actors: one row per
            actor and scan, in the frame of the map.
    """

    actors: bool = False
    mesh: AnyPath | None = None
    distance: AnyPath | None = None
    trajectory: AnyPath | None = None
    boxes_out: AnyPath | None = None

    def __post_init__(self) -> None:
        check_types(MapExtras, vars(self))


@dataclass(frozen=True)
class RecordingOptions:
    """How a recording is read that is no data set of the layout.

    Attributes:
        converter: name of its converter, such as bag or scans, whose options are then options of
            this command, too. Default: the one that can read it.
        keep: folder for the converted recording, which is kept.
        options: options of the converter, by name.
    """

    converter: str | None = None
    keep: AnyPath | None = None
    options: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        check_types(RecordingOptions, vars(self))


@dataclass(frozen=True)
class MapResult:
    """The result of `map`.

    Attributes:
        files: the files, and the folder of actors.
        points: number of points, or of occupied voxels.
        frames: number of scans; 1 for a grid.
        actors: number of actors whose bodies were written.
        parked: number of parked actors that were left out, as they are gone in another pass.
        failures: scans of a recording that could not be read, and are not in the map.
        notes: remarks on the results, one line each.
        findings: what is probably wrong with a recording.
        elapsed_s: duration, in seconds.
    """

    files: tuple[str, ...]
    points: int
    frames: int
    actors: int
    parked: int
    failures: tuple[Failure, ...]
    notes: tuple[str, ...]
    findings: tuple[Finding, ...]
    elapsed_s: float


def map(
    source: AnyPath | Source,
    out: AnyPath | None = None,
    *,
    cell_m: float = 0.05,
    frames: Frames = None,
    grid: str | None = None,
    extras: MapExtras = MapExtras(),
    recording: RecordingOptions = RecordingOptions(),
    motion: MotionOptions = MotionOptions(),  # noqa: B008 (frozen)
    poses: PoseOptions = PoseOptions(),  # noqa: B008 (frozen)
    keep_parked: bool = False,
    overwrite: bool = False,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> MapResult:
    """Write a map of a drive: the static points of its scans in one frame, one point per cell,
    without moving points.

    The frame is that of the drive's poses, in right-handed axes: x ahead, y to the left, z up, at
    the first scan. Each point is the mean of the points in its cell. Its class has the most votes,
    one vote per scan; `seen` is the number of scans; `confidence` is the share of the votes for the
    class with one more vote against it: 0.5 for a cell that one scan saw. Moving points are found
    as in `regrid`. With `grid`, the map is a grid of one frame instead, in the frame of its sensor.

    A recording is converted first, as by `convert`, into a hidden folder beside the map, which also
    keeps refined poses and found actors. After an interruption, the same call continues there; the
    folder is removed when the map is written.

    Args:
        source: a data set with one sequence: anything that `carlasc.open` takes, or a source; or
            one recording that a converter reads: a bag, a folder of scans, a sequence of KITTI.
        out: the file of the map: .ply, .pcd, .las or .npz (points), or .bt (OctoMap). None: only
            the extra files.
        cell_m: size of a cell, in metres: one point is written per cell. A grid has its own cells.
        frames: range of frame numbers; None for all. Moving actors are searched for in a few more
            seconds. With `grid`, one frame.
        grid: make the map from this grid of one frame, instead of the scans.
        extras: what is written beside the map.
        recording: how a recording is read.
        motion: how moving points are found.
        poses: where poses come from. Missing poses are estimated from the scans, unless
            `PoseOptions("file")` is given.
        keep_parked: keep vehicles that stand there in one pass of a place and not in another one.
        overwrite: replace existing files.
        run: how the work is spread. Steps of progress are scans.

    Returns:
        The files that were written.

    Raises:
        ArgumentError: an ending that is not known, cells that OctoMap cannot hold, several drives,
            or an argument that does not fit.
        MissingDataError: there is no scan, no pose, no such grid, or nothing static.
        ConflictError: a file exists.
        CompleteError: the files of this call exist.
        FormatError: a scan, poses or times are not valid.
        DependencyError: a file needs a package that is not installed, or poses have to be
            estimated, and kiss-icp is not installed.
        StorageError: a file cannot be written.
    """
    check_types(map, locals())
    began = time.perf_counter()
    if not (math.isfinite(cell_m) and cell_m >= _LEAST_CELL_M):
        raise ArgumentError("cell_m", expected=f"{_LEAST_CELL_M:g} metres or more", found=cell_m)
    if run.part.count > 1:
        raise ArgumentError("part", expected="none, as a map is one file", found=run.part)
    given_files = {name: path for name, path in vars(extras).items() if name != "actors"}
    files = MapFiles.of({"out": out, **given_files}, extras.actors, grid)
    wanted = FrameRange.of(frames)
    keep = recording.keep
    options = recording.options
    root = None
    reader = None
    if (
        isinstance(source, Source)
        or (reader := recording.converter or _reader_of(source, grid)) is None
    ):
        if keep is not None or options:
            given = "keep" if keep is not None else "options"
            raise ArgumentError(given, expected="a recording to convert", found=f"{source}")
        drive = as_source(source)
        states = sequence_states(drive, *([f"{grid}/labels", f"{grid}/counts"] if grid else []))
    else:
        root = Path(source)
        try:
            recordings = find_recordings(open_converter(reader, root, options))
        except ArgumentError as error:  # of an option that `carlasc map` has only then
            if recording.converter is None:
                error.advice += f', with `converter="{reader}"`'
            raise
        only(
            "source",
            {one.location: one for one in recordings},
            "one recording, as a map has one frame",
        )
        of_places = source_states(root, recordings, options)
        states = {name: state for of in of_places.values() for name, state in of.items()}
    first = files.all[0]
    settings = (cell_m, str(wanted), grid, [str(path) for path in files.all])
    record = MadeFrom(combined(settings, motion, poses, keep_parked, sorted(states.items())))
    keeper = FolderWriter(first.parent)
    kept = f"map-{first.name}"
    is_ours = MadeFrom.read(keeper, kept) == record
    place = first.parent / layout.DERIVED
    place /= f"recording-{first.name}"
    for path in (first, first.parent / layout.record_file(kept)):
        remove_stale_of(path)
    if not overwrite and all(path.exists() for path in files.all):
        if is_ours:  # a run that was killed at its end leaves it
            shutil.rmtree(place, ignore_errors=True)
        check_complete(first, is_ours)
    files.check(overwrite or is_ours)
    if not overwrite:  # so that the next run continues one that is killed
        files = replace(files, begin=lambda: record.write(keeper, kept))

    made = None
    steps = StepCounter(run.progress)
    if root is not None and reader is not None:
        check_outside(first, str(root))
        made = convert(
            reader,
            root,
            place if keep is None else keep,
            frames=with_neighbours(wanted),
            poses=poses,
            grids=None,
            options=options,
            run=replace(run, progress=steps.stage()),
        )
        if not made.made + made.skipped:
            if keep is None:
                shutil.rmtree(place)
            raise MissingDataError(
                root,
                expected="scans with points that can be read",
                found=f"none of {len(made.failures)}",
                advice=" ".join(str(failure.message) for failure in made.failures[:1]),
            )
        drive = as_source(made.sequences[0])
        poses = replace(poses, source="file")
    try:
        if grid is None:
            spread = replace(run, progress=steps.stage())
            writer = FolderWriter(place)
            content = write_map(
                drive, files, wanted, cell_m, motion, poses, keep_parked, writer, spread
            )
        else:
            content = write_grid(drive, grid, wanted, files)
    except CarlascError as error:
        if made is not None and keep is None:  # a hidden folder says nothing to the user
            error.where = error.where.replace(made.sequences[0], str(root))
        raise
    record.write(keeper, kept)
    notes = (*(made.notes if made else ()), *content.notes)
    shutil.rmtree(place, ignore_errors=True)
    if made is not None and keep is None:
        notes = tuple(note.replace(made.sequences[0], str(root)) for note in notes)
    return MapResult(
        tuple(str(path) for path in files.all),
        content.points,
        content.frames,
        content.actors,
        content.parked,
        made.failures if made else (),
        notes,
        made.findings if made else (),
        time.perf_counter() - began,
    )


def _reader_of(source: AnyPath, grid: str | None) -> str | None:
    """Return the name of the converter that reads a recording; None for a data set with scans, or
    with grids if a grid is asked for.

    Raises:
        ArgumentError: several converters can read it.
    """
    if grid is not None or is_url(os.fspath(source)):
        return None
    try:
        if any(len(sequence.frames("points")) for sequence in as_source(source).values()):
            return None
    except CarlascError:
        if not Path(source).exists():
            raise
    names = readers_of(Path(source))
    names = [name for name in names if name != _ANY_LIDAR] or names
    if len(names) > 1:
        raise ArgumentError(
            "converter",
            expected=f"the converter of {source}",
            found="none given, and several that can read it: " + ", ".join(names),
        )
    if names:
        return names[0]
    place = Path(source)  # what cannot be read says what it expects
    bags = load_converter("bag").endings
    is_bag = place.is_file() or any(path.name.endswith(bags) for path in place.iterdir())
    return "bag" if is_bag else _ANY_LIDAR
