"""The window: what its keys show, and what it says where it cannot open."""

import importlib
import json
import subprocess
import sys
from unittest.mock import MagicMock

import numpy as np
import pytest
from helpers.displays.browser import OUTPUT
from helpers.displays.virtual_screen import virtual_screen
from helpers.readers.pixels import blue_pixels, middle_of, red_pixels
from helpers.scenes.road_blocks import write_blocks

from carlasc.core.tables import CARLA
from carlasc.errors import CarlascError, DependencyError
from carlasc.viewing import Scene, Window, view
from carlasc.viewing.window import KEYS, import_open3d

STEPS = """
import json, sys
import numpy as np
from carlasc.viewing import Scene, Window

data, out, actions = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
truth = sys.argv[4] if len(sys.argv) > 4 else None
said = []
window = Window(Scene(data, truth=truth).open(), size=(900, 600), report=said.append)
pictures = {"start": window.picture()}
for name, method, arguments in actions:
    getattr(window, method)(*arguments)
    pictures[name] = window.picture()
window.close()
np.savez_compressed(out, **pictures)
print(json.dumps({"said": said, "position": window.position, "look": window.look}))
"""


def drive_window(tmp_path, data, actions, truth=None):
    """Open a window, press keys; returns what was seen after each, and what was said."""
    try:
        import_open3d()
    except CarlascError as error:
        pytest.skip(str(error))
    arguments = [data, tmp_path / "seen.npz", json.dumps(actions), *([truth] if truth else [])]
    with virtual_screen() as environment:
        run = subprocess.run(
            [sys.executable, "-c", STEPS, *arguments],
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
    assert run.returncode == 0, run.stderr[-2000:]
    with np.load(tmp_path / "seen.npz") as seen:
        pictures = dict(seen)
    return pictures, json.loads(run.stdout.splitlines()[-1])


def keep(name, picture):
    OUTPUT.mkdir(exist_ok=True)
    pytest.importorskip("PIL.Image").fromarray(picture).save(OUTPUT / f"{name}.png")


@pytest.mark.slow
def test_keys_step_and_switch_to_the_points(blocks, tmp_path):
    actions = [("last", "step", [-1]), ("points", "next_look", []), ("grid", "next_look", [])]
    seen, state = drive_window(tmp_path, blocks, actions)
    keep("window", seen["start"])
    keep("window_points", seen["points"])
    start = seen["start"]
    height, width = start.shape[:2]
    red, blue = middle_of(red_pixels(start)), middle_of(blue_pixels(start))
    # x = +10, y = +5: ahead and to the right
    assert red[0] > width / 2 + 20 and red[1] < height / 2
    assert blue[0] < width / 2 - 20 and blue[1] > red[1]
    assert middle_of(red_pixels(seen["last"]))[1] < red[1] - 2  # it drove on
    assert red_pixels(seen["points"]).sum() > 20
    assert red_pixels(seen["points"]).sum() < red_pixels(seen["last"]).sum()
    assert red_pixels(seen["grid"]).sum() == pytest.approx(red_pixels(seen["last"]).sum(), rel=0.1)
    assert state["position"] == 2 and state["look"] == 0
    assert state["said"][:2] == ["frame 2", "points"]


@pytest.mark.slow
def test_a_key_switches_between_prediction_truth_and_errors(blocks, tmp_path):
    prediction = write_blocks(
        tmp_path / "pred" / "Town01_Light" / "cartesian", shift=3.0, points=False, frames=1
    )
    actions = [("truth", "next_look", []), ("errors", "next_look", [])]
    seen, state = drive_window(tmp_path, prediction, actions, truth=blocks)
    keep("window_errors", seen["errors"])
    assert middle_of(red_pixels(seen["start"]))[1] < middle_of(red_pixels(seen["truth"]))[1] - 2
    assert not red_pixels(seen["errors"]).any()
    assert state["said"] == ["truth", "errors"] and state["look"] == 2


@pytest.fixture
def o3d(monkeypatch):
    """An Open3D that only records what it is told, on a screen."""
    monkeypatch.setenv("DISPLAY", ":0")
    o3d = MagicMock()
    monkeypatch.setattr("carlasc.viewing.window.import_open3d", lambda: o3d)
    return o3d


@pytest.fixture
def open_window(o3d):
    """Opens a window; returns it, a function that presses keys, and what is said."""

    def start(*arguments, **options):
        said = []
        window = Window(Scene(*arguments, **options).open(), report=said.append)
        visualizer = o3d.visualization.VisualizerWithKeyCallback.return_value
        keys = {
            call.args[0]: call.args[1] for call in visualizer.register_key_callback.call_args_list
        }

        def press(key):
            assert keys[ord(key) if isinstance(key, str) else key](visualizer) is True

        return window, press, said

    return start


def test_keys_do_what_the_help_says(blocks, open_window):
    window, press, said = open_window(blocks)
    press(262)
    assert window.position == 1 and said[-1] == "frame 1"
    press(263)
    press(263)
    assert window.position == 2 and said[-1] == "frame 2"
    press(" ")
    assert window.playing
    press(" ")
    assert not window.playing


def test_a_key_shows_each_grid_then_the_points(blocks, open_window):
    window, press, said = open_window(blocks, truth=blocks)
    for look in (1, 2, 3, 0):
        press("T")
        assert window.look == look
    assert said == ["truth", "errors", "points", "prediction"]


def test_the_keys_are_told_and_the_window_is_closed(blocks, o3d):
    said = []
    visualizer = o3d.visualization.VisualizerWithKeyCallback.return_value
    visualizer.poll_events.side_effect = [True, False]
    assert view(Scene(blocks), report=said.append) is None
    assert [line.split("  ")[0] for line in said] == list(KEYS)
    assert visualizer.destroy_window.called


def test_playing_goes_to_the_next_frame_when_it_is_due_and_starts_again_after_the_last(
    blocks, open_window, monkeypatch
):
    clock = [100.0]
    monkeypatch.setattr("carlasc.viewing.window.time.monotonic", lambda: clock[0])
    window, press, said = open_window(blocks)
    press(" ")
    positions = []
    for _ in range(4):
        window.tick()
        positions.append(window.position)
        window.tick()  # not due yet
        assert window.position == positions[-1]
        clock[0] += 0.11
    assert positions == [1, 2, 0, 1]
    assert said == []  # frames are not named while playing


def test_without_a_screen_the_window_says_what_to_do(blocks, monkeypatch):
    if sys.platform != "linux":
        pytest.skip("screens are named by DISPLAY on Linux only")
    monkeypatch.setattr("carlasc.viewing.window.import_open3d", MagicMock())
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(DependencyError) as error:
        Window(Scene(blocks).open())
    assert (error.value.expected, error.value.found) == ("a screen", "no DISPLAY")
    assert '`out="page.html"`' in str(error.value)


def drawn_arrays(o3d):
    """Return the (N, 3) arrays given to Open3D since the last call, and forget them."""
    calls = o3d.utility.Vector3dVector.call_args_list
    arrays = [call.args[0] for call in calls]
    calls.clear()
    return arrays


def test_points_have_the_colours_of_the_table_in_right_handed_axes(blocks, open_window, o3d):
    _, press, _ = open_window(blocks)
    drawn_arrays(o3d)
    press("T")
    points, colors, *_ = drawn_arrays(o3d)
    pedestrian, road = (np.array(CARLA.colors[label]) / 255 for label in (4, 7))
    block = np.isclose(colors, pedestrian).all(1)
    assert np.isclose(colors[~block], road).all() and 0 < block.sum() < len(block)
    # Open3D's y points to the left
    np.testing.assert_allclose(points[block].mean(0), (10, -5, 0), atol=0.2)


def test_level_faces_have_the_colours_of_the_table(blocks, open_window, o3d):
    open_window(blocks)
    corners, colors = drawn_arrays(o3d)
    assert len(corners) == len(colors)
    for label in (4, 7):
        assert np.isclose(colors, np.array(CARLA.colors[label]) / 255).all(1).any()
    assert colors.max() <= 1


@pytest.mark.parametrize(
    ("message", "package"),
    [
        ("libEGL.so.1: cannot open shared object file: No such file or directory", "libegl1"),
        ("libGL.so.1: cannot open shared object file: No such file or directory", "libgl1"),
        ("libX11.so.6: cannot open shared object file: No such file or directory", "libx11-6"),
        ("libudev.so.1: cannot open shared object file: No such file or directory", "libudev1"),
        ("libusb-1.0.so.0: cannot open shared object file: No such file", "libusb-1.0-0"),
        ("libidn2.so.0: cannot open shared object file: No such file", "libidn2-0"),
        ("libgomp.so.1: cannot open shared object file: No such file", "libgomp1"),
    ],
)
@pytest.mark.parametrize("kind", [ImportError, OSError])
def test_the_package_of_a_missing_library_is_named(monkeypatch, message, package, kind):
    def fail(_):
        raise kind(message)

    monkeypatch.setattr(importlib, "import_module", fail)
    with pytest.raises(DependencyError) as error:
        import_open3d()
    said = str(error.value)
    assert f" {package} " in said and message.split(":")[0] in said
    assert '`out="page.html"`' in said and "\n" not in said


def test_without_open3d_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(DependencyError, match=r"\[view\]"):
        import_open3d()
