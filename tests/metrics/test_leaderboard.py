from __future__ import annotations

import json
import re

import pytest
from typer.testing import CliRunner

from carlasc import scores
from carlasc.cli import app
from carlasc.errors import ArgumentError, FormatError, MissingDataError


def result(name, convention="carlasc", miou=0.4, **classes):
    return {
        "name": name, "convention": convention, "frames": 3, "miou": miou, "iou": 0.8, "precision": 0.9, "recall": None, "false_free": 0.1,
        "class_iou": {"Road": 0.7, "Car": 0.25} | classes,
    }  # fmt: skip


@pytest.fixture
def files(tmp_path):
    paths = []
    for number, content in enumerate([result("Net_1"), result("Net 2 <b>", miou=0.5, Car=None)]):
        paths.append(tmp_path / f"{number}.json")
        paths[-1].write_text(json.dumps(content))
    return paths


def run(*arguments):
    return CliRunner().invoke(app, ["scores", *map(str, arguments)])


def test_results_stand_side_by_side_in_every_format(files):
    table = scores(files)
    assert table.convention == "carlasc"
    markdown = table.table().to_markdown().splitlines()
    assert markdown[2] == "| Network | Road | Car | mIoU | IoU | Precision | Recall | False free |"
    assert markdown[4] == "| Net_1 | 70.00 | 25.00 | 40.00 | 80.00 | 90.00 | - | 10.00 |"
    assert markdown[5].split(" | ")[2] == "-"
    assert r"Net\_1 & 70.00 & 25.00" in table.table().to_latex()


def test_the_page_has_a_bar_per_class_escapes_names_and_asks_no_other_host(files):
    page = scores(files).to_html()
    assert "Net 2 &lt;b&gt;" in page and "<b>" not in page
    bars = re.findall(r'height="([\d.]+)"><title>(\w+): ([\d.-]+)', page)
    assert bars == [
        ("16.8", "Road", "70.0"),
        ("6.0", "Car", "25.0"),
        ("16.8", "Road", "70.0"),
        ("0.6", "Car", "-"),
    ]
    assert "http" not in page


def test_conventions_are_not_mixed_silently(files, tmp_path):
    other = tmp_path / "other.json"
    other.write_text(json.dumps(result("Third", "sscbench")))
    with pytest.raises(
        ArgumentError, match="files: expected results by one convention, found carlasc, sscbench"
    ):
        scores([*files, other])
    mixed = scores([*files, other], mixed=True).table()
    assert mixed.header[1] == "Convention"
    assert mixed.rows[2][:2] == ("Third", "sscbench")
    refused = run(*files, other)
    assert (refused.exit_code, refused.output.count("\n")) == (2, 1)
    assert "`--mixed`" in refused.output
    assert run(*files, other, "--mixed").exit_code == 0


def test_files_that_hold_no_result_are_named(files, tmp_path):
    bad = tmp_path / "bad.json"
    bad.write_text('{"name": "x"}')
    with pytest.raises(FormatError, match="JSON without convention, frames, class_iou"):
        scores([bad])
    bad.write_text(json.dumps(result("x", miou="much")))
    with pytest.raises(FormatError, match="a fraction from 0 to 1, or null, for miou"):
        scores([bad])
    with pytest.raises(MissingDataError, match="nothing"):
        scores([tmp_path / "absent.json"])
    with pytest.raises(MissingDataError, match="files"):
        scores([])


def test_the_command_writes_by_the_ending_and_replaces_only_when_told(files, tmp_path):
    assert "Net_1" in run(*files).output
    assert run(*files, "--format", "markdown").output.startswith("Scores by the convention carlasc")
    for name, start in (("t.md", "Scores"), ("t.tex", "% Scores"), ("t.html", "<!doctype html>")):
        assert run(*files, "-o", tmp_path / name).exit_code == 0
        assert (tmp_path / name).read_text().startswith(start)
    again = run(*files, "-o", tmp_path / "t.md")
    assert again.exit_code == 1 and "`--overwrite`" in again.output
    assert run(*files, "-o", tmp_path / "t.md", "--overwrite").exit_code == 0
