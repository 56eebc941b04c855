"""A conversion in parts deals out whole recordings, and makes the same files as one command."""

import pytest
from helpers.datasets.captures import read_tree
from helpers.datasets.tiny_kitti import write_tiny_kitti
from typer.testing import CliRunner

from carlasc.cli import app
from carlasc.converting import convert
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError
from carlasc.groundtruth import GridOptions
from carlasc.motion import PoseOptions
from carlasc.running import Part, Run

SPEC = GridSpec.published().with_size((16, 16, 4))


@pytest.fixture
def kitti(tmp_path):
    """Four recordings of different lengths."""
    for name, frames in (("00", 6), ("01", 1), ("02", 3), ("08", 2)):
        write_tiny_kitti(tmp_path / "kitti", name, frames)
    return tmp_path / "kitti"


@pytest.mark.slow
@pytest.mark.parametrize("order", [(1, 2, 3), (3, 1, 2)])
def test_parts_make_the_files_of_one_conversion(kitti, tmp_path, order):
    how = {"grids": GridOptions(SPEC, follow_ground=False), "poses": PoseOptions(force=True)}
    whole = convert("kitti", kitti, tmp_path / "whole", run=Run(1), **how)
    parts = [
        convert("kitti", kitti, tmp_path / "parts", run=Run(1, part=Part(n, 3)), **how)
        for n in order
    ]
    assert sum(part.made for part in parts) == whole.made == 12
    assert sorted(path for part in parts for path in part.sequences) == sorted(
        path.replace("whole", "parts") for path in whole.sequences
    )
    trees = [read_tree(tmp_path / name) for name in ("parts", "whole")]
    assert any("/.carlasc/tracks-" in name for name in trees[0])
    assert trees[0] == trees[1]


def test_long_recordings_weigh_more(kitti, tmp_path):
    made = [
        convert(
            "kitti",
            kitti,
            tmp_path / "out",
            poses=PoseOptions(force=True),
            grids=None,
            run=Run(part=Part(n, 2), workers=1),
        ).made
        for n in (1, 2)
    ]
    assert made == [6, 6]


def test_grids_do_not_follow_a_ground_that_a_part_does_not_see(kitti, tmp_path):
    with pytest.raises(ArgumentError, match="ground of all recordings"):
        convert("kitti", kitti, tmp_path / "out", run=Run(part=Part(1, 2)))
    ran = CliRunner().invoke(
        app, ["convert", "kitti", str(kitti), str(tmp_path / "out"), "--part", "1/2"]
    )
    assert ran.exit_code == 2
    assert ran.stderr.startswith("carlasc: --part: expected --bounds or --grids none")
    assert not (tmp_path / "out").exists()
