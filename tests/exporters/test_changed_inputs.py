"""An export after a change of its input gives what an export into an empty folder gives."""

from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.drives import write_drive

from carlasc import Run, export

ALONE = Run(workers=1)


def files(out: Path) -> dict[str, bytes]:
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and ".carlasc" not in path.parts
    }


@pytest.mark.parametrize("name", ["kitti", "opensceneflow"])
@pytest.mark.parametrize("change", ["labels", "remove"])
def test_a_changed_sequence_is_exported_again(tmp_path, name, change):
    write_drive(tmp_path / "in/Train/Town01/cartesian", range(3))
    (labels,) = (tmp_path / "in").rglob("labels")
    if name == "opensceneflow":
        pytest.importorskip("h5py")
    export(name, tmp_path / "in", tmp_path / "out", run=ALONE)
    if change == "labels":
        path = labels / "000001.label"
        np.full_like(np.fromfile(path, "<u4"), 3).tofile(path)
    else:
        for folder in labels.parent.iterdir():
            for path in folder.glob("000002.*"):
                path.unlink()
    again = export(name, tmp_path / "in", tmp_path / "out", run=ALONE)
    assert sum("again" in note for note in again.notes) == 1
    export(name, tmp_path / "in", tmp_path / "fresh", run=ALONE)
    assert files(tmp_path / "out") == files(tmp_path / "fresh")
    unchanged = export(name, tmp_path / "in", tmp_path / "out", run=ALONE)
    assert unchanged.made == 0
