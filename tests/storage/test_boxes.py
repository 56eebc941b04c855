"""Boxes on their way through the stores and a run: nothing is lost, and a frame without boxes stays
one.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.sequences import scan
from helpers.errors import raises

import carlasc
from carlasc import Run
from carlasc.errors import FormatError
from carlasc.groundtruth import FromScans
from carlasc.storage import FolderSink, layout
from carlasc.testing.data import boxes

PATH = "Train/Town01_Light/cartesian"
COUNTS = {0: 0, 1: 3, 3: 300}  # boxes by frame; frames 2 and 4 were not annotated


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    with FolderSink(tmp_path / "data") as sink, sink.sequence(PATH) as writer:
        for frame in range(5):
            for name, array in scan(rng, 20).items():
                writer.write(name, frame, array)
            if frame in COUNTS:
                writer.write("boxes", frame, boxes(rng, COUNTS[frame]).to_table())
        writer.write_document("poses.txt", layout.encode_poses(np.tile(np.eye(4), (5, 1, 1))))
    return tmp_path / "data"


def files(root: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in (root / PATH / "boxes").iterdir()}


@pytest.mark.parametrize("store", ["zip", "zarr", "h5", "parquet"])
def test_boxes_go_through_every_store(folder, tmp_path, store):
    pytest.importorskip(
        {"zip": "zipfile", "zarr": "zarr", "h5": "h5py", "parquet": "pyarrow"}[store]
    )
    if store == "zip":
        out = Path(shutil.make_archive(str(tmp_path / "packed"), "zip", folder))
    else:
        out = carlasc.pack(folder, tmp_path / f"packed.{store}").out
    (sequence,) = carlasc.open(out).sequences().values()
    counts = {
        frame: found for frame in range(5) if (found := sequence.scan(frame).boxes) is not None
    }
    assert {frame: len(found) for frame, found in counts.items()} == COUNTS
    carlasc.unpack(out, tmp_path / "back")
    assert files(tmp_path / "back") == files(folder)


def test_a_store_in_which_no_frame_has_objects_keeps_the_frames(folder, tmp_path):
    pytest.importorskip("zarr")
    for frame in COUNTS:
        (folder / PATH / f"boxes/{frame:06d}.bin").write_bytes(b"")
    out = carlasc.pack(folder, tmp_path / "packed.zarr").out
    (sequence,) = carlasc.open(out).sequences().values()
    assert sequence.frames("boxes").tolist() == list(COUNTS)
    assert [len(table) for table in sequence.read_many("boxes", COUNTS)] == [0, 0, 0]


def test_info_counts_their_frames(folder):
    (sequence,) = carlasc.info(folder).sequences
    assert sequence.fields["boxes"] == 3
    assert not [
        finding for finding in carlasc.validate(folder).findings if finding.severity == "error"
    ]


def test_regrid_from_scans_carries_them_along(folder, tmp_path):
    spec = carlasc.GridSpec.published().with_size((8, 8, 4))
    carlasc.regrid(folder, spec, tmp_path / "out", observe=FromScans(), run=Run(workers=1))
    assert files(tmp_path / "out") == files(folder)
    # it continues with the same boxes
    carlasc.regrid(folder, spec, tmp_path / "out", observe=FromScans(), run=Run(workers=1))


def test_a_scan_has_them_if_they_are_asked_for(folder):
    (sequence,) = carlasc.open(folder).sequences().values()
    assert sequence.scan(1, fields=("labels",)).boxes is None
    chosen = sequence.scan(1, fields=("boxes",))
    assert chosen.labels is None and chosen.boxes is not None and len(chosen.boxes) == 3
    assert chosen.select(np.array([0])).boxes is chosen.boxes


def test_boxes_that_are_wrong_name_their_frame(folder):
    (sequence,) = carlasc.open(folder).sequences().values()
    table = sequence.read("boxes", 1).copy()
    table["length"] = 0
    FolderSink(folder).sequence(PATH).write("boxes", 1, table)
    with raises(FormatError, where="frame 1: boxes: sizes", expected="positive"):
        sequence.scan(1)
    assert len(sequence.scan(1, fields=("labels",))) == 20
