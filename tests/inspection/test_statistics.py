"""`stats`: exact class histograms, weights, and the list of files that could not be read."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from carlasc import Run
from carlasc.core.classes import class_weights
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA, CARLASC11, REMAPS, SEMANTICKITTI
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.inspection.charts import draw_histograms
from carlasc.inspection.statistics import Statistics, stats
from carlasc.storage import FolderSink, Metadata, layout
from carlasc.storage.files import to_json

SPEC = GridSpec("cartesian", (8, 8, 4), (-4.0, -4.0, -2.0), (4.0, 4.0, 2.0))


def write_sequence(
    root: Path, path: str, seed: int, frames: int = 5, grid: str = "evaluation"
) -> dict[str, np.ndarray]:
    """Write random labels of points and voxels; returns what must be counted."""
    rng, writer = np.random.default_rng(seed), FolderSink(root).sequence(path)
    writer.write_document(layout.params_file(grid), json.dumps(SPEC.to_params()).encode())
    points, voxels, unknown = np.zeros(25, np.int64), np.zeros(25, np.int64), 0
    for frame in range(frames):
        labels = rng.integers(0, 23, 100, dtype=np.uint32)
        counts = rng.integers(0, 3, SPEC.size).astype(np.float32)
        cells = np.where(counts > 0, rng.integers(0, 23, SPEC.size), 0).astype(np.uint32)
        writer.write("points", frame, np.zeros((100, 4), np.float32))
        writer.write("labels", frame, labels)
        writer.write(f"{grid}/labels", frame, cells)
        writer.write(f"{grid}/counts", frame, counts)
        for label in labels:
            points[label] += 1
        for label, count in zip(cells.ravel(), counts.ravel(), strict=True):
            voxels[label] += count > 0
            unknown += int(count == 0)
    return {"points": points, "voxels": voxels, "unknown": np.array(unknown)}


@pytest.fixture
def data(tmp_path: Path) -> tuple[Path, dict[str, dict[str, np.ndarray]]]:
    paths = (
        "Train/Town01_Light/cartesian",
        "Train/Town02_Light/cartesian",
        "Val/Town07_Light/cartesian",
    )
    return tmp_path, {path: write_sequence(tmp_path, path, seed) for seed, path in enumerate(paths)}


@pytest.mark.parametrize("workers", [1, 2])
def test_every_point_and_known_voxel_is_counted_once(
    data: tuple[Path, dict[str, dict[str, np.ndarray]]], workers: int
) -> None:
    root, expected = data
    result = stats(root, run=Run(workers=workers))
    assert list(result.sequences) == list(expected)
    for path, histogram in result.sequences.items():
        np.testing.assert_array_equal(histogram.points, expected[path]["points"])
        np.testing.assert_array_equal(histogram.voxels, expected[path]["voxels"])
        assert histogram.unknown == expected[path]["unknown"]
        assert (histogram.scans, histogram.grids) == (5, 5)


def test_splits_and_total_are_sums(data: tuple[Path, dict[str, dict[str, np.ndarray]]]) -> None:
    root, expected = data
    result = stats(root)
    train = [counts for path, counts in expected.items() if path.startswith("Train")]
    assert list(result.by_split()) == ["Train", "Val"]
    np.testing.assert_array_equal(
        result.by_split()["Train"].voxels, sum(counts["voxels"] for counts in train)
    )
    np.testing.assert_array_equal(
        result.total.points, sum(counts["points"] for counts in expected.values())
    )
    known = sum(int(counts["voxels"].sum()) for counts in expected.values())
    assert result.total.known_share == pytest.approx(known / (15 * SPEC.num_voxels))


def test_remapped_counts_and_weights_follow_the_remap(
    data: tuple[Path, dict[str, dict[str, np.ndarray]]],
) -> None:
    result = stats(data[0])
    voxels = result.total.voxels
    summed = result.summed(voxels)
    assert summed["Barrier"] == voxels[2] + voxels[11] + voxels[17]
    assert sum(summed.values()) == voxels.sum()
    expected = class_weights(voxels, REMAPS["carlasc11"])
    assert list(result.weights().values()) == expected.tolist()
    assert stats(data[0], remap=None).weights()["Fence"] == class_weights(voxels)[2]


def test_the_golden_grids_have_the_counts_of_their_files(golden_capture: Path) -> None:
    result = stats(golden_capture / "cartesian").total
    labels = np.concatenate(
        [np.fromfile(p, "<u4") for p in sorted((golden_capture / "cartesian/labels").iterdir())]
    )
    np.testing.assert_array_equal(result.points, np.bincount(labels, minlength=25))
    assert int(result.voxels.sum()) + result.unknown == 3 * 128 * 128 * 8


def test_every_other_frame_is_counted_on_request(
    data: tuple[Path, dict[str, dict[str, np.ndarray]]],
) -> None:
    assert stats(data[0], every=2).total.scans == 9


def test_the_only_grid_is_counted_whatever_its_name(tmp_path: Path) -> None:
    expected = write_sequence(tmp_path, "cartesian", 0, grid="evaluation_8x8x4")
    np.testing.assert_array_equal(stats(tmp_path).total.voxels, expected["voxels"])


def test_a_bad_frame_is_listed_and_the_others_are_counted(
    data: tuple[Path, dict[str, dict[str, np.ndarray]]],
) -> None:
    root, _ = data
    folder = root / "Val/Town07_Light/cartesian"
    (folder / "evaluation/000001.label").write_bytes(b"123")
    (folder / "labels/000002.label").write_bytes(np.full(100, 77, "<u4").tobytes())
    result = stats(root)
    assert [where.split()[1:] for where, _ in result.failures] == [
        ["labels", "000002"],
        ["evaluation/labels", "000001"],
    ]
    assert "found 77 (100 times) of 100 labels" in result.failures[0][1]
    assert (result.total.scans, result.total.grids) == (14, 14)


def test_wide_class_ids_are_counted(tmp_path: Path) -> None:
    writer = FolderSink(tmp_path).sequence("cartesian")
    writer.write_document(layout.METADATA, Metadata("right", classes=SEMANTICKITTI).to_json())
    writer.write("points", 0, np.zeros((3, 4), np.float32))
    writer.write("labels", 0, np.array([259, 259, 40], np.uint32))
    result = stats(tmp_path)
    assert result.named(result.total.points)["moving-other-vehicle"] == 2
    assert result.remap == REMAPS["semantickitti19"]


def test_two_class_tables_are_not_summed_up(
    data: tuple[Path, dict[str, dict[str, np.ndarray]]],
) -> None:
    root, _ = data
    (root / "Val/Town07_Light/cartesian" / layout.METADATA).write_bytes(
        Metadata(classes=SEMANTICKITTI).to_json()
    )
    with pytest.raises(FormatError) as caught:
        stats(root)
    assert caught.value.found == "carla, semantickitti"


def test_senseless_arguments_and_data_without_classes_are_told(
    data: tuple[Path, dict[str, dict[str, np.ndarray]]], tmp_path: Path
) -> None:
    with pytest.raises(ArgumentError) as caught:
        stats(data[0], every=0)
    assert caught.value.where == "every"
    with pytest.raises(ArgumentError) as caught:
        stats(data[0], remap="carlasc12")
    assert caught.value.where == "remap"
    with pytest.raises(FormatError) as caught:
        stats(data[0], remap="semantickitti19")
    assert (caught.value.expected, caught.value.found) == ("labels of semantickitti", "carla")
    for path in data[0].glob("*/*/cartesian"):
        shutil.rmtree(path / "labels")
        shutil.rmtree(path / "evaluation")
    with pytest.raises(MissingDataError) as caught:
        stats(data[0])
    assert caught.value.found == "neither"


def test_progress_ends_at_its_total(data: tuple[Path, dict[str, dict[str, np.ndarray]]]) -> None:
    seen: list[tuple[int, int]] = []
    stats(data[0], run=Run(1, progress=lambda done, total: seen.append((done, total))))
    assert seen[-1] == (30, 30)


def test_the_figures_turn_into_json(data: tuple[Path, dict[str, dict[str, np.ndarray]]]) -> None:
    values = json.loads(json.dumps(stats(data[0]).to_dict()))
    assert set(values["splits"]) == {"Train", "Val"}
    assert values["total"]["points"].keys() == set(CARLA.names.values())
    assert values["total"]["voxels_remapped"]["Road"] == sum(
        values["total"]["voxels"][name] for name in ("Road", "RoadLine")
    )


@pytest.mark.parametrize(
    ("suffix", "start"), [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF")]
)
def test_a_chart_is_drawn(
    data: tuple[Path, dict[str, dict[str, np.ndarray]]], tmp_path: Path, suffix: str, start: bytes
) -> None:
    path = tmp_path / f"classes{suffix}"
    draw_histograms(stats(data[0]), path)
    assert path.read_bytes().startswith(start)


def test_a_chart_of_an_unknown_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError) as caught:
        draw_histograms(Statistics("", CARLA, None, {}, {}), tmp_path / "classes.doc")
    assert (caught.value.where, caught.value.found) == ("plot", ".doc")


def test_points_beside_a_prediction_are_counted_in_its_classes(tmp_path: Path) -> None:
    writer = FolderSink(tmp_path).sequence("cartesian")
    writer.write("points", 0, np.zeros((3, 4), np.float32))
    writer.write("labels", 0, np.array([7, 14, 22], np.uint32))  # road, ground and terrain
    spec = GridSpec("cartesian", (2, 2, 1), (-1, -1, -1), (1, 1, 1))
    params = spec.to_params(11) | {"carlasc": {"classes": "carlasc11"}}
    writer.write_document(layout.params_file("completion"), to_json(params))
    writer.write("completion/labels", 0, np.array([0, 7, 7, 10], np.uint32).reshape(2, 2, 1))
    result = stats(tmp_path, grid="completion")
    assert result.classes == CARLASC11
    assert result.named(result.total.points)["Ground"] == 2
    assert result.named(result.total.voxels) == dict.fromkeys(CARLASC11.names.values(), 0) | {
        "Free": 1,
        "Ground": 2,
        "Vehicles": 1,
    }


def test_of_several_other_grids_none_is_counted(tmp_path: Path) -> None:
    for grid in ("evaluation_a", "evaluation_b"):
        write_sequence(tmp_path, "cartesian", 0, grid=grid)
    assert (stats(tmp_path).total.grids, stats(tmp_path).total.scans) == (0, 5)
    assert stats(tmp_path, grid="evaluation_b").total.grids == 5


def test_every_other_frame_starts_with_the_first(tmp_path: Path) -> None:
    write_sequence(tmp_path, "cartesian", 0, frames=2)
    (tmp_path / "cartesian/labels/000001.label").write_bytes(b"odd")
    assert stats(tmp_path, every=2).failures == ()


def test_voxels_of_a_grid_without_counts_are_all_known(tmp_path: Path) -> None:
    write_sequence(tmp_path, "cartesian", 0)
    for path in (tmp_path / "cartesian/evaluation").glob("*.bin"):
        path.unlink()
    total = stats(tmp_path).total
    assert (total.unknown, total.voxels.sum(), total.known_share) == (0, 5 * SPEC.num_voxels, 1.0)


def test_the_remap_of_a_table_without_one_is_none(tmp_path: Path) -> None:
    write_sequence(tmp_path, "cartesian", 0)
    params = tmp_path / "cartesian/evaluation/params.json"
    params.write_text(json.dumps(SPEC.to_params(11) | {"carlasc": {"classes": "carlasc11"}}))
    for path in (tmp_path / "cartesian/evaluation").glob("*.label"):
        (np.fromfile(path, "<u4") % 11).astype("<u4").tofile(path)
    result = stats(tmp_path)
    assert (result.classes, result.remap) == (CARLASC11, None)
    assert result.summed(result.total.voxels) == result.named(result.total.voxels)
