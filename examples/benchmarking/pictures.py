"""A picture of what labels are worth: one frame as the networks complete it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from completion.data import open_split
from completion.networks import build_network
from completion.processes import Processes
from completion.scoring import predict
from completion.tasks import Batch
from completion.training import BEST
from completion.weights import load_weights, read_weights
from numpy.typing import NDArray
from PIL import Image
from torch import nn

from benchmarking.rows import Row
from benchmarking.runs import choose_rate, on_truth, run_folder
from benchmarking.sizes import Size
from benchmarking.tables import FREE, PEDESTRIAN, VEHICLE
from carlasc import Grid, collate
from carlasc.core import CARLASC11
from carlasc.viewing import ClassColors, Panel, draw_panels, grid_drawing

SCENE = "labels.png"


@torch.no_grad()
def draw_scene(rows: Sequence[Row], size: Size, folder: Path, path: Path) -> None:
    """Draw a frame of the test split as the first run of each row of hard labels completes it, and
    the truth.

    It is the frame in which the first row has the median number of phantom voxels of actors, so
    neither its best nor its worst one. Voxels that no sensor saw are left out of all panels.
    """
    rows = [row for row in rows if not row.config.soft_labels]
    scenes = size.scenes
    networks = [_trained(row, size, folder) for row in rows]
    test = open_split(folder / "data", "test", on_truth(rows[0].config))
    samples = [test[index] for index in range(len(test))]
    phantoms = [_count_phantoms(networks[0], sample) for sample in samples]
    sample = samples[int(np.argsort(phantoms, kind="stable")[len(samples) // 2])]
    grids = {
        f"trained on {row.name}": _complete(network, sample)
        for row, network in zip(rows, networks, strict=True)
    }
    grids["capture truth"] = sample["labels"].astype(np.int64)
    colors, seen = ClassColors(CARLASC11), sample["known"]
    panels = [
        Panel(
            grid_drawing(Grid(scenes.spec, np.where(seen, labels, 0).astype(np.uint8)), colors),
            title=title,
        )
        for title, labels in grids.items()
    ]
    Image.fromarray(draw_panels(panels, size=(1500, 760), columns=3)).quantize(128).save(
        path, optimize=True
    )


def _trained(row: Row, size: Size, folder: Path) -> nn.Module:
    alone = Processes(0, 1, torch.device("cpu"))
    rate = choose_rate(size.scenes, row.config, size.trial_epochs, folder, alone)
    config = replace(row.config, learning_rate=rate)
    weights = run_folder(size.scenes, config, folder) / BEST
    network = build_network(
        config.network, len(CARLASC11.names), size.scenes.spec, config.history
    ).eval()
    load_weights(network, read_weights(weights), str(weights))
    return network


def _complete(network: nn.Module, sample: Batch) -> NDArray[np.int64]:
    return predict(network, collate([sample]), torch.device("cpu"))[0].numpy()


def _count_phantoms(network: nn.Module, sample: Batch) -> int:
    """Return the number of free voxels that a network calls Vehicle or Pedestrian."""
    free = sample["known"] & (sample["labels"] == FREE)
    return int((np.isin(_complete(network, sample), (VEHICLE, PEDESTRIAN)) & free).sum())
