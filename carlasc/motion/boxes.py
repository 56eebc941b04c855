"""Tracks from annotated boxes: the boxes of one object over time, smoothed, and the points of a
scan that are in them.

Each drawn box is wrong by some centimetres and a degree, which blurs merged scans. Boxes are
therefore corrected by the points in them: the observations of a moving object are registered, as
for actors without boxes, and each stays near the smoothed box of its scan. Objects with few points
keep their drawn poses.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlasc.core.arrays import BoolArray, FloatArray, IntArray, LabelArray
from carlasc.core.boxes import Boxes, mirror_boxes
from carlasc.core.geometry import (
    Transform,
    invert,
    mirror_poses,
    moved_back,
    multiply,
    rotation_z,
    transform_points,
)
from carlasc.core.scans import Scan, finite
from carlasc.motion.bodies import BODY_MARGIN_M, Extent
from carlasc.motion.paths import MIN_POINTS, Segment, best_observation, corrections
from carlasc.motion.segments import MIN_SPEED_M_S
from carlasc.motion.solving import nearest_rotation, resample, smooth
from carlasc.motion.tracks import Track
from carlasc.storage.protocol import Sequence as Series

# fact: smooth-boxes
_SMOOTH_S = 0.5  # half width of the window in which an object moves with constant acceleration
_FILLED_IN = 0.3  # weight of a box that was not annotated in its frame
_STATIC_M = 1.0  # boxes of a static object may move this far, but not steadily
# a shorter displacement counts if it is so many times its deviation from a line
_STEADY_M, _STEADY = (
    0.3,
    5.0,
)
_HOLD_S = 1.0  # an object that is static for this time is static in all frames
_EXTRAPOLATE_S = 0.5  # time by which a track extends beyond its first and its last box
# boxes that are farther apart belong to different objects with one number
_JUMP_M, _MAX_SPEED_M_S = (
    1.5,
    40.0,
)
# points of other classes than the track's count as ground up to this height in its box
_FLOOR_M = 0.15
_ROUNDING_M = 0.01  # more than the rounding of a position


@dataclass(frozen=True)
class _ObjectBoxes:
    """The boxes of one object.

    Attributes:
        frames: (F,) frame numbers, increasing.
        seconds: (F,) their times.
        poses: (F, 4, 4) world_T_box.
        sizes: (F, 3) metres.
        labels: (F,) class ids.
        weights: (F,) weight of each box.
    """

    frames: IntArray
    seconds: FloatArray
    poses: FloatArray
    sizes: FloatArray
    labels: IntArray
    weights: FloatArray

    def part(self, rows: IntArray) -> _ObjectBoxes:
        return _ObjectBoxes(*(values[rows] for values in vars(self).values()))


def sequence_boxes(
    sequence: Series, frames: Sequence[int]
) -> tuple[FloatArray, FloatArray, dict[int, Boxes]]:
    """Return (F,) seconds and (F, 4, 4) first_T_scan of frames of a sequence, and the boxes of
    those that are annotated, in the frame of the scan; all right-handed.

    Raises:
        MissingDataError: there are no poses.
        FormatError: a pose, a time or boxes are not valid.
    """
    poses = np.stack([sequence.read_pose(frame) for frame in frames])
    boxes = {frame: own for frame in frames if (own := sequence.boxes(frame)) is not None}
    if sequence.metadata.axes == "left":
        poses = mirror_poses(poses)
        boxes = {frame: mirror_boxes(own) for frame, own in boxes.items()}
    return sequence.times_of(frames), poses, boxes


def velocities_of(tracks: Sequence[Track], frame: int, boxes: Boxes) -> FloatArray:
    """Return (N, 3) m/s, world: the velocity at a frame of the track of each of its boxes."""
    own = {
        track.instance: velocity
        for track in tracks
        if (velocity := track.velocity_at(frame)) is not None
    }
    return np.array([own[number] for number in boxes.tracks.tolist()]).reshape(-1, 3)


def tracks_from_boxes(
    boxes: Mapping[int, Boxes],
    poses: Mapping[int, Transform],
    times: Mapping[int, float],
    *,
    deformable: Collection[int] = (),
) -> list[Track]:
    """Return the tracks of annotated boxes.

    All boxes of an object together decide whether it is static, because annotated boxes of a parked
    car move by some decimetres. A static object has one pose, the median of its boxes, and velocity
    0 in all frames of `times`. The poses of moving objects are smoothed, and interpolated where
    boxes are missing. No points are used.

    Args:
        boxes: the boxes of each annotated frame, sensor frame.
        poses: (4, 4) world_T_sensor of these frames, or of more.
        times: seconds of all frames of the sequence, increasing.
        deformable: classes whose objects change their shape.

    Returns:
        The tracks in order of their numbers, without members: `segment_by_boxes` finds the members
        in a scan. An object whose boxes jump has several tracks with the same number.
    """
    places: dict[int, list[tuple[int, int]]] = {}  # frames and rows by track
    for frame in sorted(boxes):
        for row, track in enumerate(boxes[frame].tracks.tolist()):
            places.setdefault(track, []).append((frame, row))
    world = {frame: boxes[frame].transform(poses[frame]) for frame in boxes}
    known, seconds = (np.array(values) for values in zip(*sorted(times.items()), strict=True))
    return [
        _make_track(track, part, known, seconds, deformable)
        for track in sorted(places)
        for part in _split_at_jumps(
            _boxes_of([(frame, world[frame], row) for frame, row in places[track]], times)
        )
    ]


def segment_by_boxes(
    frame: int,
    scan: Scan,
    world_T_sensor: Transform,
    tracks: Sequence[Track],
    *,
    ground: Collection[int] = (),
) -> list[Segment]:
    """Return the points of a scan that are in the boxes of tracks.

    Points of ground classes belong to no track. A point in the boxes of several tracks belongs to
    the smallest one.

    Args:
        frame: frame number.
        scan: points, with labels if it has any.
        world_T_sensor: (4, 4) pose of the scan.
        tracks: the tracks. Tracks that do not extend to the frame have no segment.
        ground: ids of the ground classes.

    Returns:
        The segments of the tracks that have points in the scan, in the order of the tracks. Each
        has the label, the number and the velocity of its track.
    """
    owners = np.full(len(scan), -1, np.int64)
    usable = finite(scan.points)
    if scan.labels is not None:
        usable &= ~np.isin(scan.labels, sorted(ground))
    candidates = np.flatnonzero(usable)
    x, y = scan.points[candidates, 0], scan.points[candidates, 1]
    labels = None if scan.labels is None else scan.labels[candidates]
    times = scan.others.get("seconds")
    late_s = 0.0 if times is None else float(np.abs(times).max(initial=0.0))
    sensor_T_world = invert(world_T_sensor)
    for index in np.argsort([-np.prod(track.size) for track in tracks], kind="stable").tolist():
        track = tracks[index]
        pose, velocity = track.pose(frame), track.velocity_at(frame)
        if pose is not None and velocity is not None:
            reach = (
                np.linalg.norm(np.maximum(np.abs(track.lower), np.abs(track.upper)), axis=0)
                + float(np.linalg.norm(velocity)) * late_s
                + _ROUNDING_M
            )
            there = transform_points(sensor_T_world, pose[:3, 3])
            near = np.flatnonzero((np.abs(x - there[0]) <= reach) & (np.abs(y - there[1]) <= reach))
            points = transform_points(world_T_sensor, scan.points[candidates[near]])
            points = moved_back(
                points, None if times is None else times[candidates[near]], velocity
            )
            members = near[_inside(track, pose, points, None if labels is None else labels[near])]
            owners[candidates[members]] = index
    segments = []
    for index, track in enumerate(tracks):
        members = np.flatnonzero(owners == index)
        if len(members):
            own = transform_points(world_T_sensor, scan.points[members])
            velocity, origin = track.velocity_at(frame), world_T_sensor[:3, 3]
            assert velocity is not None
            own = moved_back(own, None if times is None else times[members], velocity)
            segments.append(
                Segment(frame, track.label, members, own, velocity, track.instance, origin)
            )
    return segments


def _inside(
    track: Track, pose: Transform, points: FloatArray, labels: LabelArray | None
) -> BoolArray:
    """Return which of (M, 3) points, world, are in a track's box at a pose and above its ground."""
    body = transform_points(invert(pose), points)
    inside = ((body >= track.lower) & (body <= track.upper)).all(axis=1)
    above = body[:, 2] > track.lower[2] + BODY_MARGIN_M + _FLOOR_M
    if labels is not None:
        above |= labels == track.label
    return inside & above


