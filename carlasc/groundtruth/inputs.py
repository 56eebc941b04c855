"""Where a run's observations come from: a provider for each kind of data.

A provider finds the sequences of a source. A sequence knows its frames and what stands once in it; a frame is a small object that
pickles into a worker and is read there.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.raw import RAW, Capture, Recording, find_captures
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import relative_to
from carlasc.core.grids import Grid, GridSpec
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.groundtruth.voting.ballot import VoteRule, Votes, count_votes
from carlasc.groundtruth.voting.observations import Observation
from carlasc.storage import layout
from carlasc.storage.metadata import Metadata

FrameRange = tuple[int | None, int | None]
"""Half-open range of frame numbers; None leaves an end open."""


@dataclass(frozen=True)
class Recipe:
    """How a grid is made of a frame: what every task of a sequence shares.

    Attributes:
        spec: the grid's geometry.
        grid: its folder.
        classes: table of the labels.
        vote: rule by which votes are counted.
        free_step_m: distance of free samples on a ray, metres.
        keep_votes: whether the votes by class are written too.
    """

    spec: GridSpec
    grid: str
    classes: ClassTable
    vote: VoteRule
    free_step_m: float
    keep_votes: bool

    def fields(self) -> tuple[str, ...]:
        """Return the names of the grid's fields."""
        parts = ("labels", "counts", "votes") if self.keep_votes else ("labels", "counts")
        return tuple(f"{self.grid}/{part}" for part in parts)


@dataclass(frozen=True)
class FrameData:
    """What one frame gives.

    Attributes:
        fields: scan fields that are written beside the grid, by name.
        grid: the grid.
        votes: what it was elected from; None where it was not elected.
    """

    fields: Mapping[str, NDArray[Any]]
    grid: Grid
    votes: Votes | None


class FrameInputs(ABC):
    """One frame of a sequence; holds paths and numbers only.

    Attributes:
        number: its number in the output.
        source_frame: its number in the source.
    """

    number: int
    source_frame: int

    @abstractmethod
    def fields(self) -> tuple[str, ...]:
        """Return the names of the scan fields that `make` gives."""

    @abstractmethod
    def make(self, recipe: Recipe) -> FrameData:
        """Read the frame and make its grid.

        Raises:
            MissingDataError: a file is not there.
            FormatError: a file does not hold what it must.
        """


class SequenceInputs(ABC):
    """One sequence of a source.

    Attributes:
        path: where it stands below the source, "" where the source is just it.
        location: what to call it in errors.
        metadata: what carlasc.json says of it.
        frames: its chosen frames in rising order.
    """

    path: str
    location: str
    metadata: Metadata
    frames: tuple[FrameInputs, ...]
    vote: VoteRule = "sensor"  # the rule if none is asked for

    @abstractmethod
    def poses(self) -> NDArray[np.float64] | None:
        """Return (F, 4, 4) first_T_sensor by output frame; NaN where a pose cannot be read; None where there are none."""

    @abstractmethod
    def times(self) -> NDArray[np.float64] | None:
        """Return (F,) seconds since the first frame by output frame; None where there are none."""

    @abstractmethod
    def record(self) -> dict[str, Any]:
        """Return what params.json tells of the source: a run that differs in it may not go on with the grid."""

    def notes(self) -> list[str]:
        """Return what the reader of the grids should know, a line each."""
        return []


@dataclass(frozen=True)
class CaptureFrame(FrameInputs):
    """One frame of a capture: each sensor is a voter, the grid's frame is the ego sensor's."""

    capture: Capture
    sensors: tuple[int, ...]
    number: int
    source_frame: int

    def fields(self) -> tuple[str, ...]:
        """Return points, labels, flow, instances, and bev where there is a picture."""
        always = ("points", "labels", "flow", "instances")
        return (*always, "bev") if self.capture.has_bev(self.source_frame) else always

    def make(self, recipe: Recipe) -> FrameData:
        """Read the ego sensor's recording, which is the scan; the other sensors' as they vote: memory does not grow with them."""
        ego = self.capture.read(self.sensors[0], self.source_frame)
        fields: dict[str, NDArray[Any]] = {
            "points": np.column_stack([ego.scan.points, np.zeros(len(ego.scan), np.float32)]),
            "labels": _present(ego.scan.labels),
            "flow": ego.flow(),
            "instances": _present(ego.scan.instances),
        }
        picture = self.capture.read_bev(self.source_frame)
        if picture is not None:
            fields["bev"] = np.frombuffer(picture, np.uint8)
        votes = count_votes(
            self._observe(ego), recipe.spec, recipe.classes, vote=recipe.vote, free_step_m=recipe.free_step_m
        )
        return FrameData(fields, votes.to_grid(), votes)

    def _observe(self, ego: Recording) -> Iterator[Observation]:
        for sensor in self.sensors:
            recording = ego if sensor == self.sensors[0] else self.capture.read(sensor, self.source_frame)
            ego_T_sensor = relative_to(ego.world_T_sensor, recording.world_T_sensor)
            yield Observation(recording.scan.points, _present(recording.scan.labels), ego_T_sensor)


