"""The mini benchmark: its drives and labels, its rows, what it keeps and prints; and the check with
published weights.
"""

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
from carlasc.metrics import Interval

pytest.importorskip("torch", reason="needs carlasc[torch]")

import benchmark
import benchmark_page
import published
import torch
from benchmarking.drives import build_drives, choose_stretch
from benchmarking.kept import note, read
from benchmarking.rows import history_rows, js3cnet_rows, label_rows, network_rows
from benchmarking.runs import RATES, Result, result_of, settings_of_run
from benchmarking.sizes import SIZES, SPLITS, key_of, settings_of
from benchmarking.tables import (
    LABELS,
    MIOU,
    NETWORK,
    VEHICLES,
    difference,
    figure_table,
    to_markdown,
    with_interval,
)
from completion.processes import Processes
from helpers.errors import raises

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
    """Return a result over two frames of two drives, which are alike: 50 voxels of vehicles, 500
    free ones in each.
    """
    counts = np.zeros((2, 11, 11), np.int64)
    counts[:, VEHICLE, VEHICLE], counts[:, VEHICLE, 0] = correct // 2, 50 - correct // 2
    counts[:, 0, PEDESTRIAN], counts[:, 0, 0] = phantoms // 2, 500 - phantoms // 2
    run = {"seed": seed, "epochs": 3, "learning_rate": 1e-3}
    return Result({"scenes": {}, "run": run}, counts, 2, 0.01, 0.2, 12.0, 3, 0.5)


@pytest.mark.slow
def test_the_same_frames_of_a_drive_have_four_kinds_of_labels(folder):
    samples = {}
    for name in ("evaluation", "tube", "align", "wrong"):
        data = Dataset(
            folder / "data", "train", grid=name, fields=("labels", "known", "visibility")
        )
        assert [data[i]["frame"] for i in range(len(data))] == [1, 2, 3]
        assert data.spec == TINY.scenes.spec
        samples[name] = data[1]
    for name in ("tube", "align"):
        assert not np.array_equal(samples[name]["labels"], samples["evaluation"]["labels"])
        both = samples[name]["known"] & samples["evaluation"]["known"]
        assert (samples[name]["labels"] == samples["evaluation"]["labels"])[both].mean() > 0.7
    errors = (samples["wrong"]["labels"] != samples["align"]["labels"]).mean()
    assert 0 < errors < 0.2
    soft = Dataset(folder / "data", "train", grid="align", fields=("posterior",))[1]["posterior"]
    assert soft.shape == (11, *TINY.scenes.cells)
    for test in open_source(folder / "data" / "Test").sequences().values():
        assert set(test.grids) == {"evaluation"}


@pytest.mark.slow
def test_drives_are_made_once_and_other_scenes_do_not_mix_with_them(folder):
    files = {path: path.stat().st_mtime_ns for path in (folder / "data").rglob("*.bin")}
    done = []
    build_drives(
        folder / "data", TINY.scenes, workers=1, progress=lambda *steps: done.append(steps)
    )
    assert done == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert {path: path.stat().st_mtime_ns for path in files} == files
    with raises(ConflictError, where="scenes.json"):
        build_drives(folder / "data", dataclasses.replace(TINY.scenes, sensors=5), workers=1)


@pytest.mark.slow
def test_a_run_is_kept_and_made_again_only_with_other_settings(folder):
    row = label_rows(TINY)[-1]
    first = result_of(TINY.scenes, row.config, folder, ALONE)
    (kept,) = (folder / "results").iterdir()
    assert kept.stem == key_of(settings_of_run(TINY.scenes, row.config))
    written = kept.stat().st_mtime_ns
    again = result_of(
        TINY.scenes, dataclasses.replace(row.config, workers=3, keep_samples=False), folder, ALONE
    )
    assert kept.stat().st_mtime_ns == written
    np.testing.assert_array_equal(again.matrix.counts, first.matrix.counts)
    assert (again.frames, again.best_epoch) == (first.frames, first.best_epoch) == (6, 1)
    assert first.drives.shape == (2, 11, 11)
    assert (first.drives.sum((1, 2)) > 0).all()
    result_of(TINY.scenes, dataclasses.replace(row.config, seed=1), folder, ALONE)
    assert len(list((folder / "results").iterdir())) == 2