def _boxes_of(places: list[tuple[int, Boxes, int]], times: Mapping[int, float]) -> _ObjectBoxes:
    """Return the boxes of one object: (frame, boxes of the frame in the world, row)."""
    chosen = [boxes.select(np.array([row])) for _, boxes, row in places]
    frames = np.array([frame for frame, _, _ in places], np.int64)
    return _ObjectBoxes(
        frames,
        np.array([times[frame] for frame in frames.tolist()]),
        np.concatenate([box.sensor_T_box for box in chosen]),
        np.concatenate([box.sizes for box in chosen]),
        np.concatenate([box.labels for box in chosen]).astype(np.int64),
        np.where(np.concatenate([box.annotated for box in chosen]), 1.0, _FILLED_IN),
    )


def _split_at_jumps(boxes: _ObjectBoxes) -> list[_ObjectBoxes]:
    """Split the boxes of a number where no object can move from one to the next in time."""
    steps = np.linalg.norm(np.diff(boxes.poses[:, :3, 3], axis=0), axis=1)
    jumps = np.flatnonzero(steps > _JUMP_M + _MAX_SPEED_M_S * np.diff(boxes.seconds)) + 1
    return [boxes.part(rows) for rows in np.split(np.arange(len(boxes.frames)), jumps)]


def _make_track(
    instance: int,
    boxes: _ObjectBoxes,
    known: IntArray,
    known_seconds: FloatArray,
    deformable: Collection[int],
) -> Track:
    """Return the track of the boxes of one object; `known` are (K,) the frames of the sequence,
    increasing, and their times.
    """
    seconds, centers = boxes.seconds, boxes.poses[:, :3, 3]
    headings, tilt = _headings_and_tilt(boxes.poses[:, :3, :3])
    path, speed = smooth(centers, seconds, boxes.weights, _SMOOTH_S)
    static = _is_static(path, centers, seconds)
    if static:
        path = np.tile(np.median(centers, axis=0), (len(seconds), 1))
        speed = np.zeros_like(speed)
        turns = np.full(len(seconds), np.median(headings))
    else:
        turns = smooth(headings[:, None], seconds, boxes.weights, _SMOOTH_S)[0][:, 0]
    frames = known
    if not static or seconds[-1] - seconds[0] < _HOLD_S:
        start, end = seconds[0] - _EXTRAPOLATE_S, seconds[-1] + _EXTRAPOLATE_S
        frames = known[(known_seconds > start) & (known_seconds < end)]
    every = np.arange(frames[0], frames[-1] + 1)
    at = np.interp(every, known, known_seconds)
    if static:  # all frames share the memory of one pose
        pose = multiply(rotation_z(turns[0]), tilt)
        pose[:3, 3] = path[0]
        poses, speed = (
            np.broadcast_to(pose, (len(every), 4, 4)),
            np.broadcast_to(speed[0], (len(every), 3)),
        )
    else:
        path, speed = resample(at, seconds, path, speed)
        poses = np.stack(
            [multiply(rotation_z(angle), tilt) for angle in np.interp(at, seconds, turns)]
        )
        poses[:, :3, 3] = path
    half = np.median(boxes.sizes, axis=0) / 2
    label = int(np.bincount(boxes.labels).argmax())
    return Track(
        label=label,
        instance=instance,
        members={},
        first=int(frames[0]),
        world_T_actor=poses,
        velocity=speed,
        lower=-half - BODY_MARGIN_M,
        upper=half + BODY_MARGIN_M,
        extent=Extent(-half, half, (True, True, True, True), 0),
        rigid=label not in deformable,
    )


