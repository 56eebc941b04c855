"""The model of large runs in docs/studies/scale.md: the table is what the script prints, and the
model behaves as its text says.
"""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(scope="module")
def model():
    sys.path.insert(0, str(DOCS / "studies"))
    spec = importlib.util.spec_from_file_location("scale_model", DOCS / "studies" / "scale.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_the_table_of_the_page_is_what_the_script_prints(model):
    page = (DOCS / "studies" / "scale.md").read_text()
    assert (
        page.partition("<!-- model begin -->\n")[2].partition("<!-- model end -->")[0].strip()
        == model.table()
    )


def test_more_workers_help_until_something_else_is_the_limit(model):
    hours = [
        model.estimate(model.Job(), workers).hours for workers in (1, 2, 16, 100, 10_000, 100_000)
    ]
    assert hours == sorted(hours, reverse=True)
    assert hours[0] / hours[1] == pytest.approx(2, rel=0.01)
    assert model.estimate(model.Job(), 100_000).limit != "cores"


def test_ten_times_the_frames_take_ten_times_the_work(model):
    one, ten = (
        model.estimate(replace(model.Job(), frames=frames), 16) for frames in (43_200, 432_000)
    )
    assert ten.core_hours / one.core_hours == pytest.approx(10, rel=0.02)
    assert (ten.gets, ten.puts) == (10 * one.gets, 10 * one.puts)
    assert ten.monthly == pytest.approx(10 * one.monthly)
