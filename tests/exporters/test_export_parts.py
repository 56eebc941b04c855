"""An export in parts makes the same files as one command, whatever order the parts run in."""

import numpy as np
import pytest
from helpers.datasets.exported import files_and_bytes, write_scene

from carlasc.converting import export
from carlasc.errors import FormatError
from carlasc.running import Part, Run
from carlasc.storage import FolderSink


@pytest.fixture
def scenes(tmp_path):
    """A folder with two sequences of four frames, with flow."""
    for name in ("Town07_Light", "Town08_Light"):
        path = f"Val/{name}/cartesian"
        write_scene(tmp_path / "in", frames=4, grid="evaluation", path=path)
        for frame in range(4):
            FolderSink(tmp_path / "in").sequence(path).write(
                "flow", frame, np.zeros((2, 3), np.float32)
            )
    return tmp_path / "in"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kitti", "occ3d", "sscbench", "opensceneflow"])
@pytest.mark.parametrize("order", [(1, 2, 3), (3, 2, 1)])
def test_parts_make_the_files_of_one_export(scenes, tmp_path, name, order):
    whole = export(name, scenes, tmp_path / "whole", run=Run(workers=1))
    made = [
        export(name, scenes, tmp_path / "parts", run=Run(part=Part(n, 3), workers=1)).made
        for n in order
    ]
    # SSCBench has every fifth frame
    assert sum(made) == whole.made == (2 if name == "sscbench" else 8)
    assert files_and_bytes(tmp_path / "parts") == files_and_bytes(tmp_path / "whole")


def test_two_sequences_of_one_name_are_refused(tmp_path):
    for folder in ("A", "B"):
        write_scene(tmp_path / "in" / folder, grid="evaluation")
    with pytest.raises(FormatError, match="sequences of different names"):
        export("kitti", tmp_path / "in", tmp_path / "out")
