"""How the actors of a recording move: found by their numbers, frame by frame, then each followed by itself.

Nothing is kept but frame numbers and velocities: whoever follows an actor reads its points again, so memory does not grow with the recording.
"""

from __future__ import annotations

from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.converting.protocol import FrameHandle, Recording
from carlasc.converting.results import Steps
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import invert, transform_points
from carlasc.errors import CarlascError
from carlasc.motion.paths import estimate_path
from carlasc.running.processes import run_all

_BLOCK = 16  # frames that a worker looks at in one go
_MAX_GAP = 10  # frames that an actor may be hidden; afterwards it is followed anew
_LONGEST = 400  # sightings that are followed in one go
_MOST_POINTS = 1000  # of a sighting
_STANDING_M = 1.0  # of what has no moving class: what is seen of a standing actor may wander as much


@dataclass(frozen=True)
class _Look:
    """Frames in which to look for actors, and of which classes."""

    handles: tuple[FrameHandle, ...]
    labels: tuple[int, ...]


@dataclass(frozen=True)
class _Chase:
    """An actor to follow: the frames that it is in, where the sensor was, and when."""

    actor: int
    label: int
    handles: tuple[FrameHandle, ...]
    poses: NDArray[np.float64]
    seconds: NDArray[np.float64]
    classes: ClassTable


def estimate_actor_velocities(
    recording: Recording,
    poses: NDArray[np.float64],
    times: NDArray[np.float64],
    classes: ClassTable,
    *,
    workers: int,
    executor: Executor | None,
    steps: Steps,
) -> dict[int, dict[int, tuple[float, float, float]]]:
    """Estimate the velocity of each moving actor in each frame.

    Where classes say what moves, those actors do; where they do not, every numbered actor that may move is followed, and those
    that go nowhere are left out.

    Args:
        recording: has labels and instances.
        poses: (F, 4, 4) first_T_sensor by frame number.
        times: (F,) seconds by frame number.
        classes: table of the recording's labels.
        workers: how many frames, or actors, are looked at side by side.
        executor: does the work instead of processes of our own.
        steps: told of each frame that was looked at.

    Returns:
        (vx, vy, vz) in m/s over ground, sensor frame, by frame and actor.
    """
    handles = {handle.number: handle for handle in recording.frames}
    steps.expect(len(handles))
    sightings: dict[int, dict[int, int]] = {}
    labels = tuple(sorted(classes.moving or classes.movable))
    looks = [_Look(tuple(recording.frames[i : i + _BLOCK]), labels) for i in range(0, len(handles), _BLOCK)]
    with closing(run_all(_look, looks, workers=workers, executor=executor)) as found:
        for look, actors in zip(looks, found, strict=True):
            for frame, actor, label in actors:
                sightings.setdefault(actor, {})[frame] = label
            steps(len(look.handles))
    chases = [
        _Chase(
            actor,
            int(np.bincount([by_frame[frame] for frame in frames]).argmax()),
            tuple(handles[frame] for frame in frames),
            poses[frames],
            times[frames],
            classes,
        )
        for actor, by_frame in sightings.items()
        for frames in _runs(sorted(by_frame))
    ]
    velocities: dict[int, dict[int, tuple[float, float, float]]] = {}
    steps.expect(len(chases))
    with closing(run_all(_follow, chases, workers=workers, executor=executor)) as followed:
        for chase, estimate in zip(chases, followed, strict=True):
            for handle, velocity in zip(chase.handles, estimate, strict=True):
                velocities.setdefault(handle.number, {})[chase.actor] = (velocity[0], velocity[1], velocity[2])
            steps()
    return velocities


def _look(look: _Look) -> list[tuple[int, int, int]]:
    """Return (frame, actor, its class) of the actors in some frames; frames that cannot be read have none: who converts them reports them."""
    found = []
    for handle in look.handles:
        try:
            labels, instances = handle.read_labels()
        except (CarlascError, OSError):
            continue
        if labels is None or instances is None:
            continue
        numbered = np.flatnonzero(instances)
        numbered = numbered[np.isin(labels[numbered], look.labels)]
        for actor in np.unique(instances[numbered]).tolist():
            own = labels[numbered[instances[numbered] == actor]]
            found.append((handle.number, actor, int(np.bincount(own).argmax())))
    return found


def _follow(chase: _Chase) -> list[tuple[float, ...]]:
    """Return the actor's velocity in each of its frames, sensor frame; nothing where it goes nowhere."""
    sightings = [_points(chase, index) for index in range(len(chase.handles))]
    rigid = chase.label not in chase.classes.deformable
    velocities = estimate_path(sightings, chase.seconds, rigid=rigid)[1]
    if not chase.classes.moving:
        way = np.trapezoid(velocities, chase.seconds, axis=0)
        if np.linalg.norm(way) < _STANDING_M:
            velocities = np.zeros_like(velocities)
    sensor_R_world = invert(chase.poses)[:, :3, :3]
    return [tuple(row) for row in np.einsum("fij,fj->fi", sensor_R_world, velocities).tolist()]


def _points(chase: _Chase, index: int) -> NDArray[np.float64]:
    """Read the actor's points of one frame, world."""
    try:
        content = chase.handles[index].read()
    except (CarlascError, OSError):
        return np.empty((0, 3))
    own = np.flatnonzero(content.instances == chase.actor)
    points = content.points[own[:: max(1, len(own) // _MOST_POINTS)], :3]
    return transform_points(chase.poses[index], points[np.isfinite(points).all(axis=1)])


def _runs(frames: list[int]) -> list[list[int]]:
    """Split an actor's frames where it was hidden for long, and what is very long."""
    breaks = np.flatnonzero(np.diff(frames) > _MAX_GAP) + 1
    parts: list[list[int]] = []
    for part in np.split(np.array(frames), breaks):
        pieces = -(-len(part) // _LONGEST)
        parts += [piece.tolist() for piece in np.array_split(part, pieces)]
    return parts
