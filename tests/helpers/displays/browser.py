"""A headless Chromium that opens pages from files."""

from __future__ import annotations

import functools
import io
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

OUTPUT = Path(__file__).parents[3] / "test-output"
_FLAGS = (
    "--headless=new --no-sandbox --use-gl=angle --use-angle=swiftshader "
    "--enable-unsafe-swiftshader --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --disable-dev-shm-usage --hide-scrollbars"
).split()


def start_chromium(profile: Path) -> Any:
    """Start a browser with a fresh profile, or skip the test saying what is missing."""
    webdriver = pytest.importorskip(
        "selenium.webdriver", reason="selenium is not installed: pip install selenium"
    )
    binary = (
        shutil.which("chromium")
        or shutil.which("google-chrome")
        or shutil.which("chromium-browser")
    )
    driver = shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("chromium or chromedriver is not installed: apt-get install chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for flag in (*_FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    browser.set_script_timeout(60)
    return browser


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""


@contextmanager
def serve_folder(folder: Path) -> Iterator[str]:
    """Run a web server for a folder on a free port of this machine, as `python -m http.server`
    does; yields its address.
    """
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


class Page:
    """A page that `carlasc view --out` wrote, opened from a file or from an address."""

    def __init__(self, browser: Any, path: Path | str, size: tuple[int, int] = (1000, 640)) -> None:
        self.browser = browser
        browser.get_log("browser")  # of the page before
        browser.set_window_size(*size)
        browser.get(path if isinstance(path, str) else path.absolute().as_uri())
        self.run(
            "while (!document.documentElement.dataset.ready && !window.failed) {"
            " await new Promise((done) => setTimeout(done, 20));"
            " window.failed = document.getElementById('message').textContent.startsWith('This "
            "page');"
            "} document.documentElement.dataset.theme = 'light'; window.carlasc?.setTheme('light');"
        )

    def run(self, script: str, *arguments: object) -> Any:
        """Run the body of an async function in the page, wait until the page is drawn again, and
        return its result.
        """
        return self.browser.execute_async_script(
            "const [args, done] = [[...arguments].slice(0, -1), arguments[arguments.length - 1]];"
            f"(async () => {{ {script} }})().then("
            " (value) => requestAnimationFrame(() => requestAnimationFrame(() => done(value))), "
            "(error) => done(`failed: ${error.stack}`));",
            *arguments,
        )

    def click(self, selector: str) -> None:
        """Click the element of a CSS selector, as a user would, and wait until the page is drawn
        again.
        """
        self.browser.find_element("css selector", selector).click()
        self.run("")

    def text(self, selector: str) -> str:
        """Return the visible text of an element."""
        return str(self.browser.find_element("css selector", selector).text)

    def picture(self, name: str | None = None) -> NDArray[np.uint8]:
        """Return a screenshot, (H, W, 3) uint8, and keep it as test-output/<name>.png if it has a
        name.
        """
        image = pytest.importorskip("PIL.Image")

        png = self.browser.get_screenshot_as_png()
        if name is not None:
            OUTPUT.mkdir(exist_ok=True)
            (OUTPUT / f"{name}.png").write_bytes(png)
        return np.asarray(image.open(io.BytesIO(png)).convert("RGB"))

    def canvas(self, name: str | None = None) -> NDArray[np.uint8]:
        """Return the part of a screenshot that three.js draws."""
        box = self.run(
            "const r = document.getElementById('stage').getBoundingClientRect(); return [r.x, r.y, "
            "r.right, r.bottom]"
        )
        x0, y0, x1, y1 = (round(value) for value in box)
        return self.picture(name)[y0:y1, x0:x1]

    def complaints(self) -> list[str]:
        """Return the warnings and errors in the console since the page was opened."""
        return [
            entry["message"]
            for entry in self.browser.get_log("browser")
            if entry["level"] in ("SEVERE", "WARNING")
        ]
