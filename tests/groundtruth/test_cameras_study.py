"""The study of cameras, on two frames of one town."""

import subprocess
import sys
from pathlib import Path

import pytest

STUDY = Path(__file__).parents[2] / "docs/studies/cameras.py"


@pytest.mark.slow
@pytest.mark.needs("embreex")
def test_the_study_prints_the_rows_of_its_page(tmp_path):
    call = [sys.executable, STUDY, tmp_path / "work", "--seeds", "23", "--size", "tiny"]
    done = subprocess.run([*map(str, call)], capture_output=True, text=True, check=True)
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in done.stdout.splitlines()
    ]
    first, second, others = rows[:2], rows[2:6], done.stdout.splitlines()[6:]
    labelled, right, of_all, voxels = (float(cell.removesuffix("%")) for cell in first[1][1:])
    assert min(labelled, right, of_all, voxels) > 90
    assert [row[1] for row in second[1:]] == [
        "coarse, one LiDAR",
        "coarse, twelve LiDARs",
        "0.2 m, twelve LiDARs",
    ]
    for row in second[1:]:
        uncut, late, early, filled, whole, share, by_centre = (
            float(cell.removesuffix("%")) for cell in row[2:]
        )
        assert uncut > 99 and abs(uncut + late + early - 100) < 0.02
        # one LiDAR fills few voxels that no edge cuts
        assert filled > (80 if row[1] == "coarse, one LiDAR" else 95)
        assert uncut > whole > 80 and uncut > by_centre > 85 and 50 < share < 95
    assert float(others[0].split(": ")[1].split()[0]) > 0
    assert [float(line.split(": ")[1].split()[0]) < 1e-2 for line in others[1:]] == [True] * 3
