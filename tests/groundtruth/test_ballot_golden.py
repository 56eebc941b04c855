"""The authors' generator made these grids: they come out again byte for byte, from the kernel and
from the plain version.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.references.plain_voting import plain_grid, plain_votes

from carlasc.core.grids import GridSpec
from carlasc.groundtruth.voting.ballot import Observation, count_votes

VARIANTS = {"cartesian": 1.5, "cylindrical": 1.5, "cartesian_fine": 1.5, "cartesian_step0.5": 0.5}


def observe(capture: Path, frame: int) -> list[Observation]:
    raw = capture / "raw"
    poses = [np.load(raw / f"pose{s}" / f"{frame}.npy") for s in range(5)]
    return [
        Observation(
            np.load(raw / f"velodyne{s}" / f"{frame}.npy"),
            np.load(raw / f"labels{s}" / f"{frame}.npy"),
            np.linalg.inv(poses[0]) @ pose,
        )
        for s, pose in enumerate(poses)
    ]


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("frame", range(3))
def test_golden_grids_come_out_byte_for_byte(
    golden_capture: Path, variant: str, frame: int
) -> None:
    folder = golden_capture / variant / "evaluation"
    spec = GridSpec.from_params(json.loads((folder / "params.json").read_text()))
    grid = count_votes(
        observe(golden_capture, 100 + frame), spec, free_step_m=VARIANTS[variant]
    ).to_grid()
    assert grid.counts is not None
    assert grid.labels.astype("<u4").tobytes() == (folder / f"{frame:06d}.label").read_bytes()
    assert grid.counts.astype("<f4").tobytes() == (folder / f"{frame:06d}.bin").read_bytes()


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_plain_version_makes_the_golden_grids_too(golden_capture: Path, variant: str) -> None:
    folder = golden_capture / variant / "evaluation"
    spec = GridSpec.from_params(json.loads((folder / "params.json").read_text()))
    labels, counts = plain_grid(
        plain_votes(observe(golden_capture, 101), spec, free_step_m=VARIANTS[variant]), spec
    )
    assert labels.astype("<u4").tobytes() == (folder / "000001.label").read_bytes()
    assert counts.astype("<f4").tobytes() == (folder / "000001.bin").read_bytes()
