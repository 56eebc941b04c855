"""Names that are HTML run nothing in a browser, on every page that carlasc writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from faults.hostile_files import HTML, names
from typer.testing import CliRunner

from carlasc.cli import app


@pytest.mark.slow
@pytest.mark.needs("trimesh")
def test_names_run_nothing_in_a_browser(
    browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exceptions = pytest.importorskip("selenium.common.exceptions")
    control = tmp_path / "control.html"
    control.write_text(HTML.partition("<img")[0])
    browser.get(control.as_uri())
    browser.switch_to.alert.accept()  # the name does run where it is not text
    from carlasc.testing import write_dataset

    write_dataset(tmp_path / "base" / "data")
    tried = 0
    for place, case in enumerate(names(tmp_path / "base")):
        if "out.html" not in case.arguments:
            continue
        work = tmp_path / str(place)
        work.mkdir()
        case.make(work)
        monkeypatch.chdir(work)
        result = CliRunner().invoke(app, case.arguments.split())
        assert result.exit_code == 0, result.output
        browser.get((work / "out.html").as_uri())
        browser.execute_async_script("setTimeout(arguments[0], 500)")
        with pytest.raises(exceptions.NoAlertPresentException):
            browser.switch_to.alert.accept()
        text = browser.execute_script("return document.body.textContent + document.title")
        assert "<script>alert(1)" in text, case.arguments  # it is shown as text
        tried += 1
    assert tried >= 2
