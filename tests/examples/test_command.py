"""The frame of the scripts: progress where there is no terminal, what Ctrl-C leaves, and the
README's command on the demo's data.
"""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")

from completion import command  # noqa: E402

from carlasc.demo import demonstrate  # noqa: E402

ROOT = Path(__file__).parents[2]


def test_progress_without_a_terminal_is_a_line_every_ten_seconds(monkeypatch, capsys):
    now = [100.0]
    monkeypatch.setattr(command.time, "monotonic", lambda: now[0])
    line = command.Line()
    for seconds in (101, 109.9, 110, 111, 119.9, 125):
        now[0] = seconds
        line.show(f"at {seconds}")
    assert capsys.readouterr().err == "at 110\nat 125\n"
    with command.progress_bar("Completing") as progress:
        progress(1, 4)
        now[0] += command.EVERY_S
        progress(2, 4)
    assert capsys.readouterr().err == "Completing 2/4\n"


def test_ctrl_c_says_how_to_continue(monkeypatch, capsys):
    def main() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "argv", ["train.py"])
    with pytest.raises(SystemExit) as ended:
        command.run(main, "with --resume, the same command continues")
    assert ended.value.code == 130
    assert (
        capsys.readouterr().err
        == "\ntrain.py: interrupted: with --resume, the same command continues\n"
    )


@pytest.mark.slow
@pytest.mark.needs("trimesh", "embreex", "imageio_ffmpeg", "tensorboard")
def test_the_readmes_command_trains_and_validates_on_the_demo(tmp_path):
    demonstrate(tmp_path / "CarlaSC", count=5, sensors=2)
    (typed,) = re.findall(r"`python (examples/train\.py [^`]*)`", (ROOT / "README.md").read_text())
    script, *arguments = shlex.split(typed)
    settings, *arguments = arguments
    ran = subprocess.run(
        [sys.executable, ROOT / script, ROOT / settings, *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert re.search(r"best mIoU [\d.]+ after epoch 1: run/best\.safetensors", ran.stdout)
    assert "UserWarning" not in ran.stderr
