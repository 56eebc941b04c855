"""Panoptic quality: recognition and segmentation of objects and of stuff classes (Kirillov et al.,
CVPR 2019).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from carlasc.core.arrays import AnyArray, BoolArray, FloatArray, IntArray
from carlasc.core.compiling import cached
from carlasc.errors import ArgumentError, check_choice
from carlasc.metrics.confusion import flat_sides, mean_of, ratio
from carlasc.metrics.scoring import Summed

Variant = Literal["standard", "pasco"]
_SLOTS = 256  # size of the tables of recent segments and pairs; a power of two
_MATCH = 0.5  # above this IoU, a segment has at most one match, so no search is needed


@dataclass(frozen=True)
class PanopticScore:
    """Panoptic quality of every class.

    Attributes:
        pq: (K,) panoptic quality, `sq * rq`; NaN for a class without any segment, and for free
            space.
        sq: (K,) segmentation quality: mean IoU of the matched segments.
        rq: (K,) recognition quality: F1 score of finding segments.
        iou: (K,) IoU of each class over elements, for PQ-dagger.
        things: ids of classes with separate instances; the other classes are stuff.
    """

    pq: FloatArray
    sq: FloatArray
    rq: FloatArray
    iou: FloatArray
    things: frozenset[int]

    def mean(
        self,
        what: Literal["pq", "sq", "rq"] = "pq",
        which: Literal["all", "things", "stuff"] = "all",
    ) -> float:
        """Return the mean over the occurring classes: all, only things, or only stuff; NaN if none
        occurs.
        """
        is_thing = np.isin(np.arange(len(self.pq)), sorted(self.things))
        keep = {"all": True, "things": is_thing, "stuff": ~is_thing}[which] & ~np.isnan(self.pq)
        return mean_of(getattr(self, what)[keep])

    @property
    def pq_dagger(self) -> float:
        """PQ-dagger: the mean over classes of PQ for things and of IoU for stuff (Porzi et al.,
        CVPR 2019).
        """
        is_thing = np.isin(np.arange(len(self.pq)), sorted(self.things))
        return mean_of(np.where(is_thing, self.pq, self.iou)[~np.isnan(self.pq)])


@dataclass(frozen=True)
class Segments:
    """The segments of prediction and ground truth, and their overlaps.

    Attributes:
        pred_class: (P,) class of each predicted segment.
        pred_size: (P,) number of elements of each predicted segment.
        true_class: (T,) class of each true segment.
        true_size: (T,) number of elements of each true segment.
        overlaps: (M, 3) predicted segment, true segment, and number of common elements; only pairs
            with equal classes.
    """

    pred_class: IntArray
    pred_size: IntArray
    true_class: IntArray
    true_size: IntArray
    overlaps: IntArray


class PanopticQuality(Summed):
    """Accumulates matched segments of predictions and ground truth.

    A predicted and a true segment match if they have the same class and an IoU above 0.5. Free
    elements belong to no segment.

    Attributes:
        num_classes: K; ids are 0..K-1.
        things: ids of classes with separate instances; for other classes, all elements of a frame
            are one segment.
        free: id of free space.
        variant: "standard", or "pasco": as in the evaluation script of PaSCo, a stuff segment
            matches the true segment of its class at any overlap. Stuff is then never a false
            positive if its class occurs in the ground truth.
    """

    _SETTINGS = ("num_classes", "things", "free", "variant")
    _SUMS = ("counts", "iou_sum", "elements")

    def __init__(
        self,
        num_classes: int,
        things: frozenset[int],
        *,
        free: int = 0,
        variant: Variant = "standard",
    ) -> None:
        check_choice("variant", variant, Variant)
        if not 0 <= free < num_classes or any(
            not 0 <= thing < num_classes or thing == free for thing in things
        ):
            raise ArgumentError(
                "things",
                expected=f"class ids below {num_classes} other than free",
                found=sorted(things),
            )
        self.num_classes = num_classes
        self.things = frozenset(things)
        self.free = free
        self.variant = variant
        self.reset()

    def reset(self) -> None:
        """Set all sums to zero."""
        # true positives, false positives, false negatives
        self.counts = np.zeros((3, self.num_classes), np.int64)
        self.iou_sum = np.zeros(self.num_classes)
        self.elements = np.zeros((3, self.num_classes), np.int64)  # common, predicted, true

    def update(
        self,
        prediction: tuple[ArrayLike, ArrayLike],
        truth: tuple[ArrayLike, ArrayLike],
        mask: ArrayLike | None = None,
    ) -> Self:
        """Add a frame.

        Args:
            prediction: class ids and instance ids, of equal shape. Instance ids of stuff are
                ignored.
            truth: true class ids and instance ids, of the same shape.
            mask: the same shape, bool: only these elements are scored; None scores all.

        Raises:
            FormatError: shapes differ, or an id is not below `num_classes`.
        """
        pred, pred_ids, true, true_ids = flat_sides(prediction, truth, mask, self.num_classes)
        self.add(
            match_segments((pred, pred_ids), (true, true_ids), things=self.things, free=self.free)
        )
        return self

    def add(self, segments: Segments, *, fewest: int = 0) -> None:
        """Add the segments of a frame.

        Unmatched segments with fewer than `fewest` elements are ignored.
        """
        pred, true, common = segments.overlaps.T
        iou = common / (segments.pred_size[pred] + segments.true_size[true] - common)
        is_stuff = ~np.isin(segments.true_class[true], sorted(self.things))
        hit = (iou > _MATCH) | (is_stuff & (self.variant == "pasco"))
        k = self.num_classes
        self.counts[0] += np.bincount(segments.true_class[true[hit]], minlength=k)
        self.iou_sum += np.bincount(segments.true_class[true[hit]], iou[hit], minlength=k)
        sides = (
            (segments.pred_class, segments.pred_size, pred[hit]),
            (segments.true_class, segments.true_size, true[hit]),
        )
        for row, (classes, size, matched) in enumerate(sides, 1):
            missed = size >= fewest
            missed[matched] = False
            self.counts[row] += np.bincount(classes[missed], minlength=k)
        counted = (
            (segments.true_class[true], common),
            (segments.pred_class, segments.pred_size),
            (segments.true_class, segments.true_size),
        )
        for row, (classes, elements) in enumerate(counted):
            self.elements[row] += np.bincount(classes, elements, minlength=k).astype(np.int64)

    def compute(self) -> PanopticScore:
        """Return the score of all added frames."""
        tp, fp, fn = self.counts
        sq = ratio(self.iou_sum, tp)
        rq = ratio(tp, tp + (fp + fn) / 2)
        occurs = self.counts.sum(axis=0) > 0
        pq = np.where(occurs, np.nan_to_num(sq) * np.nan_to_num(rq), np.nan)
        common, predicted, true = self.elements
        return PanopticScore(
            pq,
            np.where(occurs, np.nan_to_num(sq), np.nan),
            rq,
            ratio(common, predicted + true - common),
            self.things,
        )


def match_segments(
    prediction: tuple[AnyArray, AnyArray],
    truth: tuple[AnyArray, AnyArray],
    *,
    things: Collection[int] | None = None,
    overlap: BoolArray | None = None,
    free: int = 0,
) -> Segments:
    """Find the segments of prediction and ground truth, and the number of their common elements.

    Args:
        prediction: (N,) class ids and (N,) instance ids; equal pairs are one segment.
        truth: (N,) true class ids and (N,) true instance ids.
        things: ids of classes with separate instances; for other classes, all elements are one
            segment. None: all classes are things.
        overlap: (N,) bool: elements that can be common elements; None for all.
        free: class id of elements without a segment.

    Returns:
        The segments, without the free class.
    """
    sides = [
        np.ascontiguousarray(array).reshape(-1) for side in (prediction, truth) for array in side
    ]
    may_overlap = np.ones(1, np.bool_) if overlap is None else overlap
    is_thing = np.ones(1, np.bool_)
    if things is not None:
        is_thing = np.zeros(
            1 + max((int(side.max(initial=0)) for side in sides[::2]), default=0), np.bool_
        )
        is_thing[[thing for thing in things if thing < len(is_thing)]] = True
    pred_keys, pred_size, true_keys, true_size, overlaps = _match(
        sides[0], sides[1], sides[2], sides[3], is_thing, may_overlap, free
    )
    same = pred_keys[overlaps[:, 0]] >> 32 == true_keys[overlaps[:, 1]] >> 32
    return Segments(pred_keys >> 32, pred_size, true_keys >> 32, true_size, overlaps[same])


@cached(error_model="python")
def _match(  # type: ignore[no-untyped-def]
    pred_class, pred_ids, true_class, true_ids, is_thing, may_overlap, free
):
    """Number the segments of both sides in order of occurrence, and count elements and overlaps, in
    one pass.

    Neighbouring elements mostly belong to few segments. Small tables of recent segments, indexed by
    the key, avoid most look-ups.
    """
    numbers = {np.int64(-1): np.int64(-1)}  # number of a segment by side and key
    keys = [[np.int64(0) for _ in range(0)] for _ in range(2)]
    sizes = [[np.int64(0) for _ in range(0)] for _ in range(2)]
    latest = np.full((2, _SLOTS), -1, np.int64)
    latest_number = np.zeros((2, _SLOTS), np.int64)
    pairs = {np.int64(-1): np.int64(0)}
    open_pairs = np.full(_SLOTS, -1, np.int64)
    open_counts = np.zeros(_SLOTS, np.int64)
    number = np.zeros(2, np.int64)
    everywhere = len(may_overlap) == 1
    all_things = len(is_thing) == 1 and is_thing[0]
    for n in range(len(pred_class)):
        has_pred = pred_class[n] != free
        has_true = true_class[n] != free
        if not has_pred and not has_true:
            continue  # most elements are free in both
        for side in range(2):
            if not (has_pred if side == 0 else has_true):
                continue
            label, instance = (
                (pred_class[n], pred_ids[n]) if side == 0 else (true_class[n], true_ids[n])
            )
            key = np.int64(label) << 32
            if all_things or is_thing[label]:
                key |= np.int64(instance)
            slot = (key ^ key >> 32) & (_SLOTS - 1)
            if latest[side, slot] != key:
                place = key << 1 | side
                if place not in numbers:
                    numbers[place] = np.int64(len(keys[side]))
                    keys[side].append(key)
                    sizes[side].append(np.int64(0))
                latest[side, slot] = key
                latest_number[side, slot] = numbers[place]
            number[side] = latest_number[side, slot]
            sizes[side][number[side]] += 1
        if has_pred and has_true and (everywhere or may_overlap[n]):
            pair = number[0] << 32 | number[1]
            slot = (number[0] + 7 * number[1]) & (_SLOTS - 1)
            if open_pairs[slot] != pair:
                if open_pairs[slot] >= 0:
                    pairs[open_pairs[slot]] = (
                        pairs.get(open_pairs[slot], np.int64(0)) + open_counts[slot]
                    )
                open_pairs[slot] = pair
                open_counts[slot] = np.int64(0)
            open_counts[slot] += np.int64(1)
    for slot in np.arange(_SLOTS):
        if open_pairs[slot] >= 0:
            pairs[open_pairs[slot]] = pairs.get(open_pairs[slot], np.int64(0)) + open_counts[slot]
    overlaps = np.empty((len(pairs) - 1, 3), np.int64)
    row = 0
    for pair, count in pairs.items():
        if pair >= 0:
            overlaps[row, 0] = pair >> 32
            overlaps[row, 1] = pair & 0xFFFFFFFF
            overlaps[row, 2] = count
            row += 1
    return np.array(keys[0]), np.array(sizes[0]), np.array(keys[1]), np.array(sizes[1]), overlaps
