"""The loops of examples/mixture train on CarlaSC and SemanticKITTI data, in two processes."""

import csv
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.datasets.drives import write_drive
from helpers.datasets.tiny_kitti import write_tiny_kitti

import carlasc
from carlasc import FromScans, GridSpec, Run
from carlasc.motion import PoseOptions

pytest.importorskip("torch", reason="needs carlasc[torch]")
pytestmark = [pytest.mark.slow, pytest.mark.posix("gloo")]

LOOPS = Path(__file__).parents[2] / "examples" / "mixture"


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A data set like CarlaSC, and one of SemanticKITTI with a grid of the same geometry."""
    root = tmp_path_factory.mktemp("mixture")
    write_drive(root / "CarlaSC" / "Train" / "Town01_Light" / "cartesian", range(6))
    write_tiny_kitti(root / "raw", frames=4, points=600)
    poses = PoseOptions(source="file")
    alone = Run(workers=1)
    carlasc.convert("kitti", root / "raw", root / "kitti", poses=poses, grids=None, run=alone)
    carlasc.regrid(
        root / "kitti", GridSpec.published(), observe=FromScans(dynamic="drop"), run=alone
    )
    return root / "CarlaSC", root / "kitti"


def run(command, folders, cwd):
    environment = os.environ | {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
    result = subprocess.run(
        [sys.executable, *command, *folders],
        check=False,
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert result.returncode == 0, result.stderr[-3000:]
    return result.stdout


def test_the_loop_in_plain_torch_learns(folders, tmp_path):
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    printed = run([*torchrun, LOOPS / "train_torch.py"], folders, tmp_path)
    losses = [float(loss) for loss in re.findall(r"epoch \d: loss ([\d.]+)", printed)]
    assert len(losses) == 5 and losses[-1] < losses[0]


@pytest.mark.needs("lightning")
def test_the_loop_in_lightning_learns(folders, tmp_path):
    run([LOOPS / "train_lightning.py"], folders, tmp_path)
    (log,) = tmp_path.rglob("metrics.csv")
    losses = [float(row["loss"]) for row in csv.DictReader(log.open())]
    assert len(losses) == 5 and losses[-1] < losses[0]


def test_the_loops_are_short():
    for name in ("train_torch.py", "train_lightning.py"):
        lines = (LOOPS / name).read_text().splitlines()
        code = [line for line in lines if line and not re.match(r'import|from| *"""', line)]
        assert len(code) <= 30
