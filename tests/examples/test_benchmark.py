"""The mini benchmark: its drives and labels, its rows, what it keeps and prints; and the check with published weights."""

from __future__ import annotations

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

from carlasc import Dataset
from carlasc import open as open_source
from carlasc.captures import Lidar
from carlasc.core import CARLA, CARLASC11, translation
from carlasc.errors import ConflictError
from carlasc.metrics import ConfusionMatrix

pytest.importorskip("torch", reason="needs carlasc[torch]")

import benchmark
import published
import torch
from benchmarking.drives import build_drives, choose_stretch
from benchmarking.rows import history_rows, label_rows, network_rows
from benchmarking.runs import Result, result_of, settings_of_run
from benchmarking.sizes import SIZES, SPLITS, key_of, settings_of
from benchmarking.tables import FIGURES, label_table, network_tables, to_markdown
from completion.processes import Processes

ALONE = Processes(0, 1, torch.device("cpu"))
TINY = SIZES["tiny"]
VEHICLE, PEDESTRIAN = CARLASC11.id_of("Vehicles"), CARLASC11.id_of("Pedestrian")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    pytest.importorskip("embreex", reason="the simulator needs carlasc[simulate]")
    out = tmp_path_factory.mktemp("benchmark")
    build_drives(out / "data", TINY.scenes, workers=1)
    return out


def result(correct: int = 50, phantoms: int = 0, seed: int = 0) -> Result:
    """Return a result over two frames: 100 voxels of vehicles, 1000 free ones."""
    matrix = ConfusionMatrix(11)
    matrix.counts[VEHICLE, VEHICLE], matrix.counts[VEHICLE, 0] = correct, 100 - correct
    matrix.counts[0, PEDESTRIAN], matrix.counts[0, 0] = phantoms, 1000 - phantoms
    return Result({"run": {"seed": seed}}, matrix, 2, 0.01, 0.2, 12.0, 3, 0.5)


@pytest.mark.slow
def test_the_same_frames_of_a_drive_have_three_kinds_of_labels(folder):
    samples = {}
    for name in ("evaluation", "tube", "align"):
        data = Dataset(folder / "data", "train", grid=name, fields=("labels", "known", "visibility"))
        assert [data[i]["frame"] for i in range(len(data))] == [1, 2, 3]
        assert data.spec == TINY.scenes.spec
        samples[name] = data[1]
    for name in ("tube", "align"):
        assert not np.array_equal(samples[name]["labels"], samples["evaluation"]["labels"])
        both = samples[name]["known"] & samples["evaluation"]["known"]
        assert (samples[name]["labels"] == samples["evaluation"]["labels"])[both].mean() > 0.7
    soft = Dataset(folder / "data", "train", grid="align", fields=("posterior",))[1]["posterior"]
    assert soft.shape == (11, *TINY.scenes.cells)
    (test,) = open_source(folder / "data" / "Test").sequences().values()
    assert set(test.grids) == {"evaluation"}


@pytest.mark.slow
def test_drives_are_made_once_and_other_scenes_do_not_mix_with_them(folder):
    files = {path: path.stat().st_mtime_ns for path in (folder / "data").rglob("*.bin")}
    done = []
    build_drives(folder / "data", TINY.scenes, workers=1, progress=lambda *steps: done.append(steps))
    assert done == [(1, 3), (2, 3), (3, 3)]
    assert {path: path.stat().st_mtime_ns for path in files} == files
    with pytest.raises(ConflictError, match="scenes.json: expected .* found other scenes"):
        build_drives(folder / "data", dataclasses.replace(TINY.scenes, sensors=5), workers=1)


