"""Which scan belongs to which grid, and where it is in the frame of the grid: by the names of sequences, and by number or time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.benchmarks import OCC3D_TO_OPENOCCUPANCY, SSCBENCH_TO_RAW, TO_OCC3D, TO_SSCBENCH
from carlasc.core.classes import ClassTable
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.geometry import Transform, transform_points
from carlasc.core.grids import GridSpec
from carlasc.core.tables import remaps_between
from carlasc.errors import ArgumentError, FormatError, MissingDataError, reading
from carlasc.metrics.grids import GridFrames, SequenceGrid
from carlasc.metrics.pairs import Place, TokenFrames, open_grids
from carlasc.storage import as_source, layout
from carlasc.storage.files import parse_json
from carlasc.storage.layout import identity_of
from carlasc.storage.protocol import Sequence

_SAME_TIME_S = 0.06  # a grid belongs to a scan of nearly its time
_NOISE = 255
_HEIGHT_M = 1.8  # of the sensor above the ground where the recording does not say it, as in CarlaSC
TIMES = "tokens.txt"
"""The table of times beside grids that are named by tokens: lines of a token and seconds."""


@dataclass(frozen=True)
class MatchedGrids:
    """The grids of a sequence and the scans that belong to them. It pickles into workers.

    Attributes:
        grids: the grids.
        scans: the recording.
        frames: pairs of the number of a grid and that of its scan, rising.
        absent: frames of the recording, within the grids' span and at their usual distance, that have no grid.
        notes: what was assumed.
        height_m: height of the sensor above the origin of the grids.
    """

    grids: GridFrames
    scans: Sequence
    frames: tuple[tuple[int, int], ...]
    absent: tuple[int, ...]
    notes: tuple[str, ...]
    height_m: float

    @property
    def path(self) -> str:
        """Path of the sequence of the scans."""
        return self.scans.path or self.scans.name

    @property
    def spec(self) -> GridSpec:
        """Geometry of the grids."""
        spec = self.grids.spec
        if spec is None:
            raise FormatError(
                self.grids.location,
                expected="grids of known geometry",
                found="a folder without params.json",
                advice="add params.json: docs/format.md#params-json",
            )
        return spec

    @property
    def axes(self) -> str:
        """Handedness of the grids: "left" or "right"; formats of other benchmarks are right-handed."""
        return self.grids.sequence.metadata.axes if isinstance(self.grids, SequenceGrid) else "right"

    @property
    def frame_name(self) -> str:
        """The frame of the grids in words."""
        place = {
            "occ3d-lidar": "the vehicle, with its origin on the ground",
            "openoccupancy": "the LiDAR, x to the right and y forward",
        }.get(self.grids.benchmark or "", "the sensor, x forward")
        return f"{place}; {self.axes}-handed"

    @cached_property
    def grid_T_scan(self) -> Transform:
        """(4, 4) from the sensor's frame to that of the grids; it may mirror y."""
        matrix: Transform = np.eye(4)
        if self.axes != self.scans.metadata.axes:
            matrix[1, 1] = -1.0
        if self.grids.benchmark == "openoccupancy":
            matrix = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ matrix
        matrix[2, 3] = self.height_m
        return matrix

    @cached_property
    def lookup(self) -> NDArray[np.int64] | None:
        """(K,) class of the grids of each class of the scans, -1 for those that have none; None if no map is known."""
        source, target = self.scans.metadata.classes, self.grid_classes
        mapping = None if target is None else _mapping(source, target, self.grids.benchmark)
        if mapping is None:
            return None
        lookup = np.full(source.num_channels, -1, np.int64)
        for old, new in mapping.items():
            lookup[old] = new
        lookup[0] = -1
        return lookup

    @property
    def grid_classes(self) -> ClassTable | None:
        """Class table of the grids; that of the scans for a plain folder."""
        return self.grids.classes or (None if self.grids.benchmark else self.scans.metadata.classes)

    def read(self, frame: int) -> tuple[NDArray[np.unsignedinteger], NDArray[np.bool_], NDArray[np.bool_] | None]:
        """Return (X, Y, Z) labels of a grid, which voxels are occupied, and which are known; None if the files do not say it.

        Raises:
            CarlascError: the grid cannot be read.
        """
        labels, known = self.grids.labels(frame), self.grids.known(frame)
        if labels.size != self.spec.num_voxels:
            raise FormatError(
                f"{self.grids.location}: frame {self.grids.name_of(frame)}",
                expected=f"{self.spec.num_voxels} voxels",
                found=str(labels.size),
            )
        labels = labels.reshape(self.spec.size)
        occupied = labels != (17 if self.grids.benchmark == "occ3d-lidar" else 0)
        if self.grids.benchmark in ("occ3d-lidar", "openoccupancy"):
            occupied &= labels != _NOISE
        if known is not None:
            known = known.reshape(self.spec.size)
            occupied &= known
        return labels, occupied, known

    def place(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return (N, 3) points of the sensor's frame in the frame of the grids."""
        return transform_points(self.grid_T_scan, points)

    def seconds(self, frame: int) -> float:
        """Return the time of a scan."""
        timed = layout.TIMES in self.scans.documents()
        return self.scans.read_time(frame) if timed else frame * layout.FRAME_PERIOD_S


def match_grids(grids: Place, scans: Place, grid: str | None, frames: Frames) -> list[MatchedGrids]:
    """Find the scans of each grid.

    Args:
        grids: the grids, as for `evaluate`.
        scans: a recording in the layout.
        grid: name of the grids; None takes `evaluation`, or the only grid of a sequence.
        frames: frames of the grids that are audited; None for all.

    Raises:
        MissingDataError: there are no grids, no scans, or no pair of them; names the pairs that were tried.
        FormatError: the geometry of the grids is not known.
    """
    recordings = {s.path: s for s in as_source(scans).sequences().values() if "points" in s.fields()}
    found = list(open_grids(grids, grid, "truth"))
    if not recordings:
        raise MissingDataError(as_source(scans).location, expected="sequences with scans (velodyne/)", found="none")
    matched = []
    for one in found:
        recording = _recording_of(one, recordings, alone=len(found) == 1)
        if recording is not None:
            matched.append(_match_frames(one, recording, FrameRange.of(frames)))
    if not matched:
        tried = ", ".join(f"{one.path or one.location} with {path}" for one in found[:3] for path in [*recordings][:3])
        raise MissingDataError(
            str(grids),
            expected="grids of a sequence of the scans",
            found=f"none of the pairs tried has one name: {tried}",
            advice="give one sequence of each side if they have other names",
        )
    return matched


def _recording_of(grids: GridFrames, recordings: Mapping[str, Sequence], *, alone: bool) -> Sequence | None:
    name = identity_of(grids.path)[1:]
    same = [s for path, s in recordings.items() if path == grids.path or (grids.path and identity_of(path)[1:] == name)]
    if len(same) == 1:
        return same[0]
    return next(iter(recordings.values())) if alone and len(recordings) == 1 else None


def _match_frames(grids: GridFrames, scans: Sequence, chosen: FrameRange) -> MatchedGrids:
    numbers, own, notes = grids.frames(), scans.frames("points"), list[str]()
    times = _token_times(grids) if isinstance(grids, TokenFrames) else None
    if isinstance(grids, TokenFrames) and times is None:
        if len(numbers) != len(own):
            raise MissingDataError(
                grids.location,
                expected=f"a time for each of {len(numbers)} tokens, or as many scans",
                found=f"{len(own)} scans, and no {TIMES} or annotations.json",
                advice=f"write lines of a token and seconds to {TIMES} beside the grids",
            )
        notes.append("tokens without times were taken in the order of the scans")
        pairs = list(zip(numbers.tolist(), own.tolist(), strict=True))
    elif isinstance(grids, TokenFrames) and times is not None:
        timed = layout.TIMES in scans.documents()
        seconds = np.array([scans.read_time(f) if timed else f * layout.FRAME_PERIOD_S for f in own.tolist()])
        wanted = [(number, times.get(grids.name_of(number))) for number in numbers.tolist()]
        nearest = [(n, int(np.abs(seconds - t).argmin()), t) for n, t in wanted if t is not None]
        pairs = [(n, int(own[row])) for n, row, t in nearest if abs(seconds[row] - t) <= _SAME_TIME_S]
    else:
        pairs = [(number, number) for number in numbers.tolist() if number in set(own.tolist())]
    pairs = [pair for pair in pairs if pair[0] in chosen]
    if not pairs:
        where = f"frames {own[0]} to {own[-1]} of {scans.location}" if len(own) else scans.location
        shown = f"{numbers[0]} to {numbers[-1]}" if len(numbers) else "no frame"
        raise MissingDataError(
            grids.location, expected=f"grids of {where}", found=shown, advice="no pair of frames has one number or time"
        )
    benchmark, height = grids.benchmark, 0.0
    if benchmark == "occ3d-lidar":
        height, assumed = _height(scans)
        notes += [f"the height of the sensor is not known, and taken to be {height:g} m"] if assumed else []
    made = [scan for _, scan in pairs]
    steps = np.diff(made)
    step = int(np.bincount(steps).argmax()) if len(steps) else 1
    usual = [f for f in own.tolist() if made[0] <= f <= made[-1] and (f - made[0]) % max(step, 1) == 0]
    result = MatchedGrids(grids, scans, tuple(pairs), tuple(sorted(set(usual) - set(made))), tuple(notes), height)
    _ = result.spec  # unknown geometry is an error before work begins
    return result


def _token_times(grids: TokenFrames) -> dict[str, float] | None:
    """Return the seconds of tokens, from tokens.txt or Occ3D's annotations.json, in the folder of the scene or one above it."""
    folder = Path(grids.location)
    for place in (folder, folder.parent, folder.parent.parent):
        if (file := place / TIMES).is_file():
            with reading(file, "lines of a token and seconds"):
                rows = [line.split() for line in file.read_text().splitlines() if line.strip()]
                return {token: float(seconds) for token, seconds in rows}
        if (file := place / "annotations.json").is_file():
            scenes: Any = parse_json(file.read_bytes(), str(file)).get("scene_infos", {})
            with reading(file, "timestamps of tokens"):
                scene = scenes.get(folder.name, {})
                return {token: float(entry["timestamp"]) / 1e6 for token, entry in scene.items()}
    return None


def _height(scans: Sequence) -> tuple[float, bool]:
    sensors = scans.metadata.extra.get("sensors")
    first = sensors[0] if isinstance(sensors, list) and sensors else None
    height = first.get("height_m") if isinstance(first, dict) else None
    known = isinstance(height, int | float) and not isinstance(height, bool)
    return (float(height), False) if known and isinstance(height, int | float) else (_HEIGHT_M, True)


def _mapping(source: ClassTable, target: ClassTable, benchmark: str | None) -> Mapping[int, int] | None:
    """Return which class of the grids each class of the scans becomes; None if nothing says so."""
    if benchmark in ("occ3d-lidar", "openoccupancy"):
        to_occ3d = TO_OCC3D.get(source.name)
        if to_occ3d is None or benchmark == "occ3d-lidar":
            return to_occ3d
        return {old: OCC3D_TO_OPENOCCUPANCY.get(new, -1) for old, new in to_occ3d.items()}
    if benchmark == "sscbench" and source.name in TO_SSCBENCH:
        return {old: SSCBENCH_TO_RAW.get(new, -1) for old, new in TO_SSCBENCH[source.name].items()}
    if source.names == target.names:
        return {index: index for index in source.names}
    try:
        mapping = {index: index for index in source.names}
        for remap in remaps_between(source, target):
            mapping = {old: remap.mapping.get(new, -1) for old, new in mapping.items()}
        return mapping
    except ArgumentError:
        names = {name.lower(): index for index, name in target.names.items()}
        same = {index: names[name.lower()] for index, name in source.names.items() if name.lower() in names}
        return same if len(same) > 1 else None
