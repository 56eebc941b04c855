"""The window under Xvfb, in a process of its own: a screenshot after each key."""

import json
import subprocess
import sys

import numpy as np
import pytest
from helpers.blocks import write_blocks
from helpers.browser import OUTPUT
from helpers.pixels import blue_pixels, middle_of, red_pixels
from helpers.screens import virtual_screen

from carlasc.errors import CarlascError
from carlasc.viewing.window.libraries import import_open3d

STEPS = """
import json, sys
import numpy as np
from carlasc.viewing import open_clip
from carlasc.viewing.window.window import Window

data, out, actions = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
truth = sys.argv[4] if len(sys.argv) > 4 else None
said = []
window = Window(open_clip(data, truth=truth), size=(900, 600), report=said.append)
pictures = {"start": window.picture()}
for name, method, arguments in actions:
    getattr(window, method)(*arguments)
    pictures[name] = window.picture()
look = window.look
window.close()
np.savez_compressed(out, **pictures)
print(json.dumps({"said": said, "position": look.position, "hidden": sorted(look.hidden), "panel": look.panel}))
"""


def drive_window(tmp_path, data, actions, truth=None):
    """Open a window, press keys; returns what was seen after each, and what was said."""
    try:
        import_open3d()
    except CarlascError as error:
        pytest.skip(str(error))
    with virtual_screen() as environment:
        run = subprocess.run(
            [sys.executable, "-c", STEPS, data, tmp_path / "seen.npz", json.dumps(actions), *([truth] if truth else [])],
            env=environment, capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    with np.load(tmp_path / "seen.npz") as seen:
        pictures = dict(seen)
    return pictures, json.loads(run.stdout.splitlines()[-1])


def keep(name, picture):
    from PIL import Image

    OUTPUT.mkdir(exist_ok=True)
    Image.fromarray(picture).save(OUTPUT / f"{name}.png")


def test_keys_step_and_toggle_scan_grid_flow_and_classes(blocks, tmp_path):
    seen, state = drive_window(
        tmp_path,
        blocks,
        [
            ("last", "step", [-1]),
            ("no_pedestrians", "toggle_class", [3]),
            ("pedestrians", "toggle_class", [3]),
            ("no_grid", "toggle_layer", ["grid"]),
            ("no_flow", "toggle_layer", ["flow"]),
            ("points", "toggle_layer", ["points"]),
        ],
    )
    keep("window", seen["start"])
    keep("window_points", seen["points"])
    start = seen["start"]
    height, width = start.shape[:2]
    red, blue = middle_of(red_pixels(start)), middle_of(blue_pixels(start))
    assert red[0] > width / 2 + 20 and red[1] < height / 2  # x = +10, y = +5: ahead and to the right
    assert blue[0] < width / 2 - 20 and blue[1] > red[1]
    assert middle_of(red_pixels(seen["last"]))[1] < red[1] - 2  # it drove on
    assert not red_pixels(seen["no_pedestrians"]).any()
    back = np.abs(seen["pedestrians"].astype(int) - seen["last"]).max(-1) > 8
    assert back.mean() < 0.01  # edges of neighbouring voxels lie on each other: which is on top is Open3D's choice
    assert red_pixels(seen["pedestrians"]).sum() == pytest.approx(red_pixels(seen["last"]).sum(), rel=0.1)
    assert not blue_pixels(seen["no_grid"]).any()
    assert (seen["no_flow"] != seen["no_grid"]).any()
    assert red_pixels(seen["points"]).sum() > 20
    assert state["position"] == 2 and state["hidden"] == []
    assert state["said"] == ["frame 2", "Pedestrian: hidden", "Pedestrian: shown"]


def test_prediction_truth_and_errors_follow_each_other(blocks, tmp_path):
    prediction = write_blocks(tmp_path / "pred" / "Town01_Light" / "cartesian", shift=3.0, points=False, frames=1)
    seen, state = drive_window(
        tmp_path, prediction, [("truth", "next_panel", []), ("errors", "next_panel", [])], truth=blocks
    )
    keep("window_errors", seen["errors"])
    assert middle_of(red_pixels(seen["start"]))[1] < middle_of(red_pixels(seen["truth"]))[1] - 2
    assert not red_pixels(seen["errors"]).any()
    assert state["said"] == ["truth", "errors"] and state["panel"] == 2


def test_keys_are_bound_to_what_they_say(blocks, tmp_path):
    from carlasc.viewing.clip import open_clip
    from carlasc.viewing.window.window import Look, Window

    class Recorder:
        """Takes the place of Open3D's window: remembers which keys are bound."""

        def __init__(self):
            self.keys = {}

        def register_key_callback(self, key, action):
            self.keys[key] = action

        def register_key_action_callback(self, key, action):
            self.keys[key] = action

        def __getattr__(self, _):
            return lambda *arguments, **options: self

    window = object.__new__(Window)
    window.clip, window.look, window._visualizer, window._shown, said = open_clip(blocks), Look(), Recorder(), {}, []
    window.report, window._draw, window._content = said.append, lambda: None, None
    window._bind_keys()
    press = window._visualizer.keys
    press[262](None)
    assert window.look.position == 1
    press[263](None)
    press[263](None)
    assert window.look.position == 2
    press[32](None)
    assert window.look.playing
    press[ord("G")](None)
    press[ord("P")](None)
    assert window.look.layers == {"flow", "vehicle"}
    press[ord("4")](None, 1, 0)
    press[ord("4")](None, 0, 0)  # let go
    press[ord("2")](None, 1, 1)
    assert window.look.hidden == {4, 12} and said[-2:] == ["Pedestrian: hidden", "TrafficSign: hidden"]
    press[ord("A")](None)
    assert window.look.hidden == set()
