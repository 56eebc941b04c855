"""The page in Firefox: WebGL draws the scene there too, from a file and from a web server."""

import numpy as np
import pytest
from helpers.displays.browser import serve_folder
from helpers.displays.firefox import start_firefox
from helpers.displays.virtual_screen import virtual_screen
from helpers.readers.pixels import blue_pixels, middle_of, red_pixels
from helpers.scenes.road_blocks import add_evidence, add_poses, write_blocks

from carlasc.viewing import Scene, view

pytestmark = pytest.mark.slow
READY = (
    "while (!document.documentElement.dataset.ready && "
    "!document.getElementById('message').textContent.startsWith('This page')) await new "
    "Promise((done) => setTimeout(done, 20)); carlasc.setTheme('light'); await new Promise((done) "
    "=> requestAnimationFrame(() => requestAnimationFrame(done))); return "
    "document.getElementById('message').textContent"
)


@pytest.fixture(scope="module")
def firefox(tmp_path_factory):
    with virtual_screen() as environment:
        driver = start_firefox(tmp_path_factory.mktemp("firefox"), environment)
        yield driver
        driver.quit()


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = write_blocks(tmp_path_factory.mktemp("drive") / "Town01_Light" / "cartesian")
    add_poses(folder, [0.0, 0.2, 0.4])
    add_evidence(folder)
    return folder


def check_picture(firefox, name):
    """Check that the blocks are drawn where they are: red ahead to the right, blue behind to the
    left.
    """
    assert firefox.run(READY) == ""
    left, top, right, bottom = firefox.run(
        "const r = document.getElementById('stage').getBoundingClientRect(); return [r.x, r.y, "
        "r.right, r.bottom].map(Math.round)"
    )
    canvas = firefox.picture(name)[top:bottom, left:right]
    assert len(np.unique(canvas.reshape(-1, 3), axis=0)) > 200
    red, blue = middle_of(red_pixels(canvas)), middle_of(blue_pixels(canvas))
    assert (
        red[0] > canvas.shape[1] / 2 + 30
        and blue[0] < canvas.shape[1] / 2 - 30
        and red[1] < blue[1]
    )


def test_a_page_in_one_file_is_drawn(firefox, drive, tmp_path):
    firefox.open(view(drive, tmp_path / "a.html").out.absolute().as_uri(), (1000, 700))
    check_picture(firefox, "page_firefox")
    assert (
        firefox.run("return carlasc.panels.renderer.getContext() instanceof WebGL2RenderingContext")
        is True
    )
    assert firefox.run("return performance.getEntriesByType('resource').length") == 0


def test_a_folder_is_drawn_from_a_web_server(firefox, drive, tmp_path):
    shifted = write_blocks(tmp_path / "b" / "Town01_Light" / "cartesian", points=False)
    result = view(Scene(shifted, truth=drive), tmp_path / "page", beside=drive)
    with serve_folder(result.out) as address:
        firefox.open(address, (1200, 760))
        assert firefox.run(READY) == ""
        firefox.run(
            "document.querySelectorAll('#panel-buttons button').forEach((button, i) => i && "
            "button.click())"
        )
        check_picture(firefox, "page_firefox_folder")
        assert firefox.run("await carlasc.show(2); return carlasc.position") == 2
