"""The rows of `movers.py`: the ways in which ground truth is made, and how what they are given is
changed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from movers_drives import MOVES_M_S, Recorded
from numpy.typing import NDArray

from carlasc import Boxes
from carlasc.core.geometry import rotation_z
from carlasc.groundtruth import FromScans
from carlasc.groundtruth.options import Complete
from carlasc.motion import MotionOptions
from carlasc.storage import Sequence

SEED = 12  # of all noise that is added
BARE = ("points",)
UNLABELLED = "align, free space, unlabelled"
Keep = Callable[[int], NDArray[np.bool_]]


class Changed(Sequence):
    """A sequence of which some points, ids or boxes are others.

    Args:
        sequence: the sequence.
        keep: returns which points of a frame are kept; None keeps all.
        instances: returns the instances of a frame; None for those of the sequence.
        labels: returns the labels of a frame; None for those of the sequence.
        boxes: the boxes by frame; None for those of the sequence.
    """

    def __init__(
        self,
        sequence: Sequence,
        *,
        keep: Keep | None = None,
        instances: Callable[[int], NDArray[np.uint32]] | None = None,
        labels: Callable[[int], NDArray[np.unsignedinteger]] | None = None,
        boxes: Mapping[int, Boxes] | None = None,
    ) -> None:
        self._sequence, self._keep, self._boxes = sequence, keep, boxes
        self._made = {
            name: made for name, made in (("instances", instances), ("labels", labels)) if made
        }
        self.path, self.location, self.split = sequence.path, sequence.location, sequence.split
        self.name, self.coordinates = sequence.name, sequence.coordinates

    def fields(self) -> frozenset[str]:
        """Return the fields of the sequence."""
        return self._sequence.fields()

    def frames(self, field: str) -> NDArray[np.int64]:
        """Return the frames that have a field."""
        if field == "boxes" and self._boxes is not None:
            return np.array(sorted(self._boxes), np.int64)
        return self._sequence.frames(field)

    def read(self, field: str, frame: int) -> NDArray[Any]:
        """Read one field of one frame."""
        if field == "boxes":
            return (
                self._sequence.read(field, frame)
                if self._boxes is None
                else self._boxes[frame].to_table()
            )
        values: NDArray[Any] = (
            self._made[field](frame) if field in self._made else self._sequence.read(field, frame)
        )
        return values if self._keep is None else values[self._keep(frame)]

    def documents(self) -> tuple[str, ...]:
        """Return the documents of the sequence."""
        return self._sequence.documents()

    def read_document(self, name: str) -> bytes:
        """Return a document of the sequence."""
        return self._sequence.read_document(name)


class Only(Changed):
    """A sequence with some of its fields only: those of `BARE` are what most recordings have."""

    def __init__(self, sequence: Sequence, names: Iterable[str]) -> None:
        super().__init__(sequence)
        self._names = frozenset(names)

    def fields(self) -> frozenset[str]:
        """Return the fields that are kept."""
        return self._sequence.fields() & self._names

    def frames(self, field: str) -> NDArray[np.int64]:
        """Return the frames that have a field."""
        return super().frames(field) if field in self.fields() else np.empty(0, np.int64)


def without_labels(drive: Recorded, frame: int) -> Sequence:
    """Keep nothing but the points."""
    return Only(drive.sequence, BARE)


def without_times(drive: Recorded, frame: int) -> Sequence:
    """Leave out the times of points."""
    return Only(drive.sequence, drive.sequence.fields() - {"seconds"})


def unchanged(drive: Recorded, frame: int) -> Sequence:
    """Return the drive as it was recorded."""
    return drive.sequence


@dataclass(frozen=True)
class Row:
    """One way to make the ground truth.

    Attributes:
        name: its name in the table.
        observe: how scans are merged.
        change: returns what is merged into a frame, of a recorded drive.
        by_frame: whether that differs from frame to frame.
    """

    name: str
    observe: FromScans
    change: Callable[[Recorded, int], Sequence] = unchanged
    by_frame: bool = False

    @property
    def finds(self) -> str:
        """What its actors depend on, apart from the drive: rows with equal ones share them."""
        return f"{self.observe.motion} {getattr(self.change, '__name__', self.change)}"


def _merging(**options: Any) -> FromScans:
    return FromScans(**options, own_path=False)


def noisy_boxes(drive: Recorded, frame: int) -> Sequence:
    """Boxes as annotators draw them: 0.1 m and 1 degree off, and none in a fifth of the frames."""
    rng = np.random.default_rng([SEED, drive.setting.seed])
    boxes = {}
    for number in drive.sequence.frames("boxes").tolist():
        exact = drive.sequence.boxes(number)
        if exact is None or rng.random() < 0.2:
            continue
        poses = exact.sensor_T_box.copy()
        poses[:, :3, 3] += rng.normal(0, 0.1, (len(poses), 3))
        poses = poses @ np.array(
            [rotation_z(a) for a in rng.normal(0, np.radians(1), len(poses))]
        ).reshape(-1, 4, 4)
        boxes[number] = Boxes.from_poses(exact.tracks, exact.labels, poses, exact.sizes)
    return Changed(drive.sequence, boxes=boxes)


def wrong_ids(drive: Recorded, frame: int) -> Sequence:
    """In every scan, one actor in ten has the number of another."""

    def instances(number: int) -> NDArray[np.uint32]:
        rng = np.random.default_rng([SEED, drive.setting.seed, number])
        ids = drive.sequence.read("instances", number)
        actors = np.unique(ids[ids > 0])
        changed = {int(a): int(rng.choice(actors)) for a in actors if rng.random() < 0.1}
        given = ids.copy()
        for actor, other in changed.items():
            given[ids == actor] = other
        return given

    return Changed(drive.sequence, instances=instances)


@dataclass(frozen=True)
class NoisyPoses:
    """Poses that are off by some metres (standard deviation, each axis) and degrees (about each
    axis) in every frame.
    """

    metres: float
    degrees: float

    def __call__(self, drive: Recorded, frame: int) -> Sequence:
        """Return the sequence with other poses."""
        rng = np.random.default_rng([SEED, drive.setting.seed])
        poses = drive.sequence.poses.copy()
        for pose in poses:
            pose[:3, :3] = pose[:3, :3] @ _turned(rng.normal(0, np.radians(self.degrees), 3))
            pose[:3, 3] += rng.normal(0, self.metres, 3)
        return drive.sequence.with_poses(poses)


def _turned(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (3, 3) rotation about x, y and z by small angles."""
    turn = np.eye(3)
    for axis, angle in enumerate(angles):
        other = [i for i in range(3) if i != axis]
        step = np.eye(3)
        step[np.ix_(other, other)] = [
            [np.cos(angle), -np.sin(angle)],
            [np.sin(angle), np.cos(angle)],
        ]
        turn = turn @ step
    return turn


