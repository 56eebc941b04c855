"""The window under Xvfb, in a process of its own: a screenshot after each key."""

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
from helpers.scenes.road_blocks import add_actors, add_poses, write_blocks

from carlasc.core.boxes import Boxes
from carlasc.core.geometry import rotation_z, translation
from carlasc.core.tables import CARLA
from carlasc.errors import CarlascError, DependencyError
from carlasc.storage import FolderSink
from carlasc.viewing import Scene, Window
from carlasc.viewing.open3d_shapes import advice, import_open3d, missing_library
from carlasc.viewing.window import KEYS, help_lines

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
state = window.state
window.close()
np.savez_compressed(out, **pictures)
print(json.dumps({"said": said, "position": state.position, "hidden": sorted(state.hidden), "panel": state.panel}))
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
    OUTPUT.mkdir(exist_ok=True)
    pytest.importorskip("PIL.Image").fromarray(picture).save(OUTPUT / f"{name}.png")


@pytest.mark.slow
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
    # x = +10, y = +5: ahead and to the right
    assert red[0] > width / 2 + 20 and red[1] < height / 2
    assert blue[0] < width / 2 - 20 and blue[1] > red[1]
    assert middle_of(red_pixels(seen["last"]))[1] < red[1] - 2  # it drove on
    assert not red_pixels(seen["no_pedestrians"]).any()
    back = np.abs(seen["pedestrians"].astype(int) - seen["last"]).max(-1) > 8
    # edges of neighbouring voxels lie on each other: which is on top is Open3D's choice
    assert back.mean() < 0.01
    assert red_pixels(seen["pedestrians"]).sum() == pytest.approx(
        red_pixels(seen["last"]).sum(), rel=0.1
    )
    assert not blue_pixels(seen["no_grid"]).any()
    assert (seen["no_flow"] != seen["no_grid"]).any()
    assert red_pixels(seen["points"]).sum() > 20
    assert state["position"] == 2 and state["hidden"] == []
    assert state["said"] == ["frame 2", "Pedestrian: hidden", "Pedestrian: shown"]


def test_a_key_switches_between_prediction_truth_and_errors(blocks, tmp_path):
    prediction = write_blocks(
        tmp_path / "pred" / "Town01_Light" / "cartesian", shift=3.0, points=False, frames=1
    )
    seen, state = drive_window(
        tmp_path,
        prediction,
        [("truth", "next_panel", []), ("errors", "next_panel", [])],
        truth=blocks,
    )
    keep("window_errors", seen["errors"])
    assert middle_of(red_pixels(seen["start"]))[1] < middle_of(red_pixels(seen["truth"]))[1] - 2
    assert not red_pixels(seen["errors"]).any()
    assert state["said"] == ["truth", "errors"] and state["panel"] == 2


@pytest.fixture
def open_window(monkeypatch):
    """Opens a window whose Open3D only records what it is told; returns the window and a function
    that presses keys.
    """
    monkeypatch.setenv("DISPLAY", ":0")
    o3d = MagicMock()
    monkeypatch.setattr("carlasc.viewing.window.import_open3d", lambda: o3d)

    def start(*arguments, **options):
        said = []
        window = Window(Scene(*arguments, **options).open(), report=said.append)
        visualizer = o3d.visualization.VisualizerWithKeyCallback.return_value
        simple = {
            call.args[0]: call.args[1] for call in visualizer.register_key_callback.call_args_list
        }
        digits = {
            call.args[0]: call.args[1]
            for call in visualizer.register_key_action_callback.call_args_list
        }

        def press(key, *modifiers):
            code = ord(key) if isinstance(key, str) else key
            assert (
                digits[code](visualizer, *modifiers) if modifiers else simple[code](visualizer)
            ) is True

        return window, press, said

    return start


