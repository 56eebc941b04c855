"""The notebooks run from top to bottom, and the outputs that are kept in them are small and of
today.
"""

import base64
import importlib.util
import io
from pathlib import Path

import numpy as np
import pytest

nbformat = pytest.importorskip("nbformat")

FOLDER = Path(__file__).parents[1] / "examples" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
DIFFERENCE = (
    6  # of 255, on average: other versions of Embree and torch draw and train a little differently
)


def pictures(notebook):
    """Return the bytes of the notebook's pictures, in order."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    return [
        base64.b64decode(o["data"]["image/png"])
        for o in outputs
        if "image/png" in o.get("data", {})
    ]


@pytest.mark.slow
@pytest.mark.needs("nbclient", "ipykernel", "embreex", "PIL")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_draws_what_it_shows(path):
    from PIL import Image

    if "import torch" in path.read_text():
        pytest.importorskip("torch")
        pytest.importorskip("matplotlib")
    spec = importlib.util.spec_from_file_location("run_notebooks", FOLDER / "run.py")
    runner = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(runner)
    ours, theirs = pictures(runner.run(path)), pictures(nbformat.read(path, as_version=4))
    assert len(ours) == len(theirs) >= 2
    for pair in zip(ours, theirs, strict=True):
        drawn, kept = (
            np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), int) for data in pair
        )
        assert drawn.shape == kept.shape
        assert np.abs(drawn - kept).mean() < DIFFERENCE


def test_notebooks_are_small_and_every_cell_has_run():
    assert len(NOTEBOOKS) == 3
    assert sum(path.stat().st_size for path in NOTEBOOKS) < 1_000_000
    for path in NOTEBOOKS:
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        code = [cell for cell in notebook.cells if cell.cell_type == "code"]
        assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), path.name
        assert "%pip install" in code[0].source and 'find_spec("carlasc")' in code[0].source
        for cell in code:
            assert not any(
                output.output_type == "error" or output.get("name") == "stderr"
                for output in cell.outputs
            )
