"""Each convention against its benchmark's definition, written out plainly."""

from __future__ import annotations

import numpy as np
import pytest

from carlasc.core import CARLA, CARLASC11, SEMANTICKITTI, ClassTable
from carlasc.errors import ArgumentError, FormatError
from carlasc.metrics import CONVENTIONS, ConfusionMatrix, convention_named

KITTI_IDS = np.array(sorted(SEMANTICKITTI.names))
LEARNING = {
    10: 1, 252: 1, 11: 2, 15: 3, 18: 4, 258: 4, 13: 5, 16: 5, 20: 5, 256: 5, 257: 5, 259: 5, 30: 6, 254: 6, 31: 7, 253: 7, 32: 8, 255: 8,
    40: 9, 60: 9, 44: 10, 48: 11, 49: 12, 50: 13, 51: 14, 70: 15, 71: 16, 72: 17, 80: 18, 81: 19,
}  # fmt: skip


def labels(ids, seed, size=3000):
    return np.random.default_rng(seed).choice(ids, size).astype(np.uint16)


def count(convention, prediction, truth, known):
    matrix = ConfusionMatrix(convention.num_classes, free=convention.free)
    return matrix.update(*convention.prepare(prediction, truth, known))


def counted_iou(pred, truth, classes):
    rows = {}
    for c in classes:
        tp, fp, fn = (
            ((pred == c) & (truth == c)).sum(),
            ((pred == c) & (truth != c)).sum(),
            ((pred != c) & (truth == c)).sum(),
        )
        rows[c] = (tp, tp + fp + fn)
    return rows


def test_semantickitti_is_its_official_rule():
    truth, pred = labels(KITTI_IDS, 0), labels(KITTI_IDS, 1)
    pred = np.where(np.random.default_rng(2).random(truth.size) < 0.5, truth, pred)
    invalid = np.random.default_rng(3).random(truth.size) < 0.2
    learned = np.array([0 if i == 0 else LEARNING.get(int(i), 255) for i in truth])
    predicted = np.array([LEARNING.get(int(i), 0) for i in pred])
    keep = (learned != 255) & ~invalid
    rows = counted_iou(predicted[keep], learned[keep], range(20))
    convention = convention_named("semantickitti")
    matrix = count(convention, (pred, SEMANTICKITTI), (truth, SEMANTICKITTI), ~invalid)
    score = convention.score(matrix)
    assert score.miou == pytest.approx(np.mean([rows[c][0] / rows[c][1] for c in range(1, 20)]))
    occupied = predicted[keep] > 0, learned[keep] > 0
    hit = (occupied[0] & occupied[1]).sum()
    assert score.precision == pytest.approx(hit / occupied[0].sum())
    assert score.recall == pytest.approx(hit / occupied[1].sum())
    assert score.iou == pytest.approx(hit / (occupied[0] | occupied[1]).sum())
    assert score.false_free == pytest.approx(1 - score.recall)


def test_sscbench_adds_its_epsilon_and_counts_absent_classes_as_zero():
    table = CONVENTIONS["sscbench"].classes
    truth, pred = labels([0, 1, 7, 11], 0), labels([0, 1, 7], 1)
    known = np.random.default_rng(2).random(truth.size) < 0.7
    rows = counted_iou(pred[known], truth[known], range(1, 19))
    convention = CONVENTIONS["sscbench"]
    score = convention.score(count(convention, (pred, table), (truth, table), known))
    assert score.miou == pytest.approx(
        np.mean([tp / (union + 1e-5) for tp, union in rows.values()]), rel=1e-12
    )


def test_occ3d_leaves_out_free_and_the_classes_that_are_absent_from_both():
    convention = CONVENTIONS["occ3d-lidar"]
    truth, pred = labels([0, 4, 11, 17], 0), labels([0, 4, 12, 17], 1)
    rows = counted_iou(pred, truth, range(17))
    table = convention.classes
    matrix = count(convention, (pred, table), (truth, table), None)
    present = [tp / union for tp, union in rows.values() if union]
    assert convention.score(matrix).miou == pytest.approx(np.mean(present))
    only_true = [tp / union for c, (tp, union) in rows.items() if (truth == c).any()]
    assert CONVENTIONS["occ3d-lidar-sparseocc"].score(matrix).miou == pytest.approx(
        np.mean(only_true)
    )
    assert len(only_true) < len(present)
    occupied = (pred != 17).sum()
    assert convention.score(matrix).precision == pytest.approx(
        ((pred != 17) & (truth != 17)).sum() / occupied
    )


