"""Scores of found boxes and tracks against annotated ones, as seen from above."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from carlasc.core.arrays import BoolArray, FloatArray
from carlasc.core.geometry import invert, transform_points
from carlasc.errors import MissingDataError, check_types, import_extra, only
from carlasc.metrics.confusion import json_number
from carlasc.metrics.results import Cell, FigureTable
from carlasc.motion import BoxTable, sequence_boxes, tracks_from_boxes, velocities_of
from carlasc.storage import Source, as_source
from carlasc.storage.files import AnyPath

_THRESHOLDS = (0.3, 0.5, 0.7)  # of IoU
_LEVELS = np.arange(1, 41) / 40  # recall values of KITTI's average precision
_KEPT = 1000.0  # a pair of the frame before is kept, as in TrackEval, if its IoU still suffices


class BoxScore(NamedTuple):
    """The scores of boxes at one IoU.

    Attributes:
        objects: "moving", of objects that move at some time, or "all".
        iou: least IoU, from above, of a found box and a true one.
        boxes: number of true boxes.
        ap: average precision: mean over 40 values of recall.
        precision: share of the found boxes that are of a true one.
        recall: share of the true boxes that were found.
        mota: accuracy of tracking: 1 - (missed + false + switches) / boxes.
        switches: how often a true object continues as another found one.
        heading: median error, degrees.
        velocity: median error, m/s.
    """

    objects: str
    iou: float
    boxes: int
    ap: float
    precision: float
    recall: float
    mota: float
    switches: int
    heading: float
    velocity: float


@dataclass(frozen=True)
class BoxScores:
    """The result of `evaluate_boxes`.

    Attributes:
        name: name of the found boxes.
        frames: number of annotated frames.
        left_out: number of found boxes at times without an annotated frame, or with a nearer box of
            the same object.
        scores: the scores, by objects and IoU.
    """

    name: str
    frames: int
    left_out: int
    scores: tuple[BoxScore, ...]

    def table(self) -> FigureTable:
        """Return the scores as a table, shares in percent."""
        units = ("Heading [deg]", "Velocity [m/s]")
        header = ("Objects", "IoU", "Boxes", "AP", "Precision", "Recall", "MOTA", "Switches")
        rows: list[tuple[Cell, ...]] = [
            (*one[:2], str(one.boxes), *(100 * share for share in one[3:7]), str(one[7]), *one[8:])
            for one in self.scores
        ]
        return FigureTable("Boxes", header + units, tuple(rows))

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain values for JSON."""
        scores = [
            {k: json_number(v) if isinstance(v, float) else v for k, v in one._asdict().items()}
            for one in self.scores
        ]
        return {**vars(self), "scores": scores}


class _Frame(NamedTuple):
    """The T true and the D found boxes of a frame; errors and IoU are (T, D)."""

    truth: list[int]
    found: list[int]
    scored: BoolArray  # (T,) annotated and in the region
    moving: BoolArray  # (T,)
    outside: BoolArray  # (D,) not in the region
    confidence: FloatArray
    iou: FloatArray
    heading: FloatArray
    velocity: FloatArray