def _headings_and_tilt(rotations: FloatArray) -> tuple[FloatArray, Transform]:
    """Return the (F,) headings of boxes, radians, unwrapped, and the mean of their (F, 3, 3)
    rotations without the headings.

    Annotators confuse the front of a box with its back. Headings that differ by half a turn
    therefore count as equal, and the majority decides.
    """
    angles = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    headings = np.unwrap(angles, period=np.pi)
    if np.cos(headings - angles).sum() < 0:
        headings = headings + np.pi
    upright = multiply(np.stack([rotation_z(-angle)[:3, :3] for angle in angles]), rotations)
    tilt = np.eye(4)
    tilt[:3, :3] = nearest_rotation(upright.mean(axis=0))
    return headings, tilt


def _is_static(path: FloatArray, centers: FloatArray, seconds: FloatArray) -> bool:
    """Return whether an object is static, from its (F, 3) smoothed path and the (F, 3) centres of
    its boxes, metres, world.
    """
    duration = float(seconds[-1] - seconds[0])
    if duration <= 0:
        return True
    line = centers[:, :2].mean(axis=0)
    offsets = (seconds - seconds.mean())[:, None]
    velocity = (offsets * centers[:, :2]).sum(axis=0) / np.square(offsets).sum()
    length = float(np.hypot(*velocity)) * duration
    deviation = centers[:, :2] - line - offsets * velocity
    steady = length > max(
        _STEADY_M, _STEADY * float(np.sqrt(np.square(deviation).sum(axis=1).mean()))
    )
    if steady and length / duration > MIN_SPEED_M_S:
        return False
    extent = float(np.hypot(*np.ptp(path[:, :2], axis=0)))
    slow = _fastest(path, seconds) < MIN_SPEED_M_S
    return extent < _STATIC_M or slow


