"""The rows of the tables: which networks are trained, on which labels, with which settings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from completion.config import Config

from benchmarking.sizes import Size

Weighting = Literal["log", "root"]
WEIGHTINGS: tuple[Weighting, ...] = ("log", "root")
CAPTURE_TRUTH, HITS = "capture truth", "Baseline T=5, hits"


@dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes:
        name: what it is called.
        config: the settings of its runs, but for the seed and the learning rate.
        seeds: number of runs.
    """

    name: str
    config: Config
    seeds: int = 1


def network_rows(size: Size) -> list[Row]:
    """Return the networks, with the optimizers and losses of their papers, trained on capture truth
    with both kinds of class weights.
    """
    motionsc, baseline = _shared(size), _baseline(size)
    networks = {
        "Baseline T=5": baseline,
        "MotionSC T=5": replace(motionsc, history=5),
        "LMSCNet SS": replace(motionsc, network="lmscnet_ss", decay=0.98),
        "SSCNet full": replace(motionsc, network="sscnet_full", decay=1.0, free_ratio=2.0),
        "MotionSC T=1": motionsc,
        "Baseline T=1": replace(baseline, history=1),
    }
    return [
        Row(f"{name}, {weighting}", replace(config, weighting=weighting), size.seeds)
        for name, config in networks.items()
        for weighting in WEIGHTINGS
    ]


def label_rows(size: Size) -> list[Row]:
    """Return one network on the kinds of labels that the same drives have."""
    plain = _baseline(size)
    labels = {
        "tube": replace(plain, grid="tube"),
        "align": replace(plain, grid="align"),
        "align, 20% of the points wrong": replace(plain, grid="wrong"),
        "align, soft labels": replace(plain, grid="align", soft_labels=True),
        CAPTURE_TRUTH: plain,
    }
    return [Row(name, config, size.seeds) for name, config in labels.items()]


def part_rows(size: Size) -> list[Row]:
    """Return our own network with and without rays, with both kinds of class weights."""
    rows = []
    for weighting in WEIGHTINGS:
        plain = replace(_baseline(size), weighting=weighting)
        rows.append(Row(f"Baseline T=5, {weighting}", plain, size.seeds))
        rows.append(
            Row(f"{HITS}, {weighting}", replace(plain, network="baseline_hits"), size.seeds)
        )
    return rows


def history_rows(size: Size) -> list[Row]:
    """Return MotionSC and our own network without history, with history, with shuffled history, and
    without alignment.
    """
    rows = []
    for name, plain in (
        ("MotionSC", replace(_shared(size), history=5, weighting="log")),
        ("Baseline", _baseline(size)),
    ):
        variants = {
            f"{name} T=1": replace(plain, history=1),
            f"{name} T=5": plain,
            f"{name} T=5, history shuffled": replace(plain, shuffle_history=True),
            f"{name} T=5, not aligned": replace(plain, align=False),
        }
        rows += [Row(variant, config, size.seeds) for variant, config in variants.items()]
    return rows


def js3cnet_rows(size: Size) -> list[Row]:
    """Return JS3C-Net, which has a table of its own: its steps take so long that it makes fewer."""
    config = replace(
        _shared(size), network="js3cnet", flips="", decay=0.7, decay_every=10, weight_decay=1e-4
    )
    return [Row("JS3C-Net", replace(config, weighting="root", epochs=size.js3cnet_epochs))]


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
    return replace(_shared(size), network="baseline", history=5, weighting="root", decay=0.8)
