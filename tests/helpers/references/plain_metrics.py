"""The metrics once more in plain NumPy, one array operation after the other: what the compiled ones
are compared with.
"""

from __future__ import annotations

import numpy as np


def cast(labels, spec, origins, directions, free=0):
    """Walk all rays at once, a voxel per step: (voxel, depth) of each, origin by origin."""
    size = np.array(spec.size)
    starts = np.repeat((origins - np.array(spec.lower)) / spec.voxel_size, len(directions), axis=0)
    steps = np.tile(directions / spec.voxel_size, (len(origins), 1))
    voxel = np.floor(starts).astype(int)
    sign = np.where(steps > 0, 1, -1)
    with np.errstate(divide="ignore"):
        to_face = np.where(steps != 0, (voxel + (steps > 0) - starts) / steps, np.inf)
        between = np.abs(1 / steps)
    found, depth = np.full(len(steps), -1), np.zeros(len(steps))
    walking = np.arange(len(steps))
    while len(walking):
        here, faces = voxel[walking], to_face[walking]
        axis = faces.argmin(axis=1)
        distance = faces[np.arange(len(walking)), axis]
        further = here.copy()
        further[np.arange(len(walking)), axis] += sign[walking, axis]
        hit = labels[tuple(here.T)] != free
        ends = hit | (further < 0).any(axis=1) | (further >= size).any(axis=1)
        done = walking[ends]
        found[done], depth[done] = (
            np.ravel_multi_index(tuple(here[ends].T), spec.size),
            distance[ends],
        )
        walking, axis, further = walking[~ends], axis[~ends], further[~ends]
        voxel[walking] = further
        to_face[walking, axis] += between[walking, axis]
    return found, depth


def rayiou(pred, truth, spec, origins, directions, num_classes, thresholds=(1.0, 2.0, 4.0)):
    """RayIoU of one frame, class by class."""
    (near, near_depth), (far, far_depth) = (
        cast(grid, spec, origins, directions) for grid in (pred, truth)
    )
    pred_class, true_class = pred.reshape(-1)[near], truth.reshape(-1)[far]
    valid = true_class != 0
    iou = np.full((len(thresholds), num_classes), np.nan)
    for row, threshold in enumerate(thresholds):
        close = np.abs(near_depth - far_depth) < threshold
        for c in range(1, num_classes):
            hit = (valid & close & (pred_class == c) & (true_class == c)).sum()
            union = (valid & (true_class == c)).sum() + (valid & (pred_class == c)).sum() - hit
            iou[row, c] = hit / union if union else np.nan
    return np.nanmean(iou)


def panoptic_quality(pred, truth, num_classes, things):
    """PQ of one frame, class by class, segments by `np.unique`."""
    (pred_class, pred_ids), (true_class, true_ids) = (
        tuple(a.reshape(-1).astype(np.int64) for a in side) for side in (pred, truth)
    )
    values = []
    for c in range(1, num_classes):
        mine, theirs = (
            np.where(classes == c, (ids if c in things else 0 * ids) + 1, 0)
            for classes, ids in ((pred_class, pred_ids), (true_class, true_ids))
        )
        pred_segments, pred_sizes = np.unique(mine[mine > 0], return_counts=True)
        true_segments, true_sizes = np.unique(theirs[theirs > 0], return_counts=True)
        both = (mine > 0) & (theirs > 0)
        pairs, common = np.unique(mine[both] << 32 | theirs[both], return_counts=True)
        union = (
            pred_sizes[np.searchsorted(pred_segments, pairs >> 32)]
            + true_sizes[np.searchsorted(true_segments, pairs & 0xFFFFFFFF)]
            - common
        )
        matched = common / union > 0.5
        tp, iou_sum = matched.sum(), (common / union)[matched].sum()
        if total := len(pred_sizes) + len(true_sizes):
            values.append(iou_sum / (total / 2))
        assert tp <= total
    return float(np.mean(values))
