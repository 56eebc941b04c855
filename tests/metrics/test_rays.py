"""RayIoU and RayPQ against plain walks along each ray."""

from __future__ import annotations

import math

import numpy as np
import pytest

from carlasc import GridSpec
from carlasc.errors import ArgumentError, FormatError
from carlasc.metrics import RayIoU, RayPQ, cast_rays, ray_origins, rayiou_directions

SPEC = GridSpec("cartesian", (16, 12, 6), (-4.0, -3.0, -1.0), (4.0, 3.0, 2.0))
K = 5


def scene(seed, density=0.04):
    rng = np.random.default_rng(seed)
    labels = np.where(rng.random(SPEC.size) < density, rng.integers(1, K, SPEC.size), 0).astype(
        np.uint8
    )
    labels[:, :, 0] = 1
    return labels


def walk(labels, origin, direction, free=0):
    """Follow one ray from face to face, every distance computed anew: (voxel, depth) as METRICS
    says.
    """
    low, high, size = (np.array(v, float) for v in (SPEC.lower, SPEC.upper, SPEC.voxel_size))
    faces = []
    for axis in range(3):
        if direction[axis] != 0:
            edges = low[axis] + size[axis] * np.arange(SPEC.size[axis] + 1)
            faces += [(t, axis) for t in (edges - origin[axis]) / direction[axis] if t > 1e-12]
    distances = sorted({round(t, 12) for t, _ in faces})
    last = None
    before = 0.0
    for t in distances:
        middle = origin + direction * (before + t) / 2
        if ((middle < low) | (middle >= high)).any():
            break
        voxel = tuple(((middle - low) / size).astype(int))
        last = (voxel, t)
        if labels[voxel] != free:
            break
        before = t
    return last


