"""The training how-to runs as it stands, and so does the README's quick start."""

import re
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")

from helpers.datasets.drives import write_drive  # noqa: E402
from helpers.servers.range_server import serve_folder  # noqa: E402

from carlasc.core.grids import GridSpec  # noqa: E402
from carlasc.storage.packing import pack  # noqa: E402

ROOT = Path(__file__).parents[1]
HOWTO, README = ROOT / "docs" / "howto" / "train.md", ROOT / "README.md"


def blocks(text):
    return re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def quick_start(path):
    """Return the one snippet between the markers; skips where there are none yet."""
    found = re.search(
        r"<!-- quick start begins -->(.*?)<!-- quick start ends -->", path.read_text(), re.DOTALL
    )
    if found is None:
        pytest.skip(f"{path.name} has no quick start between its markers")
    (snippet,) = blocks(found[1])
    return snippet


@pytest.fixture
def downloads(tmp_path, monkeypatch):
    """A folder with CarlaSC, eval_fine and eval_cylindrical in it: one short sequence; the current
    folder.
    """
    sequence = Path("Train") / "Town01_Light"
    write_drive(tmp_path / "CarlaSC" / sequence / "cartesian", range(4))
    fine, cylindrical = GridSpec.published("fine"), GridSpec.published("cylindrical")
    write_drive(
        tmp_path / "eval_fine" / sequence / "cartesian", [], grid_frames=range(4), spec=fine
    )
    write_drive(
        tmp_path / "eval_cylindrical" / sequence / "cylindrical",
        [],
        grid_frames=range(4),
        spec=cylindrical,
    )
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("path", [HOWTO, README], ids=lambda path: path.name)
def test_the_quick_start_makes_one_training_step_in_ten_lines(path, downloads):
    snippet = quick_start(path)
    assert len([line for line in snippet.splitlines() if line.strip()]) <= 10
    torch.manual_seed(0)
    names: dict = {}
    exec(snippet, names)
    network = names["network"]
    assert all(
        p.grad is not None and p.grad.isfinite().all() and p.grad.any()
        for p in network.parameters()
    )
    assert names["batch"]["occupancy"].shape == (2, 5, 128, 128, 8)
    assert names["optimizer"].state[next(network.parameters())]["step"] == 1


@pytest.mark.slow
@pytest.mark.needs("zarr", "urllib3")
def test_the_how_to_runs_from_top_to_bottom(downloads, capsys, tmp_path):
    names: dict = {}
    (tmp_path / "bucket").mkdir()
    pack(tmp_path / "CarlaSC", tmp_path / "bucket" / "carlasc.zarr")
    with serve_folder(tmp_path) as served:  # in place of a bucket
        for block in blocks(HOWTO.read_text()):
            exec(block.replace("s3://bucket/", f"{served.url}/bucket/"), names)
    assert names["state"]["position"] == 4 and list((tmp_path / "cache").glob("??/*"))
    assert capsys.readouterr().out == (
        "[(300, 3), (300, 3)] (2, 128, 128, 8)\ncartesian 256 x 256 x 16 cylindrical 128 x 128 x "
        "8\n"
    )
    assert names["weights"].shape == (11,) and names["cylindrical"][0]["occupancy"].any()


def test_readme_and_how_to_have_the_same_quick_start():
    assert quick_start(README) == quick_start(HOWTO)
