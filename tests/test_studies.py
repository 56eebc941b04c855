"""Every study of docs/studies runs in miniature, and belongs to a page that names its command."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs/studies"
SCRIPTS = {path.stem: path.read_text() for path in sorted(FOLDER.glob("*.py"))}
STUDIES = [name for name, text in SCRIPTS.items() if '__name__ == "__main__"' in text]


def run(name: str, work: Path, *more: str) -> str:
    """Return what a tiny run of a study prints."""
    call = [sys.executable, str(FOLDER / f"{name}.py"), *more, "--size", "tiny"]
    done = subprocess.run(call, capture_output=True, text=True, check=False, cwd=work, timeout=1200)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.needs("embreex")
# these have tests of their own
@pytest.mark.parametrize("name", [name for name in STUDIES if name not in ("cameras", "real")])
def test_a_study_runs_in_miniature(name: str, tmp_path: Path) -> None:
    before = {
        path: path.stat().st_mtime_ns
        for path in (ROOT / "docs").rglob("*")
        if "__pycache__" not in path.parts
    }
    printed = run(name, tmp_path)
    # a path is none
    assert re.search(r"\d", re.sub(r"\S*/\S*", "", printed)), f"no figures:\n{printed}"
    after = {
        path: path.stat().st_mtime_ns
        for path in (ROOT / "docs").rglob("*")
        if "__pycache__" not in path.parts
    }
    assert after == before  # tiny figures never reach the pages


def run_on_the_real_drive(name: str, real: Path, work: Path) -> str:
    """Return what a tiny run of a study prints that takes the archive of the real drive."""
    file = real / "kitti_tracking_0000.tar.xz"
    if not file.exists():
        pytest.skip("the archive of the real drive is absent")
    with tarfile.open(file) as archive:
        archive.extractall(work, filter="data")
    (training,) = work.rglob("training")
    return run(name, work, "--archive", str(training.parent))


@pytest.mark.slow
@pytest.mark.needs("kiss_icp")
def test_the_study_of_a_real_drive_runs_in_miniature(real: Path, tmp_path: Path) -> None:
    printed = run_on_the_real_drive("real", real, tmp_path)
    moving = dict(re.findall(r"\| track (\d) \| \d+ \| ([\d.]+)%", printed))
    assert float(moving["1"]) > 90 and float(moving["2"]) > 90 and float(moving["4"]) < 5
    of_movers, kept = re.findall(r"([\d.]+)%", re.findall(r"\| bag, .*", printed)[0])[1::4]
    assert float(of_movers) < 1 and float(kept) > 99  # the cyclist, and structure


@pytest.mark.slow
@pytest.mark.needs("kiss_icp")
def test_refining_repairs_errors_that_are_added_to_the_poses_of_a_real_drive(
    real: Path, tmp_path: Path
) -> None:
    printed = run_on_the_real_drive("poses", real, tmp_path)
    exact, repaired, wrong, refined = (
        float(share) for share in re.findall(r"^\| KISS.*? \| ([\d.]+)%", printed, re.MULTILINE)
    )
    assert wrong > exact + 2  # rays pass through what is doubled
    assert abs(refined - repaired) < 0.5


def test_every_study_is_on_a_page_and_every_other_module_belongs_to_a_study() -> None:
    pages = "\n".join(path.read_text() for path in (ROOT / "docs").rglob("*.md"))
    code = "\n".join(SCRIPTS.values())
    for name in SCRIPTS:
        used = (
            f"docs/studies/{name}.py" in pages
            if name in STUDIES
            else re.search(rf"(import|from) {name}\b", code)
        )
        assert used, f"docs/studies/{name}.py: nothing uses it"


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_takes_the_size_of_a_run(name: str) -> None:
    assert "--size" in SCRIPTS[name] or "study.options(" in SCRIPTS[name]
