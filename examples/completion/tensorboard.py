"""The logs of a run: scores per epoch for TensorBoard, as CSV and for Weights & Biases, and
pictures of predictions beside the truth.
"""

from __future__ import annotations

import csv
import dataclasses
import importlib
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from carlasc import ClassTable, Dataset, collate
from carlasc.errors import import_extra
from carlasc.metrics import ConfusionMatrix
from completion.config import Config
from completion.scoring import predict
from completion.tasks import task_of

_PICTURES = 3  # number of frames, spread over the split


class Board:
    """Writes `tensorboard/` and `epochs.csv` of a run, and `wandb/` if the settings ask for it;
    does nothing if it is not enabled.
    """

    def __init__(
        self, out: Path, classes: ClassTable, config: Config, *, enabled: bool = True
    ) -> None:
        self.classes, self._table = classes, out / "epochs.csv"
        self._writer: Any = None
        self._wandb: Any = None
        if enabled:
            import_extra("tensorboard", "torch")
            self._writer = import_extra("torch.utils.tensorboard", "torch").SummaryWriter(
                str(out / "tensorboard")
            )
        if enabled and config.wandb:
            settings = dataclasses.asdict(config)
            # offline: `wandb sync` sends it
            self._wandb = importlib.import_module("wandb").init(
                project="carlasc", dir=out, mode="offline", config=settings
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.close()
        if self._wandb is not None:
            self._wandb.finish()

    def add_epoch(
        self, epoch: int, loss: float, learning_rate: float, matrix: ConfusionMatrix
    ) -> None:
        """Add the scores of an epoch."""
        geometry = matrix.completeness()
        scalars = {
            "train/loss": loss,
            "train/learning_rate": learning_rate,
            "val/mIoU": matrix.miou,
        }
        scalars |= {"val/accuracy": matrix.accuracy, "val/precision": geometry.precision}
        scalars |= {"val/recall": geometry.recall, "val/IoU": geometry.iou}
        scalars |= {
            f"val_class/{name}": float(matrix.iou[index])
            for index, name in self.classes.names.items()
        }
        finite = {name: value for name, value in scalars.items() if np.isfinite(value)}
        for name, value in finite.items():
            self._writer.add_scalar(name, value, epoch)
        if self._wandb is not None:
            self._wandb.log(finite, step=epoch)
        is_new = not self._table.exists()
        with self._table.open("a", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, ["epoch", *scalars])
            if is_new:
                table.writeheader()
            table.writerow({"epoch": epoch, **finite})

    def add_pictures(
        self, epoch: int, network: nn.Module, data: Dataset, device: torch.device
    ) -> None:
        """Add pictures from above: input, prediction and truth side by side."""
        network.eval()
        for place in np.unique(np.linspace(0, len(data) - 1, _PICTURES).astype(int)).tolist():
            sample = data[place]
            with torch.no_grad():
                labels = predict(network, collate([sample]), device)[0].cpu().numpy()
            shown = [
                _black_on_white((task_of(network).seen(sample, data.spec) > 0).any(-1)),
                view_from_above(np.where(sample["known"], labels, 0), self.classes),
                view_from_above(sample["labels"], self.classes),
            ]
            name = f"{sample['sequence']}/{sample['frame']:06d} (input, prediction, truth)"
            self._writer.add_image(name, np.concatenate(shown, axis=1), epoch, dataformats="HWC")


def view_from_above(labels: NDArray[Any], classes: ClassTable) -> NDArray[np.uint8]:
    """Return an (X, Y, 3) picture of (X, Y, Z) labels: the colour of the highest occupied voxel,
    white if there is none.

    Forward (x) is up.
    """
    top = labels.shape[2] - 1 - (labels[:, :, ::-1] != 0).argmax(2)
    highest = np.take_along_axis(labels, top[..., None], 2)[..., 0]
    picture = np.where((highest != 0)[..., None], classes.palette[highest], np.uint8(255))
    return picture[::-1].astype(np.uint8)


def _black_on_white(mask: Any) -> NDArray[np.uint8]:
    return np.where(mask, np.uint8(0), np.uint8(255))[::-1, :, None].repeat(3, -1)
