"""The settings of a run: a dataclass, read from one YAML file per network and data set."""

from __future__ import annotations

import dataclasses
import reprlib
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from carlasc.errors import ArgumentError, FormatError, import_extra, reading

NETWORKS = (
    "motionsc",
    "lmscnet_ss",
    "lmscnet",
    "sscnet",
    "sscnet_full",
    "js3cnet",
    "js3cnet_exact",
    "js3cnet_kitti",
    "baseline",
    "baseline_hits",
)
STACKED = ("motionsc", "baseline", "baseline_hits")
"""The networks that take more than one scan."""


@dataclass(frozen=True)
class Config:
    """Settings of a training run, with the defaults of MotionSC on CarlaSC.

    Attributes:
        network: one of `NETWORKS`.
        history: T, number of scans in a stack; more than 1 for `STACKED` networks only.
        align: move past scans into the newest one's frame by their poses.
        shuffle_history: put the past scans of each stack in random order (to measure the effect of
            their order).
        grid: name of the grid to predict.
        remap: maps the labels to the predicted classes.
        train: split to train on, or names of sequences.
        val: split to choose the best epoch by.
        test: split to report.
        flips: directions in which samples are mirrored at random: "x", "y", "xy" or "".
        class_weights: of the loss: "table" (the published voxel counts), "train" (counted on the
            training split), "none", or the file that `carlasc stats --json` wrote.
        weighting: class weights from counts: "log" (the paper's 1 / ln of the count) or "root" (the
            cube root of the count of the most frequent class divided by the count, as for
            JS3C-Net); None is the network's own.
        soft_labels: train on the probability of each class instead of labels; the grid must be made
            with `keep_evidence=True`.
        free_ratio: number of free voxels in the loss per occupied one, drawn at random for each
            batch; 0 takes all (SSCNet: 2).
        epochs: passes over the training split.
        batch_size: samples per step, over all processes together.
        learning_rate: learning rate of Adam in the first epoch.
        decay: factor on the learning rate after every `decay_every` epochs.
        decay_every: number of epochs between two decays.
        weight_decay: of Adam.
        patience: stop after this number of epochs without a better mIoU; None never stops early.
        precision: "float32", or "bf16" for mixed precision.
        compile: compile the network with torch.compile.
        workers: number of processes that load data, for each training process.
        save_every: number of steps after which last.pt is written within an epoch; 0 writes it
            after each epoch only.
        keep_samples: keep all samples in memory after the first epoch, for data that are small.
        wandb: also log for Weights & Biases, without sending anything (`wandb sync` does that).
        seed: of weights, order, flips and draws.
    """

    network: Literal[
        "motionsc",
        "lmscnet_ss",
        "lmscnet",
        "sscnet",
        "sscnet_full",
        "js3cnet",
        "js3cnet_exact",
        "js3cnet_kitti",
        "baseline",
        "baseline_hits",
    ]
    history: int = 1
    align: bool = True
    shuffle_history: bool = False
    grid: str = "evaluation"
    remap: str | None = "carlasc11"
    train: str | list[str] = "train"
    val: str | list[str] = "val"
    test: str | list[str] = "test"
    flips: str = "xy"
    class_weights: str = "table"
    weighting: Literal["log", "root"] | None = None
    soft_labels: bool = False
    free_ratio: float = 0.0
    epochs: int = 10
    batch_size: int = 16
    learning_rate: float = 1e-3
    decay: float = 0.96
    decay_every: int = 1
    weight_decay: float = 0.0
    patience: int | None = None
    precision: Literal["float32", "bf16"] = "float32"
    compile: bool = False
    workers: int = 4
    save_every: int = 0
    keep_samples: bool = False
    wandb: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name, kind in typing.get_type_hints(Config).items():
            value = getattr(self, name)
            if kind is float and isinstance(value, int) and not isinstance(value, bool):
                object.__setattr__(self, name, float(value))
            elif not _fits(value, kind):
                raise ArgumentError(name, expected=_describe(kind), found=reprlib.repr(value))
        for name in ("history", "epochs", "batch_size", "decay_every"):
            if getattr(self, name) < 1:
                raise ArgumentError(name, expected="1 or more", found=str(getattr(self, name)))
        if self.save_every < 0:
            raise ArgumentError("save_every", expected="0 or more", found=str(self.save_every))
        if self.history > 1 and self.network not in STACKED:
            advice = f"only {', '.join(STACKED)} take more"
            raise ArgumentError(
                "history", expected=f"1 for {self.network}", found=str(self.history), advice=advice
            )
        if self.soft_labels and self.remap == "semantickitti19":
            raise ArgumentError(
                "soft_labels",
                expected="False with remap=semantickitti19, whose ignored classes are left out by "
                "their labels",
                found="True",
            )
        if not set(self.flips) <= {"x", "y"}:
            raise ArgumentError("flips", expected="x, y, xy or nothing", found=repr(self.flips))

    @classmethod
    def read(cls, path: Path, overrides: Iterable[str] = ()) -> Config:
        """Read a YAML file. `overrides` are "key=value" texts that replace its values.

        Raises:
            FormatError: the file does not hold settings.
            ArgumentError: an override is not "key=value", a key does not exist, or a value is
                wrong.
        """
        yaml = import_extra("yaml", "torch")
        with reading(path, "a YAML file of settings"):
            values = yaml.safe_load(path.read_text("utf-8"))
        if not isinstance(values, Mapping):
            raise FormatError(
                path, expected="settings as `key: value` lines", found=f"{type(values).__name__}"
            )
        settings: dict[str, Any] = dict(values)
        for text in overrides:
            key, equals, value = text.partition("=")
            if not equals:
                raise ArgumentError("--set", expected="key=value", found=repr(text))
            settings[key] = yaml.safe_load(value)
        names = [field.name for field in dataclasses.fields(cls)]
        if unknown := set(settings) - set(names):
            raise ArgumentError(
                path,
                expected=f"some of {', '.join(names)}",
                found=", ".join(sorted(map(str, unknown))),
            )
        if "network" not in settings:
            raise FormatError(path, expected="the key network", found="none")
        with reading(path, "settings"):
            try:
                return cls(**settings)
            except ArgumentError as error:
                raise error.within(path) from error

    def write(self, path: Path) -> None:
        """Write all settings as YAML."""
        yaml = import_extra("yaml", "torch")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(dataclasses.asdict(self), sort_keys=False))


def _fits(value: Any, kind: Any) -> bool:
    origin = typing.get_origin(kind)
    if origin is Literal:
        return value in typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):  # a Literal or None is of the second type
        return any(_fits(value, part) for part in typing.get_args(kind))
    if origin is list:
        return isinstance(value, list) and all(
            _fits(item, typing.get_args(kind)[0]) for item in value
        )
    return isinstance(value, kind) and not (kind is int and isinstance(value, bool))


def _describe(kind: Any) -> str:
    if typing.get_origin(kind) is Literal:
        return "one of " + ", ".join(map(str, typing.get_args(kind)))
    return str(getattr(kind, "__name__", kind) if typing.get_origin(kind) is None else kind)
