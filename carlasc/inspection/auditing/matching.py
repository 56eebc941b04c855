"""Pairs of grids and scans: by the names of sequences, and by the numbers or times of frames; and
the pose of a scan in the frame of its grid.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyFloatArray, BoolArray, FloatArray, IntArray, LabelArray
from carlasc.core.benchmarks import (
    CARLAOCC_TO_CARLA,
    TO_OCC3D,
    TO_SSCBENCH,
)
from carlasc.core.classes import ClassTable
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.geometry import Transform, transform_points
from carlasc.core.grids import GridSpec
from carlasc.core.tables import (
    CARLAOCC,
    OCC3D,
    OCCNET,
    OPENOCCUPANCY,
    SSCBENCH_TO_RAW,
    remaps_between,
)
from carlasc.errors import ArgumentError, FormatError, MissingDataError, count, first_names, reading
from carlasc.groundtruth.from_scans.motion_pass import refine_sequence
from carlasc.inspection.reports import inputs_of
from carlasc.metrics.grids import SequenceGrid
from carlasc.metrics.pairs import Place, open_grids
from carlasc.storage import as_source, layout
from carlasc.storage.files import parse_json
from carlasc.storage.layout import identity_of
from carlasc.storage.protocol import Sequence
from carlasc.storage.shares import Share
from carlasc.storage.voxel_files import GridFrames, VoxelFormat, VoxelFrames, is_counted

_SAME_TIME_S = 0.06  # a grid belongs to a scan if their times differ by less; fact: same-time
_HEIGHT_M = 1.8  # height of the sensor above the ground in CarlaSC, used if the recording has none
# table of times beside grids that are named by tokens: lines of a token and seconds
_TIMES = "tokens.txt"


@dataclass(frozen=True)
class MatchedGrids:
    """The grids of a sequence and the scans that belong to them. It pickles into workers.

    Attributes:
        grids: the grids.
        scans: the recording.
        frames: pairs of the number of a grid and the number of its scan, rising.
        absent: frames without a grid, within the span of the grids and at their usual interval.
        notes: what was assumed.
        height_m: height of the sensor above the origin of the grids.
        of_these_poses: whether the grids were made with the poses of the recording.
    """

    grids: GridFrames
    scans: Sequence
    frames: tuple[tuple[int, int], ...]
    absent: tuple[int, ...]
    notes: tuple[str, ...]
    height_m: float
    of_these_poses: bool = False

    @property
    def path(self) -> str:
        """Path of the sequence of the scans."""
        return self.scans.path or self.scans.name

    @property
    def pair(self) -> str:
        """The grids and the scans, for messages."""
        return f"{self.grids.location} with {self.scans.location}"

    @property
    def spec(self) -> GridSpec:
        """Geometry of the grids.

        Raises:
            FormatError: it is not known.
        """
        if self.grids.spec is None:
            raise FormatError(
                self.grids.location,
                expected="grids of known geometry",
                found="a folder without params.json",
                advice="add params.json: docs/format.md#the-record-in-paramsjson",
            )
        return self.grids.spec

    @property
    def axes(self) -> str:
        """Handedness of the grids: "left" or "right", as formats of other benchmarks are."""
        return (
            self.grids.sequence.metadata.axes if isinstance(self.grids, SequenceGrid) else "right"
        )

    @property
    def frame_name(self) -> str:
        """The frame of the grids in words."""
        format = self._format
        place = "the sensor, x forward"
        return f"{place if format is None else format.place}; {self.axes}-handed"

    @property
    def _format(self) -> VoxelFormat | None:
        return self.grids.format if isinstance(self.grids, VoxelFrames) else None

    @cached_property
    def grid_T_scan(self) -> Transform:
        """(4, 4) from the sensor's frame to that of the grids; it may mirror y."""
        matrix: Transform = np.diag(
            [1.0, 1.0 if self.axes == self.scans.metadata.axes else -1.0, 1.0, 1.0]
        )
        if self._format is not None and self._format.y_forward:
            matrix = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ matrix
        matrix[2, 3] = self.height_m
        return matrix

    @property
    def _many_to_one(self) -> bool:
        """Whether the labels of the grids are mapped, not those of the scans: if several classes of
        the grids are one class of the scans.
        """
        return self.grids.classes == CARLAOCC != self.scans.metadata.classes

    @property
    def classes(self) -> ClassTable | None:
        """Class table of the labels that `read` returns; that of the scans for a plain folder."""
        if self._many_to_one:
            return CARLAOCC_TO_CARLA.target
        return self.grids.classes or (None if self.grids.benchmark else self.scans.metadata.classes)

    @cached_property
    def lookup(self) -> IntArray | None:
        """(K,) class of the grids for each class of the scans, -1 for none; None if no map is
        known.
        """
        source = self.scans.metadata.classes
        mapping = (
            None if self.classes is None else _mapping(source, self.classes, self.grids.benchmark)
        )
        if mapping is None:
            return None
        lookup = np.full(source.num_channels, -1, np.int64)
        lookup[list(mapping)] = list(mapping.values())
        lookup[0] = -1
        return lookup

    @cached_property
    def ground(self) -> list[int]:
        """The classes of the grids that are ground, by the class table of the scans."""
        if self.lookup is None:
            return []
        return sorted({int(self.lookup[i]) for i in self.scans.metadata.classes.ground} - {-1, 0})

    def read(self, frame: int) -> tuple[LabelArray, BoolArray, BoolArray | None]:
        """Return (X, Y, Z) labels of a grid, occupied voxels, and known voxels; None for these if
        the files do not contain them.

        Raises:
            CarlascError: the grid cannot be read.
        """
        labels = self.grids.labels(frame)
        known = self.grids.known(frame)
        where = f"{self.grids.location}: frame {self.grids.name_of(frame)}"
        if labels.size != self.spec.num_voxels:
            expected = f"{self.spec.num_voxels} voxels"
            advice = "check the size in params.json"
            raise FormatError(where, expected=expected, found=labels.size, advice=advice)
        labels = labels.reshape(self.spec.size)
        occupied = labels != (0 if self.grids.classes is None else self.grids.classes.free)
        if isinstance(self.grids, VoxelFrames) and self.grids.classes is not None:
            occupied &= is_counted(labels, self.grids.classes)
        if self._many_to_one:
            labels = CARLAOCC_TO_CARLA(labels, where)
        if known is not None:
            known = known.reshape(self.spec.size)
            occupied &= known
        return labels, occupied, known

    def place(self, points: AnyFloatArray) -> FloatArray:
        """Return (N, 3) points of the sensor's frame in the frame of the grids."""
        return transform_points(self.grid_T_scan, points)

    @cached_property
    def seconds(self) -> dict[int, float]:
        """Seconds of each frame with a scan, rising."""
        frames = self.scans.frames("points")
        return dict(zip(frames.tolist(), self.scans.times_of(frames).tolist(), strict=True))

    @cached_property
    def poses(self) -> dict[int, Transform]:
        """(4, 4) pose of each frame with a scan; empty without poses.txt."""
        if layout.POSES not in self.scans.documents():
            return {}
        return {frame: self.scans.read_pose(frame) for frame in self.seconds}

    @property
    def period_s(self) -> float:
        """Seconds between two scans."""
        frames = [*self.seconds]
        seconds = [*self.seconds.values()]
        step_s = (seconds[-1] - seconds[0]) / max(frames[-1] - frames[0], 1)
        return step_s or layout.FRAME_PERIOD_S


