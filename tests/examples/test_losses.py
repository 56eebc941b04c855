from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs carlasc[torch]")

import torch
from completion.losses import IGNORE, balance_free, coarsen, coarsen_soft, completion_loss
from torch.nn.functional import cross_entropy

K = 4


def test_the_loss_is_the_weighted_cross_entropy_over_known_voxels():
    torch.manual_seed(0)
    logits, target = torch.randn(2, 4, 4, 2, K), torch.randint(0, K, (2, 4, 4, 2))
    target[torch.rand(target.shape) < 0.3] = IGNORE
    weights = torch.tensor([0.1, 1.0, 2.0, 0.5])
    sums, totals = completion_loss(logits, target, weights)
    known = target != IGNORE
    expected = cross_entropy(logits[known], target[known], weights)
    torch.testing.assert_close((sums / totals).mean(), expected)


def test_coarse_scales_join_the_loss_as_a_mean():
    torch.manual_seed(1)
    target = torch.randint(0, K, (1, 4, 4, 4))
    fine, half = torch.randn(1, 4, 4, 4, K), torch.randn(1, 2, 2, 2, K)
    weights = torch.ones(K)
    sums, totals = completion_loss([fine, half], target, weights)
    coarse = coarsen(target, 2, K)
    expected = (
        cross_entropy(fine.reshape(-1, K), target.reshape(-1))
        + cross_entropy(half.reshape(-1, K), coarse.reshape(-1))
    ) / 2
    torch.testing.assert_close((sums / totals).mean(), expected)


def test_a_block_takes_its_most_frequent_occupied_class_else_free_else_nothing():
    def block(*labels):
        target = torch.full((8,), IGNORE)
        target[: len(labels)] = torch.tensor(labels)
        return int(coarsen(target.reshape(1, 2, 2, 2), 2, K))

    assert block(0, 0, 0, 3, 2, 2) == 2
    assert block(0, 0, 0, 0, 0, 3) == 3
    assert block(3, 1) == 1  # a tie goes to the lowest
    assert block(0) == 0
    assert block() == IGNORE


def test_blocks_are_those_of_a_plain_loop():
    rng = np.random.default_rng(0)
    target = rng.choice([0, 1, 2, 3, IGNORE], (2, 8, 4, 4))
    found = coarsen(torch.from_numpy(target), 4, K).numpy()
    for b, x, y, z in np.ndindex(found.shape):
        inside = target[b, 4 * x : 4 * x + 4, 4 * y : 4 * y + 4, 4 * z : 4 * z + 4]
        counts = [(inside == c).sum() for c in range(1, K)]
        expected = (
            1 + int(np.argmax(counts)) if max(counts) else 0 if (inside == 0).any() else IGNORE
        )
        assert found[b, x, y, z] == expected


def test_balancing_keeps_every_occupied_voxel_and_twice_as_many_free_ones():
    torch.manual_seed(0)
    target = torch.zeros(2, 8, 8, 4, dtype=torch.int64)
    target[:, :2, :3] = 2
    target[0, 7] = IGNORE
    generator = torch.Generator().manual_seed(0)
    balanced = balance_free(target, 2.0, generator)
    occupied = (target == 2).sum()
    assert (balanced == 2).sum() == occupied
    assert (balanced == 0).sum() == 2 * occupied
    assert (balanced[0, 7] == IGNORE).all()
    assert not torch.equal(balanced, balance_free(target, 2.0, generator))
    few = torch.full((1, 2, 2, 2), 3)
    few[0, 0, 0, 0] = 0
    assert torch.equal(balance_free(few, 2.0, generator), few)
    nothing = torch.zeros(1, 2, 2, 2, dtype=torch.int64)
    assert (balance_free(nothing, 2.0, generator) == IGNORE).all()


def certain(target):
    """Return the probabilities of voxels whose labels are certain."""
    classes = torch.arange(K).reshape(1, K, 1, 1, 1)
    return (target.unsqueeze(1) == classes).float()


def random_target(shape, seed=2):
    generator = torch.Generator().manual_seed(seed)
    target = torch.randint(0, K, shape, generator=generator)
    return target.masked_fill(torch.rand(shape, generator=generator) < 0.4, IGNORE)


def test_certain_probabilities_give_exactly_the_loss_and_the_step_of_labels():
    torch.manual_seed(2)
    target = random_target((2, 8, 8, 4))
    target[0, :4, :4, :4] = IGNORE  # blocks without a known voxel
    target[1, :4, :4, :4] = 0  # and blocks that are free
    weights = torch.tensor([0.1, 1.0, 2.0, 0.5])
    shapes = [(2, 8, 8, 4, K), (2, 4, 4, 2, K), (2, 2, 2, 1, K)]
    found = []
    for this in (target, certain(target)):
        generator = torch.Generator().manual_seed(0)
        outputs = [torch.randn(shape, generator=generator).requires_grad_() for shape in shapes]
        sums, totals = completion_loss(outputs, this, weights)
        (sums / totals).mean().backward()
        found.append([sums.detach(), totals, *(output.grad for output in outputs)])
    for hard, soft in zip(*found, strict=True):
        assert torch.equal(hard, soft)
    assert all((totals > 0).all() for _, totals, *_ in found)


def test_the_loss_of_probabilities_is_the_mean_of_the_losses_of_the_labels_by_their_probability():
    torch.manual_seed(3)
    logits, shape = torch.randn(1, 4, 4, 2, K), (1, 4, 4, 2)
    weights = torch.tensor([0.1, 1.0, 2.0, 0.5])
    one, other = torch.randint(0, K, shape), torch.randint(0, K, shape)
    sums, totals = completion_loss(logits, 0.25 * certain(one) + 0.75 * certain(other), weights)
    parts = [completion_loss(logits, target, weights) for target in (one, other)]
    torch.testing.assert_close(sums, 0.25 * parts[0][0] + 0.75 * parts[1][0])
    torch.testing.assert_close(totals, 0.25 * parts[0][1] + 0.75 * parts[1][1])


@pytest.mark.parametrize("block", [2, 4])
def test_blocks_of_certain_voxels_have_the_label_of_the_block(block):
    target = random_target((2, 8, 4, 4))
    target[0, :4] = IGNORE
    assert torch.equal(coarsen_soft(certain(target), block, K), certain(coarsen(target, block, K)))


def test_a_block_has_the_greatest_probability_of_its_voxels_and_the_class_of_the_largest_sum():
    def block(*voxels):
        target = torch.zeros(1, K, 8)
        for place, probabilities in enumerate(voxels):
            target[0, :, place] = torch.tensor(probabilities)
        return coarsen_soft(target.reshape(1, K, 2, 2, 2), 2, K).flatten().tolist()

    assert block((0.25, 0.75, 0, 0), (0.5, 0, 0.5, 0), (0.5, 0, 0.5, 0)) == [0.25, 0, 0.75, 0]
    assert block((0.5, 0.5, 0, 0), (0.5, 0, 0, 0.5)) == [0.5, 0.5, 0, 0]  # a tie goes to the lowest
    assert block((1, 0, 0, 0)) == [1, 0, 0, 0]
    assert block() == [0, 0, 0, 0]
