"""The scans that a thread read last."""

from __future__ import annotations

import threading
from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from carlasc.storage import Sequence


class RecentScans(threading.local):
    """Keeps the last scans that a thread read, decoded: consecutive frames share all scans of their stacks but one.

    The memory of a scan that is dropped is used for the next one, so each thread has scans of its own.
    """

    def __init__(self, capacity: int) -> None:
        """Keep at most `capacity` scans."""
        super().__init__()
        self.capacity = capacity
        self._scans: OrderedDict[tuple[Sequence, int], NDArray[np.float32]] = OrderedDict()

    def read(self, sequence: Sequence, frames: list[int | None]) -> list[NDArray[np.float32] | None]:
        """Return the points of each frame as `Sequence.read_xyz` does, and None for None. They are valid until the next call.

        All scans that are not kept are read in one call.
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
