"""Objects behave as Python's own do: stores are mappings, sequences are collections of frames, data
sets take slices, and all show themselves.
"""

import base64
import json
import pickle
import re
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.drives import write_drive, write_world
from helpers.errors import raises

import carlasc
from carlasc import Dataset, Grid, GridSpec, Scan
from carlasc.core import SEMANTICKITTI
from carlasc.core.frames import FrameRange
from carlasc.core.notebook import data_frame
from carlasc.errors import ArgumentError, DependencyError, MissingDataError
from carlasc.storage.views import ChosenSequences, SequenceView

SMALL = GridSpec("cartesian", (16, 16, 4), (-8.0, -8.0, -2.0), (8.0, 8.0, 1.0))
ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("world"), SMALL)


def test_a_source_is_a_mapping_of_paths(world):
    source = carlasc.open(world)
    assert list(source) == list(source.sequences()) and len(source) == 3
    assert (
        source["Train/Town01_Light"].path
        == source["Train/Town01_Light/cartesian"].path
        == next(iter(source))
    )
    assert "Val/Town07_Light" in source and "Town99" not in source and source.get("Town99") is None
    assert (
        [sequence.path for sequence in source.values()]
        == [path for path, _ in source.items()]
        == list(source)
    )
    with raises(MissingDataError, expected="Town99", found="Train/Town01_Light") as raised:
        source["Town99"]
    assert isinstance(raised.value, KeyError)
    assert source == source  # noqa: PLR0124
    assert source != carlasc.open(world) and len({source, source}) == 1


def test_a_sequence_is_a_collection_of_frames(world):
    sequence = carlasc.open(world)["Train/Town02_Light"]
    assert list(sequence) == [0, 1, 2, 3] and len(sequence) == 4
    assert 3 in sequence and 4 not in sequence
    assert [len(sequence.scan(frame)) > 0 for frame in sequence] == [True] * 4


def test_what_is_empty_is_still_true(tmp_path):
    """`source or other` must not replace a store that has no sequence yet."""
    write_drive(tmp_path / "Test" / "Town03_Light" / "cartesian", range(1), spec=SMALL)
    (sequence,) = carlasc.open(tmp_path).values()
    without = SequenceView(sequence)
    without.scan_frames = lambda: np.zeros(0, np.int64)
    assert len(without) == 0 and bool(without)
    empty = ChosenSequences("nowhere", {})
    assert len(empty) == 0 and bool(empty)


SLICES = (
    slice(2, 5),
    slice(None, None, 3),
    slice(-4, None),
    slice(7, 2),
    slice(0, 100),
    slice(1, 8, 2),
)


@pytest.mark.parametrize("chosen", SLICES, ids=str)
def test_a_slice_of_a_data_set_holds_the_samples_of_the_slice(world, chosen):
    whole = Dataset(world, "train", history=3)
    part = whole[chosen]
    every = [(sample["sequence"], sample["frame"]) for sample in whole]
    assert [(sample["sequence"], sample["frame"]) for sample in part] == every[chosen]
    assert len(part) == len(every[chosen]) and len(whole) == 10
    for name, frame in every[chosen]:
        mine, same = part[part.index_of(name, frame)], whole[whole.index_of(name, frame)]
        # with the scans before the slice
        assert all(np.array_equal(mine[field], same[field]) for field in mine)
    again = pickle.loads(pickle.dumps(part))
    assert [sample["frame"] for sample in again] == [frame for _, frame in every[chosen]]


def test_a_slice_backwards_is_one_line(world):
    with raises(ArgumentError, where="index", expected="1 or more", found="-1"):
        Dataset(world, "train")[::-1]


def test_one_name_of_a_sequence_is_taken_as_a_list_of_one(world):
    alone = Dataset(world, "Town02_Light")
    assert (
        len(alone)
        == len(Dataset(world, ["Town02_Light"]))
        == len(Dataset(world, "Train/Town02_Light"))
        == 4
    )