def without_movers(drive: Recorded, frame: int) -> Sequence:
    """Remove the points of all movers from the scans of other frames: the best of removal."""

    def keep(number: int) -> NDArray[np.bool_]:
        flow = drive.sequence.read("flow", number)
        moves = np.linalg.norm(flow, axis=1) > MOVES_M_S
        return ~moves if number != frame else np.ones(len(flow), np.bool_)

    return Changed(drive.sequence, keep=keep)


def without_what_dufomap_finds(drive: Recorded, frame: int) -> Sequence:
    """Remove what DUFOMap finds to be dynamic from the scans of other frames."""
    static = find_static(drive)

    def keep(number: int) -> NDArray[np.bool_]:
        return static[number] if number != frame else np.ones(len(static[number]), np.bool_)

    return Changed(drive.sequence, keep=keep)


def find_static(
    drive: Recorded, cell_m: float = 0.1, hits_m: float = 0.2, unknown: int = 1
) -> dict[int, NDArray[np.bool_]]:
    """Return which points of each scan DUFOMap calls static, with the parameters of its paper or
    others; the result is kept beside the drive.
    """
    path = drive.folder / f"dufomap {cell_m:g} {hits_m:g} {unknown}.npz"
    frames = drive.sequence.frames("points").tolist()
    if not path.exists():
        from dufomap import dufomap  # noqa: PLC0415 (pip install "carlasc[study]")

        scans = {f: drive.sequence.read("points", f)[:, :3].astype(np.float64) for f in frames}
        poses = {f: np.asarray(drive.sequence.read_pose(f)) for f in frames}
        finder = dufomap(cell_m, hits_m, unknown, num_threads=1)
        finder.setCluster(0, 20, 0.2)
        for f in frames:
            finder.run(scans[f], poses[f], cloud_transform=True)
        finder.oncePropagateCluster(if_cluster=True, if_propagate=True)
        static = {
            str(f): np.asarray(finder.segment(scans[f], poses[f], cloud_transform=True)) == 0
            for f in frames
        }
        np.savez_compressed(path, **static)
    kept = np.load(path)
    return {f: kept[str(f)] for f in frames}


