"""What a run reads, whatever its grids are made from: sequences and their frames, and the plan that all of them share.

A sequence knows its frames and what exists once per sequence. A frame is a small object that pickles into a worker process and is
read there.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from carlasc.core.frames import FrameRange
from carlasc.core.grids import Grid, GridSpec
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.groundtruth.options import FromScans, Observe, Voting
from carlasc.groundtruth.voting.ballot import VoteRule, Votes
from carlasc.storage import layout
from carlasc.storage.metadata import Metadata
from carlasc.storage.protocol import Sequence


@dataclass(frozen=True)
class Plan:
    """What a run makes: the same for each of its sequences and frames.

    Attributes:
        spec: geometry of the grids.
        grid: name of their folder.
        observe: what observes the scene.
        voting: how votes are counted.
        frames: frame numbers of the source.

    Raises:
        ArgumentError: `observe` is of another type.
    """

    spec: GridSpec
    grid: str
    observe: Observe
    voting: Voting
    frames: FrameRange

    def __post_init__(self) -> None:
        kinds = get_args(Observe)
        if not isinstance(self.observe, kinds):
            names = ", ".join(kind.__name__ for kind in kinds)
            raise ArgumentError("observe", expected=f"one of {names}", found=repr(self.observe))

    @property
    def rule(self) -> VoteRule:
        """The rule by which votes are counted: the one of `voting`, or the default of `observe`."""
        return self.voting.rule or ("point" if isinstance(self.observe, FromScans) else "sensor")

    def fields(self) -> tuple[str, ...]:
        """Return the names of the grid's fields."""
        parts = ("labels", "counts", "votes") if self.voting.keep else ("labels", "counts")
        return tuple(f"{self.grid}/{part}" for part in parts)


@dataclass(frozen=True)
class FrameData:
    """What is made of one frame.

    Attributes:
        fields: the scan fields that are written beside the grid, by name.
        grid: the grid.
        votes: the votes that decided the grid; None for a resampled grid.
    """

    fields: Mapping[str, NDArray[Any]]
    grid: Grid
    votes: Votes | None


class FrameInput(ABC):
    """One frame of a sequence; it holds only paths and numbers.

    Attributes:
        number: frame number in the output.
        source_frame: frame number in the source.
    """

    number: int
    source_frame: int

    @abstractmethod
    def fields(self) -> tuple[str, ...]:
        """Return the names of the scan fields that `make` returns."""

    @abstractmethod
    def make(self, plan: Plan) -> FrameData:
        """Read the frame and make its grid.

        Raises:
            MissingDataError: a file does not exist.
            FormatError: the content of a file is not valid.
        """


class SequenceInput(ABC):
    """One sequence of a source.

    Attributes:
        path: path of the sequence below the source; "" if the source is the sequence.
        location: name of the sequence in errors.
        metadata: content of its carlasc.json.
    """

    path: str
    location: str
    metadata: Metadata

    @cached_property
    def frames(self) -> tuple[FrameInput, ...]:
        """The chosen frames in increasing order.

        Raises:
            MissingDataError: no frame is in the range, or something that all frames need does not exist.
            FormatError: something that all frames need is not valid.
        """
        return self._find_frames()

    @abstractmethod
    def _find_frames(self) -> tuple[FrameInput, ...]:
        """Return the chosen frames, as `frames` says."""

    @abstractmethod
    def poses(self) -> NDArray[np.float64] | None:
        """Return (F, 4, 4) first_T_sensor by output frame, NaN where a pose cannot be read; None if there are no poses."""

    @abstractmethod
    def times(self) -> NDArray[np.float64] | None:
        """Return (F,) seconds since the first frame by output frame; None if there are no times."""

    @abstractmethod
    def record(self) -> dict[str, Any]:
        """Return what params.json says about the source. A run with another record does not continue the grid."""

    def notes(self) -> list[str]:
        """Return remarks for the user of the grids, one line each."""
        return []


class StoredSequence(SequenceInput):
    """A sequence of the layout: its scans, poses and times are kept, and frames keep their numbers."""

    def __init__(self, sequence: Sequence, plan: Plan) -> None:
        self.sequence, self.plan = sequence, plan
        self.path = parent_path(sequence)
        self.location, self.metadata = sequence.location, sequence.metadata

    def poses(self) -> NDArray[np.float64] | None:
        """Return the sequence's poses, one per line of poses.txt; None if it has none."""
        return self.sequence.poses if layout.POSES in self.sequence.documents() else None

    def times(self) -> NDArray[np.float64] | None:
        """Return the sequence's times, one per line of times.txt; None if it has none."""
        return self.sequence.times if layout.TIMES in self.sequence.documents() else None


def choose_frames(frames: FrameRange, available: NDArray[np.int64], where: str) -> list[int]:
    """Return the available frame numbers that are in a range.

    Raises:
        MissingDataError: there is none; the message starts with `where`.
    """
    chosen: list[int] = frames.select(available).tolist()
    if not chosen:
        found = f"only {available[0]} to {available[-1]}" if len(available) else "none"
        raise MissingDataError(where, expected=f"frames in {frames}", found=found)
    return chosen


def scan_fields(sequence: Sequence, frame: int) -> tuple[str, ...]:
    """Return the names of the scan fields that a frame has."""
    present = sequence.fields()
    return tuple(name for name in layout.SCAN_FIELDS if name in present and frame in sequence.frames(name))


def parent_path(sequence: Sequence) -> str:
    """Return the path of the folder above `<coordinates>`, where a run writes the sequence again."""
    head, _, last = sequence.path.rpartition("/")
    return head if last == sequence.coordinates else sequence.path


def without_caches(sequence: Sequence) -> Sequence:
    """Return a copy of a sequence without its cached properties, small enough to be sent to a worker with every frame."""
    light = copy.copy(sequence)
    for name in [n for n in vars(light) if isinstance(getattr(type(light), n, None), cached_property)]:
        del vars(light)[name]
    return light
