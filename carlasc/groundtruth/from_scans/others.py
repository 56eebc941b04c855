"""The grid of a frame, made from the scans of other frames only: what measures how well a scan is predicted by its neighbours."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import Grid
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.sequences import ScanSequence
from carlasc.groundtruth.inputs import GridPlan
from carlasc.motion.tracks import MovingActors
from carlasc.storage import layout
from carlasc.storage.protocol import Sequence


class WithoutScans(Sequence):
    """A sequence some of whose scans are hidden. The poses and times of these frames are still known.

    A hidden frame is not listed among the frames of a scan's fields, and reads as a scan without points.

    Args:
        whole: the sequence.
        hidden: numbers of the frames whose scans are hidden.
    """

    def __init__(self, whole: Sequence, hidden: Collection[int]) -> None:
        self.whole, self.hidden = whole, frozenset(hidden)
        self.path, self.location = whole.path, whole.location
        self.split, self.name, self.coordinates = whole.split, whole.name, whole.coordinates
        self._given_poses = whole._given_poses

    def fields(self) -> frozenset[str]:
        """Return the fields of the whole sequence."""
        return self.whole.fields()

    def frames(self, field: str) -> NDArray[np.int64]:
        """Return the frames of a field; without the hidden ones if it is a field of the scans."""
        frames = self.whole.frames(field)
        return frames[~np.isin(frames, sorted(self.hidden))] if field in layout.SCAN_FIELDS else frames

    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Read one field of one frame; no rows if the frame is hidden."""
        if frame not in self.hidden or field not in layout.SCAN_FIELDS:
            return self.whole.read(field, frame)
        entry = layout.SCAN_FIELDS[field]
        return np.empty(0 if entry.columns is None else (0, entry.columns), entry.dtype)

    def documents(self) -> tuple[str, ...]:
        """Return the text files of the whole sequence."""
        return self.whole.documents()

    def read_document(self, name: str) -> bytes:
        """Return the bytes of a text file of the whole sequence."""
        return self.whole.read_document(name)

    def line_of(self, frame: int, lines: int, document: str) -> int:
        """Return the line of a text file that belongs to a frame: the one in the whole sequence."""
        return self.whole.line_of(frame, lines, document)


def feed_without(inputs: ScanSequence, hidden: Collection[int]) -> ScanFeed:
    """Return the scans of a sequence without those of some frames: they neither vote nor show how actors move.

    What the vehicle itself drove through is no evidence either.

    Raises:
        MissingDataError: there are no poses.
        FormatError: poses or times are not valid.
    """
    return ScanFeed(WithoutScans(inputs.feed.sequence, hidden), replace(inputs.options, own_path=False))


def grid_from_others(feed: ScanFeed, actors: MovingActors, frame: int, plan: GridPlan) -> Grid:
    """Return the grid at a frame whose scan is hidden, in the sensor frame of that scan.

    Args:
        feed: as `feed_without` returns it.
        actors: what moves in the scans of the feed.
        frame: number of a hidden frame.
        plan: geometry of the grid, and how votes are counted.
    """
    return merge_frame(plan, feed, actors, frame, feed.reaching(frame, plan.spec)).grid
