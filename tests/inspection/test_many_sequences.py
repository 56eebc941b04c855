"""Large sets: sums by split, the ten worst, and samples whose intervals hold what all give."""

import json

import numpy as np
import pytest
from helpers.errors import raises
from typer.testing import CliRunner

from carlasc import Run, card, report, stats, validate
from carlasc.cli import app
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError
from carlasc.groundtruth import FromScans, regrid
from carlasc.inspection import info
from carlasc.metrics.results import estimate
from carlasc.motion import MotionOptions, PoseOptions
from carlasc.storage import FolderSink

NUMBER, ODD = 120, 77


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """120 sequences of one frame in two splits; the labels of one are of another class."""
    root, rng = tmp_path_factory.mktemp("many"), np.random.default_rng(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CARLASC_DURABLE", "no")
        for index in range(NUMBER):
            split = "Val" if index % 4 == 0 else "Train"
            writer = FolderSink(root).sequence(f"{split}/Drive{index:03d}/cartesian")
            points = np.zeros((60, 4), np.float32)
            points[:, :3] = rng.uniform((-10, -10, -1.9), (10, 10, 1), (60, 3))
            labels = np.full(60, 10) if index == ODD else rng.integers(1, 9, 60)
            writer.write_document("poses.txt", b"1 0 0 0 0 1 0 0 0 0 1 0\n")
            writer.write_document("times.txt", b"0\n")
            writer.write_frames({0: {"points": points, "labels": labels.astype(np.uint32)}})
    return root


def run(*arguments):
    done = CliRunner().invoke(app, [*map(str, arguments)], terminal_width=200)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.stdout


def test_an_interval_of_a_sample_holds_the_share_of_all():
    rng, hits = np.random.default_rng(0), 0
    sizes = rng.integers(50, 500, 5_000)
    values = rng.binomial(sizes, rng.beta(2, 5, 5_000))
    for _ in range(400):
        some = rng.choice(5_000, 100, replace=False)
        found = estimate([*values[some]], {"Train": 5_000}, [*sizes[some]])
        hits += found.low <= values.sum() / sizes.sum() <= found.high
    assert 0.92 <= hits / 400 <= 0.98
    whole = estimate([*values], {}, [*sizes])
    assert whole.low == whole.value == whole.high == values.sum() / sizes.sum()


def test_classes_are_counted_in_a_sample_and_the_most_unusual_sequences_are_shown(data):
    whole = stats(data)
    some = stats(data, sample=40)
    assert len(some.sequences) == 40 and some.places == {"Train": 90, "Val": 30}
    shares = whole.summed(whole.total.points)
    inside = [
        one.low <= shares[name] / sum(shares.values()) <= one.high
        for name, one in some.intervals("points", remapped=True).items()
    ]
    assert np.mean(inside) > 0.8
    assert not whole.places and "intervals" in some.to_dict()
    shown = run("stats", data, "--by", "sequence")
    assert f"Drive{ODD:03d}" in shown and shown.count("Drive") == 2 * 10
    assert run("stats", data, "--by", "sequence", "--all").count("Drive") == 2 * NUMBER
    assert "a sample of 120 sequences" in run("stats", data, "--sample", 40)
    for wrong in (stats, info, report):
        with raises(ArgumentError, where="sample", found="0"):
            wrong(data, sample=0)
    with raises(ArgumentError, where="sequences", found="-1"):
        validate(data, sequences=-1)


@pytest.mark.slow
def test_checks_are_summed_by_split(data):
    whole, some = validate(data), validate(data, sequences=60)
    assert {split: sums["sequences"] for split, sums in whole.by_split().items()} == {
        "Train": 90,
        "Val": 30,
    }
    assert len(some.sequences) == 60
    for (severity, check), findings in some.grouped().items():
        found = some.sequences_with(findings)
        all_found = whole.grouped()[severity, check]
        assert found.low <= len({one.sequence for one in all_found}) <= found.high
    shown = run("validate", data)
    assert shown.count("1 read") == 10 and "sequences with" in shown
    assert run("validate", data, "--all").count("1 read") == NUMBER


@pytest.mark.slow
def test_grids_are_summed_by_split_in_reports_and_cards(data, tmp_path):
    still = FromScans(motion=MotionOptions("none"), poses=PoseOptions("file", "never"))
    spec = GridSpec.published().with_size((8, 8, 4))
    regrid(data, spec, tmp_path / "out", observe=still, run=Run(1))
    whole, some = report(tmp_path / "out"), report(tmp_path / "out", sample=40)
    assert len(whole.reports) == NUMBER and len(some.reports) == 40
    sums = whole.by_split()
    assert {name.split("/")[0]: one["grids"] for name, one in sums.items()} == {
        "Train": 90,
        "Val": 30,
    }
    share = sum(one["known"] for one in sums.values()) / sum(one["voxels"] for one in sums.values())
    assert some.known().low <= share <= some.known().high
    assert run("report", tmp_path / "out").count("convergence") == 10
    assert run("report", tmp_path / "out", "--all").count("convergence") == NUMBER
    made = card(tmp_path / "out", draft=True, pictures=False, sample=40)
    text = made.files[0].read_text()
    assert "| train | not named | not stated | carla | 90 | 90 |" in text
    assert "40 of 120 sequences" in text
    tables = json.loads(made.files[1].read_text())["recordSet"]
    assert {"splits", "sequences"} <= {one["name"] for one in tables}
