"""One run: its learning rate is chosen, a network is trained, scored on capture truth, and the
result kept, so that it is never made twice.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from completion.config import Config
from completion.data import eval_loader, open_split
from completion.networks import build_network
from completion.processes import Processes
from completion.scoring import score_with_certainty
from completion.training import BEST, LAST, train
from completion.weights import load_weights, read_checkpoint, read_weights
from numpy.typing import NDArray

from benchmarking.sizes import Scenes, key_of, settings_of
from carlasc.metrics import CONVENTIONS, ConfusionMatrix, Evaluation

RATES = (1e-3, 2e-3, 4e-3)
_ANYHOW = ("workers", "keep_samples", "compile")  # settings that do not change what a run is


@dataclass(frozen=True)
class Result:
    """What a run gave on the test split.

    Attributes:
        settings: its settings, and those of the scenes.
        drives: (D, K, K) confusion matrix of each test drive over the known voxels of capture
            truth.
        frames: number of frames.
        ece_free: expected calibration error of voxels that are predicted free, mean over frames.
        ece_occupied: the same of voxels that are predicted occupied.
        train_s: duration of the training, in seconds.
        best_epoch: the epoch whose weights were taken.
        val_miou: their mIoU on the validation split, with labels of the kind that the run was
            trained on.
    """

    settings: Mapping[str, Any]
    drives: NDArray[np.int64]
    frames: int
    ece_free: float
    ece_occupied: float
    train_s: float
    best_epoch: int
    val_miou: float

    @property
    def matrix(self) -> ConfusionMatrix:
        """Confusion matrix over all test drives."""
        return ConfusionMatrix(self.drives.shape[-1], counts=self.drives.sum(0))

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
        return cls(drives=np.array(kept.pop("drives"), np.int64), **kept)

    def write(self, path: Path) -> None:
        """Keep the result. The file is complete or does not exist."""
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.write_text(json.dumps(vars(self) | {"drives": self.drives.tolist()}))
        part.replace(path)


def settings_of_run(scenes: Scenes, config: Config) -> dict[str, Any]:
    """Return what makes a run what it is."""
    run = {name: value for name, value in asdict(config).items() if name not in _ANYHOW}
    return {"scenes": settings_of(scenes), "run": run}


def on_truth(config: Config) -> Config:
    """Return the settings that score a run: on capture truth, whatever it learned from."""
    return replace(config, grid="evaluation", soft_labels=False)


def run_folder(scenes: Scenes, config: Config, out: Path) -> Path:
    """Return the folder of a run.

    Its number of epochs is not in its name: a run that was long enough to choose it goes on as a
    longer one.
    """
    settings = settings_of_run(scenes, config)
    del settings["run"]["epochs"]
    return out / "runs" / key_of(settings)


def choose_rate(
    scenes: Scenes, config: Config, trial_epochs: int, out: Path, processes: Processes
) -> float:
    """Return the one of `RATES` with the best mIoU on the validation drives after a few epochs of
    the first seed on capture truth.

    JS3C-Net keeps that of its paper.
    """
    if config.network == "js3cnet":
        return config.learning_rate
    tried = replace(on_truth(config), shuffle_history=False, align=True, seed=0)
    scores = {}
    for rate in RATES:
        trial = replace(tried, learning_rate=rate, epochs=trial_epochs)
        last = run_folder(scenes, trial, out) / LAST
        if not last.exists() or read_checkpoint(last)["epoch"] < trial_epochs:
            train(out / "data", trial, last.parent, processes, resume=last.exists())
        scores[rate] = max(read_checkpoint(last)["mious"][:trial_epochs])
    return max(scores, key=lambda rate: scores[rate])


def result_of(scenes: Scenes, config: Config, out: Path, processes: Processes) -> Result:
    """Return the result of a run.

    It is trained only if no result is kept; a training that was stopped continues.

    Args:
        scenes: the scenes of the data.
        config: the settings of the run.
        out: folder with `data`; runs and results are kept beside it.
        processes: the processes of the run.
    """
    settings = settings_of_run(scenes, config)
    path, run = out / "results" / f"{key_of(settings)}.json", run_folder(scenes, config, out)
    if path.exists():
        return Result.read(path)
    data = out / "data"
    progress = train(data, config, run, processes, resume=(run / LAST).exists())
    truth = on_truth(config)
    test = open_split(data, truth.test, truth)
    num_classes = max(test.classes.names) + 1
    network = build_network(config.network, num_classes, test.spec, config.history)
    load_weights(network, read_weights(run / BEST), str(run / BEST))
    network.to(processes.device)
    drives, errors = [], []
    for frames, sequence in zip(test.frames, test.sequences, strict=True):
        drive = open_split(data, [PurePosixPath(sequence.path).parts[-2]], truth)
        loader = eval_loader(drive, truth, processes.rank, processes.world)
        matrix, certainty = score_with_certainty(network, loader, num_classes, processes)
        score = certainty.compute()
        drives.append(matrix.counts)
        errors.append((len(frames), score.ece_empty, score.ece_occupied))
    counts, empty, occupied = np.array(errors).T
    samples = len(open_split(data, config.train, config))
    result = Result(
        settings,
        np.stack(drives),
        len(test),
        float(np.average(empty, weights=counts)),
        float(np.average(occupied, weights=counts)),
        sum(samples / speed for speed in progress.samples_per_s),
        progress.best_epoch,
        progress.best_miou,
    )
    if processes.first:
        result.write(path)
    processes.wait()
    return result