def match_grids(grids: Place, scans: Place, grid: str | None, frames: Frames) -> list[MatchedGrids]:
    """Find the scans of each grid.

    Args:
        grids: the grids, as for `evaluate`.
        scans: a recording in the layout.
        grid: name of the grids; None takes `evaluation`, or the only grid of a sequence.
        frames: frames of the grids that are audited; None for all.

    Raises:
        MissingDataError: there are no grids, no scans, or no pair of them; names the pairs that
            were tried.
        FormatError: the geometry of the grids is not known.
    """
    source = as_source(scans)
    recordings = {s.path: s for s in source.sequences().values() if "points" in s.fields()}
    sequences = list(open_grids(grids, grid, "truth"))
    if not recordings:
        advice = "give the recording in the layout, such as `carlasc convert` writes it"
        expected = "sequences with scans (velodyne/)"
        raise MissingDataError(source.location, expected=expected, found="none", advice=advice)
    alone = len(sequences) == 1 and not (isinstance(source, Share) and source.others)
    pairs = [(one, _recording_of(one, recordings, alone=alone)) for one in sequences]
    matched = [
        _match_frames(one, own, FrameRange.of(frames)) for one, own in pairs if own is not None
    ]
    if not matched:
        tried = first_names(
            [f"{one.path or one.location} with {path}" for one in sequences for path in recordings],
            6,
        )
        raise MissingDataError(
            str(grids),
            expected="grids of a sequence of the scans",
            found=f"none of the pairs tried has the same name: {tried}",
            advice="give one sequence of each, if their names differ",
        )
    return matched


def _recording_of(
    grids: GridFrames, recordings: Mapping[str, Sequence], *, alone: bool
) -> Sequence | None:
    name = identity_of(grids.path)[1:]
    same = [
        s
        for path, s in recordings.items()
        if path == grids.path or (grids.path and identity_of(path)[1:] == name)
    ]
    if len(same) == 1:
        return same[0]
    return next(iter(recordings.values())) if alone and len(recordings) == 1 else None


