"""An export after a change of its input gives what an export into an empty folder gives."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.drives import write_drive

from carlasc import Run, export

ALONE = Run(workers=1)


def files(out: Path) -> dict[str, bytes]:
    """Return the bytes of all files but records, and folders without bytes."""
    return {
        path.relative_to(out).as_posix(): path.read_bytes() if path.is_file() else b""
        for path in sorted(out.rglob("*"))
        if not path.match("carlasc-*-of-*.json")
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


def test_a_folder_that_a_killed_run_left_empty_goes_with_its_frame(tmp_path):
    write_drive(tmp_path / "in/Train/Town01/cartesian", range(3))
    export("occ3d", tmp_path / "in", tmp_path / "out", run=ALONE)
    last = max((tmp_path / "out/gts").rglob("*.npz"))
    last.unlink()
    for path in (tmp_path / "in").rglob("000002.*"):
        path.unlink()
    export("occ3d", tmp_path / "in", tmp_path / "out", run=ALONE)
    export("occ3d", tmp_path / "in", tmp_path / "fresh", run=ALONE)
    assert files(tmp_path / "out") == files(tmp_path / "fresh")


def test_a_record_of_a_stranger_removes_nothing_outside_the_export(tmp_path):
    write_drive(tmp_path / "in/Train/Town01/cartesian", range(2))
    export("kitti", tmp_path / "in", tmp_path / "out", run=ALONE)
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    (record,) = (
        path for path in (tmp_path / "out").rglob("*.json") if '"whole"' in path.read_text()
    )
    told = json.loads(record.read_text())
    told["frames"]["0"] += f"\n{mine}\n../../../mine.txt\n../../mine.txt\n.."
    record.write_text(json.dumps(told))
    (labels,) = (tmp_path / "in").rglob("labels")
    path = labels / "000001.label"
    np.full_like(np.fromfile(path, "<u4"), 3).tofile(path)
    again = export("kitti", tmp_path / "in", tmp_path / "out", run=ALONE)
    assert any("again" in note for note in again.notes)
    assert mine.read_text() == "mine"
