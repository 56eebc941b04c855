"""Annotated boxes follow the points that are in them: a person draws each box some centimetres and a degree off, which blurs what is merged.

The sightings of a moving object are laid on each other, as those of actors without boxes are, but each stays near the smoothed box of its
scan. So objects that few rays hit stay where they were drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from carlasc.core.geometry import multiply, rotation_z
from carlasc.motion.paths import MIN_POINTS, best_sighting, corrections
from carlasc.motion.segments import Segment
from carlasc.motion.tracks import Track

_DRAWN = np.array([0.05, 0.05, 0.03, 0.01])  # error of a smoothed box: x, y, z in metres, yaw in radians
_MIN_SIGHTINGS = 5  # with fewer, there is nothing to lay on each other


def register_boxes(track: Track, segments: Sequence[Segment], times: Mapping[int, float]) -> Track:
    """Return the track of an object's boxes with poses under which its sightings fit each other.

    The mean of all boxes stays where it is, in the object's frame. Objects that stand, and those that change their shape, stay as they are.

    Args:
        track: the track of the boxes.
        segments: the points in its boxes, one segment for each scan, in order of frames.
        times: seconds by frame.
    """
    hit = {s.frame: s for s in segments if len(s.points) >= MIN_POINTS and track.pose(s.frame) is not None}
    if not (track.moves and track.rigid) or len(hit) < _MIN_SIGHTINGS:
        return track
    rows, seconds = np.array([*hit]) - track.first, np.array([times[frame] for frame in hit])
    points = [segment.points for segment in hit.values()]
    poses = track.world_T_actor
    drawn = np.column_stack([poses[rows, :3, 3], np.unwrap(np.arctan2(poses[rows, 1, 0], poses[rows, 0, 0]))])
    change, rates = corrections(points, seconds, drawn, _DRAWN, best_sighting(points))
    axes = np.stack([rotation_z(-yaw)[:3, :3] for yaw in drawn[:, 3].tolist()])
    own = np.column_stack([multiply(axes, change[:, :3, None])[:, :, 0], change[:, 3]])
    own -= np.average(own, axis=0, weights=[len(some) for some in points])
    every = np.arange(len(poses))
    x, y, z, yaw = (np.interp(every, rows, own[:, axis]) for axis in range(4))
    moved = np.stack([rotation_z(angle) for angle in yaw])
    moved[:, :3, 3] = np.column_stack([x, y, z])
    faster = np.column_stack([np.interp(every, rows, rates[:, axis], left=0, right=0) for axis in range(3)])
    return replace(track, world_T_actor=multiply(poses, moved), velocity=track.velocity + faster)