@pytest.mark.slow
def test_the_benchmark_keeps_its_results_and_a_second_run_trains_nothing(folder, tmp_path):
    pytest.importorskip("matplotlib", reason="the pictures need carlasc[plots]")
    from PIL import Image

    (tmp_path / "tiny").mkdir()
    (tmp_path / "tiny" / "data").symlink_to(folder / "data")
    arguments = {"size": "tiny", "study": list(benchmark.Study), "device": "cpu", "workers": 1}
    benchmark.main(tmp_path, **arguments, pictures=tmp_path / "pictures")
    assert Image.open(tmp_path / "pictures" / "labels.png").size == (1500, 760)
    results = tmp_path / "tiny" / "results.json"
    kept = read(results)
    assert {study: list(rows) for study, rows in kept.items()} == {
        study: [row.name for row in rows(TINY)] for study, rows in benchmark.ROWS.items()
    }
    runs = [run for study in kept.values() for (run,) in study.values()]
    assert len({run.drives.sum() for run in runs}) == 1
    assert {run.settings["run"]["learning_rate"] for run in runs} <= set(RATES)
    made = benchmark_page.tables(kept)
    assert not [text for text in made.values() if "Not run" in text]
    written = {
        path: path.stat().st_mtime_ns
        for path in (tmp_path / "tiny" / "runs").rglob("best.safetensors")
    }
    before = results.read_text()
    benchmark.main(tmp_path, **arguments)
    assert results.read_text() == before
    assert {path: path.stat().st_mtime_ns for path in written} == written


def test_a_stretch_with_pedestrians_and_moving_vehicles_is_chosen():
    def actor(label, at, speed=0.0):
        mesh = SimpleNamespace(labels=np.array([label, label, 0]))
        return SimpleNamespace(
            world_T_actor=translation(at), velocity=np.array([speed, 0, 0]), mesh=mesh
        )

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
        towns = [
            range(first, first + count)
            for (_, first), count in zip(SPLITS, size.scenes.towns, strict=True)
        ]
        assert len(set().union(*towns)) == sum(map(len, towns))
        assert size.scenes.spec.size == size.scenes.cells
    medium, small = SIZES["medium"].scenes, SIZES["small"].scenes
    assert medium.spec.voxel_size[:2] == pytest.approx(0.4)
    # the small one is a part of it
    assert all(a <= b for a, b in zip(small.towns, medium.towns, strict=True))


def test_every_row_trains_as_its_paper_says():
    size = SIZES["full"]
    networks = {row.name: row.config for row in network_rows(size)}
    assert len(networks) == 12
    for weighting in ("log", "root"):
        sscnet = networks[f"SSCNet full, {weighting}"]
        assert (sscnet.free_ratio, sscnet.decay, sscnet.weighting) == (2.0, 1.0, weighting)
        decays = (
            networks[f"LMSCNet SS, {weighting}"].decay,
            networks[f"MotionSC T=5, {weighting}"].decay,
        )
        assert decays == (0.98, 0.96)
    (js3cnet,) = js3cnet_rows(size)
    assert (js3cnet.config.decay, js3cnet.config.decay_every) == (0.7, 10)
    labels = {row.name: row for row in label_rows(size)}
    assert {name: row.config.grid for name, row in labels.items()} == {
        "tube": "tube",
        "align": "align",
        "align, 20% of the points wrong": "wrong",
        "align, soft labels": "align",
        "capture truth": "evaluation",
    }
    # one run for both tables
    assert labels["capture truth"].config == networks["Baseline T=5, root"]
    assert [row.config.history for row in history_rows(size)] == [1, 5, 5, 5] * 2
    assert {row.seeds for row in (*labels.values(), *network_rows(size), *history_rows(size))} == {
        3
    }


def test_settings_that_change_a_result_change_its_key():
    scenes, config = TINY.scenes, label_rows(TINY)[0].config
    key = key_of(settings_of_run(scenes, config))
    assert key == key_of(settings_of_run(scenes, dataclasses.replace(config, workers=7)))
    others = [
        dataclasses.replace(config, **{name: value})
        for name, value in (("seed", 1), ("grid", "align"), ("epochs", 9))
    ]
    assert key not in {key_of(settings_of_run(scenes, other)) for other in others}
    denser = dataclasses.replace(scenes, lidar=Lidar(channels=64))
    assert key != key_of(settings_of_run(denser, config))
    assert json.loads(json.dumps(settings_of(scenes))) == settings_of(scenes)


