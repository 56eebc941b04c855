"""What the demonstration says before it starts; tests of examples, packages and pages run it as a
whole.
"""

import re
from pathlib import Path

import pytest

import carlasc.demo
from carlasc.errors import DependencyError

INDEX = Path(__file__).parents[1] / "docs/howto/install.md"


def test_a_missing_package_is_named_with_the_size_of_the_extra_and_nothing_is_written(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(carlasc.demo, "_MODULES", ("carlasc_has_no_such_module",))
    with pytest.raises(DependencyError) as caught:
        carlasc.demo.demonstrate(tmp_path / "out")
    message = str(caught.value)
    assert "carlasc_has_no_such_module is not installed" in message
    assert re.search(r"pip install (-e )?'.*\[demo\]'` \(about \d+ MB\)$", message)
    assert not (tmp_path / "out").exists()


def test_the_size_of_the_extra_is_the_measured_one():
    without, demo = (
        int(size)
        for size in re.findall(
            r"^\| (?:without extras|`demo`) \| (\d+) MB", INDEX.read_text(), re.MULTILINE
        )
    )
    assert pytest.approx(demo - without, abs=10) == carlasc.demo._EXTRA_MB
