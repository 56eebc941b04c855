"""Data sets and loaders of a run, and the class weights of the loss."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, DistributedSampler, Subset
from torch.utils.data import Dataset as TorchDataset

from carlasc import Dataset, Flip, ShardSampler, Source, collate
from carlasc.core import CARLA, SEMANTICKITTI, SEMANTICKITTI19, TRAIN_VOXEL_COUNTS, Remap
from carlasc.dataset import Sample
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.metrics import CONVENTIONS
from carlasc.storage import read_remap
from completion.config import Config
from completion.losses import FREE, IGNORE
from completion.networks import KINDS
from completion.tasks import WEIGHTINGS

Values = Mapping[str, Any]  # a sample, or a batch of samples


class ShuffleHistory:
    """Puts the past scans of a stack in random order; the newest stays last.

    The order depends on the seed and the frame.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def __call__(self, sample: Values) -> Values:
        """Return the sample with its history shuffled."""
        last = len(sample["valid"]) - 1
        order = [*np.random.default_rng([self.seed, sample["frame"]]).permutation(last), last]
        return {**sample} | {
            name: sample[name][order] for name in ("occupancy", "visibility") if name in sample
        }


class SemanticKittiRule:
    """Maps SemanticKITTI's ids to the classes of the benchmark.

    Voxels of ignored classes become unknown, points of them class 0.
    """

    def __call__(self, sample: Values) -> Values:
        """Return the sample in the benchmark's classes."""
        labels, counted = _benchmark_classes(sample["labels"])
        mapped = {"labels": labels, "known": sample["known"] & counted}
        if "point_labels" in sample:
            labels, counted = _benchmark_classes(sample["point_labels"])
            mapped["point_labels"] = np.where(counted, labels, FREE).astype(np.uint8)
        return {**sample} | mapped


def _benchmark_classes(
    raw: NDArray[np.unsignedinteger],
) -> tuple[NDArray[np.unsignedinteger], NDArray[np.bool_]]:
    """Return SemanticKITTI's labels as those of the benchmark, and which are not ignored."""
    labelled = raw, SEMANTICKITTI
    return CONVENTIONS["semantickitti"].prepare(labelled, labelled, None)[1:]


class Compose:
    """Transforms one after another."""

    def __init__(self, *transforms: Any) -> None:
        self.transforms = transforms

    def __call__(self, sample: Values) -> Values:
        """Return the sample after all of them."""
        for transform in self.transforms:
            sample = transform(sample)
        return sample

    def set_epoch(self, epoch: int) -> None:
        """Pass the epoch to the transforms that use it."""
        for transform in self.transforms:
            if hasattr(transform, "set_epoch"):
                transform.set_epoch(epoch)


def open_split(
    source: str | Path | Source, split: str | list[str], config: Config, *, training: bool = False
) -> Dataset:
    """Open a split of a data set with the settings of a run.

    Raises:
        MissingDataError: the split does not exist, or has no frame.
        ArgumentError: the history is longer than every sequence.
    """
    kitti = config.remap == "semantickitti19"
    remap = None if kitti else config.remap
    task = KINDS[config.network].task
    fields = (*task.fields, "labels", "known")
    if training:
        fields += task.training_fields + (("posterior",) if config.soft_labels else ())
    try:
        data = Dataset(
            source,
            split,
            history=config.history,
            grid=config.grid,
            fields=fields,
            remap=remap,
            align=config.align,
        )
    except MissingDataError as error:
        raise error.within(f"split {split!r}") from error
    frames = {sequence.location: len(sequence.scan_frames()) for sequence in data.sequences}
    longest = max(frames, key=lambda location: frames[location])
    if config.history > frames[longest]:
        raise ArgumentError(
            "history",
            expected=f"at most the {frames[longest]} frames of {longest} (the longest sequence)",
            found=str(config.history),
        )
    transforms: list[Any] = (
        [ShuffleHistory(config.seed)] if config.shuffle_history and config.history > 1 else []
    )
    if kitti:
        if data.classes is not SEMANTICKITTI:
            raise ArgumentError(
                "remap",
                expected=f"one for data with the classes {data.classes.name}",
                found="semantickitti19",
                advice="set remap=carlasc11 for CarlaSC's classes",
            )
        data.classes = SEMANTICKITTI19
        transforms.append(SemanticKittiRule())
    if training and config.flips:
        transforms.append(Flip(data.spec, tuple(config.flips), seed=config.seed))
    data.transform = Compose(*transforms)
    return data


