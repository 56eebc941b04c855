"""The motion of a recording's actors: they are found by their numbers, frame by frame, and each one's path is then estimated.

Only frame numbers and velocities are kept. The task that estimates a path reads the actor's points again, so memory does not
grow with the recording.
"""

from __future__ import annotations

from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.converting.frames import Velocity
from carlasc.converting.protocol import FrameHandle, Recording
from carlasc.converting.results import Steps
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import invert, transform_points
from carlasc.errors import CarlascError
from carlasc.motion.paths import estimate_path
from carlasc.running.processes import run_all

_BLOCK = 16  # frames that a worker searches in one task
_MAX_GAP = 10  # frames for which an actor may be hidden; after a longer gap a new path begins
_MAX_SIGHTINGS = 400  # of one path
_MAX_POINTS = 1000  # of one sighting
_MIN_PATH_M = 1.0  # where no class says what moves: the visible part of a standing actor may shift by as much


@dataclass(frozen=True)
class _FrameBlock:
    """Frames in which actors of some classes are looked for."""

    handles: tuple[FrameHandle, ...]
    labels: tuple[int, ...]


@dataclass(frozen=True)
class _Track:
    """The frames in which one actor is seen.

    Attributes:
        actor: its number.
        label: its most frequent class.
        handles: T frames.
        poses: (T, 4, 4) first_T_sensor of these frames.
        times_s: (T,) seconds.
        classes: table of the labels.
    """

    actor: int
    label: int
    handles: tuple[FrameHandle, ...]
    poses: NDArray[np.float64]
    times_s: NDArray[np.float64]
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
) -> dict[int, dict[int, Velocity]]:
    """Estimate the velocity of each moving actor in each frame.

    If the class table has classes of moving actors, only actors of these classes get a velocity. If it has none, the paths of all
    numbered actors of movable classes are estimated, and those whose path is short get zero.

    Args:
        recording: has labels and instances.
        poses: (F, 4, 4) first_T_sensor by frame number.
        times: (F,) seconds by frame number.
        classes: table of the recording's labels.
        workers: number of frames, or actors, that are worked on at the same time.
        executor: runs the work instead of processes of our own.
        steps: is called after each frame and each actor.

    Returns:
        The velocity by frame number and actor.
    """
    handles = {handle.number: handle for handle in recording.frames}
    steps.expect(len(handles))
    sightings: dict[int, dict[int, int]] = {}  # actor -> frame -> class
    labels = tuple(sorted(classes.moving or classes.movable))
    blocks = [_FrameBlock(tuple(recording.frames[i : i + _BLOCK]), labels) for i in range(0, len(handles), _BLOCK)]
    with closing(run_all(_find_actors, blocks, workers=workers, executor=executor)) as found:
        for block, actors in zip(blocks, found, strict=True):
            for frame, actor, label in actors:
                sightings.setdefault(actor, {})[frame] = label
            steps(len(block.handles))
    tracks = [
        _Track(
            actor,
            int(np.bincount([by_frame[frame] for frame in frames]).argmax()),
            tuple(handles[frame] for frame in frames),
            poses[frames],
            times[frames],
            classes,
        )
        for actor, by_frame in sightings.items()
        for frames in _split_at_gaps(sorted(by_frame))
    ]
    velocities: dict[int, dict[int, Velocity]] = {}
    steps.expect(len(tracks))
    with closing(run_all(_estimate_velocities, tracks, workers=workers, executor=executor)) as estimates:
        for track, estimate in zip(tracks, estimates, strict=True):
            for handle, velocity in zip(track.handles, estimate, strict=True):
                velocities.setdefault(handle.number, {})[track.actor] = velocity
            steps()
    return velocities


def _find_actors(block: _FrameBlock) -> list[tuple[int, int, int]]:
    """Return (frame, actor, class) of the actors in some frames. Frames that cannot be read are skipped: their conversion reports them."""
    found = []
    for handle in block.handles:
        try:
            labels, instances = handle.read_labels()
        except (CarlascError, OSError):
            continue
        if labels is None or instances is None:
            continue
        numbered = np.flatnonzero(instances)
        numbered = numbered[np.isin(labels[numbered], block.labels)]
        for actor in np.unique(instances[numbered]).tolist():
            own = labels[numbered[instances[numbered] == actor]]
            found.append((handle.number, actor, int(np.bincount(own).argmax())))
    return found


def _estimate_velocities(track: _Track) -> list[Velocity]:
    """Return the actor's velocity in each of its frames, in the sensor frame of that frame."""
    sightings = [_read_points(track, index) for index in range(len(track.handles))]
    rigid = track.label not in track.classes.deformable
    velocities = estimate_path(sightings, track.times_s, rigid=rigid)[1]
    if not track.classes.moving:
        displacement = np.trapezoid(velocities, track.times_s, axis=0)
        if np.linalg.norm(displacement) < _MIN_PATH_M:
            velocities = np.zeros_like(velocities)
    sensor_R_world = invert(track.poses)[:, :3, :3]
    return [(x, y, z) for x, y, z in np.einsum("fij,fj->fi", sensor_R_world, velocities).tolist()]


def _read_points(track: _Track, index: int) -> NDArray[np.float64]:
    """Return (N, 3) points of the actor in one frame, world frame; none if the frame cannot be read."""
    try:
        content = track.handles[index].read()
    except (CarlascError, OSError):
        return np.empty((0, 3))
    own = np.flatnonzero(content.instances == track.actor)
    points = content.points[own[:: max(1, len(own) // _MAX_POINTS)], :3]
    return transform_points(track.poses[index], points[np.isfinite(points).all(axis=1)])


def _split_at_gaps(frames: list[int]) -> list[list[int]]:
    """Split an actor's frames at long gaps, and long parts into pieces of at most `_MAX_SIGHTINGS`."""
    breaks = np.flatnonzero(np.diff(frames) > _MAX_GAP) + 1
    parts: list[list[int]] = []
    for part in np.split(np.array(frames), breaks):
        pieces = -(-len(part) // _MAX_SIGHTINGS)
        parts += [piece.tolist() for piece in np.array_split(part, pieces)]
    return parts
