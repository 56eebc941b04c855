"""The rows of the tables: which networks are trained, on which labels, with which settings."""

from __future__ import annotations

from dataclasses import dataclass, replace

from completion.config import Config

from benchmarking.sizes import Size


@dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes:
        name: what it is called.
        config: the settings of its runs, but for the seed.
        seeds: number of runs.
    """

    name: str
    config: Config
    seeds: int = 1

    def runs(self) -> list[Config]:
        """Return the settings of its runs."""
        return [replace(self.config, seed=seed) for seed in range(self.seeds)]


def network_rows(size: Size) -> list[Row]:
    """Return the networks, with the optimizers and losses of their papers, trained on capture truth."""
    motionsc = _shared(size)
    js3cnet = replace(motionsc, network="js3cnet", flips="", decay=0.7, decay_every=10, weight_decay=1e-4)
    js3cnet = replace(js3cnet, epochs=size.js3cnet_epochs)
    return [
        Row("LMSCNet SS", replace(motionsc, network="lmscnet_ss", decay=0.98), size.seeds),
        Row("SSCNet full", replace(motionsc, network="sscnet_full", decay=1.0, free_ratio=2.0), size.seeds),
        Row("JS3C-Net", js3cnet),
        Row("MotionSC T=1", motionsc, size.seeds),
        Row("MotionSC T=5", replace(motionsc, history=5), size.seeds),
        Row("Baseline T=5", _baseline(size), size.seeds),
    ]


def label_rows(size: Size) -> list[Row]:
    """Return one network on the kinds of labels that the same drives have."""
    plain = _baseline(size)
    labels = {
        "tube": replace(plain, grid="tube"),
        "align": replace(plain, grid="align"),
        "align, soft labels": replace(plain, grid="align", soft_labels=True),
        "capture truth": plain,
    }
    return [Row(name, config, size.seeds) for name, config in labels.items()]


def part_rows(size: Size) -> list[Row]:
    """Return our own network without each of its parts, and MotionSC with its class weights."""
    plain = _baseline(size)
    variants = {
        "Baseline T=5": plain,
        "one scan (T=1)": replace(plain, history=1),
        "hits alone, without rays": replace(plain, network="baseline_hits"),
        "class weights of the paper": replace(plain, weighting="log"),
        "MotionSC T=5 with the class weights of Baseline": replace(_shared(size), history=5, weighting="root"),
    }
    return [Row(name, config, size.seeds) for name, config in variants.items()]


def history_rows(size: Size) -> list[Row]:
    """Return our own network without history, with history, with shuffled history, and without alignment."""
    plain = _baseline(size)
    variants = {
        "T=1": replace(plain, history=1),
        "T=5": plain,
        "T=5, history shuffled": replace(plain, shuffle_history=True),
        "T=5, not aligned": replace(plain, align=False),
    }
    return [Row(name, config, size.seeds) for name, config in variants.items()]


def _shared(size: Size) -> Config:
    return Config(
        "motionsc",
        class_weights="train",
        epochs=size.epochs,
        batch_size=size.batch_size,
        workers=size.workers,
        keep_samples=size.workers == 0,
    )


def _baseline(size: Size) -> Config:
    return replace(_shared(size), network="baseline", history=5, learning_rate=2e-3, decay=0.8)
