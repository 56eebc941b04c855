"""One run: a network is trained, scored on capture truth, and the result kept, so that it is never made twice."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from completion.config import Config
from completion.data import eval_loader, open_split
from completion.networks import build_network
from completion.processes import Processes
from completion.scoring import score_with_certainty
from completion.training import BEST, LAST, train
from completion.weights import load_weights, read_weights

from benchmarking.sizes import Scenes, key_of, settings_of
from carlasc.metrics import CONVENTIONS, ConfusionMatrix, Evaluation

_ANYHOW = ("workers", "keep_samples", "precision", "compile")  # settings that do not change what a run is


@dataclass(frozen=True)
class Result:
    """What a run gave on the test split.

    Attributes:
        settings: its settings, and those of the scenes.
        matrix: confusion matrix over the known voxels of capture truth.
        frames: number of frames.
        ece_free: expected calibration error of voxels that are predicted free, mean over frames.
        ece_occupied: the same of voxels that are predicted occupied.
        train_s: duration of the training, in seconds.
        best_epoch: the epoch whose weights were taken.
        val_miou: their mIoU on the validation split, with labels of the kind that the run was trained on.
    """

    settings: Mapping[str, Any]
    matrix: ConfusionMatrix
    frames: int
    ece_free: float
    ece_occupied: float
    train_s: float
    best_epoch: int
    val_miou: float

    def evaluation(self, name: str) -> Evaluation:
        """Return the scores by the paper's rules, under a name."""
        return Evaluation(name, CONVENTIONS["carlasc"], self.matrix, {}, self.frames, "known", [])

    def to_dict(self, name: str) -> dict[str, Any]:
        """Return every figure by name, as fractions, for JSON."""
        own = {
            "seed": self.settings["run"]["seed"],
            "ece_free": self.ece_free,
            "ece_occupied": self.ece_occupied,
            "train_s": self.train_s,
            "best_epoch": self.best_epoch,
            "val_miou": self.val_miou,
        }
        return self.evaluation(name).to_dict() | own

    @classmethod
    def read(cls, path: Path) -> Result:
        """Read a result that was kept."""
        kept = json.loads(path.read_text())
        counts = np.array(kept.pop("confusion"))
        return cls(matrix=ConfusionMatrix(len(counts), counts=counts), **kept)

    def write(self, path: Path) -> None:
        """Keep the result. The file is complete or does not exist."""
        values = {name: value for name, value in vars(self).items() if name != "matrix"}
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.write_text(json.dumps(values | {"confusion": self.matrix.counts.tolist()}, indent=1))
        part.replace(path)


def settings_of_run(scenes: Scenes, config: Config) -> dict[str, Any]:
    """Return what makes a run what it is."""
    run = {name: value for name, value in asdict(config).items() if name not in _ANYHOW}
    return {"scenes": settings_of(scenes), "run": run}


def on_truth(config: Config) -> Config:
    """Return the settings with which a run is scored: on capture truth, whatever it was trained on."""
    return replace(config, grid="evaluation", soft_labels=False)


def result_of(scenes: Scenes, config: Config, out: Path, processes: Processes) -> Result:
    """Return the result of a run. It is trained only if no result is kept; a training that was stopped continues.

    Args:
        scenes: the scenes of the data.
        config: the settings of the run.
        out: folder with `data`; runs and results are kept beside it.
        processes: the processes of the run.
    """
    settings = settings_of_run(scenes, config)
    key = key_of(settings)
    path, run = out / "results" / f"{key}.json", out / "runs" / key
    if path.exists():
        return Result.read(path)
    data = out / "data"
    progress = train(data, config, run, processes, resume=(run / LAST).exists())
    truth = on_truth(config)
    test = open_split(data, truth.test, truth)
    num_classes = max(test.classes.names) + 1
    network = build_network(config.network, num_classes, test.spec, config.history)
    load_weights(network, read_weights(run / BEST), str(run / BEST))
    loader = eval_loader(test, truth, processes.rank, processes.world)
    matrix, certainty = score_with_certainty(network.to(processes.device), loader, num_classes, processes)
    score = certainty.compute()
    samples = len(open_split(data, config.train, config))
    result = Result(
        settings,
        matrix,
        len(test),
        score.ece_empty,
        score.ece_occupied,
        sum(samples / speed for speed in progress.samples_per_s),
        progress.best_epoch,
        progress.best_miou,
    )
    if processes.first:
        result.write(path)
    processes.wait()
    return result