def has_dufomap() -> bool:
    """Whether DUFOMap is installed: it has no wheel for every version of Python."""
    from importlib.util import find_spec  # noqa: PLC0415

    return find_spec("dufomap") is not None


FLOW = _merging(motion=MotionOptions("flow"))
ROWS = (
    Row("tube", FromScans(dynamic="tube")),
    Row("current", _merging(dynamic="current", motion=MotionOptions("flow"))),
    Row("drop", _merging(dynamic="drop", motion=MotionOptions("flow"))),
    *(
        [Row("dufomap, then tube", FromScans(dynamic="tube"), without_what_dufomap_finds, True)]
        if has_dufomap()
        else []
    ),
    Row("perfect removal, then tube", FromScans(dynamic="tube"), without_movers, True),
    Row("align, flow", FLOW),
    *(
        Row(f"align, flow, complete={complete}", replace(FLOW, complete=complete))
        for complete in get_args(Complete)
        if complete != FLOW.complete
    ),
    Row("align, instances", _merging(motion=MotionOptions("instances"))),
    Row("align, boxes", _merging(motion=MotionOptions("boxes")), noisy_boxes),
    Row("align, exact boxes", _merging(motion=MotionOptions("boxes"))),
    Row("align, free space", _merging(motion=MotionOptions("evidence"))),
    Row(UNLABELLED, _merging(motion=MotionOptions("evidence")), without_labels),
)
"""The rows of the tables."""

EVIDENCE = _merging(motion=MotionOptions("evidence"))
_HINTS = {"flow": FLOW, "free space": EVIDENCE}
ABLATIONS = (
    *(
        Row(f"{hint}, poses {text}", observe, NoisyPoses(metres, degrees))
        for hint, observe in _HINTS.items()
        for text, metres, degrees in (
            ("1 cm", 0.01, 0.0),
            ("5 cm", 0.05, 0.0),
            ("20 cm", 0.2, 0.0),
            ("0.1 degrees", 0.0, 0.1),
            ("0.5 degrees", 0.0, 0.5),
        )
    ),
    *(
        Row(f"{hint}, window of {frames} frames", replace(observe, window=(-frames, frames)))
        for hint, observe in _HINTS.items()
        for frames in (5, 15)
    ),
    Row("instances, 10% wrong ids", _merging(motion=MotionOptions("instances")), wrong_ids),
)
"""What is changed one at a time, at 32 channels on the coarse grid.

The window is 30 frames elsewhere.
"""
TURNING = (
    *(Row(f"align, {hint}", observe) for hint, observe in _HINTS.items()),
    *(Row(f"{hint}, without times", observe, without_times) for hint, observe in _HINTS.items()),
)
"""The rows with LiDARs that turn: with the times of points, and without them."""
BASIC = tuple(
    row
    for row in ROWS
    if row.name in ("tube", "perfect removal, then tube")
    or (row.observe.dynamic == "align" and "complete" not in row.name and "exact" not in row.name)
)
"""The rows with other LiDARs, and on the finer grid."""
PARKED = tuple(
    row for row in ROWS if row.name in ("tube", "current", "align, flow", "align, instances")
)
"""The rows of the drives with parked cars."""