def _match_frames(grids: GridFrames, scans: Sequence, chosen: FrameRange) -> MatchedGrids:
    numbers = grids.frames().tolist()
    own = scans.frames("points").tolist()
    notes = list[str]()
    on_ground = grids.classes == OCC3D
    height = scans.metadata.height_m if on_ground else 0.0
    if height is None:
        height = _HEIGHT_M
        notes.append(f"the height of the sensor is not known: {height:g} m is assumed")
    result = MatchedGrids(grids, scans, (), (), (), height)
    _ = result.spec  # raises now, before work begins, if the geometry is unknown
    if not isinstance(grids, VoxelFrames) or grids.numbered:
        pairs = [(number, number) for number in numbers if number in set(own)]
    elif (times := _token_times(grids)) is not None:
        seconds = np.array([*result.seconds.values()])
        pairs = []
        for number in numbers:
            if (time := times.get(grids.name_of(number))) is not None:
                apart = np.abs(seconds - time)
                if apart.min() <= _SAME_TIME_S:
                    pairs.append((number, own[int(apart.argmin())]))
    elif len(numbers) == len(own):
        notes.append("tokens have no times: they were matched to the scans in their order")
        pairs = list(zip(numbers, own, strict=True))
    else:
        raise MissingDataError(
            result.pair,
            expected=f"a time for each of {len(numbers)} tokens, or as many scans",
            found=f"{len(own)} scans, and no {_TIMES} or annotations.json",
            advice=f"write lines of a token and seconds to {_TIMES} beside the grids",
        )
    if without := sorted(set(numbers) - {number for number, _ in pairs}):
        names = first_names([grids.name_of(number) for number in without], 4)
        left_out = f"{len(without)} of {count(len(numbers), 'grid')} left out"
        notes.append(f"{left_out}, without a scan of the same number or time: {names}")
    pairs = [pair for pair in pairs if pair[0] in chosen]
    if not pairs:
        where = f"frames {own[0]} to {own[-1]}" if own else "frames with scans"
        ends = [grids.name_of(number) for number in (numbers[:1] + numbers[-1:])]
        raise MissingDataError(
            result.pair,
            expected=f"grids of {where}",
            found=" to ".join(ends) or "no frame",
            advice="check the names of the files: no grid has the number or time of a scan",
        )
    made = [scan for _, scan in pairs]
    step = max(int(np.bincount(np.diff(made)).argmax()), 1) if len(made) > 1 else 1
    usual = [f for f in own if made[0] <= f <= made[-1] and (f - made[0]) % step == 0]
    posed = _posed(grids, scans)
    return MatchedGrids(
        grids,
        posed or scans,
        tuple(pairs),
        tuple(sorted(set(usual) - set(made))),
        tuple(notes),
        height,
        posed is not None,
    )


def _posed(grids: GridFrames, scans: Sequence) -> Sequence | None:
    """Return a recording under the poses with which the grids were made, by their record: given or
    refined; None if they were not made from these scans.
    """
    if not isinstance(grids, SequenceGrid) or grids.sequence.location != scans.location:
        return None
    inputs = inputs_of(scans, grids.grid)
    if inputs is None or layout.POSES not in scans.documents():
        return None
    if inputs.refines:
        inputs.use_refined(refine_sequence(inputs.feed))
    return inputs.feed.sequence


def _token_times(grids: VoxelFrames) -> dict[str, float] | None:
    """Return the seconds of tokens, from tokens.txt or Occ3D's annotations.json, in the folder of
    the scene or one above it.
    """
    folder = Path(grids.location)
    for place in (folder, *list(folder.parents)[:3]):
        if (file := place / _TIMES).is_file():
            with reading(file, "lines of a token and seconds"):
                rows = [line.split() for line in file.read_text().splitlines() if line.strip()]
                return {token: float(seconds) for token, seconds in rows}
        if (file := place / "annotations.json").is_file():
            with reading(file, "timestamps of tokens"):
                scenes: Any = parse_json(file.read_bytes(), str(file)).get("scene_infos", {})
                scene = scenes.get(folder.name, {})
                return {token: float(entry["timestamp"]) / 1e6 for token, entry in scene.items()}
    return None


def _mapping(
    source: ClassTable, target: ClassTable, benchmark: str | None
) -> Mapping[int, int] | None:
    """Return the class of the grids for each class of the scans; None if no map is known."""
    if target in (OCC3D, OPENOCCUPANCY, OCCNET):
        to_occ3d = TO_OCC3D.get(source.name)
        if to_occ3d is None or target == OCC3D:
            return to_occ3d
        ids = {name: i for i, name in target.names.items()} | {"free": target.free}
        return {old: ids.get(OCC3D.names.get(new, ""), -1) for old, new in to_occ3d.items()}
    if benchmark == "sscbench" and source.name in TO_SSCBENCH:
        return {old: SSCBENCH_TO_RAW.get(new, -1) for old, new in TO_SSCBENCH[source.name].items()}
    mapping = {index: index for index in source.names}
    if source.names == target.names:
        return mapping
    try:
        for remap in remaps_between(source, target):
            mapping = {old: remap.mapping.get(new, -1) for old, new in mapping.items()}
        return mapping
    except ArgumentError:
        names = {name.lower(): index for index, name in target.names.items()}
        same = {
            index: names[name.lower()]
            for index, name in source.names.items()
            if name.lower() in names
        }
        return same if len(same) > 1 else None
