"""The mini benchmark and the check with published weights, whole, on the smallest settings."""

from __future__ import annotations

import json

import pytest

from carlasc import open as open_source
from carlasc.metrics import CONVENTIONS, ConfusionMatrix, Evaluation

pytest.importorskip("torch", reason="needs carlasc[torch]")

import benchmark
import published

pytest.importorskip("embreex", reason="the simulator needs carlasc[simulate]")


@pytest.mark.slow
def test_the_benchmark_simulates_trains_and_prints_both_tables_and_goes_on_where_it_was(tmp_path, capsys):
    arguments = {"size": "tiny", "history": True, "device": "cpu", "workers": 1}
    benchmark.main(tmp_path, **arguments)
    printed = capsys.readouterr().out
    assert printed.count("| MotionSC T=5 |") == 2
    assert printed.count("| T=5, not aligned |") == 2
    results = json.loads((tmp_path / "results.json").read_text())["results"]
    assert [result["name"] for result in results[:4]] == ["LMSCNet SS", "SSCNet full", "MotionSC T=1", "MotionSC T=5"]
    assert len(results) == 8
    assert all(0 < result["scored_voxels"] == results[0]["scored_voxels"] for result in results)
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("best.safetensors")}
    benchmark.main(tmp_path, **arguments)
    assert capsys.readouterr().out == printed
    assert {path: path.stat().st_mtime_ns for path in written} == written


def test_the_seeds_of_the_splits_are_apart_and_every_entry_trains_as_its_paper_says():
    size = benchmark.SIZES["full"]
    seeds = [range(first, first + count) for (_, first), count in zip(benchmark.SPLITS, size.towns, strict=True)]
    assert not set(seeds[0]) & set(seeds[1])
    assert not set(seeds[1]) & set(seeds[2])
    configs = {entry.name: entry.config for entry in benchmark.list_entries(size)}
    assert (configs["SSCNet full"].free_ratio, configs["SSCNet full"].decay) == (2.0, 1.0)
    assert (configs["LMSCNet SS"].decay, configs["MotionSC T=5"].decay) == (0.98, 0.96)
    study = benchmark.list_history_entries(size)
    assert {name: len({entry.config.seed for entry in runs}) for name, runs in study.items()} == dict.fromkeys(study, 3)
    assert [runs[0].config.history for runs in study.values()] == [1, 5, 5, 5]


def test_seeds_are_averaged_and_their_spread_is_told():
    def run(correct: int) -> Evaluation:
        matrix = ConfusionMatrix(11)
        matrix.counts[1, 1], matrix.counts[1, 0] = correct, 100 - correct
        return Evaluation("run", CONVENTIONS["carlasc"], matrix, {}, 1, "known", [])

    semantic, geometric = benchmark.average_seeds({"two": [run(40), run(60)], "one": [run(50)]})
    assert semantic.rows[0][semantic.header.index("Building")] == "50.00 ± 14.14"
    assert semantic.rows[1][semantic.header.index("Building")] == "50.00"
    assert geometric.rows[0] == ("two", "100.00 ± 0.00", "50.00 ± 14.14", "50.00 ± 14.14", "50.00 ± 14.14")
    assert semantic.rows[0][semantic.header.index("Pole")] == "-"


@pytest.mark.slow
@pytest.mark.parametrize("weights", ["LMSC_11_T1B.pt", "SSC_Full_11_T1B.pt"])
def test_the_published_weights_see_a_simulated_town(real, tmp_path, weights):
    """3 of the 30 frames of docs/networks.md: free space, poles and buildings are where the town has them."""
    result = published.score_towns(real / weights, tmp_path, every=10, workers=1)
    iou = {name: 100 * value for name, value in result.class_iou.items()}
    assert iou["Free"] >= 90
    assert iou["Road"] >= 40
    assert iou["Pole"] >= 20
    assert iou["Building"] >= 20
    grid = next(iter(open_source(tmp_path).sequences().values())).grids["completion"]
    assert grid.size == (128, 128, 8)
