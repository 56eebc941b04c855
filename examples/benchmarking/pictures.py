"""Two pictures of what labels are worth: the figures of all runs, and one frame as the networks complete it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from completion.data import open_split
from completion.networks import build_network
from completion.scoring import predict
from completion.tasks import Batch
from completion.training import BEST
from completion.weights import load_weights, read_weights
from numpy.typing import NDArray
from PIL import Image
from torch import nn

from benchmarking.rows import Row
from benchmarking.runs import Result, on_truth, settings_of_run
from benchmarking.sizes import Scenes, key_of
from benchmarking.tables import FIGURES, FREE, PEDESTRIAN, VEHICLE
from carlasc import Grid, collate
from carlasc.core import CARLASC11
from carlasc.errors import import_extra
from carlasc.viewing import ClassColors, Panel, draw_panels, grid_drawing

CHART, SCENE = "labels.svg", "labels.png"
_SHOWN = (
    ("mIoU", "mIoU, %"),
    ("Vehicle", "IoU of vehicles, %"),
    ("Pedestrian", "IoU of pedestrians, %"),
    ("phantom actors, voxels per frame", "phantom actors, voxels per frame"),
)


def draw_chart(groups: Mapping[str, Sequence[Result]], path: Path) -> None:
    """Draw a bar for the mean of each group of runs, and a dot for each run.

    Raises:
        DependencyError: Matplotlib is not installed.
    """
    matplotlib = import_extra("matplotlib", "plots")
    figures, backend = (
        import_extra("matplotlib.figure", "plots"),
        import_extra("matplotlib.backends.backend_svg", "plots"),
    )
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "carlasc", "font.size": 9}):
        figure = figures.Figure(figsize=(10, 2.6), layout="constrained")
        backend.FigureCanvasSVG(figure)
        for axis, (name, title) in zip(figure.subplots(1, len(_SHOWN)), _SHOWN, strict=True):
            for place, runs in enumerate(groups.values()):
                values = [FIGURES[name](run) for run in runs]
                axis.bar(place, np.mean(values), color=f"C{place}", alpha=0.5)
                axis.plot([place] * len(values), values, ".", color=f"C{place}")
            axis.set_title(title, fontsize=9)
            axis.set_xticks(
                range(len(groups)), [group.replace(", ", ",\n") for group in groups], rotation=30, fontsize=8
            )
            axis.spines[["top", "right"]].set_visible(False)
        figure.savefig(path, format="svg", metadata={"Date": None, "Creator": None})


@torch.no_grad()
def draw_scene(rows: Sequence[Row], scenes: Scenes, folder: Path, path: Path) -> None:
    """Draw a frame of the test split as the first run of each row of hard labels completes it, and the truth.

    It is the frame in which the first row has the median number of phantom voxels of actors, so neither its best nor its worst one. Voxels
    that no sensor saw are left out of all panels.
    """
    rows = [row for row in rows if not row.config.soft_labels]
    networks = [_trained(row, scenes, folder) for row in rows]
    test = open_split(folder / "data", "test", on_truth(rows[0].config))
    samples = [test[index] for index in range(len(test))]
    phantoms = [_count_phantoms(networks[0], sample) for sample in samples]
    sample = samples[int(np.argsort(phantoms, kind="stable")[len(samples) // 2])]
    grids = {f"trained on {row.name}": _complete(network, sample) for row, network in zip(rows, networks, strict=True)}
    grids["capture truth"] = sample["labels"].astype(np.int64)
    colors, seen = ClassColors(CARLASC11), sample["known"]
    panels = [
        Panel(grid_drawing(Grid(scenes.spec, np.where(seen, labels, 0).astype(np.uint8)), colors), title=title)
        for title, labels in grids.items()
    ]
    Image.fromarray(draw_panels(panels, size=(1800, 460))).quantize(128).save(path, optimize=True)


def _trained(row: Row, scenes: Scenes, folder: Path) -> nn.Module:
    config = row.runs()[0]
    weights = folder / "runs" / key_of(settings_of_run(scenes, config)) / BEST
    network = build_network(config.network, len(CARLASC11.names), scenes.spec, config.history).eval()
    load_weights(network, read_weights(weights), str(weights))
    return network


def _complete(network: nn.Module, sample: Batch) -> NDArray[np.int64]:
    return predict(network, collate([sample]), torch.device("cpu"))[0].numpy()


def _count_phantoms(network: nn.Module, sample: Batch) -> int:
    """Return the number of free voxels that a network calls Vehicle or Pedestrian."""
    free = sample["known"] & (sample["labels"] == FREE)
    return int((np.isin(_complete(network, sample), (VEHICLE, PEDESTRIAN)) & free).sum())