FRAMES = {
    "range": (range(2, 5), [2, 3, 4]),
    "range with a step": (range(0, 9, 4), [0, 4, 8]),
    "slice": (slice(None, 3), [0, 1, 2]),
    "text": ("7:", [7, 8, 9]),
    "one frame as text": ("4", [4]),
    "list": ([5, 1, 1], [1, 5]),
    "array": (np.array([6, 7]), [6, 7]),
    "tuple": ((8, None), [8, 9]),
    "none": (None, list(range(10))),
}


@pytest.mark.parametrize(("given", "chosen"), FRAMES.values(), ids=FRAMES)
def test_frames_are_taken_as_python_says_them(given, chosen):
    frames = FrameRange.of(given)
    assert (
        frames.select(np.arange(10)).tolist()
        == chosen
        == [frame for frame in range(10) if frame in frames]
    )


@pytest.mark.parametrize(
    "wrong", [3, 2.5, slice(0, 9, 2), [1.5], [], range(0), "a:b", (1, 2, 3), {"a": 1}], ids=str
)
def test_wrong_frames_are_one_line(wrong):
    with raises(ArgumentError, where="frames"):
        FrameRange.of(wrong)


def test_some_frames_of_a_list_are_made(world, tmp_path):
    sequence, spec = world / "Train" / "Town01_Light", SMALL.with_size((8, 8, 4))
    options = {"observe": carlasc.FromScans(dynamic="tube"), "run": carlasc.Run(workers=1)}
    carlasc.regrid(sequence, spec, tmp_path, frames=[0, 3], **options)
    (grid,) = carlasc.open(tmp_path).values()
    assert grid.frames(f"{next(iter(grid.grids))}/labels").tolist() == [0, 3]


def test_representations_are_short(world):
    sequence = carlasc.open(world)["Train/Town01_Light"]
    scan, grid = sequence.scan(0), sequence.grid("evaluation", 0)
    assert re.fullmatch(r"<Scan of [\d,]+ points: labels, flow, remission>", repr(scan))
    assert re.fullmatch(
        r"<Grid cartesian 16 x 16 x 4: [\d,]+ occupied and [\d,]+ free voxels>", repr(grid)
    )
    assert (
        repr(Dataset(world, "Town02_Light"))
        == "<Dataset of 4 frames in 1 sequence: occupancy, labels, known>"
    )


def pixels(html):
    """Return the (H, W, 3) pixels of the PNG in an object's HTML."""
    data = base64.b64decode(re.search(r"data:image/png;base64,([^']+)'", html)[1])
    width, height = np.frombuffer(data[16:24], ">u4").tolist()
    start = data.index(b"IDAT") + 4
    length = int.from_bytes(data[start - 8 : start - 4], "big")
    rows = np.frombuffer(zlib.decompress(data[start : start + length]), np.uint8).reshape(
        height, 1 + 3 * width
    )
    return rows[:, 1:].reshape(height, width, 3)


@pytest.mark.parametrize("coordinates", ["cartesian", "cylindrical"])
def test_a_grid_in_a_notebook_shows_its_voxels_where_they_are(coordinates):
    spec = GridSpec.published(coordinates)
    labels = np.zeros(spec.size, np.uint8)
    labels.reshape(-1)[spec.flat_index(np.array([[15.0, 5.0, 0.0], [15.2, 5.1, 0.0]]))] = 4
    picture = pixels(Grid(spec, labels)._repr_html_())
    dark = np.argwhere((picture < 255).any(axis=2)).mean(axis=0) / 200
    reach = spec.upper[0]
    assert dark == pytest.approx([(reach - 15) / (2 * reach), (reach + 5) / (2 * reach)], abs=0.02)