@pytest.mark.slow
def test_a_run_is_kept_and_made_again_only_with_other_settings(folder):
    row = label_rows(TINY)[-1]
    first = result_of(TINY.scenes, row.runs()[0], folder, ALONE)
    (kept,) = (folder / "results").iterdir()
    assert kept.stem == key_of(settings_of_run(TINY.scenes, row.config))
    written = kept.stat().st_mtime_ns
    again = result_of(TINY.scenes, dataclasses.replace(row.config, workers=3, keep_samples=False), folder, ALONE)
    assert kept.stat().st_mtime_ns == written
    np.testing.assert_array_equal(again.matrix.counts, first.matrix.counts)
    assert (again.frames, again.best_epoch) == (first.frames, first.best_epoch) == (3, 1)
    result_of(TINY.scenes, dataclasses.replace(row.config, seed=1), folder, ALONE)
    assert len(list((folder / "results").iterdir())) == 2


@pytest.mark.slow
def test_the_benchmark_prints_its_tables_and_a_second_run_trains_nothing(folder, tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="the pictures need carlasc[plots]")
    from PIL import Image

    (tmp_path / "tiny").mkdir()
    (tmp_path / "tiny" / "data").symlink_to(folder / "data")
    arguments = {"size": "tiny", "study": list(benchmark.Study), "device": "cpu", "workers": 1}
    benchmark.main(tmp_path, **arguments, pictures=tmp_path / "pictures")
    printed = capsys.readouterr().out
    rows = {"LMSCNet SS": 2, "JS3C-Net": 2, "Baseline T=5": 4, "align, soft labels": 1, "T=5, not aligned": 2}
    assert {name: printed.count(f"| {name} |") for name in rows} == rows
    assert (tmp_path / "pictures" / "labels.svg").read_text().count("IoU of vehicles") == 1
    assert Image.open(tmp_path / "pictures" / "labels.png").size == (1800, 460)
    figures = json.loads((tmp_path / "tiny" / "results.json").read_text())
    runs = [run for study in ("labels", "networks", "history") for runs in figures[study].values() for run in runs]
    assert all(0 < run["scored_voxels"] == runs[0]["scored_voxels"] for run in runs)
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "tiny" / "runs").rglob("best.safetensors")}
    benchmark.main(tmp_path, **arguments)
    assert capsys.readouterr().out == printed
    assert {path: path.stat().st_mtime_ns for path in written} == written


def test_a_stretch_with_pedestrians_and_moving_vehicles_is_chosen():
    def actor(label, at, speed=0.0):
        mesh = SimpleNamespace(labels=np.array([label, label, 0]))
        return SimpleNamespace(world_T_actor=translation(at), velocity=np.array([speed, 0, 0]), mesh=mesh)

    class Stub:
        def actors(self, frame):
            ego = actor(CARLA.id_of("Vehicle"), (float(frame), 0, 0), 5.0)
            walker = actor(CARLA.id_of("Pedestrian"), (303.0, 4.0, 0))
            parked = actor(CARLA.id_of("Vehicle"), (500.0, 3.0, 0))
            moving = actor(CARLA.id_of("Vehicle"), (300.0, -3.0, 0), 5.0)
            return [ego, walker, parked, moving]

    scenes = dataclasses.replace(SIZES["medium"].scenes, frames=1)
    assert choose_stretch(Stub(), scenes) == 300 - scenes.margin


def test_seeds_of_the_splits_are_apart_and_a_part_fits_the_size():
    for size in SIZES.values():
        towns = [range(first, first + count) for (_, first), count in zip(SPLITS, size.scenes.towns, strict=True)]
        assert len(set().union(*towns)) == sum(map(len, towns))
        assert size.scenes.spec.size == size.scenes.cells
    medium, small = SIZES["medium"].scenes, SIZES["small"].scenes
    assert medium.spec.voxel_size[:2] == pytest.approx(0.4)
    assert all(a <= b for a, b in zip(small.towns, medium.towns, strict=True))  # the small one is a part of it


