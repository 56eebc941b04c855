"""The sequences and frames of a Dataset: sequences of a split, their grids, frames with all fields,
and a cache of recent scans.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from carlasc.core.arrays import Float32Array, FloatArray, IntArray
from carlasc.core.frames import compact, expand
from carlasc.core.grids import Coordinates, GridSpec
from carlasc.errors import ArgumentError, FormatError, MissingDataError, first_names
from carlasc.storage import layout
from carlasc.storage.protocol import Sequence, Source

_T = TypeVar("_T")

_ADVICE = "leave the sequence out with `split`, a list of names, or remove the field from `fields`"
_ADVICE_KEEP = "regrid with `voting=Voting(keep_{}=True)`, or remove the field from `fields`"
_RIGID = 1e-2  # maximum deviation of the determinant of a rotation from 1


@dataclass(frozen=True, eq=False)
class SequenceFrames:
    """One sequence of a Dataset.

    Attributes:
        scans: sequence from which scans, poses and metadata are read.
        grids: sequence from which grids are read: the same sequence, its other `<coordinates>`
            folder, or a sequence of another source; None if no grid is needed.
        grid: name of the grid in `grids`.
        frames: frame numbers of the samples, increasing.
        fields: the fields from which samples are read, each with its sequence.
    """

    scans: Sequence
    grids: Sequence | None
    grid: str
    frames: IntArray
    fields: tuple[tuple[Sequence, str], ...]

    @cached_property
    def _scanned(self) -> frozenset[int]:
        return frozenset(self.scans.frames("points").tolist())

    def __getstate__(self) -> dict[str, Any]:
        state = {name: value for name, value in self.__dict__.items() if name != "_scanned"}
        return state | {"frames": compact(self.frames)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, frames=expand(state["frames"]))

    def history(self, frame: int, length: int) -> list[int | None]:
        """Return the frame numbers of a stack, oldest first; None before the start of the sequence
        or before a gap.
        """
        past: list[int | None] = [None] * length
        for back in range(length):
            if frame - back not in self._scanned:
                break
            past[length - 1 - back] = frame - back
        return past

    def with_history(self, frames: Iterable[int], length: int) -> list[int]:
        """Return the sorted numbers of all frames in the stacks of some frames."""
        return sorted(
            {past for frame in frames for past in self.history(frame, length) if past is not None}
        )

    def current_T_past(self, frame: int, past: list[int | None]) -> FloatArray:
        """Return (T, 4, 4) float64 transforms from past sensor frames to the sensor frame of
        `frame`; the identity for `frame` and for None.
        """
        transforms = np.tile(np.eye(4), (len(past), 1, 1))
        others = {
            row: number for row, number in enumerate(past) if number is not None and number != frame
        }
        if others:
            first_T_past = np.array([self.scans.read_pose(number) for number in others.values()])
            transforms[list(others)] = np.linalg.inv(self.scans.read_pose(frame)) @ first_T_past
        return transforms

    def check_poses(self) -> None:
        """Check that every frame has a rigid pose.

        Raises:
            MissingDataError: poses.txt does not exist.
            FormatError: it has too few lines, or a line is not a pose.
        """
        where = f"{self.scans.location}/{layout.POSES}"
        poses = self.scans.poses
        if len(self.frames):
            # if the last frame has a line, all frames have
            self.scans.read_pose(int(self.frames[-1]))
        rotations = np.nan_to_num(poses[:, :3, :3])
        rigid = np.isfinite(poses).all((1, 2)) & (np.abs(np.linalg.det(rotations) - 1) < _RIGID)
        if not rigid.all():
            line = int(np.argmin(rigid))
            raise FormatError(
                f"{where}, line {line + 1}",
                expected="a rigid transform",
                found=poses[line, :3].ravel().tolist(),
            )


def choose_sequences(
    source: Source, split: str | Iterable[str] | None, coordinates: Coordinates
) -> list[Sequence]:
    """Return the sequences of a split or with the given names, in the order of the source.

    Scans are read from these sequences.

    Raises:
        ArgumentError: `split` is not a split, the name of a sequence or a list of names.
        MissingDataError: no sequence has that split or name.
    """
    groups = _groups(source)
    return [_with_scans(groups[key], coordinates) for key in _match(source, groups, split)]


def find_grid_sequences(
    chosen: list[Sequence], source: Source, coordinates: Coordinates
) -> list[Sequence]:
    """Return, for each sequence, the sequence from which its grids are read.

    Sequences are matched by split and name, or by name alone if a path has no split. If both
    sources have a single sequence, these match regardless of their names.

    Raises:
        MissingDataError: a sequence has no counterpart.
    """
    groups = _groups(source)
    only = list(groups.values()) if len(groups) == len(chosen) == 1 else []
    matches = []
    for scans in chosen:
        candidates = [
            group
            for (split, name, _), group in groups.items()
            if name == scans.name and (split == scans.split or None in (split, scans.split))
        ]
        exact = [
            group
            for group in candidates
            if any(member.location == scans.location for member in group.values())
        ]
        group = next(iter(exact or candidates or only), {})
        if coordinates not in group:
            existing = ", ".join(sorted(f"{split or '?'}/{name}" for split, name, _ in groups))
            raise MissingDataError(
                source.location,
                expected=f"{coordinates} grids of {scans.split or '?'}/{scans.name}",
                found=f"only {', '.join(group)}" if group else f"the sequences {existing}",
            )
        matches.append(group[coordinates])
    return matches


def find_grid_name(grids: Sequence, grid: str | GridSpec) -> str:
    """Return the name of a grid of a sequence, given by name or geometry.

    Raises:
        MissingDataError: the sequence has no such grid.
    """
    for name, spec in grids.grids.items():
        if grid in (name, spec):
            return name
    existing = ", ".join(f"{name} ({spec})" for name, spec in grids.grids.items()) or "none"
    raise MissingDataError(
        grids.location,
        expected=f"the grid {grid}",
        found=existing,
        advice="use another `grid`, or a GridSpec if only scans are needed",
    )


def common_frames(wanted: Mapping[tuple[Sequence, str], None]) -> IntArray:
    """Return the frames that have all fields of `wanted`.

    Raises:
        MissingDataError: no frame of a sequence has a field.
    """
    common: IntArray | None = None
    for sequence, field in wanted:
        frames = sequence.frames(field)
        if not len(frames):
            raise MissingDataError(
                sequence.location,
                expected=f"the field {field}",
                found="no frame with it",
                advice=_advice(field.rpartition("/")[2]),
            )
        common = frames if common is None else np.intersect1d(common, frames, assume_unique=True)
    return np.empty(0, np.int64) if common is None else common


def _advice(part: str) -> str:
    """Return the advice for a missing field or part of a grid."""
    kept = {"evidence": layout.EVIDENCE_FIELDS, "actors": layout.ACTOR_FIELDS, "seen": ("seen",)}
    return next(
        (_ADVICE_KEEP.format(name) for name, parts in kept.items() if part in parts), _ADVICE
    )


def common_value(values: Mapping[str, _T], what: str, advice: str = "") -> _T:
    """Return the common value of `values`, a mapping from places to values.

    Raises:
        FormatError: the values of two places differ; the message names both places.
    """
    (place, value), *others = values.items()
    for other, theirs in others:
        if theirs != value:
            raise FormatError(
                other,
                expected=f"the {what} of {place} ({value})",
                found=theirs,
                advice=" or ".join(
                    filter(
                        None,
                        (
                            advice,
                            "select sequences with equal values with `split`, a list of names",
                        ),
                    )
                ),
            )
    return value


_Key = tuple[str | None, str, str]  # split, name, and path of the folder of the sequence


def _groups(source: Source) -> dict[_Key, dict[str, Sequence]]:
    """Return the `<coordinates>` folders of each sequence."""
    groups: dict[_Key, dict[str, Sequence]] = {}
    for path, sequence in source.sequences().items():
        folder, _, last = path.rpartition("/")
        key = (sequence.split, sequence.name, folder if last in layout.COORDINATES else path)
        groups.setdefault(key, {})[sequence.coordinates] = sequence
    return groups


def _with_scans(group: dict[str, Sequence], coordinates: Coordinates) -> Sequence:
    candidates = [group[name] for name in (coordinates, "cartesian") if name in group]
    if not candidates:
        (other,) = group.values()
        raise MissingDataError(
            other.location,
            expected=f"{coordinates} data",
            found=f"only {other.coordinates}",
            advice=f"give `coordinates={other.coordinates!r}`",
        )
    return next(
        (sequence for sequence in candidates if len(sequence.frames("points"))), candidates[0]
    )


def _match(
    source: Source, groups: Mapping[_Key, object], split: str | Iterable[str] | None
) -> list[_Key]:
    if split is None:
        return list(groups)
    if isinstance(split, str) and split.lower() not in map(str.lower, layout.SPLITS):
        if not any(split in _names(key) for key in groups):
            existing = first_names(key[1] for key in groups)
            expected = f"{', '.join(layout.SPLITS)} in any case, or one or more of {existing}"
            raise ArgumentError("split", expected=expected, found=repr(split))
        split = [split]
    if isinstance(split, str):
        chosen = [key for key in groups if (key[0] or "").lower() == split.lower()]
        if not chosen:
            existing = ", ".join(sorted({key[0] or "none" for key in groups}))
            raise MissingDataError(
                source.location,
                expected=f"the split {split}",
                found=existing,
                advice="open a folder with this split, or use `split=None`",
            )
        return chosen
    names = list(split)
    for name in names:
        if not any(name in _names(key) for key in groups):
            existing = ", ".join(sorted(key[1] for key in groups))
            raise MissingDataError(source.location, expected=f"the sequence {name}", found=existing)
    return [key for key in groups if not _names(key).isdisjoint(names)]


def _names(key: _Key) -> set[str]:
    """Return the names of a sequence: "Town01_Light", "Train/Town01_Light", and its path."""
    split, name, path = key
    return {name, f"{split}/{name}", path}


class RecentScans(threading.local):
    """Caches the last decoded scans of a thread, because the stacks of consecutive frames differ by
    one scan only.

    The memory of a dropped scan is reused for the next one, so each thread has a separate cache.
    """

    def __init__(self, capacity: int) -> None:
        """Keep at most `capacity` scans."""
        super().__init__()
        self.capacity = capacity
        self._scans: OrderedDict[tuple[Sequence, int], Float32Array] = OrderedDict()

    def read(self, sequence: Sequence, frames: list[int | None]) -> list[Float32Array | None]:
        """Return the points of each frame like `Sequence.read_xyz`, and None for None.

        They are valid until the next call.

        All scans that are not cached are read in one call.
        """
        wanted = [(sequence, frame) for frame in frames if frame is not None]
        for key in wanted:
            if key in self._scans:
                self._scans.move_to_end(key)
        missing = [key for key in wanted if key not in self._scans]
        spare = []
        while self._scans and len(self._scans) + len(missing) > self.capacity:
            spare.append(self._scans.popitem(last=False)[1])
        if missing:
            read = sequence.read_xyz([frame for _, frame in missing], spare)
            self._scans.update(zip(missing, read, strict=True))
        return [None if frame is None else self._scans[sequence, frame] for frame in frames]