def _fastest(path: FloatArray, seconds: FloatArray) -> float:
    """Return the greatest mean speed over `_HOLD_S` along a path, in m/s; over the whole path if it
    is shorter.
    """
    then = np.minimum(np.searchsorted(seconds, seconds + _HOLD_S), len(seconds) - 1)
    elapsed = seconds[then] - seconds
    whole = (elapsed >= min(_HOLD_S, float(seconds[-1] - seconds[0])) - 1e-9) & (elapsed > 0)
    length = np.linalg.norm(path[then, :2] - path[:, :2], axis=1)
    return float((length[whole] / elapsed[whole]).max(initial=0.0))


# error of a smoothed box: x, y, z in metres, yaw in radians
_DRAWN = np.array([0.05, 0.05, 0.03, 0.01])
_MIN_OBSERVATIONS = 5  # with fewer, boxes are not corrected


def register_boxes(track: Track, segments: Sequence[Segment], times: Mapping[int, float]) -> Track:
    """Return the track of an object's boxes with poses under which its observations align.

    The mean of all boxes does not change, in the frame of the object. Tracks of static and of
    deformable objects do not change.

    Args:
        track: the track of the boxes.
        segments: the points in its boxes, one segment per scan, in order of frames.
        times: seconds by frame.
    """
    hit = {
        s.frame: s
        for s in segments
        if len(s.points) >= MIN_POINTS and track.pose(s.frame) is not None
    }
    if not (track.moves and track.rigid) or len(hit) < _MIN_OBSERVATIONS:
        return track
    rows = np.array([*hit]) - track.first
    seconds = np.array([times[frame] for frame in hit])
    points = [segment.points for segment in hit.values()]
    poses = track.world_T_actor
    drawn = np.column_stack(
        [poses[rows, :3, 3], np.unwrap(np.arctan2(poses[rows, 1, 0], poses[rows, 0, 0]))]
    )
    change, rates = corrections(points, seconds, drawn, _DRAWN, best_observation(points))
    axes = np.stack([rotation_z(-yaw)[:3, :3] for yaw in drawn[:, 3].tolist()])
    own = np.column_stack([multiply(axes, change[:, :3, None])[:, :, 0], change[:, 3]])
    own -= np.average(own, axis=0, weights=[len(some) for some in points])
    every = np.arange(len(poses))
    *place, yaw = (np.interp(every, rows, column) for column in own.T)
    moved = np.stack([rotation_z(angle) for angle in yaw])
    moved[:, :3, 3] = np.column_stack(place)
    faster = np.column_stack([np.interp(every, rows, r, left=0, right=0) for r in rates.T[:3]])
    return replace(track, world_T_actor=multiply(poses, moved), velocity=track.velocity + faster)
