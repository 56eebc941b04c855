"""`carlasc download`: exit codes, and Ctrl-C in a real process."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.servers.http_server import Site, serve
from typer.testing import CliRunner

from carlasc.cli import app

ZIP = "/val_cartesian.zip"


def make_zip(size: int) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(
            "Val/Town07_Light/cartesian/poses.txt", np.random.default_rng(0).bytes(size)
        )
    return buffer.getvalue()


def test_a_split_is_fetched_and_unpacked(tmp_path: Path) -> None:
    with serve(Site({ZIP: make_zip(1000)})) as site:
        arguments = ["download", str(tmp_path), "--split", "val", "--base-url", site.url]
        result = CliRunner().invoke(app, [*arguments, "--extract", "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["archives"][0]["files"] == 1
    assert (tmp_path / "Val/Town07_Light/cartesian/poses.txt").stat().st_size == 1000


@pytest.mark.parametrize(
    "arguments",
    [["--split", "dev"], [], ["--what", "fine", "--split", "val"], ["--split", "val", "--keep"]],
)
def test_wrong_usage_exits_2(tmp_path: Path, arguments: list[str]) -> None:
    assert CliRunner().invoke(app, ["download", str(tmp_path), *arguments]).exit_code == 2


def test_a_missing_zip_exits_1_with_one_line(tmp_path: Path) -> None:
    with serve(Site({})) as site:
        arguments = ["download", str(tmp_path), "--split", "val", "--base-url", site.url]
        result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 1
    assert "status 404" in result.stderr
    assert result.stderr.count("\n") == 1


def test_ctrl_c_keeps_what_came_and_the_next_run_goes_on(tmp_path: Path) -> None:
    content = make_zip(40 << 20)
    with serve(Site({ZIP: content})) as site:
        site.before = lambda number: time.sleep(0.5 if number > 2 else 0)
        arguments = [
            "download",
            str(tmp_path),
            "--split",
            "val",
            "--base-url",
            site.url,
            "--connections",
            "1",
        ]
        # a background job ignores it
        listen = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
        command = [
            sys.executable,
            "-c",
            f"{listen}; from carlasc.cli import main; main()",
            *arguments,
        ]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        record = tmp_path / "val_cartesian.zip.part.json"
        deadline = time.monotonic() + 60
        while not record.exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)  # the first block of 16 MiB has come when its record is there
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 130
        assert "run the same command again" in errors
        assert not (tmp_path / "val_cartesian.zip").exists()
        assert sum(json.loads(record.read_text())["got"].values()) >= 16 << 20
        site.before, sent = None, site.sent
        assert CliRunner().invoke(app, arguments).exit_code == 0
        assert site.sent - sent <= len(content) - (16 << 20) + 2
    assert (tmp_path / "val_cartesian.zip").read_bytes() == content