def evaluate_boxes(
    found: AnyPath | BoxTable,
    truth: AnyPath | Source,
    *,
    name: str = "",
    near_m: float = 0.0,
    far_m: float = math.inf,
    fov_rad: float = 2 * math.pi,
) -> BoxScores:
    """Score found boxes against the annotated ones of a sequence, whatever their classes.

    Boxes are in the frame of the sequence's poses. IoU is that of rectangles seen from above. A
    found box of a true one that is not scored (one that was filled in, outside of the region, or
    static where moving objects are scored) counts neither as right nor as false.

    Args:
        found: the boxes, or their file.
        truth: a data set with one sequence with the field `boxes`, and poses.
        name: name of the boxes. Default: their file.
        near_m: only boxes at least so far from the sensor are scored, metres.
        far_m: only boxes nearer than this, metres.
        fov_rad: only boxes in a field of view of this angle, centred forward, radians.

    Raises:
        ArgumentError: several sequences have boxes.
        MissingDataError: no sequence has boxes, or it has no poses.
        FormatError: the boxes are not valid, or are those of another sequence.
        DependencyError: scipy is not installed.
    """
    check_types(evaluate_boxes, locals())
    table = found if isinstance(found, BoxTable) else BoxTable.read(found)
    where = "found" if isinstance(found, BoxTable) else str(found)
    source = as_source(truth)
    having = {path: one for path, one in source.sequences().items() if len(one.frames("boxes"))}
    if not having:
        raise MissingDataError(source, expected="annotated boxes, in the field boxes", found="none")
    sequence = only("truth", having, "one sequence with boxes")
    frames = sequence.frames("boxes").tolist()
    times, poses, boxes = sequence_boxes(sequence, frames)
    pose_of = dict(zip(frames, poses, strict=True))
    tracks = tracks_from_boxes(boxes, pose_of, dict(zip(frames, times.tolist(), strict=True)))

    place = table.frames_of(times, poses, where, sequence.location)
    gathered = []
    for index, frame in enumerate(frames):
        own = np.flatnonzero(place == index)
        world = boxes[frame].transform(poses[index])
        values = table.values[own]
        axes = world.sensor_T_box[:, :2, 0]
        local = transform_points(invert(poses[index]), values[:, :3])
        inside = [
            (np.hypot(at[:, 0], at[:, 1]) >= near_m)
            & (np.hypot(at[:, 0], at[:, 1]) < far_m)
            & (np.abs(np.arctan2(at[:, 1], at[:, 0])) <= fov_rad / 2)
            for at in (boxes[frame].centers, local)
        ]
        velocity = velocities_of(tracks, frame, world)
        headings = np.arctan2(axes[:, 1], axes[:, 0])
        true = np.column_stack([world.centers[:, :2], world.sizes[:, :2], headings])
        turned = np.abs(headings[:, None] - values[:, 6] + np.pi) % (2 * np.pi) - np.pi
        gathered.append(
            _Frame(
                world.tracks.tolist(),
                table.numbers[own].tolist(),
                world.annotated & inside[0],
                np.isin(world.tracks, [track.instance for track in tracks if track.moves]),
                ~inside[1],
                values[:, 10],
                _overlaps(true, values[:, [0, 1, 3, 4, 6]]),
                np.abs(turned),
                np.linalg.norm(velocity[:, None, :2] - values[:, 7:9], axis=2),
            )
        )
    scores = [
        _score(gathered, objects, threshold)
        for objects in ("moving", "all")
        for threshold in _THRESHOLDS
    ]
    return BoxScores(name or where, len(frames), int((place < 0).sum()), tuple(scores))


def _score(frames: list[_Frame], objects: str, threshold: float) -> BoxScore:
    """Return the scores at one IoU, with the pairs of CLEAR MOT as TrackEval finds them."""
    assign = import_extra("scipy.optimize", "kitti").linear_sum_assignment
    before = dict[int, int]()
    last = dict[int, int]()
    hits = total = false = switches = 0
    heading = list[float]()
    velocity = list[float]()
    ranked = list[tuple[float, bool]]()  # confidence, and whether it is right
    for frame in frames:
        wanted = frame.scored & (frame.moving | (objects == "all"))
        good = frame.iou >= threshold
        kept = np.array([[before.get(t) == d for d in frame.found] for t in frame.truth])
        gain = np.where(good, frame.iou + _KEPT * kept.reshape(good.shape), 0)
        rows, columns = assign(gain, maximize=True)
        rows, columns = rows[good[rows, columns]], columns[good[rows, columns]]
        before = {frame.truth[t]: frame.found[d] for t, d in zip(rows, columns, strict=True)}
        counted = wanted[rows]
        switches += sum(
            last.get(frame.truth[t], frame.found[d]) != frame.found[d]
            for t, d in zip(rows[counted], columns[counted], strict=True)
        )
        last |= before
        hits = hits + int(counted.sum())
        total = total + int(wanted.sum())
        false += int(np.delete(~frame.outside, columns).sum())
        heading += frame.heading[rows[counted], columns[counted]].tolist()
        velocity += frame.velocity[rows[counted], columns[counted]].tolist()
        ranked += _ranked(frame, wanted, good)
    of = max(total, 1) if total else math.nan
    return BoxScore(
        objects,
        threshold,
        total,
        _average_precision(ranked, total),
        hits / (hits + false) if hits + false else math.nan,
        hits / of,
        (hits - false - switches) / of,
        switches,
        math.degrees(np.median(heading)) if heading else math.nan,
        float(np.median(velocity)) if velocity else math.nan,
    )