def test_keys_do_what_the_help_says(blocks, open_window):
    window, press, said = open_window(blocks)
    press(262)
    assert window.state.position == 1 and said[-1] == "frame 1"
    press(263)
    press(263)
    assert window.state.position == 2 and said[-1] == "frame 2"
    press(" ")
    assert window.state.playing
    press(" ")
    assert not window.state.playing
    assert window.state.layers == {"grid", "flow", "boxes", "tracks", "vehicle"}
    for key, layer in (
        ("G", "grid"),
        ("P", "points"),
        ("F", "flow"),
        ("B", "boxes"),
        ("K", "tracks"),
        ("V", "vehicle"),
    ):
        before = set(window.state.layers)
        press(key)
        assert window.state.layers ^ before == {layer}
    press("4", 1, 0)
    press("4", 0, 0)  # the key is released
    press("2", 1, 1)
    press("0", 1, 0)
    press("1", 1, 2)
    assert window.state.hidden == {4, 12, 10, 21}
    assert said[-4:] == [
        "Pedestrian: hidden",
        "TrafficSign: hidden",
        "Vehicle: hidden",
        "Water: hidden",
    ]
    press("4", 1, 0)
    assert said[-1] == "Pedestrian: shown"
    press("A")
    assert window.state.hidden == set()


def test_the_panel_key_switches_between_prediction_truth_and_errors(blocks, open_window):
    window, press, said = open_window(blocks, truth=blocks)
    press("4", 1, 0)
    for panel in (1, 2, 0):
        press("T")
        assert window.state.panel == panel and window.state.hidden == set()
    assert said[-3:] == ["truth", "errors", "prediction"]
    press("T")
    press("T")
    assert [entry.name for entry in window.classes][:2] == ["right class", "wrong class"]


def test_the_help_names_every_key_and_the_class_of_every_digit(blocks, open_window):
    window, _, _ = open_window(blocks)
    *keys, classes = help_lines(window)
    assert [line.split("  ")[0] for line in keys] == list(KEYS)
    named = dict(part.split(" ", 1) for part in classes.split(", "))
    assert (named["1"], named["0"], named["Shift+1"], named["Ctrl+1"]) == (
        "Building",
        "Vehicle",
        "Wall",
        "Water",
    )


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
        positions.append(window.state.position)
        window.tick()  # not due yet
        assert window.state.position == positions[-1]
        clock[0] += 0.11
    assert positions == [1, 2, 0, 1]
    assert said == []  # frames are not named while playing


def test_without_a_screen_the_window_says_what_to_do(blocks, monkeypatch):
    if sys.platform != "linux":
        pytest.skip("screens are named by DISPLAY on Linux only")
    monkeypatch.setattr("carlasc.viewing.window.import_open3d", MagicMock())
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(
        DependencyError, match=r"window: expected a screen, found no DISPLAY: .*`out=\"page.html\"`"
    ):
        Window(Scene(blocks).open())


def drawn_arrays(window):
    """Return the (N, 3) arrays given to Open3D since the last call, and forget them."""
    calls = window.o3d.utility.Vector3dVector.call_args_list
    arrays = [call.args[0] for call in calls]
    calls.clear()
    return arrays


def test_hidden_classes_hide_points_too_and_colours_are_those_of_the_table(blocks, open_window):
    window, press, _ = open_window(blocks)
    for key in "GFV":
        press(key)
    drawn_arrays(window)
    press("P")
    points, colors = drawn_arrays(window)
    pedestrian, road = (np.array(CARLA.colors[label]) / 255 for label in (4, 7))
    block = np.isclose(colors, pedestrian).all(1)
    assert np.isclose(colors[~block], road).all() and 0 < block.sum() < len(block)
    # Open3D's y points to the left
    np.testing.assert_allclose(points[block].mean(0), (10, -5, 0), atol=0.2)
    press("4", 1, 0)
    _, colors = drawn_arrays(window)
    assert np.isclose(colors, road).all()


def test_arrows_point_along_the_flow(blocks, open_window):
    window, press, _ = open_window(blocks)
    for key in "GV":
        press(key)
    drawn_arrays(window)
    press("P")
    press("P")
    vertices = drawn_arrays(window)[-2]
    # 10 m/s ahead, from x = 10
    assert vertices[:, 0].min() > 9 and vertices[:, 0].max() == pytest.approx(20, abs=0.5)


