"""`info`: what a data set, a split, a sequence, a zip or a capture holds, from listings alone."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from carlasc.core.grids import GridSpec
from carlasc.errors import MissingDataError
from carlasc.inspection.overview import info
from carlasc.storage import layout
from carlasc.storage.published import PublishedSequence


@pytest.fixture
def data(golden_capture: Path, tmp_path: Path) -> Path:
    """A data set of two sequences; one with gaps, two grids, a record, metadata, and its raw
    capture beside it.
    """
    first, second = tmp_path / "Train/Town01_Light", tmp_path / "Val/Town07_Heavy"
    shutil.copytree(golden_capture / "cartesian", first / "cartesian")
    shutil.copytree(golden_capture / "cartesian", second / "cartesian")
    shutil.copytree(golden_capture / "raw", second / "raw")
    fine = second / "cartesian" / "evaluation_256x256x16"
    shutil.copytree(golden_capture / "cartesian_fine" / "evaluation", fine)
    params = json.loads((fine / "params.json").read_text())
    (fine / "params.json").write_text(
        json.dumps(params | {"carlasc": {"version": "0.1", "vote": "sensor"}})
    )
    for path in second.glob("cartesian/*/000001.*"):
        path.unlink()
    (second / "cartesian" / layout.METADATA).write_text(
        json.dumps({"sensor": "HDL-64E", "source": "elsewhere"})
    )
    return tmp_path


def test_a_data_set_is_described_from_its_splits_to_its_grids(data: Path) -> None:
    overview = info(data)
    assert (overview.level, overview.store, overview.splits) == (
        "data set",
        "folder",
        {"Train": 1, "Val": 1},
    )
    light, heavy = overview.sequences
    assert (light.path, light.split, light.name) == (
        "Train/Town01_Light/cartesian",
        "Train",
        "Town01_Light",
    )
    assert (light.frames, light.first, light.last, light.gaps) == (3, 0, 2, 0)
    assert (heavy.frames, heavy.first, heavy.last, heavy.gaps) == (2, 0, 2, 1)
    assert light.fields == {"bev": 3, "flow": 3, "labels": 3, "points": 3}
    assert set(light.documents) == {"poses.txt", "times.txt"}
    assert (heavy.sensor, heavy.source, heavy.axes, heavy.classes) == (
        "HDL-64E",
        "elsewhere",
        "left",
        "carla",
    )


def test_grids_are_told_with_their_geometry_and_how_they_were_made(data: Path) -> None:
    coarse, fine = info(data).sequences[1].grids
    assert (coarse.name, coarse.size, coarse.made, coarse.parts) == (
        "evaluation",
        (128, 128, 8),
        None,
        ("labels", "counts"),
    )
    assert (fine.coordinates, fine.size, fine.frames) == ("cartesian", (256, 256, 16), 2)
    assert fine.voxel_size == pytest.approx((0.2, 0.2, 0.1875), abs=1e-6)
    assert fine.lower == GridSpec.published().lower
    assert fine.made == {"version": "0.1", "vote": "sensor"}


def test_captures_are_told_beside_sequences_and_alone(data: Path, golden_capture: Path) -> None:
    capture = info(data).captures[0]
    assert (capture.path, capture.sensors, capture.frames, capture.first, capture.last) == (
        "Val/Town07_Heavy",
        5,
        3,
        100,
        102,
    )
    alone = info(golden_capture / "raw")
    assert (alone.level, len(alone.sequences), alone.captures[0].sensors) == ("capture", 0, 5)


def test_every_level_is_called_by_its_name(data: Path) -> None:
    levels = {
        path: info(data / path).level
        for path in ("Val", "Val/Town07_Heavy", "Val/Town07_Heavy/cartesian")
    }
    assert list(levels.values()) == ["split", "sequence", "coordinates"]


def test_a_size_is_given_that_is_about_that_of_the_files(data: Path) -> None:
    sequence = info(data / "Train").sequences[0]
    files = [
        path
        for path in (data / "Train").rglob("*")
        if path.is_file() and path.suffix not in (".txt", ".json")
    ]
    assert sequence.bytes == pytest.approx(sum(path.stat().st_size for path in files), rel=0.01)


def test_a_zip_is_looked_at_in_place(data: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = Path(shutil.make_archive(str(tmp_path_factory.mktemp("zip") / "set"), "zip", data))
    overview = info(path)
    assert overview.bytes == path.stat().st_size
    assert [sequence.frames for sequence in overview.sequences] == [3, 2]


def test_a_broken_grid_is_a_problem_of_its_sequence_not_of_the_whole(data: Path) -> None:
    (data / "Train/Town01_Light/cartesian/evaluation/params.json").write_text("{")
    light, heavy = info(data).sequences
    assert "expected JSON" in (light.problem or "")
    assert (light.frames, heavy.problem) == (3, None)


def test_nothing_and_a_level_too_low_are_told(data: Path, tmp_path: Path) -> None:
    with pytest.raises(MissingDataError) as caught:
        info(tmp_path / "nowhere")
    assert caught.value.found == "nothing"
    with pytest.raises(MissingDataError) as caught:
        info(data / "Train/Town01_Light/cartesian/labels")
    assert "give the folder above" in caught.value.advice


def test_the_overview_turns_into_json(data: Path) -> None:
    assert json.loads(json.dumps(info(data).to_dict()))["splits"] == {"Train": 1, "Val": 1}


def test_no_frame_is_read(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(PublishedSequence, "read")
    assert len(info(data).sequences) == 2