def _ranked(frame: _Frame, wanted: BoolArray, good: BoolArray) -> list[tuple[float, bool]]:
    """Return the confidence of the counted found boxes of a frame, and whether each is right: the
    surest one takes the free true box with the highest IoU, and one that is scored before others.
    """
    free = np.ones(len(wanted), np.bool_)
    ranked = list[tuple[float, bool]]()
    for row in np.argsort(-frame.confidence, kind="stable").tolist():
        gain = np.where(good[:, row] & free, frame.iou[:, row] + wanted, 0)
        if gain.any():
            best = int(gain.argmax())
            free[best] = False
            if wanted[best]:
                ranked.append((float(frame.confidence[row]), True))
        elif not frame.outside[row]:
            ranked.append((float(frame.confidence[row]), False))
    return ranked


def _average_precision(ranked: list[tuple[float, bool]], total: int) -> float:
    """Return KITTI's mean, over 40 values of recall, of the best precision at it or above it;
    boxes of one confidence count together.
    """
    if not total:
        return math.nan
    sure, right = np.array(ranked).reshape(-1, 2).T
    right = right[np.argsort(-sure, kind="stable")]
    ends = np.append(np.diff(-np.sort(-sure)) != 0, True)[: len(sure)]
    hits = np.cumsum(right)[ends]
    many = (np.arange(len(sure)) + 1)[ends]
    best = [(hits / many)[hits >= level * total - 1e-9].max(initial=0) for level in _LEVELS]
    return float(np.mean(best))


def _overlaps(true: FloatArray, found: FloatArray) -> FloatArray:
    """Return the (T, D) IoU of (T, 5) and (D, 5) rectangles: x, y, length, width, heading."""
    iou = np.zeros((len(true), len(found)))
    apart = np.hypot(*(true[:, None, :2] - found[:, :2]).T).T
    near = apart < (true[:, 2:4].sum(axis=1)[:, None] + found[:, 2:4].sum(axis=1)) / 2
    for row, column in np.argwhere(near).tolist():
        a = true[row]
        b = found[column]
        shared = _shared_area(a, b)
        iou[row, column] = shared / (a[2] * a[3] + b[2] * b[3] - shared)
    return iou


def _shared_area(a: FloatArray, b: FloatArray) -> float:
    """Return the area, square metres, of the intersection of two rectangles.

    The corners of one, as complex numbers in the frame of the other, are cut at each of its sides.
    """
    turned = np.array([1 + 1j, -1 + 1j, -1 - 1j, 1 - 1j])
    own = (turned.real * b[2] + 1j * turned.imag * b[3]) / 2 * np.exp(1j * b[4])
    corners = ((own + complex(*b[:2]) - complex(*a[:2])) * np.exp(-1j * a[4])).tolist()
    for half in (*a[2:4] / 2, *a[2:4] / 2):
        cut = list[complex]()
        for p, q in zip(corners, corners[1:] + corners[:1], strict=True):
            if p.real <= half:
                cut.append(p)
            if (p.real <= half) != (q.real <= half):
                cut.append(p + (q - p) * (half - p.real) / (q.real - p.real))
        corners = [corner * -1j for corner in cut]  # the next side lies ahead
    pairs = zip(corners, corners[1:] + corners[:1], strict=True)
    return abs(sum((p.conjugate() * q).imag for p, q in pairs)) / 2
