"""The voxels of SemanticKITTI made again from its files, as the page of it says: without ghost
trails, in its own format.
"""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from carlasc_recorders import SimulatedCapture

import carlasc
from carlasc import FromScans, GridSpec, Run, cli
from carlasc.captures import Lidar

pytest.importorskip("embreex")

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "semantickitti-clean.md"
ALONE = Run(workers=1)
CARS, PEOPLE, ROAD = (10, 252), (30, 254), 40


def commands(page):
    """Return the two commands at the top of the page."""
    block = re.search(r"```bash\n(.*?)```", page.read_text(), re.DOTALL)[1]
    return [shlex.split(line)[1:] for line in block.splitlines()]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A short drive as SemanticKITTI's files, with voxels by the benchmark's rule."""
    folder = tmp_path_factory.mktemp("kitti")
    lidar = Lidar(channels=24, points=16_000)
    capture = SimulatedCapture(count=12, seed=3, first_frame=80, sensors=1, bev=False, lidar=lidar)
    carlasc.regrid(capture, GridSpec.published(), folder / "drive", run=ALONE)
    spec = GridSpec.published().with_bounds((0, -25.6, -2), (51.2, 25.6, 4.4)).with_resolution(0.8)
    tube = FromScans(window=(0, 10), dynamic="tube")
    carlasc.regrid(folder / "drive", spec, observe=tube, name="official", run=ALONE)
    carlasc.export(
        "kitti", folder / "drive", folder / "dataset", options={"grid": "official"}, run=ALONE
    )
    return folder / "dataset"


@pytest.mark.slow
def test_the_commands_of_the_page_make_voxels_without_ghost_trails(dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dataset").symlink_to(dataset)
    convert, export = commands(PAGE)
    # the same commands with coarser voxels and a shorter window
    convert[convert.index("--size") + 1] = "64,64,8"
    convert[convert.index("--window") + 1] = "0:10"
    for arguments in (convert, export):
        monkeypatch.setattr("sys.argv", ["carlasc", *arguments, "--workers", "1"])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert ended.value.code == 0
    official, clean = (folder / "sequences/00/voxels" for folder in (dataset, tmp_path / "clean"))
    assert {path.name for path in clean.iterdir()} == {path.name for path in official.iterdir()}
    counts = []
    for folder in (official, clean):
        labels = np.stack([np.fromfile(path, np.uint16) for path in sorted(folder.glob("*.label"))])
        counts.append([np.isin(labels, ids).sum() for ids in (PEOPLE, CARS, (ROAD,))])
    (people, cars, road), (clean_people, clean_cars, clean_road) = counts
    assert 0 < clean_people < 0.7 * people and clean_cars < cars
    assert 0.95 * road < clean_road
