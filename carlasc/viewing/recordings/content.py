"""What a recording holds of each frame, whichever format it is written in: right-handed, thinned, with the way of each actor."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from carlasc.core.boxes import Boxes
from carlasc.core.geometry import Transform
from carlasc.core.grids import Grid
from carlasc.core.scans import Scan
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc.viewing import colors as palette
from carlasc.viewing.recordings.trails import Trail, Trails
from carlasc.viewing.rendering.drawings import motion_arrows
from carlasc.viewing.scene import SceneReader

MAX_POINTS = 30_000
"""Points of a frame, unless all are asked for: a frame is then smaller than half a megabyte."""

_GOLDEN = (
    2654435769  # 2**32 over the golden ratio: multiples of it, modulo 2**32, are spread evenly, however many are taken
)


@dataclass(frozen=True)
class RecordedFrame:
    """One frame, in right-handed axes: x ahead, y to the left, z up; in the frame of the sensor where nothing else is said.

    Attributes:
        number: frame number.
        time_s: seconds since the first frame; 0.1 s per frame if the sequence has no times.
        grids: one for each panel of the scene.
        scan: the thinned points with their labels; None if the frame has no points.
        tails: (M, 3) start points of the arrows that show how actors move, metres.
        vectors: (M, 3) vectors of the arrows, metres per second.
        boxes: tracked boxes; None where the frame was not annotated.
        pose: (4, 4) world_T_sensor, where the world is the frame of the first scan; None if the sequence has no poses.
        trails: the ways of the actors up to this frame, in the world.
        picture: the bird's-eye camera picture as its JPEG bytes, or None.
    """

    number: int
    time_s: float
    grids: tuple[Grid, ...]
    scan: Scan | None
    tails: NDArray[np.float64]
    vectors: NDArray[np.float64]
    boxes: Boxes | None
    pose: Transform | None
    trails: tuple[Trail, ...]
    picture: bytes | None


class RecordingWriter(Protocol):
    """Writes the frames of a scene to a file, one after the other, and keeps none of them."""

    def write(self, frame: RecordedFrame) -> None:
        """Append a frame."""

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: it could not be written.
        """


def record_frames(reader: SceneReader, max_points: int | None) -> Iterator[RecordedFrame]:
    """Read the frames of a right-handed scene.

    Args:
        reader: the scene.
        max_points: points that are kept of each frame; None keeps all.
    """
    trails = Trails()
    for number in reader.frames:
        content = reader.read(number)
        time_s = number * FRAME_PERIOD_S if content.time_s is None else content.time_s
        scan, nothing = content.scan, np.empty((0, 3))
        tails, vectors = nothing, nothing
        if scan is not None and scan.flow is not None:
            tails, vectors = motion_arrows(scan.select(np.linalg.norm(scan.flow, axis=1) > 0))
        yield RecordedFrame(
            number,
            time_s,
            content.grids,
            scan if scan is None or max_points is None else thin_scan(scan, max_points),
            tails,
            vectors,
            content.boxes,
            content.pose,
            trails.follow(content),
            reader.read_picture(number),
        )


def thin_scan(scan: Scan, most: int) -> Scan:
    """Return at most so many points of a scan, spread evenly over their order in the file. It chooses the same ones each time."""
    if len(scan) <= most:
        return scan
    order = np.arange(len(scan), dtype=np.uint64) * np.uint64(_GOLDEN) % np.uint64(2**32)
    return scan.select(np.sort(np.argpartition(order, most)[:most]))


def point_colors(scan: Scan, by_id: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return (N, 3) uint8 RGB of the points of a scan, in the colours of their classes, (num_channels, 3)."""
    colors = by_id.copy()
    colors[0] = palette.UNLABELLED
    return colors[np.zeros(len(scan), np.int64) if scan.labels is None else scan.labels]


def class_cells(grid: Grid) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield each class of a grid with the (K, 3) indices of its voxels."""
    cells = np.argwhere(grid.labels)
    labels = grid.labels[tuple(cells.T)]
    for label in np.unique(labels).tolist():
        yield label, cells[labels == label]
