"""A frame that kills every process that reads it is a failed frame; the others are converted."""

from pathlib import Path

import numpy as np
import pytest
from helpers.converters.deadly_converter import Deadly
from helpers.converters.lab_converter import Lab
from helpers.datasets.captures import read_tree

from carlasc.converting import LayoutOptions, convert
from carlasc.running import Run, open_cluster

FRAMES = 12  # more than one task: a single one is done in this process


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    folder, rng = tmp_path / "lab" / "one", np.random.default_rng(0)
    folder.mkdir(parents=True)
    for number in range(FRAMES):
        points = rng.uniform(-20, 20, (300, 4)).astype(np.float32)
        np.savez(
            folder / f"{number}.npz",
            points=points,
            labels=np.full(300, 3, np.uint32),
            actors=np.zeros(300, np.uint32),
        )
    np.save(folder / "poses.npy", np.tile(np.eye(4), (FRAMES, 1, 1)))
    return tmp_path / "lab"


def check(drive: Path, out: Path, executor=None) -> None:
    result = convert(
        Deadly,
        drive,
        out,
        layout=LayoutOptions(flow="none"),
        grids=None,
        run=Run(workers=2, executor=executor),
    )
    assert [(failure.frame, failure.message[:38]) for failure in result.failures] == [
        (3, "a task: 3 worker processes died while ")
    ]
    assert result.made == FRAMES - 1
    # the library was mended
    result = convert(
        Lab, drive, out, layout=LayoutOptions(flow="none"), grids=None, run=Run(workers=1)
    )
    assert (result.made, result.skipped, result.failures) == (1, FRAMES - 1, ())
    convert(
        Lab,
        drive,
        out.with_name("whole"),
        layout=LayoutOptions(flow="none"),
        grids=None,
        run=Run(workers=1),
    )
    left_out = "carlasc.json"  # it names the converter
    assert read_tree(out, left_out) == read_tree(out.with_name("whole"), left_out)


@pytest.mark.slow
def test_processes_of_our_own(drive, tmp_path):
    check(drive, tmp_path / "out")


@pytest.mark.slow
@pytest.mark.needs("distributed")
def test_a_cluster(drive, tmp_path):
    with open_cluster("local:2") as cluster:
        check(drive, tmp_path / "out", cluster)
