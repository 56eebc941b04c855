from __future__ import annotations

import pytest
from helpers.displays.browser import start_chromium
from helpers.scenes.road_blocks import write_blocks


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    driver = start_chromium(tmp_path_factory.mktemp("chromium"))
    yield driver
    driver.quit()


@pytest.fixture(scope="session")
def blocks(tmp_path_factory):
    return write_blocks(tmp_path_factory.mktemp("blocks") / "Train" / "Town01_Light" / "cartesian")