def test_a_result_is_read_as_it_was_written(tmp_path):
    one = result(40, 10)
    one.write(tmp_path / "results" / "a.json")
    other = Result.read(tmp_path / "results" / "a.json")
    np.testing.assert_array_equal(other.drives, one.drives)
    assert {**vars(other), "drives": None} == {**vars(one), "drives": None}
    for seed in (1, 0):
        note(tmp_path / "results.json", "labels", "tube", result(40, 10, seed))
    assert [
        run.settings["run"]["seed"] for run in read(tmp_path / "results.json")["labels"]["tube"]
    ] == [0, 1]


def test_figures_are_those_of_the_counts():
    counts = result(40, 10).drives.sum(0)
    assert {name: float(figure(counts)) for name, figure in LABELS.items()} == pytest.approx(
        {
            "mIoU": (100 * 990 / 1060 + 40) / 11,
            "Vehicles": 40.0,
            "Pedestrian": 0.0,
            "false free": 60.0,
            "phantom actors": 1.0,
        }
    )
    whole = result(40, 10).matrix
    assert NETWORK[MIOU](counts) == pytest.approx(100 * whole.miou)
    assert NETWORK["IoU"](counts) == pytest.approx(100 * whole.completeness().iou)


def test_seeds_are_averaged_and_their_spread_is_told():
    groups = {"two": [result(40), result(60, seed=1)], "one": [result(50)]}
    table = figure_table("", groups, NETWORK)
    assert [row[table.header.index("Vehicles")] for row in table.rows] == ["50.0 ± 14.1", "50.0"]
    assert "| two | " in to_markdown(table)


def test_a_difference_that_every_drive_and_seed_shows_is_sure_and_one_of_a_single_drive_is_not():
    vehicles = NETWORK[VEHICLES]
    assert difference([result(60), result(62)], [result(40), result(42)], vehicles).low > 0
    same = difference([result(60), result(40)], [result(40), result(60)], vehicles)
    assert same.value == 0
    assert same.low < 0 < same.high
    better = result(40)
    better.drives[0] = result(80).drives[0]
    one = difference([better], [result(40)], vehicles)
    assert one.value == pytest.approx(20)
    assert one.low < 0 < one.high
    assert with_interval(Interval(20.0, 0.0, 40.0)) == "+20.0 (+0.0 to +40.0)"
    assert with_interval(Interval(2.0, 1.0, 3.0)) == "**+2.0 (+1.0 to +3.0)**"


def test_a_study_that_was_stopped_has_equally_many_seeds_of_each_row():
    rows = {
        "MotionSC T=5, root": [result(40), result(44, seed=1)],
        "Baseline T=5, root": [result(60)],
    }
    made = benchmark_page.tables({"networks": rows})
    assert "| MotionSC T=5 | root | 0.001 | 12.2 | 40.0 |" in made["networks"]
    assert "one seed, 3 epochs, 2 test drives of 1 frames" in made["networks"]
    assert "Not run yet: Baseline T=5, log; MotionSC T=5, log; LMSCNet SS, log" in made["networks"]
    assert made["history"].startswith(
        "Not run: `python examples/benchmark.py WORK --size medium --study history`"
    )


@pytest.mark.slow
def test_the_page_has_the_tables_of_the_results_that_are_kept():
    kept = read(benchmark_page.KEPT)
    page = benchmark_page.PAGE.read_text()
    assert benchmark_page.fill(page, benchmark_page.tables(kept)) == page
    assert benchmark_page.EVERY_CLASS.read_text() == benchmark_page.every_class(kept["networks"])


@pytest.mark.slow
@pytest.mark.parametrize("weights", ["LMSC_11_T1B.pt", "SSC_Full_11_T1B.pt"])
def test_the_published_weights_see_a_simulated_town(real, tmp_path, weights):
    """3 of the 30 frames of docs/networks.md: free space, poles and buildings are where the town
    has them.
    """
    score = published.score_towns(real / weights, tmp_path, every=10, workers=1)
    iou = {name: 100 * value for name, value in score.class_iou.items()}
    assert iou["Free"] >= 90
    assert iou["Road"] >= 40
    assert iou["Pole"] >= 20
    assert iou["Building"] >= 20
    grid = next(iter(open_source(tmp_path).sequences().values())).grids["completion"]
    assert grid.size == (128, 128, 8)