def test_openoccupancy_takes_what_nobody_saw_for_empty_leaves_noise_out_and_is_nan_where_a_class_is_absent():
    convention = CONVENTIONS["openoccupancy"]
    table = convention.classes
    truth, pred = labels([*range(17), 255], 0, 9000), labels(range(17), 1, 9000)
    known = np.random.default_rng(2).random(truth.size) < 0.7
    seen = np.where(known, truth, 0)
    keep = seen != 255
    rows = counted_iou(pred[keep], seen[keep], range(1, 17))
    matrix = count(convention, (pred, table), (truth, table), known)
    assert convention.score(matrix).miou == pytest.approx(
        np.mean([tp / union for tp, union in rows.values()])
    )
    without = truth.copy()
    without[truth == 9] = 0
    few = count(convention, (np.where(pred == 9, 0, pred), table), (without, table), known)
    assert np.isnan(convention.score(few).miou)
    assert np.isnan(convention.score(few).class_iou["trailer"])


def test_carlasc_is_the_papers_mean_over_all_eleven_with_free():
    truth, pred = labels(range(23), 0), labels(range(23), 1)
    known = np.random.default_rng(2).random(truth.size) < 0.7
    convention = CONVENTIONS["carlasc"]
    matrix = count(convention, (pred, CARLA), (truth, CARLA), known)
    assert matrix.total == known.sum()
    assert convention.score(matrix).miou == pytest.approx(matrix.miou)


@pytest.mark.parametrize("name", list(CONVENTIONS))
@pytest.mark.parametrize("table", [CARLA, CARLASC11])
def test_the_truth_itself_scores_one_in_every_class_that_occurs(name, table):
    convention = CONVENTIONS[name]
    truth = labels(sorted(table.names), 5)
    score = convention.score(count(convention, (truth, table), (truth, table), None))
    found = [value for value in score.class_iou.values() if not np.isnan(value)]
    assert len(found) >= 7
    assert found == pytest.approx([1.0] * len(found), abs=1e-6)
    assert score.iou == 1.0


def test_maps_reach_every_class_and_only_classes_that_exist():
    for convention in CONVENTIONS.values():
        for mapping in convention.maps.values():
            assert set(mapping.values()) <= {-1, *convention.classes.names}
        for table in (CARLA, CARLASC11):
            assert set(convention.maps[table.name]) == set(table.names)


def test_matrices_of_frames_add_up_in_any_order():
    convention = CONVENTIONS["sscbench"]
    frames = [(labels(KITTI_IDS, s), labels(KITTI_IDS, 9 + s)) for s in range(3)]
    parts = [count(convention, (p, SEMANTICKITTI), (t, SEMANTICKITTI), None) for p, t in frames]
    whole = count(
        convention,
        (np.concatenate([p for p, _ in frames]), SEMANTICKITTI),
        (np.concatenate([t for _, t in frames]), SEMANTICKITTI),
        None,
    )
    assert parts[2] + parts[0] + parts[1] == whole
    assert isinstance(whole, ConfusionMatrix)


def test_what_cannot_be_scored_is_said_in_one_line():
    with pytest.raises(
        ArgumentError, match="convention: expected one of carlasc, .*, found 'nuscenes'"
    ):
        convention_named("nuscenes")
    other = ClassTable("lab", {0: "free", 1: "thing"}, {0: (0, 0, 0), 1: (9, 9, 9)})
    with pytest.raises(
        FormatError,
        match=r"truth: expected a class table with a map in the convention sscbench \(.*\), found "
        r"lab",
    ):
        CONVENTIONS["sscbench"].check(other, "truth")
    with pytest.raises(
        FormatError, match=r"prediction: expected class ids of carla, found 77 \(3000 times\)"
    ):
        count(
            CONVENTIONS["carlasc"], (np.full(3000, 77), CARLA), (labels(range(23), 0), CARLA), None
        )
