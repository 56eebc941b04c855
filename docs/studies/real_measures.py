"""What is wrong in a grid of a real drive: what stays of things that moved on, and what is lost of
things that did not.

No dense truth exists for real drives, but the space that something drove through is free at all
other times. Volumes are compared with grids by their voxels' centres. "World" is the sensor frame
of the first scan, as in poses.txt.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from carlasc import Grid
from carlasc.core import Transform, invert, rotation_z, transform_points
from carlasc.motion import tracks_from_boxes
from carlasc.motion.solving import smooth
from carlasc.storage import Sequence as Drive

# a body's volume: smaller than its box on all sides, and this high above its floor
SHRINK_M, FLOOR_M = (
    0.2,
    0.4,
)
GROW_M = 0.3  # what is this close to a body that is there now belongs to it
HEIGHT_M = 0.3  # structure is higher above the ground
# of the recording vehicle, sensor frame, above the road
OWN_LOWER, OWN_UPPER = (
    (-2.2, -0.75, -1.2),
    (2.2, 0.75, 0.0),
)
SENSOR_HEIGHT_M = 1.73
_FOLLOWER_START, _FOLLOWER_RADIUS_M, _FOLLOWER_SMOOTH_S = (-8.5, 2.0), 2.2, 0.7
_FOLLOWER_LENGTH_M, _FOLLOWER_HEIGHT_M = 4.0, 1.45
_GROUND_CELL_M = 3.0


@dataclass(frozen=True)
class Body:
    """Something solid, and where it was.

    Attributes:
        name: what it is.
        poses: (4, 4) world_T_body by frame.
        lower: (3,) metres, lower corner, body frame; its floor is the road.
        upper: (3,) metres, upper corner.
    """

    name: str
    poses: Mapping[int, Transform]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    def contains(
        self, frames: Iterable[int], points: NDArray[np.float64], grow_m: float = 0.0
    ) -> NDArray[np.bool_]:
        """Return whether (N, 3) points, world, are in the body at one of some frames, grown on all
        sides.
        """
        return self._covers(frames, points, self.lower - grow_m, self.upper + grow_m)

    def swept(self, frames: Iterable[int], points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether (N, 3) points, world, are in the inner volume of the body at one of some
        frames.
        """
        return self._covers(
            frames, points, self.lower + [SHRINK_M, SHRINK_M, FLOOR_M], self.upper - SHRINK_M
        )

    def _covers(
        self,
        frames: Iterable[int],
        points: NDArray[np.float64],
        lower: NDArray[np.float64],
        upper: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        covered = np.zeros(len(points), np.bool_)
        poses = [self.poses[frame] for frame in frames if frame in self.poses]
        if not poses:
            return covered
        reach = max(np.linalg.norm(lower), np.linalg.norm(upper))
        places = np.stack(poses)[:, :3, 3]
        candidates = _between(points, places.min(axis=0) - reach, places.max(axis=0) + reach)
        nearby = points[candidates]
        for pose in poses:
            near = _between(nearby, pose[:3, 3] - reach, pose[:3, 3] + reach)
            covered[
                candidates[
                    near[_between(transform_points(invert(pose), nearby[near]), lower, upper)]
                ]
            ] = True
        return covered


@dataclass(frozen=True)
class Share:
    """A share of voxels or points: `part` of `whole`. Shares of several frames are added."""

    part: int = 0
    whole: int = 0

    def __add__(self, other: Share) -> Share:
        return Share(self.part + other.part, self.whole + other.whole)

    @property
    def percent(self) -> float:
        """The share in percent; NaN of nothing."""
        return 100 * self.part / self.whole if self.whole else float("nan")


@dataclass(frozen=True)
class Measures:
    """The measures of a frame, or of several that were added.

    Attributes:
        trail: occupied share of the volume that labelled movers swept at other times, without what
            is there now.
        own_path: occupied share of the volume that the recording vehicle drove through, without
            what is there now.
        own_path_all: the same with what is there now.
        lane: occupied share of the volume that the unlabelled follower swept, without what is there
            now.
        kept: share of the frame's own points on structure that are in occupied voxels.
    """

    trail: Share = field(default_factory=Share)
    own_path: Share = field(default_factory=Share)
    own_path_all: Share = field(default_factory=Share)
    lane: Share = field(default_factory=Share)
    kept: Share = field(default_factory=Share)

    def __add__(self, other: Measures) -> Measures:
        return Measures(*(getattr(self, name) + getattr(other, name) for name in vars(self)))


@dataclass(frozen=True)
class Judge:
    """Measures the grids of a drive.

    Attributes:
        drive: the sequence with boxes, from whose scans and poses the grids were made.
        window: first and last scan of the window that grids are made from, relative to the frame.
        movers: the labelled objects that move.
        standing: the labelled objects that do not.
        follower: the unlabelled car behind the recording vehicle.
        own: the recording vehicle, without its lowest part.
        min_range_m: nearer points are on the recording vehicle.
    """

    drive: Drive
    window: tuple[int, int]
    movers: tuple[Body, ...]
    standing: tuple[Body, ...]
    follower: Body
    own: Body
    min_range_m: float

    @classmethod
    def of(cls, drive: Drive, window: tuple[int, int] = (-30, 30)) -> Judge:
        """Return the judge of a drive that was written by `write_drive` with labels."""
        movers, standing = labelled_bodies(drive)
        own = Body("own", _poses(drive), np.array(OWN_LOWER), np.array(OWN_UPPER))
        return cls(
            drive,
            window,
            movers,
            standing,
            find_follower(drive),
            own,
            drive.metadata.min_range_m or 0.0,
        )

    def measure(self, grid: Grid, frame: int) -> Measures:
        """Return the measures of the grid of a frame."""
        pose = self.drive.read_pose(frame)
        centers = transform_points(pose, grid.spec.centers().reshape(-1, 3))
        occupied = grid.labels.reshape(-1) != 0
        others = [frame + step for step in range(self.window[0], self.window[1] + 1) if step]
        empty = ~self._occupied_now(frame, grid, centers)
        trail = np.zeros(len(centers), np.bool_)
        for body in self.movers:
            trail |= body.swept(others, centers)
        own = self.own.contains(others, centers)
        lane = self.follower.swept(others, centers)

        def share(volume: NDArray[np.bool_]) -> Share:
            return Share(int((occupied & volume).sum()), int(volume.sum()))

        kept = self._structure(frame, grid, pose)
        return Measures(
            share(trail & empty), share(own & empty), share(own), share(lane & empty), kept
        )

    def _occupied_now(
        self, frame: int, grid: Grid, centers: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return the voxels that a known body is in at the frame itself, or that the frame's own
        scan has points in.
        """
        now = np.zeros(len(centers), np.bool_)
        for body in (*self.movers, *self.standing, self.follower):
            now |= body.contains([frame], centers, GROW_M)
        index = grid.spec.flat_index(self._scan(frame))
        now[index[index >= 0]] = True
        return now

    def _structure(self, frame: int, grid: Grid, pose: Transform) -> Share:
        """Return which of the frame's own points on structure are in occupied voxels."""
        points = self._scan(frame)
        index = grid.spec.flat_index(points)
        world = transform_points(pose, points)
        use = (index >= 0) & (points[:, 2] - ground_below(points) > HEIGHT_M)
        for body in (*self.movers, *self.standing):
            use &= ~body.contains([frame], world, GROW_M)
        window = range(frame + self.window[0], frame + self.window[1] + 1)
        use &= ~self.follower.contains(window, world, GROW_M)
        return Share(int((grid.labels.reshape(-1)[index[use]] != 0).sum()), int(use.sum()))

    def _scan(self, frame: int) -> NDArray[np.float64]:
        points = self.drive.read("points", frame)[:, :3].astype(np.float64)
        return points[np.linalg.norm(points, axis=1) >= self.min_range_m]


def labelled_bodies(drive: Drive) -> tuple[tuple[Body, ...], tuple[Body, ...]]:
    """Return the labelled objects of a drive that move, and those that stand, with the boxes as
    they were annotated.
    """
    poses = _poses(drive)
    boxes = {frame: found for frame in poses if (found := drive.boxes(frame)) is not None}
    times = {frame: drive.read_time(frame) for frame in poses}
    world = {frame: found.transform(poses[frame]) for frame, found in boxes.items()}
    moves = {track.instance: track.moves for track in tracks_from_boxes(boxes, poses, times)}
    movers: list[Body] = []
    standing: list[Body] = []
    for number, is_mover in moves.items():
        seen = {
            frame: found.select(found.tracks == number)
            for frame, found in world.items()
            if number in found.tracks
        }
        half = np.median([box.sizes[0] for box in seen.values()], axis=0) / 2
        body = Body(
            f"track {number}",
            {frame: box.sensor_T_box[0] for frame, box in seen.items()},
            -half,
            half,
        )
        (movers if is_mover else standing).append(body)
    return tuple(movers), tuple(standing)


def find_follower(drive: Drive) -> Body:
    """Return the car that follows the recording vehicle outside the camera's view, which has no
    box.

    It keeps its distance, so its points are followed from scan to scan in the sensor's frame: in
    each scan, the mean of the points above the road that are near the mean of the scan before. The
    means in the world, smoothed, are its path, whose direction is its heading. All points together,
    moved to the body's frame, show its front and its sides; its rear is hidden.
    """
    poses = _poses(drive)
    frames = sorted(poses)
    center, means, seen = np.array(_FOLLOWER_START), [], []
    for frame in frames:
        points = drive.read("points", frame)[:, :3].astype(np.float64)
        height = points[:, 2] + SENSOR_HEIGHT_M
        points = points[(height > FLOOR_M) & (height < 2.0) & (points[:, 0] < -3.0)]
        for _ in range(5):
            near = np.linalg.norm(points[:, :2] - center, axis=1) < _FOLLOWER_RADIUS_M
            center = points[near, :2].mean(axis=0)
        means.append(transform_points(poses[frame], np.array([*center, -SENSOR_HEIGHT_M])))
        seen.append(transform_points(poses[frame], points[near]))
    seconds = np.array([drive.read_time(frame) for frame in frames])
    path, velocity = smooth(np.array(means), seconds, np.ones(len(frames)), _FOLLOWER_SMOOTH_S)
    bodies: dict[int, Transform] = {}
    for frame, place, (x, y, _) in zip(frames, path, velocity, strict=True):
        bodies[frame] = rotation_z(float(np.arctan2(y, x)))
        bodies[frame][:3, 3] = place
    cloud = np.concatenate(
        [
            transform_points(invert(bodies[frame]), points)
            for frame, points in zip(frames, seen, strict=True)
        ]
    )
    front, (right, left) = np.quantile(cloud[:, 0], 0.95), np.quantile(cloud[:, 1], (0.02, 0.98))
    lower, upper = (front - _FOLLOWER_LENGTH_M, right, 0.0), (front, left, _FOLLOWER_HEIGHT_M)
    return Body("follower", bodies, np.array(lower), np.array(upper))


def ground_below(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N,) the height of the ground below (N, 3) points, metres: the lowest points of each
    cell of 3 m, but outliers.
    """
    cells = np.floor(points[:, :2] / _GROUND_CELL_M).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    order = np.lexsort((points[:, 2], cell))
    counts = np.bincount(cell)
    firsts = np.cumsum(counts) - counts
    return points[order[firsts + counts // 50], 2][cell]


def _poses(drive: Drive) -> dict[int, Transform]:
    return {frame: drive.read_pose(frame) for frame in drive.scan_frames().tolist()}


def _between(
    points: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return the indices of the (N, 3) points between two corners."""
    return np.flatnonzero(((points > lower) & (points < upper)).all(axis=1))
