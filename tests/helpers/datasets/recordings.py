"""Recordings and stores in memory, for tests of what all converters share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.converting import Cloud, FrameHandle, Recording, Trajectory, VoxelContent
from carlasc.errors import FormatError
from carlasc.storage import SequenceWriter


class MemoryFrame(FrameHandle):
    """A frame that holds its content; None stands for a file that cannot be read."""

    def __init__(
        self, number: int, content: Cloud | None, voxels: VoxelContent | None = None
    ) -> None:
        self.number, self.content, self.voxels = number, content, voxels
        self.location = f"scan {number}"

    def read(self) -> list[Cloud]:
        if self.content is None:
            raise FormatError(self.location, expected="points", found="nothing")
        return [self.content]

    def read_voxels(self) -> VoxelContent | None:
        return self.voxels


class MemoryRecording(Recording):
    """A recording of such frames."""

    name, split, location, has_labels, has_instances = "MEM_00", "Train", "memory", True, True

    def __init__(
        self,
        frames: Sequence[FrameHandle],
        poses: NDArray[np.float64] | None = None,
        times: NDArray[np.float64] | None = None,
    ) -> None:
        self.frames, self._poses, self._times = frames, poses, times

    def poses(self, *, force: bool = False) -> Trajectory | None:
        return None if self._poses is None else Trajectory(self._poses)

    def times(self) -> NDArray[np.float64] | None:
        return self._times


class MemoryWriter(SequenceWriter):
    """Keeps what is written. It cannot be used in workers."""

    location = "memory"

    def __init__(self) -> None:
        self.fields: dict[tuple[str, int], NDArray[Any]] = {}
        self.texts: dict[str, bytes] = {}

    def has(self, field: str, frame: int) -> bool:
        return (field, frame) in self.fields

    def write(self, field: str, frame: int, array: NDArray[Any]) -> None:
        self.fields[field, frame] = array

    def write_document(self, name: str, data: bytes) -> None:
        self.texts[name] = data

    def read_document(self, name: str) -> bytes | None:
        return self.texts.get(name)
