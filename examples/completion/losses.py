"""The loss: weighted cross-entropy over known voxels, at every scale of a network's output, with
labels or with probabilities.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy, one_hot

IGNORE = 255  # label of voxels that are left out
FREE = 0


def completion_loss(
    outputs: Tensor | Sequence[Tensor], target: Tensor, class_weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the weighted sum of the cross-entropy, and the sum of the weights, at each scale.

    The loss is the mean over the scales of sum / weight. Several processes add up their weights
    before they divide, which gives each process its part of the loss of the whole batch.

    Args:
        outputs: (B, X, Y, Z, K) logits, or a list of them at 1/1, 1/2, 1/4, ... of the scale.
        target: (B, X, Y, Z) int64 labels, `IGNORE` for voxels that are left out. Or (B, K, X, Y, Z)
            float32 probabilities of the classes, zeros for voxels that are left out. Certain
            probabilities give exactly the loss of the labels.
        class_weights: (K,) float32.

    Returns:
        (S,) sums and (S,) weights.
    """
    sums, weights = [], []
    measure, blocks = (
        (_measure_soft, coarsen_soft) if target.is_floating_point() else (_measure, coarsen)
    )
    for scale, logits in enumerate([outputs] if isinstance(outputs, Tensor) else outputs):
        coarse = target if scale == 0 else blocks(target, 2**scale, len(class_weights))
        # the loss per voxel first, then the sum, so that labels and certain probabilities are added
        # up in the same way
        losses, counted = measure(logits.movedim(-1, 1).float(), coarse, class_weights)
        sums.append(losses.sum())
        weights.append(counted.sum())
    return torch.stack(sums), torch.stack(weights)


def _measure(logits: Tensor, target: Tensor, class_weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return (B, X, Y, Z) the loss and the weight of each voxel for labels."""
    losses = cross_entropy(logits, target, class_weights, ignore_index=IGNORE, reduction="none")
    counted = target != IGNORE
    return losses, class_weights[torch.where(counted, target, 0)] * counted


def _measure_soft(logits: Tensor, target: Tensor, class_weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the same for probabilities."""
    losses = cross_entropy(logits, target, class_weights, reduction="none")
    return losses, (target * class_weights.reshape(-1, 1, 1, 1)).sum(1)


def coarsen(target: Tensor, block: int, num_classes: int) -> Tensor:
    """Return one label per block: the most frequent occupied class, else free if any voxel is free,
    else `IGNORE`.

    If two classes are equally frequent, the lower id is taken.

    Args:
        target: (B, X, Y, Z) int64; X, Y and Z multiples of `block`.
        block: voxels per axis of a block.
        num_classes: K.

    Returns:
        (B, X / block, Y / block, Z / block) int64.
    """
    known = target != IGNORE
    votes = one_hot(torch.where(known, target, 0), num_classes) * known.unsqueeze(-1)
    batch, x, y, z = target.shape
    votes = votes.reshape(
        batch, x // block, block, y // block, block, z // block, block, num_classes
    ).sum((2, 4, 6))
    occupied, most = votes[..., 1:].max(-1)
    free = torch.where(votes[..., FREE] > 0, FREE, IGNORE)
    return torch.where(occupied > 0, most + 1, free)


def coarsen_soft(target: Tensor, block: int, num_classes: int) -> Tensor:
    """Return the probabilities of one class per block, by the rule of `coarsen`.

    The probability that a block is occupied is the largest such probability of its voxels; its
    class is the one with the largest sum of probabilities. The probability that it is free is the
    smallest such probability of its known voxels. If two classes are equally probable, the lower id
    is taken.

    Args:
        target: (B, K, X, Y, Z) float32, zeros for voxels that are left out; X, Y and Z multiples of
            `block`.
        block: voxels per axis of a block.
        num_classes: K.

    Returns:
        (B, K, X / block, Y / block, Z / block) float32, zeros for blocks in which all voxels are
        left out.
    """
    batch, _, x, y, z = target.shape
    blocks = target.reshape(
        batch, num_classes, x // block, block, y // block, block, z // block, block
    )
    voxels = blocks.permute(0, 1, 2, 4, 6, 3, 5, 7).flatten(5)
    occupied, known = voxels[:, 1:].sum(1), voxels.sum(1) > 0
    free = torch.where(known, voxels[:, FREE], 1.0).amin(-1) * known.any(-1)
    coarse = torch.zeros_like(voxels[..., 0])
    most = voxels[:, 1:].sum(-1).argmax(1, keepdim=True) + 1
    coarse.scatter_(1, most, occupied.amax(-1).unsqueeze(1))
    coarse[:, FREE] = free
    return coarse


def balance_free(target: Tensor, ratio: float, generator: torch.Generator) -> Tensor:
    """Keep all occupied voxels and at most `ratio` times as many free ones, drawn at random over
    the batch (SSCNet).

    Args:
        target: (B, X, Y, Z) int64 labels.
        ratio: free voxels for each occupied one.
        generator: random generator on the target's device.

    Returns:
        The target with the other free voxels set to `IGNORE`.
    """
    free = target == FREE
    wanted = int(ratio * ((target != IGNORE) & ~free).sum())
    if int(free.sum()) <= wanted:
        return target
    draw = torch.rand(target.shape, generator=generator, device=target.device).masked_fill(
        ~free, 2.0
    )
    last = draw.reshape(-1).kthvalue(wanted).values if wanted else -1.0
    return target.masked_fill(free & (draw > last), IGNORE)
