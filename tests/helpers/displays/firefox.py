"""A headless Firefox that opens pages, driven by its own remote protocol (Marionette): no driver
needs to be installed.
"""

from __future__ import annotations

import base64
import io
import json
import shutil
import socket
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.displays.browser import OUTPUT
from numpy.typing import NDArray

_PREFERENCES = {
    "marionette.port": 0,  # any free port, which Firefox writes into its profile
    "webgl.force-enabled": True,  # also without a GPU
    "browser.shell.checkDefaultBrowser": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "app.update.enabled": False,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
}


class Firefox:
    """A browser with a fresh profile in a folder."""

    def __init__(self, binary: str, folder: Path, environment: Mapping[str, str]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        lines = (
            f"user_pref({json.dumps(name)}, {json.dumps(value)});"
            for name, value in _PREFERENCES.items()
        )
        (folder / "user.js").write_text("\n".join(lines))
        command = [binary, "--headless", "--marionette", "--no-remote", "--profile", str(folder)]
        quiet = subprocess.DEVNULL
        self.process = subprocess.Popen(
            command, env={**environment, "HOME": str(folder)}, stdout=quiet, stderr=quiet
        )
        self.socket = socket.create_connection(("127.0.0.1", self._port(folder)), timeout=60)
        self.number = 0
        self._receive()  # it introduces itself
        self.call("WebDriver:NewSession", {})
        self.call("WebDriver:SetTimeouts", {"script": 60_000})

    def _port(self, folder: Path) -> int:
        """Return the port, which it writes into its profile once it listens."""
        file, until = folder / "MarionetteActivePort", time.monotonic() + 60
        while time.monotonic() < until and self.process.poll() is None:
            if file.is_file() and (text := file.read_text().strip()):
                return int(text)
            time.sleep(0.05)
        self.quit()
        raise RuntimeError("Firefox did not start within a minute")

    def call(self, command: str, parameters: dict[str, Any]) -> Any:
        """Send a command and return its result."""
        self.number += 1
        message = json.dumps([0, self.number, command, parameters]).encode()
        self.socket.sendall(b"%d:%s" % (len(message), message))
        _, _, error, result = self._receive()
        if error is not None:
            raise RuntimeError(f"{command}: {error}")
        return result

    def _receive(self) -> Any:
        """Read a message: its length, a colon, JSON."""
        length = b""
        while (byte := self._read(1)) != b":":
            length += byte
        return json.loads(self._read(int(length)))

    def _read(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            part = self.socket.recv(size - len(data))
            if not part:
                raise RuntimeError("Firefox closed the connection")
            data += part
        return data

    def open(self, address: str, size: tuple[int, int]) -> None:
        """Open a page in a window of about some size."""
        self.call("WebDriver:SetWindowRect", {"width": size[0], "height": size[1]})
        self.call("WebDriver:Navigate", {"url": address})

    def run(self, script: str) -> Any:
        """Run the body of an async function in the page, and return its result."""
        body = f"const done = arguments[0]; (async () => {{ {script} }})().then(done, (error) => done(`failed: ${{error.stack}}`));"
        # in the page's own world
        parameters: dict[str, Any] = {
            "script": body,
            "args": [],
            "sandbox": None,
        }
        return self.call("WebDriver:ExecuteAsyncScript", parameters)["value"]

    def picture(self, name: str) -> NDArray[np.uint8]:
        """Return a screenshot, (H, W, 3) uint8, and keep it as test-output/<name>.png."""
        image = pytest.importorskip("PIL.Image")
        png = base64.b64decode(self.call("WebDriver:TakeScreenshot", {"full": False})["value"])
        OUTPUT.mkdir(exist_ok=True)
        (OUTPUT / f"{name}.png").write_bytes(png)
        return np.asarray(image.open(io.BytesIO(png)).convert("RGB"))

    def quit(self) -> None:
        """End the browser."""
        if hasattr(self, "socket"):
            self.socket.close()
        self.process.terminate()
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def start_firefox(profile: Path, environment: Mapping[str, str]) -> Firefox:
    """Start a browser with a fresh profile, or skip the test saying what is missing.

    Args:
        profile: an empty folder.
        environment: names a screen, without which Firefox has no WebGL, not even headless (see
            `helpers.displays.virtual_screen`).
    """
    binary = shutil.which("firefox-esr") or shutil.which("firefox")
    if binary is None:
        pytest.skip("Firefox is not installed: apt-get install firefox-esr")
    return Firefox(binary, profile, environment)