def test_there_are_14040_rays_of_39_pitches():
    directions = rayiou_directions()
    assert directions.shape == (14_040, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    pitch = np.rad2deg(np.arcsin(directions[::360, 2]))
    assert len(pitch) == 39
    np.testing.assert_allclose(
        pitch[:3], [-45, -math.degrees(math.pi / 2 - math.atan(2)), -18.4349488]
    )
    assert pitch[-1] == pytest.approx(12.55, abs=0.005)
    np.testing.assert_allclose(np.diff(pitch[9:]), pitch[9] - pitch[8])
    np.testing.assert_allclose(
        np.rad2deg(np.arctan2(directions[:360, 1], directions[:360, 0])) % 360,
        np.arange(360),
        atol=1e-9,
    )


@pytest.mark.parametrize("seed", range(3))
def test_each_ray_takes_the_voxel_and_the_depth_of_a_plain_walk(seed):
    rng = np.random.default_rng(seed)
    labels = np.stack([scene(seed), scene(seed + 10)])
    origins = rng.uniform((-3.9, -2.9, -0.4), (3.9, 2.9, 1.9), (4, 3))
    directions = rng.standard_normal((60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    voxels, depths = cast_rays(labels, SPEC, origins, directions)
    for grid in range(2):
        for ray in range(len(origins) * len(directions)):
            expected, depth = walk(labels[grid], origins[ray // 60], directions[ray % 60])
            assert np.unravel_index(voxels[grid, ray], SPEC.size) == expected
            assert depths[grid, ray] == pytest.approx(depth, abs=1e-9)


def test_rays_along_axes_and_rays_from_outside():
    labels = np.zeros((1, *SPEC.size), np.uint8)
    labels[0, 10, 6, 3] = 2
    voxel = np.ravel_multi_index((10, 6, 3), SPEC.size)
    center = np.array([-4 + 10.5 * 0.5, -3 + 6.5 * 0.5, -1 + 3.5 * 0.5])
    for axis in range(3):
        for sign in (-1.0, 1.0):
            step = np.zeros(3)
            step[axis] = sign
            for far in (1.0, 100.0):  # inside the grid, and outside of it
                found, depth = cast_rays(labels, SPEC, [center - far * step], [step])
                if far == 100.0 or (abs(center - far * step) < 4).all():
                    assert found[0, 0] == voxel
                    assert depth[0, 0] == pytest.approx(far + 0.25)
    missed, _ = cast_rays(labels, SPEC, [[100.0, 50.0, 0.0]], [[1.0, 0.0, 0.0]])
    assert missed[0, 0] == -1


def test_the_voxel_of_the_origin_counts_and_a_ray_that_meets_nothing_takes_the_last_voxel():
    labels = np.zeros((1, *SPEC.size), np.uint8)
    found, depth = cast_rays(labels, SPEC, [[0.1, 0.1, 0.1]], [[1.0, 0.0, 0.0]])
    assert np.unravel_index(found[0, 0], SPEC.size) == (15, 6, 2)
    assert depth[0, 0] == pytest.approx(3.9)
    labels[0, 8, 6, 2] = 3
    found, depth = cast_rays(labels, SPEC, [[0.1, 0.1, 0.1]], [[1.0, 0.0, 0.0]])
    assert np.unravel_index(found[0, 0], SPEC.size) == (8, 6, 2)
    assert depth[0, 0] == pytest.approx(0.4)


def plain_rayiou(pred, truth, origins, thresholds=(1, 2, 4)):
    directions = rayiou_directions()[::97]
    true, predicted, hits = np.zeros(K), np.zeros(K), np.zeros((len(thresholds), K))
    for origin in origins:
        for direction in directions:
            (vp, dp), (vt, dt) = walk(pred, origin, direction), walk(truth, origin, direction)
            if truth[vt] == 0:
                continue
            true[truth[vt]] += 1
            predicted[pred[vp]] += 1
            for row, threshold in enumerate(thresholds):
                hits[row, truth[vt]] += truth[vt] == pred[vp] and abs(dp - dt) < threshold
    with np.errstate(invalid="ignore"):
        return (hits / (true + predicted - hits))[:, 1:]


def test_rayiou_is_that_of_a_plain_count():
    pred, truth = scene(1), scene(2)
    origins = np.array([[0.13, 0.21, 0.4], [-2.2, 1.1, 0.9]])
    score = (
        RayIoU(K, directions=rayiou_directions()[::97]).update(pred, truth, SPEC, origins).compute()
    )
    expected = plain_rayiou(pred, truth, origins)
    np.testing.assert_allclose(score.class_iou[:, 1:], expected)
    assert score.rayiou == pytest.approx(np.nanmean(expected))
    assert list(score.by_threshold.values()) == pytest.approx(np.nanmean(expected, axis=1))


def test_a_perfect_prediction_scores_one_and_a_wall_that_is_thicker_behind_too():
    truth = scene(3)
    origins = [[0.0, 0.0, 0.5]]
    assert RayIoU(K).update(truth, truth, SPEC, origins).compute().rayiou == 1.0
    wall = np.zeros(SPEC.size, np.uint8)
    wall[12] = 2
    thick = wall.copy()
    thick[13:15] = 2
    assert RayIoU(K).update(thick, wall, SPEC, origins).compute().rayiou == 1.0
    shifted = np.roll(wall, -3, axis=0)  # 1.5 m nearer
    by_threshold = RayIoU(K).update(shifted, wall, SPEC, [[-3.0, 0.0, 0.5]]).compute().by_threshold
    assert by_threshold[1.0] < by_threshold[2.0] <= by_threshold[4.0]


def test_merged_metrics_are_one_metric_whatever_the_order():
    frames = [(scene(s), scene(s + 50), [[0.1 * s, 0.3, 0.2]]) for s in range(3)]
    whole, parts = RayIoU(K), [RayIoU(K) for _ in frames]
    for (pred, truth, origins), part in zip(frames, parts, strict=True):
        whole.update(pred, truth, SPEC, origins)
        part.update(pred, truth, SPEC, origins)
    merged = RayIoU(K).merge(parts[2]).merge(parts[0]).merge(parts[1])
    np.testing.assert_array_equal(merged.compute().class_iou, whole.compute().class_iou)
    whole.reset()
    assert math.isnan(whole.compute().rayiou)


def test_classes_may_be_numbered_in_any_way():
    pred, truth, origins = scene(5), scene(6), [[0.0, 0.0, 0.5]]
    order = np.array([4, 2, 0, 1, 3])  # free becomes 4
    plain = RayIoU(K).update(pred, truth, SPEC, origins).compute()
    turned = RayIoU(K, free=4).update(order[pred], order[truth], SPEC, origins).compute()
    np.testing.assert_allclose(turned.class_iou[:, order[1:]], plain.class_iou[:, 1:])
    assert turned.rayiou == pytest.approx(plain.rayiou)


def test_origins_are_places_on_the_way_inside_the_grid_at_most_eight_evenly():
    poses = np.tile(np.eye(4), (41, 1, 1))
    poses[:, 0, 3] = np.arange(41) * 0.5
    origins = ray_origins(poses, 20, SPEC)
    assert len(origins) == 8
    assert np.abs(origins[:, 0]).max() < 3.0
    near = (np.arange(41) - 20) * 0.5
    near = near[np.abs(near) < 3]
    np.testing.assert_allclose(
        origins[:, 0], near[np.round(np.linspace(0, len(near) - 1, 8)).astype(int)]
    )
    assert len(ray_origins(poses[:1], 0, SPEC)) == 1


def plain_raypq(pred, truth, origins, things, threshold, fewest=10):
    """Sets of rays as segments, and every pair of them compared."""
    rays = []
    for origin in origins:
        for direction in rayiou_directions()[::29]:
            (vp, dp), (vt, dt) = walk(pred[0], origin, direction), walk(truth[0], origin, direction)
            if truth[0][vt]:
                rays.append(
                    (pred[0][vp], pred[1][vp], truth[0][vt], truth[1][vt], abs(dp - dt) < threshold)
                )
    pq = []
    for c in range(1, K):
        mine = {
            i: {n for n, r in enumerate(rays) if r[0] == c and r[1] == i}
            for i in {r[1] for r in rays if r[0] == c}
        }
        if c not in things:
            theirs = {0: {n for n, r in enumerate(rays) if r[2] == c}}
        else:
            theirs = {
                i: {n for n, r in enumerate(rays) if r[2] == c and r[3] == i}
                for i in {r[3] for r in rays if r[2] == c}
            }
        theirs = {i: s for i, s in theirs.items() if s}
        near = {n for n, r in enumerate(rays) if r[4]}
        matched, total, iou_sum = set(), 0, 0.0
        for i, a in mine.items():
            for j, b in theirs.items():
                common = len(a & b & near)
                iou = common / (len(a) + len(b) - common)
                if iou > 0.5:
                    matched |= {("p", i), ("t", j)}
                    total, iou_sum = total + 1, iou_sum + iou
        fp = sum(len(s) >= fewest and ("p", i) not in matched for i, s in mine.items())
        fn = sum(len(s) >= fewest and ("t", i) not in matched for i, s in theirs.items())
        pq.append(iou_sum / (total + fp / 2 + fn / 2) if total + fp + fn else np.nan)
    return pq


def test_raypq_is_that_of_sets_of_rays():
    labels = np.zeros(SPEC.size, np.uint8)
    labels[:, :, 0] = 1
    ids = np.zeros(SPEC.size, np.int64)
    for number, corner in enumerate([(10, 2), (12, 8), (2, 3), (3, 9)], 1):
        labels[corner[0] : corner[0] + 2, corner[1] : corner[1] + 2, 1:4] = 3
        ids[labels == 3] = np.where(ids[labels == 3] == 0, number, ids[labels == 3])
    pred = np.roll(labels, 1, axis=0)
    pred[2:4, 3:5, 1:4] = 0
    pred_ids = np.where(pred == 3, np.roll(ids, 1, axis=0), 0)
    origins = np.array([[0.1, 0.1, 0.6]])
    scores = (
        RayPQ(K, frozenset({3, 4}), directions=rayiou_directions()[::29])
        .update((pred, pred_ids), (labels, ids), SPEC, origins)
        .compute()
    )
    for threshold, score in scores.items():
        np.testing.assert_allclose(
            score.pq[1:], plain_raypq((pred, pred_ids), (labels, ids), origins, {3, 4}, threshold)
        )
    assert (
        RayPQ(K, frozenset({3}))
        .update((labels, ids), (labels, ids), SPEC, origins)
        .compute()[1.0]
        .mean()
        == 1.0
    )


def test_wrong_input_is_named():
    cylinder = GridSpec.published("cylindrical")
    with pytest.raises(ArgumentError, match="Cartesian"):
        RayIoU(K).update(
            np.zeros(cylinder.size, np.uint8),
            np.zeros(cylinder.size, np.uint8),
            cylinder,
            [[0, 0, 0]],
        )
    with pytest.raises(FormatError, match=r"prediction: expected shape \(16, 12, 6\)"):
        RayIoU(K).update(np.zeros((2, 2, 2), np.uint8), scene(0), SPEC, [[0, 0, 0]])
    with pytest.raises(FormatError, match=r"class ids 0\.\.4, found uint8 from 9 to 9"):
        RayIoU(K).update(np.full(SPEC.size, 9, np.uint8), scene(0), SPEC, [[0, 0, 0]])
    with pytest.raises(ArgumentError, match=r"expected a \w+ with \w+ "):
        RayIoU(K).merge(RayIoU(K + 1))


def test_tensors_are_scored_as_arrays_are():
    torch = pytest.importorskip("torch")
    labels, origins = [scene(0), scene(10)], [[0.1, 0.3, 0.2]]
    tensors = [torch.from_numpy(grid) for grid in labels]
    assert (
        RayIoU(K).update(*tensors, SPEC, origins).compute().rayiou
        == RayIoU(K).update(*labels, SPEC, origins).compute().rayiou
    )
