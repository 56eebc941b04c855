"""Counting how many voxels of each true class were predicted as each class, for NumPy arrays and torch tensors."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.compiling import cached
from carlasc.errors import FormatError

if TYPE_CHECKING:
    import torch

    Labels = NDArray[Any] | torch.Tensor
else:
    Labels = Any


def device_of(*arrays: Any) -> Any:
    """Return the device of the first torch tensor that is not on the CPU, None without one; torch is not imported to find out."""
    torch = sys.modules.get("torch")
    tensors = [array for array in arrays if torch and isinstance(array, torch.Tensor) and array.device.type != "cpu"]
    return tensors[0].device if tensors else None


def to_numpy(array: Any) -> NDArray[Any]:
    """Return a NumPy array, or a torch tensor from any device, as a NumPy array."""
    return np.asarray(array.detach().cpu() if hasattr(array, "detach") else array)


def count_arrays(
    prediction: NDArray[Any], truth: NDArray[Any], mask: NDArray[np.bool_] | None, num_classes: int
) -> NDArray[np.int64]:
    """Count on the CPU.

    Args:
        prediction: any shape, integer class ids.
        truth: the same shape, integer class ids.
        mask: the same shape: only these voxels count; None counts all.
        num_classes: K.

    Returns:
        (K, K) number of voxels, truth in rows, prediction in columns.

    Raises:
        FormatError: labels are not integers, or an id that counts is not in 0..K-1.
    """
    for name, labels in (("prediction", prediction), ("truth", truth)):
        if labels.dtype.kind not in "uib":
            raise FormatError(name, expected="integer class ids", found=str(labels.dtype))
    prediction, truth = (np.ascontiguousarray(labels).reshape(-1) for labels in (prediction, truth))
    counted = np.ones(prediction.shape, np.bool_) if mask is None else np.ascontiguousarray(mask, np.bool_).reshape(-1)
    prediction = _in_range(prediction, counted, num_classes, "prediction")
    truth = _in_range(truth, counted, num_classes, "truth")
    return _count_pairs(prediction, truth, counted, num_classes).sum(axis=0).reshape(num_classes, num_classes)


def count_tensors(
    device: torch.device, prediction: Labels, truth: Labels, mask: Labels | None, num_classes: int
) -> NDArray[np.int64]:
    """Count on a device of torch; only the (K, K) result is copied back. Arguments, result and errors as in `count_arrays`."""
    import torch

    def on_device(array: Labels) -> torch.Tensor:
        if not isinstance(array, torch.Tensor):
            array = torch.from_numpy(np.asarray(array).astype(np.int64))
        return array.to(device).reshape(-1)

    ids = {"prediction": on_device(prediction), "truth": on_device(truth)}
    for name, labels in ids.items():
        if labels.is_floating_point() or labels.is_complex():
            raise FormatError(name, expected="integer class ids", found=str(labels.dtype))
        counted = labels.long() if mask is None else labels.long()[on_device(mask).bool()]
        wrong = counted[(counted < 0) | (counted >= num_classes)]
        if wrong.numel():
            raise _out_of_range(name, int(wrong[0]), wrong.numel(), num_classes)
        ids[name] = counted
    pairs = torch.bincount(ids["truth"] * num_classes + ids["prediction"], minlength=num_classes**2)
    return pairs.reshape(num_classes, num_classes).cpu().numpy()


def _in_range(labels: NDArray[Any], counted: NDArray[np.bool_], num_classes: int, name: str) -> NDArray[Any]:
    """Return labels with all ids in 0..K-1. An id outside is an error in a voxel that counts, and becomes 0 in other voxels."""
    if not labels.size or (labels.max() < num_classes and (labels.dtype.kind != "i" or labels.min() >= 0)):
        return labels
    wrong = ((labels < 0) | (labels >= num_classes)) & counted
    if wrong.any():
        raise _out_of_range(name, int(labels[wrong][0]), int(wrong.sum()), num_classes)
    return np.where(counted, labels, 0)


@cached(error_model="python")
def _count_pairs(
    prediction: NDArray[Any], truth: NDArray[Any], counted: NDArray[np.bool_], num_classes: int
) -> NDArray[np.int64]:
    """`np.bincount(truth * K + prediction)` of the voxels that count, in one pass.

    Most voxels are free and predicted as free, so that successive voxels increment the same element. Four tables in turn avoid
    waiting for the previous store to it. They are added up outside: `sum` would take most of the time of compiling.

    Returns:
        (4, K * K) int64, whose sum over the first axis is the result.
    """
    tables = np.zeros((4, num_classes * num_classes), np.int64)
    row = np.uint32(num_classes)  # unsigned: signed indices would be checked for negative values
    for i in range(np.uint64(prediction.size)):
        tables[i & np.uint64(3), np.uint32(truth[i]) * row + np.uint32(prediction[i])] += counted[i]
    return tables


def _out_of_range(name: str, found: int, times: int, num_classes: int) -> FormatError:
    return FormatError(
        name,
        expected=f"class ids 0..{num_classes - 1}",
        found=f"{found} ({times} voxels are out of range)",
        advice="remap the labels, or mask these voxels",
    )