class EpochSampler(DistributedSampler[int]):
    """A DistributedSampler that can continue in the middle of an epoch, like
    `carlasc.ShardSampler`.
    """

    _trained = 0

    def __iter__(self) -> Iterator[int]:
        """Iterate over the rest of the epoch."""
        left = islice(super().__iter__(), self._trained // self.num_replicas, None)
        self._trained = 0
        return left

    def state_dict(self, trained: int) -> dict[str, int]:
        """Return the position in the epoch."""
        return {"epoch": self.epoch, "position": trained}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Let the next iteration begin at a position."""
        self.epoch, self._trained = state["epoch"], state["position"]


class Kept(TorchDataset[Values]):
    """Keeps the samples of a data set in memory, before transforms are applied, for all runs of
    this process on the same data.
    """

    _samples_of: ClassVar[dict[tuple[Any, ...], dict[int, Sample]]] = {}

    def __init__(self, data: Dataset, config: Config) -> None:
        self.data, self.transform = copy.copy(data), data.transform
        self.data.transform = None
        places = tuple(sequence.location for sequence in data.sequences)
        same = places, data.fields, config.history, config.align, config.grid, config.remap
        self._samples = self._samples_of.setdefault(same, {})

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, index: int) -> Values:
        """Return a sample; it is read once."""
        if index not in self._samples:
            self._samples[index] = self.data[index]
        sample = self._samples[index]
        return sample if self.transform is None else self.transform(sample)


class TrainLoader:
    """Batches of the training split.

    Order and flips differ between epochs, and depend only on the seed and the epoch.

    If the data are a store with many frames per file, files are read one after the other
    (`carlasc.ShardSampler`), so that each file of an object store is fetched once.

    Args:
        data: the split.
        config: batch size (over all processes), workers, seed.
        rank: of this process.
        world: number of processes; each takes every `world`-th sample.
    """

    def __init__(self, data: Dataset, config: Config, rank: int = 0, world: int = 1) -> None:
        if config.batch_size % world:
            raise ArgumentError(
                "batch_size",
                expected=f"a multiple of the {world} processes",
                found=str(config.batch_size),
            )
        if len(data) < world:
            raise ArgumentError(
                "training split",
                expected=f"a sample for each of the {world} processes",
                found=str(len(data)),
            )
        self.data = data
        self.batch_size = config.batch_size
        self.sampler: EpochSampler | ShardSampler
        if _share_files(data):
            self.sampler = ShardSampler(data, seed=config.seed, rank=rank, num_replicas=world)
        else:
            self.sampler = EpochSampler(data, world, rank, shuffle=True, seed=config.seed)
        samples: Any = Kept(data, config) if config.keep_samples else data
        self.loader = _loader(samples, config, config.batch_size // world, sampler=self.sampler)

    def __len__(self) -> int:
        return len(self.loader)

    def epoch(self, number: int, first: int = 0) -> Any:
        """Return an iterator over the batches of an epoch, from the step `first` on."""
        self.sampler.set_epoch(number)
        self.sampler.load_state_dict(self.sampler.state_dict(trained=first * self.batch_size))
        if isinstance(self.data.transform, Compose):
            self.data.transform.set_epoch(number)
        return iter(self.loader)


def _share_files(data: Dataset) -> bool:
    """Whether the scans of successive frames are in the same files."""
    frames, sequence = max(
        zip(data.frames, data.sequences, strict=True), key=lambda pair: len(pair[0])
    )
    files = [sequence.files_of("points", [frame]) for frame in frames[:3].tolist()]
    return any(before and before == after for before, after in pairwise(files))


def eval_loader(data: Dataset, config: Config, rank: int = 0, world: int = 1) -> DataLoader[Values]:
    """Return a loader that gives each sample once, in order.

    Each process takes every `world`-th sample.
    """
    samples: Any = Kept(data, config) if config.keep_samples else data
    mine: Any = samples if world == 1 else Subset(samples, range(rank, len(data), world))
    return _loader(mine, config, max(1, config.batch_size // world))


def _loader(data: Any, config: Config, batch_size: int, **options: Any) -> DataLoader[Values]:
    # torch warns about more workers, which do not help
    workers = min(config.workers, os.cpu_count() or 1)
    return DataLoader(
        data,
        batch_size,
        num_workers=workers,
        persistent_workers=workers > 0,
        collate_fn=collate,
        pin_memory=torch.cuda.is_available(),
        **options,
    )


def target_of(batch: Values, device: torch.device) -> Tensor:
    """Return a batch's target (B, X, Y, Z) int64, `IGNORE` where unknown."""
    labels = batch["labels"].to(device, non_blocking=True).long()
    return labels.masked_fill(~batch["known"].to(device, non_blocking=True), IGNORE)


def soft_target(batch: Values, target: Tensor) -> Tensor:
    """Return a batch's soft target (B, K, X, Y, Z) float32: the probability of each class, zeros
    where `target` is `IGNORE`.
    """
    posterior = batch["posterior"].to(target.device, non_blocking=True)
    return posterior.masked_fill((target == IGNORE).unsqueeze(1), 0)


def class_weights(
    source: str | Path | Source, data: Dataset, config: Config
) -> NDArray[np.float32]:
    """Return the (K,) class weights of the loss for the training split `data` of `source`.

    Raises:
        ArgumentError: the published counts are used, but the classes are not CarlaSC's.
        FormatError: the file of `carlasc stats` does not hold counts.
    """
    num_classes = max(data.classes.names) + 1
    weights_of = WEIGHTINGS[config.weighting or KINDS[config.network].task.weighting]
    if config.class_weights == "none":
        return np.ones(num_classes, np.float32)
    if config.class_weights == "train":
        weights = weights_of(_count_voxels(source, config, num_classes))
    elif config.class_weights == "table":
        if (found := data.sequences[0].metadata.classes.name) != CARLA.name:
            raise ArgumentError(
                "class_weights",
                expected=f"train for data with the classes {found}",
                found="table, which is for CarlaSC's",
            )
        weights = weights_of(
            _merge(
                TRAIN_VOXEL_COUNTS,
                None if config.remap is None else read_remap(config.remap),
                num_classes,
            )
        )
    else:
        weights = _read_weights(Path(config.class_weights), data)
    if len(weights) != num_classes:
        raise FormatError("class weights", expected=str(num_classes), found=str(len(weights)))
    return weights.astype(np.float32)


def _merge(
    counts: NDArray[np.integer], remap: Remap | None, num_classes: int
) -> NDArray[np.float64]:
    """Return the counts of a remap's target classes."""
    if remap is None:
        return counts.astype(np.float64)
    merged = np.zeros(num_classes)
    for old, new in remap.mapping.items():
        merged[new] += counts[old] if old < len(counts) else 0
    return merged


def _count_voxels(
    source: str | Path | Source, config: Config, num_classes: int
) -> NDArray[np.int64]:
    """Count the known voxels of each class over the training split."""
    config = replace(config, history=1, shuffle_history=False)
    data = open_split(source, config.train, config)
    samples: Any = Kept(data, config) if config.keep_samples else data
    counts = np.zeros(num_classes, np.int64)
    for index in range(len(data)):
        sample = samples[index]
        counts += np.bincount(sample["labels"][sample["known"]], minlength=num_classes)
    return counts


def _read_weights(path: Path, data: Dataset) -> NDArray[np.float64]:
    """Read the class weights from a file with the output of `carlasc stats --json`."""
    try:
        named = json.loads(path.read_text())["class_weights"]
        weights = np.zeros(max(data.classes.names) + 1)
        for index, name in data.classes.names.items():
            weights[index] = named[name]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError(
            path,
            expected=f"the output of `carlasc stats --json`, with a weight for each class of "
            f"{data.classes.name}",
            found=f"something else ({error})",
        ) from error
    return weights