def test_every_row_trains_as_its_paper_says():
    size = SIZES["full"]
    networks = {row.name: row.config for row in network_rows(size)}
    assert (networks["SSCNet full"].free_ratio, networks["SSCNet full"].decay) == (2.0, 1.0)
    assert (networks["LMSCNet SS"].decay, networks["MotionSC T=5"].decay) == (0.98, 0.96)
    assert (networks["JS3C-Net"].decay, networks["JS3C-Net"].decay_every) == (0.7, 10)
    labels = {row.name: row for row in label_rows(size)}
    assert {name: row.config.grid for name, row in labels.items()} == {
        "tube": "tube",
        "align": "align",
        "align, soft labels": "align",
        "capture truth": "evaluation",
    }
    assert labels["capture truth"].config == networks["Baseline T=5"]  # one run for both tables
    assert [row.config.history for row in history_rows(size)] == [1, 5, 5, 5]
    assert [run.seed for run in labels["tube"].runs()] == [0, 1, 2]


def test_settings_that_change_a_result_change_its_key():
    scenes, config = TINY.scenes, label_rows(TINY)[0].config
    key = key_of(settings_of_run(scenes, config))
    assert key == key_of(settings_of_run(scenes, dataclasses.replace(config, workers=7)))
    others = [
        dataclasses.replace(config, **{name: value}) for name, value in (("seed", 1), ("grid", "align"), ("epochs", 9))
    ]
    assert key not in {key_of(settings_of_run(scenes, other)) for other in others}
    denser = dataclasses.replace(scenes, lidar=Lidar(channels=64))
    assert key != key_of(settings_of_run(denser, config))
    assert json.loads(json.dumps(settings_of(scenes))) == settings_of(scenes)


def test_a_result_is_read_as_it_was_written(tmp_path):
    one = result(40, 10)
    one.write(tmp_path / "results" / "a.json")
    other = Result.read(tmp_path / "results" / "a.json")
    np.testing.assert_array_equal(other.matrix.counts, one.matrix.counts)
    assert {**vars(other), "matrix": None} == {**vars(one), "matrix": None}
    assert other.to_dict("x")["ece_occupied"] == 0.2


def test_figures_are_those_of_the_counts():
    figures = {name: figure(result(40, 10)) for name, figure in FIGURES.items()}
    assert figures == pytest.approx(
        {
            "mIoU": (100 * 990 / 1060 + 40) / 11,
            "Vehicle": 40.0,
            "Pedestrian": 0.0,
            "false free": 60.0,
            "actors called free": 60.0,
            "phantom actors, voxels per frame": 5.0,
            "ECE, free": 1.0,
            "ECE, occupied": 20.0,
        }
    )


def test_seeds_are_averaged_and_their_spread_is_told():
    groups = {"two": [result(40), result(60, seed=1)], "one": [result(50)]}
    table = label_table(groups)
    assert table.rows[0][table.header.index("Vehicle")] == "50.00 ± 14.14"
    assert table.rows[1][table.header.index("Vehicle")] == "50.00"
    semantic, geometric = network_tables(groups)
    assert semantic.rows[0][semantic.header.index("Vehicles")] == "50.00 ± 14.14"
    assert semantic.rows[0][semantic.header.index("Pole")] == "-"
    assert geometric.rows[0][1:] == ("100.00 ± 0.00", "50.00 ± 14.14", "50.00 ± 14.14", "50.00 ± 14.14")
    assert "| two | " in to_markdown(geometric)


@pytest.mark.slow
@pytest.mark.parametrize("weights", ["LMSC_11_T1B.pt", "SSC_Full_11_T1B.pt"])
def test_the_published_weights_see_a_simulated_town(real, tmp_path, weights):
    """3 of the 30 frames of docs/networks.md: free space, poles and buildings are where the town has them."""
    score = published.score_towns(real / weights, tmp_path, every=10, workers=1)
    iou = {name: 100 * value for name, value in score.class_iou.items()}
    assert iou["Free"] >= 90
    assert iou["Road"] >= 40
    assert iou["Pole"] >= 20
    assert iou["Building"] >= 20
    grid = next(iter(open_source(tmp_path).sequences().values())).grids["completion"]
    assert grid.size == (128, 128, 8)
