"""The loss: weighted cross-entropy over known voxels, at every scale of a network's output."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy, one_hot

IGNORE = 255  # label of voxels that are left out
FREE = 0


def completion_loss(outputs: Tensor | Sequence[Tensor], target: Tensor, class_weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weighted sum of the cross-entropy, and the sum of the weights, at each scale.

    The loss is the mean over the scales of sum / weight. Several processes add up their weights before they divide, which gives each
    process its part of the loss of the whole batch.

    Args:
        outputs: (B, X, Y, Z, K) logits, or a list of them at 1/1, 1/2, 1/4, ... of the scale.
        target: (B, X, Y, Z) int64 labels, `IGNORE` for voxels that are left out.
        class_weights: (K,) float32.

    Returns:
        (S,) sums and (S,) weights.
    """
    sums, weights = [], []
    for scale, logits in enumerate([outputs] if isinstance(outputs, Tensor) else outputs):
        coarse = target if scale == 0 else coarsen(target, 2**scale, len(class_weights))
        sums.append(
            cross_entropy(logits.movedim(-1, 1).float(), coarse, class_weights, ignore_index=IGNORE, reduction="sum")
        )
        counted = coarse != IGNORE
        weights.append((class_weights[torch.where(counted, coarse, 0)] * counted).sum())
    return torch.stack(sums), torch.stack(weights)


def coarsen(target: Tensor, block: int, num_classes: int) -> Tensor:
    """Return one label per block: the most frequent occupied class, else free if any voxel is free, else `IGNORE`.

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
    votes = votes.reshape(batch, x // block, block, y // block, block, z // block, block, num_classes).sum((2, 4, 6))
    occupied, most = votes[..., 1:].max(-1)
    free = torch.where(votes[..., FREE] > 0, FREE, IGNORE)
    return torch.where(occupied > 0, most + 1, free)


def balance_free(target: Tensor, ratio: float, generator: torch.Generator) -> Tensor:
    """Keep all occupied voxels and at most `ratio` times as many free ones, drawn at random over the batch (SSCNet).

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
    draw = torch.rand(target.shape, generator=generator, device=target.device).masked_fill(~free, 2.0)
    last = draw.reshape(-1).kthvalue(wanted).values if wanted else -1.0
    return target.masked_fill(free & (draw > last), IGNORE)