def test_a_sequence_and_a_data_set_show_their_classes_in_their_own_axes(world):
    for html in (
        carlasc.open(world)["Train/Town01_Light"]._repr_html_(),
        Dataset(world, "train")._repr_html_(),
    ):
        assert (pixels(html) < 255).any() and "cartesian 16 x 16 x 4" in html
    labels = np.zeros(SMALL.size, np.uint8)
    labels[12, 3, 1] = 10
    mirrored = SMALL.seen_from_above(labels, SEMANTICKITTI.palette, left_handed=False)
    assert np.array_equal(mirrored[:, ::-1], SMALL.seen_from_above(labels, SEMANTICKITTI.palette))


def test_an_empty_scan_and_names_from_data_can_be_shown(tmp_path):
    assert "<table>" in Scan(np.zeros((0, 3), np.float32))._repr_html_()
    write_drive(tmp_path / "<script>" / "cartesian", range(1), spec=SMALL)
    (sequence,) = carlasc.open(tmp_path).values()
    assert "<script>" not in sequence._repr_html_()


SCRIPT = """
import carlasc
import numpy as np
from carlasc.dataset import Sample
from numpy.typing import NDArray

source = carlasc.open("CarlaSC")
sequence = source["Train/Town01_Light"]
frames: list[int] = [frame for frame in sequence if frame in sequence]
points: NDArray[np.float32] = sequence.scan(frames[0]).points
dataset = carlasc.Dataset(source, "train", history=len(sequence))
part: carlasc.Dataset = dataset[2:8]
sample: Sample = part[0]
occupancy: NDArray[np.uint8] = sample["occupancy"]
name: str = sample["sequence"]
carlasc.regrid(source, carlasc.GridSpec.published("fine"), frames=range(0, 10))
lowest: float = float(points[:, 2].min()) + float(sequence.grid("evaluation", 0).known.mean())
rows: int = len(carlasc.info(source).to_pandas()) + len(carlasc.stats(source).to_pandas())
best = carlasc.scores(["a.json"]).to_pandas().sort_values("mIoU")
reveal_type(sample["known"])
sample["nothing"]
"""


def test_tables_of_pandas_hold_what_the_objects_hold(world, tmp_path):
    pandas = pytest.importorskip("pandas")
    found = carlasc.info(world)
    overview = found.to_pandas()
    assert overview.index.name == "path" and list(overview.index) == [
        one.path for one in found.sequences
    ]
    assert list(overview["frames"]) == [one.frames for one in found.sequences]
    counted = carlasc.stats(world, grid="evaluation_0")
    table = counted.to_pandas()
    named = counted.summed(counted.total.voxels)
    assert dict(table.groupby("class")["voxels"].sum()) == named and list(table.columns) == [
        "split", "class", "points", "voxels",
    ]  # fmt: skip
    file = tmp_path / "net.json"
    result = {
        "name": "net",
        "convention": "carlasc",
        "frames": 2,
        "class_iou": {"Road": 0.5, "Pole": None},
    }
    figures = {"miou": 0.25, "iou": 0.5, "precision": 0.5, "recall": 1.0, "false_free": None}
    file.write_text(json.dumps(result | figures))
    scores = carlasc.scores([file]).to_pandas()
    assert (
        scores.loc["net", "Road"] == 0.5
        and pandas.isna(scores.loc["net", "Pole"])
        and scores.index.name == "Network"
    )


def test_a_table_of_nothing_has_no_rows_and_missing_pandas_is_one_line(tmp_path, monkeypatch):
    pytest.importorskip("pandas")
    assert data_frame((), "path").empty
    monkeypatch.setitem(sys.modules, "pandas", None)
    with raises(DependencyError, where="pandas"):
        data_frame((), "path")


@pytest.mark.slow
def test_editors_know_the_fields_of_a_sample(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    (tmp_path / "mypy.ini").write_text("[mypy]\n[mypy-pandas.*]\nignore_missing_imports = true\n")
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--cache-dir",
        str(tmp_path / "cache"),
        "script.py",
    ]
    found = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False
    ).stdout
    assert 'has no key "nothing"' in found and found.count(": error:") == 1, found
    assert re.search(r"Revealed type is .*ndarray.*bool", found)