class CaptureInputs(SequenceInputs):
    """A capture: its frames are renumbered from 0."""

    def __init__(self, capture: Capture, path: str, frames: FrameRange | None) -> None:
        """Choose the frames of a capture.

        Raises:
            MissingDataError: it has no sensor, or no frame in the range.
        """
        start, stop = frames or (None, None)
        numbers = [int(f) for f in capture.frames if (start is None or f >= start) and (stop is None or f < stop)]
        if not numbers:
            raise MissingDataError(
                capture.location,
                expected=f"frames in {range_text(start, stop)}",
                found=f"only {capture.frames[0]} to {capture.frames[-1]}",
            )
        self.path, self.location, self.metadata = path, capture.location, Metadata(classes=capture.classes)
        # Frames carry a capture of their own: the one here remembers its listing, which need not be pickled each time.
        bare = Capture(capture.raw, capture.classes)
        self.frames = tuple(CaptureFrame(bare, capture.sensors, i, number) for i, number in enumerate(numbers))
        self._capture = capture
        self._open_end = stop is None

    def poses(self) -> NDArray[np.float64]:
        """Return inv(pose0[first]) @ pose0[f].

        Raises:
            FormatError: the first frame's pose, which is the origin, cannot be read.
            MissingDataError: it is not there.
        """
        first = self.frames[0].source_frame
        try:
            world_T_first = self._capture.read_pose(0, first)
        except (FormatError, MissingDataError) as error:
            raise type(error)(
                f"{error}; the first frame's pose is the origin of poses.txt: mend it, or start with a later frame"
            ) from error
        return relative_to(world_T_first, np.stack([self._read_pose(frame.source_frame) for frame in self.frames]))

    def _read_pose(self, frame: int) -> NDArray[np.float64]:
        try:
            return self._capture.read_pose(0, frame)
        except (FormatError, MissingDataError):
            return np.full((4, 4), np.nan)  # reading the frame meets the same error, and that one is reported

    def times(self) -> NDArray[np.float64]:
        """Return (f - first) * 0.1 (FORMAT section 4)."""
        numbers = np.array([frame.source_frame for frame in self.frames])
        return (numbers - numbers[0]) * layout.FRAME_PERIOD_S

    def record(self) -> dict[str, Any]:
        """Return the kind of source, the frames and the number of sensors.

        An end that was left open stays open, so that a run goes on when the capture has grown.
        """
        first, last = self.frames[0].source_frame, self.frames[-1].source_frame
        frames = f"{first}:" if self._open_end else f"{first}:{last + 1}"
        return {"source": "capture", "frames": frames, "sensors": len(self._capture.sensors)}


def capture_inputs(source: str | os.PathLike[str], frames: FrameRange | None) -> list[SequenceInputs]:
    """Find the captures at or below a folder."""
    return [CaptureInputs(capture, path, frames) for path, capture in find_captures(source).items()]


def default_sink(source: str | os.PathLike[str]) -> Path:
    """Return the folder that a run writes to if it is told nothing: the source, beside raw/ and `<coordinates>/`.

    Raises:
        ArgumentError: the source is no folder, so nothing can be written into it.
    """
    folder = Path(source)
    if not folder.is_dir() and folder.exists():
        raise ArgumentError(source, expected="a folder to write into", found="a file", advice="say where to (`-o`)")
    return folder.resolve().parent if folder.resolve().name in (RAW, *layout.COORDINATES) else folder


def check_frames(frames: FrameRange | None) -> None:
    """Raise ArgumentError where a range can hold no frame."""
    start, stop = frames or (None, None)
    if (start is not None and start < 0) or (stop is not None and stop <= (start or 0)):
        raise ArgumentError(
            "frames", expected="a half-open range of frame numbers from 0", found=f"{range_text(start, stop)}"
        )


def _present(array: NDArray[Any] | None) -> NDArray[Any]:
    if array is None:  # a recording always has labels and instances: Capture.read takes none without
        raise FormatError("recording", expected="labels and instances", found="none")
    return array


def range_text(start: int | None, stop: int | None) -> str:
    """Return a range as it is typed: "3:7"."""
    return f"{'' if start is None else start}:{'' if stop is None else stop}"