def test_boxes_are_drawn_where_they_are_in_the_colours_of_their_classes(tmp_path, open_window):
    folder = write_blocks(tmp_path / "cartesian", frames=1)
    pose = translation((10.0, 5.0, 0.0)) @ rotation_z(np.pi / 2)
    boxes = Boxes.from_poses(np.array([7]), np.array([4]), pose[None], np.array([[4.0, 2.0, 1.5]]))
    FolderSink(folder.parent).sequence(folder.name).write("boxes", 0, boxes.to_table())
    window, press, _ = open_window(folder)
    for key in "GFVB":
        press(key)
    drawn_arrays(window)
    press("B")
    corners, colors = drawn_arrays(window)
    # right-handed: y points to the left
    np.testing.assert_allclose(corners[:24].min(0), (9, -7, -0.75), atol=1e-6)
    np.testing.assert_allclose(corners[:24].max(0), (11, -3, 0.75), atol=1e-6)
    # a bar to its front
    np.testing.assert_allclose(corners[24:], [(10, -5, -0.75), (10, -7.8, -0.75)], atol=1e-6)
    assert len(colors) == 13 and np.allclose(colors, np.array(CARLA.colors[4]) / 255)
    ends = window.o3d.utility.Vector2iVector.call_args.args[0]
    lengths = np.linalg.norm(corners[ends[:, 0]] - corners[ends[:, 1]], axis=1)
    assert sorted(np.round(lengths[:12], 6).tolist()) == [1.5] * 4 + [2.0] * 4 + [4.0] * 4


@pytest.fixture
def actors(tmp_path):
    """A vehicle that stands, and a grid whose red block is actor 70,003 and drives a metre in each
    of three frames. There are no boxes.
    """
    folder = write_blocks(tmp_path / "Town01_Light" / "cartesian")
    add_actors(folder)
    add_poses(folder, [0.0] * 3, step_m=0.0)
    return folder


def test_tracks_are_drawn_to_where_their_actors_are(actors, open_window):
    window, press, _ = open_window(actors)
    writer = FolderSink(actors.parent).sequence(actors.name)
    for frame in range(3):
        labels = np.fromfile(actors / "labels" / f"{frame:06d}.label", np.uint32)
        writer.write("instances", frame, np.where(labels == 4, 9, 0).astype(np.uint32))
    window, press, _ = open_window(actors)
    for key in "GFV":
        press(key)
    press(262)
    drawn_arrays(window)
    press(262)
    ends, colors = drawn_arrays(window)
    np.testing.assert_allclose(ends, [(x, -5, 0) for x in (10, 11, 11, 12)], atol=0.1)
    assert np.allclose(colors, np.array(CARLA.colors[4]) / 255)
    press(263)  # backwards: the way up to there
    ends, _ = drawn_arrays(window)
    assert len(ends) == 2
    press("K")
    assert drawn_arrays(window) == []


def test_the_panel_key_shows_the_grid_by_actor(actors, open_window):
    window, press, said = open_window(actors)
    for key in "FKV":
        press(key)
    drawn_arrays(window)
    press("T")
    assert said[-1] == "actors" and window.state.panel == 1
    seen = {tuple(color) for color in np.round(255 * drawn_arrays(window)[3]).astype(int).tolist()}
    assert len(seen) >= 3  # no actor, and two
    assert [entry.name for entry in window.classes][:2] == ["no actor", "actors 12, 24, ..."]
    press("T")
    assert window.state.panel == 0


@pytest.mark.parametrize(
    ("message", "package"),
    [
        ("libEGL.so.1: cannot open shared object file: No such file or directory", "libegl1"),
        ("libGL.so.1: cannot open shared object file: No such file or directory", "libgl1"),
        ("libX11.so.6: cannot open shared object file: No such file or directory", "libx11-6"),
        ("libudev.so.1: cannot open shared object file: No such file or directory", "libudev1"),
        (
            "libusb-1.0.so.0: cannot open shared object file: No such file or directory",
            "libusb-1.0-0",
        ),
        ("libidn2.so.0: cannot open shared object file: No such file or directory", "libidn2-0"),
        ("libgomp.so.1: cannot open shared object file: No such file or directory", "libgomp1"),
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
    assert (
        f"apt-get install {package} " in said
        and message.split(":")[0] in said
        and '`out="page.html"`' in said
    )
    assert "\n" not in said


def test_an_unknown_library_is_named():
    assert (
        missing_library("libstrange.so.3: cannot open shared object file: No such file")
        == "libstrange.so.3"
    )
    assert "page.html" in advice("libstrange.so.3")
    assert missing_library("undefined symbol: foo") is None


def test_without_open3d_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(DependencyError, match=r"\[view\]"):
        import_open3d()
