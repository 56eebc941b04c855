"""The recipes of docs/contributing.md: their diffs are applied as they are printed, and must be
enough.
"""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.sequences import scan
from helpers.errors import raises

import carlasc
from carlasc import Run
from carlasc.converting import Cloud, Sensor
from carlasc.converting.assembling import AxesAndClasses, Rig, assemble, make_fields
from carlasc.core.tables import CARLA
from carlasc.errors import FormatError
from carlasc.groundtruth import FromScans
from carlasc.storage import FolderSink, FolderSource, field_files, layout

PAGE = Path(__file__).parents[1] / "docs/contributing.md"
PATH = "Train/Town01_Light/cartesian"


def added_lines(file: str) -> str:
    """Return the lines that the page's diff adds to a file."""
    (text,) = re.findall(
        rf'```diff title="{re.escape(file)}"\n(.*?)```', PAGE.read_text(), re.DOTALL
    )
    return "\n".join(line.strip()[1:] for line in text.splitlines() if line.strip().startswith("+"))


@pytest.fixture
def rings(monkeypatch: pytest.MonkeyPatch) -> field_files.Field:
    """Add the field of the recipe to the layout's table."""
    (field,) = eval(f"[{added_lines('carlasc/storage/layout.py')}]", vars(layout))
    monkeypatch.setitem(layout.SCAN_FIELDS, field.name, field)
    return field


@pytest.fixture
def folder(tmp_path: Path, rings: field_files.Field) -> Path:
    """Three scans with rings, the last one with numbers that need 16 bits."""
    rng = np.random.default_rng(0)
    with FolderSink(tmp_path / "data") as sink, sink.sequence(PATH) as writer:
        for frame in range(3):
            for name, array in scan(rng, 40 + frame).items():
                writer.write(name, frame, array)
            writer.write(
                "rings",
                frame,
                rng.integers(0, 64 if frame < 2 else 2000, 40 + frame).astype(np.uint16),
            )
        writer.write_document("poses.txt", layout.encode_poses(np.tile(np.eye(4), (3, 1, 1))))
    return tmp_path / "data"


def rings_of(source: str | Path) -> list[np.ndarray]:
    (sequence,) = carlasc.open(source).sequences().values()
    assert sequence.frames("rings").tolist() == [0, 1, 2]
    assert [len(array) for array in sequence.read_many("rings", [2, 0])] == [42, 40]
    return [sequence.scan(frame).others["rings"] for frame in range(3)]


@pytest.mark.parametrize("store", ["zip", "zarr", "h5", "parquet"])
def test_a_field_of_the_recipe_goes_through_every_store(folder, tmp_path, store):
    pytest.importorskip(
        {"zip": "zipfile", "zarr": "zarr", "h5": "h5py", "parquet": "pyarrow"}[store]
    )
    files = {file.name: file.read_bytes() for file in (folder / PATH / "rings").iterdir()}
    if store == "zip":
        out = Path(shutil.make_archive(str(tmp_path / "packed"), "zip", folder))
    else:
        out = carlasc.pack(folder, tmp_path / f"packed.{store}").out
    for found, wanted in zip(rings_of(out), rings_of(folder), strict=True):
        assert found.dtype == wanted.dtype == np.uint16 and np.array_equal(found, wanted)
    carlasc.unpack(out, tmp_path / "back")
    assert {
        file.name: file.read_bytes() for file in (tmp_path / "back" / PATH / "rings").iterdir()
    } == files


def test_info_lists_it_and_validate_compares_it_with_the_points(folder, rings):
    (sequence,) = carlasc.info(folder).sequences
    assert sequence.fields["rings"] == 3
    assert not [
        finding for finding in carlasc.validate(folder).findings if finding.severity == "error"
    ]
    (folder / PATH / rings.file(1)).write_bytes(bytes(2 * 39))
    (folder / PATH / rings.file(2)).unlink()
    found = {finding.check: str(finding) for finding in carlasc.validate(folder).findings}
    assert "rings/000001.label" in found["point-counts"] and "rings" in found["frame-counts"]


def test_a_scan_keeps_it_with_its_points(folder):
    (sequence,) = FolderSource(folder).sequences().values()
    whole = sequence.scan(1)
    few = whole.select(np.array([3, 5]))
    assert np.array_equal(few.others["rings"], whole.others["rings"][[3, 5]])
    assert sequence.scan(1, fields=("labels",)).others == {}
    with raises(FormatError, where="rings", expected="41", found="40"):
        carlasc.Scan(whole.points, others={"rings": whole.others["rings"][:-1]})


def test_a_converter_passes_it_on(rings):
    numbers = np.arange(5, dtype=np.uint16)
    cloud = Cloud(
        np.ones((5, 4), np.float32), others={"rings": numbers, "flow": np.ones((5, 3), np.float32)}
    )
    scan = assemble([cloud], Rig((Sensor(),), np.eye(4)), None, "a")
    fields = make_fields(scan, AxesAndClasses(CARLA, None, mirrored=True), "a")
    assert np.array_equal(fields["rings"], numbers)
    assert fields["flow"].tolist() == [[1, -1, 1]] * 5


def test_regrid_from_scans_carries_it_along(folder, tmp_path):
    spec = carlasc.GridSpec.published().with_size((8, 8, 4))
    carlasc.regrid(folder, spec, tmp_path / "out", observe=FromScans(), run=Run(workers=1))
    for found, wanted in zip(rings_of(tmp_path / "out"), rings_of(folder), strict=True):
        assert np.array_equal(found, wanted)
