"""The motion of the numbered actors of a recording: their points are collected while scans are
read, then their paths are estimated.

A path is estimated when its actor was not seen for a while, and only its velocities are kept.
Except for the result, memory therefore does not grow with the length of the recording.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np

from carlasc.core.arrays import Float32Array, LabelArray, Uint32Array
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, multiply, thin, transform_points
from carlasc.motion.paths import estimate_path, is_static
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run

Velocity = tuple[float, float, float]
"""(vx, vy, vz) in m/s over ground, right-handed sensor frame."""

_MAX_GAP = 10  # frames for which an actor may be hidden; a new path begins after a longer gap
_MAX_OBSERVATIONS = 400  # of one path
_MAX_POINTS = 1000  # of one observation
_FARTHEST_M = 1e4  # points farther than any LiDAR measures are damaged, as infinity and NaN are
_BATCH = 32  # paths that are estimated together


@dataclass(frozen=True)
class ActorObservation:
    """The points of one actor in one scan.

    Attributes:
        actor: its number.
        label: its most frequent class.
        points: (M, 3) float32, at most some hundreds, metres, right-handed sensor frame.
    """

    actor: int
    label: int
    points: Float32Array


def find_actors(
    points: Float32Array,
    labels: LabelArray,
    instances: Uint32Array,
    classes: ClassTable,
) -> tuple[ActorObservation, ...]:
    """Return the numbered actors of a scan that may move: those of moving classes, or of movable
    classes if the table has no moving ones.

    Args:
        points: (N, 4) x, y, z in metres and remission.
        labels: (N,) class ids.
        instances: (N,) number of each point's actor, 0 for none.
        classes: table of the ids.
    """
    wanted = np.flatnonzero(
        (instances > 0) & np.isin(labels, sorted(classes.moving or classes.movable))
    )
    wanted = wanted[(np.abs(points[wanted, :3]) < _FARTHEST_M).all(axis=1)]
    order = wanted[np.argsort(instances[wanted], kind="stable")]
    groups = np.split(order, np.flatnonzero(np.diff(instances[order])) + 1) if len(order) else []
    return tuple(
        ActorObservation(
            int(instances[own[0]]),
            int(np.bincount(labels[own]).argmax()),
            thin(points[own, :3], _MAX_POINTS),
        )
        for own in groups
    )


@dataclass
class _ObservationChain:
    """The observations of one actor without a long gap."""

    actor: int
    label_counts: dict[int, int] = field(default_factory=dict)
    frames: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    poses: list[Transform] = field(default_factory=list)
    points: list[Float32Array] = field(default_factory=list)

    def size(self) -> int:
        """Return the number of points."""
        return sum(map(len, self.points))

    @property
    def label(self) -> int:
        """The class of most observations, the lowest of several."""
        return max(sorted(self.label_counts), key=self.label_counts.__getitem__)


@dataclass(frozen=True)
class _VelocityEstimate:
    """Estimates the velocities of an actor, in a worker."""

    classes: ClassTable

    def __call__(self, chain: _ObservationChain) -> list[Velocity]:
        """Return the velocity in each frame of a chain, in the sensor frame of that frame."""
        poses, seconds = np.stack(chain.poses), np.array(chain.seconds)
        observations = [
            transform_points(pose, points) for pose, points in zip(poses, chain.points, strict=True)
        ]
        rigid = chain.label not in self.classes.deformable
        positions, velocities, headings = estimate_path(observations, seconds, rigid=rigid)
        if not self.classes.moving and is_static(observations, positions, headings, seconds):
            velocities = np.zeros_like(velocities)
        own = multiply(invert(poses)[:, :3, :3], velocities[:, :, None])[:, :, 0]
        return [(x, y, z) for x, y, z in own.tolist()]


class ActorMotion:
    """Collects the observations of actors, frame by frame, and estimates their velocities.

    If the class table has no classes of moving actors, static actors get zero.

    Args:
        classes: table of the labels.
        run: how the work is spread.
    """

    def __init__(self, classes: ClassTable, run: Run) -> None:
        self._estimate, self._run_options = _VelocityEstimate(classes), run
        self._chains: dict[int, _ObservationChain] = {}
        self._ended: list[_ObservationChain] = []
        self._velocities: dict[int, dict[int, Velocity]] = {}

    def add(
        self,
        frame: int,
        seconds: float,
        first_T_sensor: Transform,
        actors: Iterable[ActorObservation],
    ) -> None:
        """Add the actors of the next frame.

        Args:
            frame: its number.
            seconds: its time.
            first_T_sensor: (4, 4) pose of the sensor.
            actors: what was seen of each actor.
        """
        for observation in actors:
            chain = self._chains.get(observation.actor)
            if (
                chain is None
                or frame - chain.frames[-1] > _MAX_GAP
                or len(chain.frames) >= _MAX_OBSERVATIONS
            ):
                self._ended += [] if chain is None else [chain]
                chain = self._chains[observation.actor] = _ObservationChain(observation.actor)
            chain.label_counts[observation.label] = chain.label_counts.get(observation.label, 0) + 1
            chain.frames.append(frame)
            chain.seconds.append(seconds)
            chain.poses.append(first_T_sensor)
            chain.points.append(observation.points)
        for actor in [
            actor for actor, chain in self._chains.items() if frame - chain.frames[-1] > _MAX_GAP
        ]:
            self._ended.append(self._chains.pop(actor))
        if len(self._ended) >= _BATCH:
            self._run()

    def finish(self) -> Mapping[int, Mapping[int, Velocity]]:
        """Return the velocity by frame number and actor."""
        self._ended += self._chains.values()
        self._chains = {}
        self._run()
        return self._velocities

    def _run(self) -> None:
        # longest first: no worker ends late
        chains = sorted(self._ended, key=_ObservationChain.size, reverse=True)
        self._ended = []
        with closing(run_all(self._estimate, chains, self._run_options)) as estimates:
            for chain, velocities in zip(chains, estimates, strict=True):
                for frame, velocity in zip(chain.frames, velocities, strict=True):
                    self._velocities.setdefault(frame, {})[chain.actor] = velocity
