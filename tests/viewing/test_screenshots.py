"""The pictures of the documentation: a simulated street in the page and in the window.

They stay in test-output/.
"""

import subprocess
import sys

import numpy as np
import pytest
from helpers.displays.browser import OUTPUT, Page
from helpers.displays.virtual_screen import virtual_screen
from helpers.readers.pixels import has_color

from carlasc import Run, regrid, simulate
from carlasc.captures import Lidar
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA
from carlasc.errors import CarlascError
from carlasc.groundtruth import FromScans, Voting
from carlasc.viewing import Scene, view
from carlasc.viewing.window import import_open3d

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    folder = tmp_path_factory.mktemp("town") / "Train" / "Demo_Heavy"
    simulate(
        folder,
        count=2,
        sensors=6,
        traffic="heavy",
        lidar=Lidar(points=60_000),
        bev=False,
        run=Run(workers=1),
    )
    regrid(folder, GridSpec.published(), run=Run(workers=1))
    return folder / "cartesian"


@pytest.mark.slow
def test_the_page_of_a_street(browser, street, tmp_path):
    page = Page(browser, view(street, tmp_path / "scene.html").out, (1280, 860))
    page.run("carlasc.panels.setShadows(true)")
    canvas = page.canvas("docs_page")
    # open, level faces in the sun have the legend's colours
    for name in (
        "Road",
        "Sidewalk",
        "Vehicle",
    ):
        assert has_color(canvas, CARLA.colors[CARLA.id_of(name)])
    page.run(
        "carlasc.setTheme('dark'); carlasc.layerButtons.points.click(); carlasc.setView('top')"
    )
    above = page.canvas("docs_page_dark")
    assert np.median(above.reshape(-1, 3)[:, 0]) < 140
    assert page.complaints() == []


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A street with two grids that were merged from scans in two ways, and the truth."""
    folder = tmp_path_factory.mktemp("drive") / "Train" / "Demo_Heavy"
    simulate(
        folder,
        count=16,
        sensors=4,
        traffic="heavy",
        lidar=Lidar(points=40_000),
        bev=False,
        run=Run(workers=1),
    )
    regrid(folder, GridSpec.published(), run=Run(workers=1))
    for name in ("tube", "align"):
        scans = FromScans(window=(-6, 6), dynamic=name)
        regrid(
            folder / "cartesian",
            GridSpec.published(),
            observe=scans,
            voting=Voting(keep_evidence=True),
            name=name,
            run=Run(workers=1),
        )
    return folder / "cartesian"


@pytest.mark.slow
def test_the_page_of_two_runs(browser, drive, tmp_path):
    truth = drive / "evaluation"
    result = view(
        Scene(drive, grid="tube", truth=truth), tmp_path / "scene.html", beside_grid="align"
    )
    page = Page(browser, result.out, (1280, 860))
    page.run("carlasc.panels.setShadows(true)")
    page.click("[data-panel='truth']")
    page.click("[data-panel='errors']")
    page.run("await carlasc.show(12); document.activeElement.blur()")
    canvas = page.canvas("docs_runs")
    for name in ("Road", "Sidewalk", "Vehicle"):
        assert has_color(canvas, CARLA.colors[CARLA.id_of(name)])
    scores = page.run("return carlasc.scene.scores.miou")
    assert np.mean(scores[1]) > np.mean(scores[0])  # moving actors leave no traces
    assert page.complaints() == []


@pytest.mark.slow
def test_the_window_of_a_street(street):
    try:
        import_open3d()
    except CarlascError as error:
        pytest.skip(str(error))
    OUTPUT.mkdir(exist_ok=True)
    script = (
        "import sys; from PIL import Image; from carlasc.viewing import Scene, Window;"
        "window = Window(Scene(sys.argv[1]).open(), size=(1280, 720)); "
        "Image.fromarray(window.picture()).save(sys.argv[2]); window.close()"
    )
    target = OUTPUT / "docs_window.png"
    target.unlink(missing_ok=True)
    with virtual_screen() as environment:
        subprocess.run(
            [sys.executable, "-c", script, street, target], env=environment, check=True, timeout=120
        )
    image = pytest.importorskip("PIL.Image")
    picture = np.asarray(image.open(target).convert("RGB"))
    assert picture.shape == (720, 1280, 3)
    for name in ("Road", "Sidewalk", "Vehicle"):
        assert has_color(picture, CARLA.colors[CARLA.id_of(name)])
