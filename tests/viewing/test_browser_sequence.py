"""The page in a browser: the path, a folder behind a web server, two runs, evidence, scores, small
screens, the keyboard.
"""

import re

import numpy as np
import pytest
from helpers.displays.browser import Page, serve_folder
from helpers.readers.pixels import middle_of, red_pixels
from helpers.scenes.road_blocks import add_actors, add_evidence, add_poses, write_blocks

from carlasc.core.boxes import Boxes
from carlasc.core.geometry import translation
from carlasc.storage import FolderSink
from carlasc.viewing import Scene, view

pytestmark = pytest.mark.slow
FRAMES = 12
KEY = {
    "left": "\ue012",
    "right": "\ue014",
    "end": "\ue010",
    "home": "\ue011",
    "shift": "\ue008",
    "enter": "\ue007",
}


def path_pixels(picture):
    """Return (H, W) bool: the colours of the path, driven and ahead."""
    return np.any(
        [
            np.abs(picture.astype(int) - color).max(-1) <= 4
            for color in ((37, 99, 235), (169, 193, 245))
        ],
        0,
    )


def colored(picture, color):
    """Return (H, W) bool: the hue of a colour, in the sun or in the shade."""
    shade = picture.astype(float) / np.maximum(picture.max(-1, keepdims=True), 1)
    wanted = np.array(color) / max(color)
    return (np.abs(shade - wanted).max(-1) < 0.06) & (picture.max(-1) > 60)


def choose(page, selector, value):
    page.run(
        "const s = document.querySelector(args[0]); s.value = args[1]; s.dispatchEvent(new "
        "Event('change'))",
        selector,
        value,
    )


def press(page, selector, *keys):
    page.browser.find_element("css selector", selector).send_keys(*keys)
    page.run("")


def click_at(page, x, y):
    for kind in ("mousePressed", "mouseReleased"):
        event = {"type": kind, "x": x, "y": y, "button": "left", "clickCount": 1}
        page.browser.execute_cdp_cmd("Input.dispatchMouseEvent", event)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A vehicle that turns right by 15 degrees per frame, in left-handed axes, where positive
    angles turn to the right.
    """
    folder = write_blocks(tmp_path_factory.mktemp("drive") / "Town01_Light" / "cartesian", FRAMES)
    add_poses(folder, list(np.radians(15) * np.arange(FRAMES)), step_m=4.0)
    add_evidence(folder, FRAMES)
    return folder


@pytest.fixture(scope="module")
def worse(drive, tmp_path_factory):
    """A prediction of the drive, the last frames of which are worse."""
    folder = write_blocks(
        tmp_path_factory.mktemp("worse") / "Town01_Light" / "cartesian", FRAMES, points=False
    )
    for frame in (7, 9):
        labels = np.fromfile(folder / f"evaluation/{frame:06d}.label", np.uint32)
        labels[: 4000 + 500 * frame] = 0
        labels.tofile(folder / f"evaluation/{frame:06d}.label")
    return folder


@pytest.fixture(scope="module")
def drive_page(drive, tmp_path_factory):
    return view(drive, tmp_path_factory.mktemp("page") / "scene.html").out


@pytest.fixture(scope="module")
def compared(drive, worse, tmp_path_factory):
    shifted = write_blocks(
        tmp_path_factory.mktemp("shifted") / "Town01_Light" / "cartesian", FRAMES, shift=6.0
    )
    out = tmp_path_factory.mktemp("page") / "scene.html"
    return view(Scene(worse, truth=drive), out, beside=shifted).out


def test_the_path_turns_to_the_side_to_which_the_vehicle_turns(browser, drive_page):
    page = Page(browser, drive_page)
    page.click("#view-top")
    page.click("[data-layer='vehicle']")
    page.run("carlasc.panels.zoom(1.2)")
    picture = page.canvas("page_path")
    ahead = path_pixels(picture)
    columns, rows = np.nonzero(ahead)[::-1]
    middle = np.array(picture.shape[1::-1]) / 2
    # to the right of the vehicle, never to its left
    assert columns.max() > middle[0] + 80 and columns.min() > middle[0] - 12
    assert rows.min() < middle[1] - 60  # ahead of it
    page.click("[data-layer='path']")
    assert not path_pixels(page.canvas()).any()
    assert page.complaints() == []


def test_data_with_y_on_the_left_have_a_path_that_turns_to_the_left(browser, tmp_path):
    folder = write_blocks(
        tmp_path / "Town01_Light" / "cartesian", FRAMES, metadata={"axes": "right"}
    )
    add_poses(folder, list(np.radians(15) * np.arange(FRAMES)), step_m=4.0)
    page = Page(browser, view(folder, tmp_path / "a.html").out)
    page.click("#view-top")
    page.run("carlasc.panels.zoom(1.2)")
    columns = np.nonzero(path_pixels(page.canvas()))[1]
    middle = page.canvas().shape[1] / 2
    assert columns.min() < middle - 80 and columns.max() < middle + 12
    page.run("carlasc.setView('top'); carlasc.panels.zoom(1.3)")
    moved = follow(page, "page_followed_right_handed")
    assert moved[0] > 20 and moved[1] > 20  # the vehicle drove ahead and to the left
    assert page.complaints() == []


def follow(page, name):
    """Show the frames until the seventh while the camera follows; check that the path does not
    turn, and return how it moved, (x, y) pixels.
    """
    page.run("carlasc.setLayer('grid', false); carlasc.setLayer('vehicle', false)")
    start = path_pixels(page.canvas())
    page.click("#follow")
    page.run("for (let i = 1; i < 7; i++) await carlasc.show(i)")
    end = path_pixels(page.canvas(name))
    sizes = np.array([[np.ptp(np.nonzero(mask)[axis]) for axis in (0, 1)] for mask in (start, end)])
    assert np.abs(sizes[0] - sizes[1]).max() < 12
    return np.subtract(middle_of(end), middle_of(start))


def test_while_it_follows_the_world_keeps_its_direction(browser, drive_page):
    page = Page(browser, drive_page)
    page.click("#view-top")
    page.run("carlasc.panels.zoom(1.3)")
    moved = follow(page, "page_followed")
    assert moved[0] < -20 and moved[1] > 20  # the vehicle drove ahead and to the right
    following = path_pixels(page.canvas())
    page.click("#follow")
    turned = path_pixels(page.canvas())
    # the path turns, and the vehicle does not
    assert abs(middle_of(turned)[0] - middle_of(following)[0]) > 5
    assert page.complaints() == []


def test_a_folder_is_read_frame_by_frame_and_few_are_kept(browser, drive, tmp_path):
    out = view(drive, tmp_path / "page").out
    with serve_folder(out) as address:
        page = Page(browser, address)
        fetched = "return performance.getEntriesByType('resource').map((entry) => entry.name.split('/').pop())"
        assert sorted(page.run(fetched)) == [f"{n:06d}.bin" for n in range(4)]
        assert red_pixels(page.canvas("page_folder")).any()
        page.run("for (let i = 0; i < 12; i++) await carlasc.step(1)")
        assert page.run("return carlasc.store.kept.size") == 8
        assert page.run("return carlasc.position") == 0 and len(page.run(fetched)) >= FRAMES
        names = page.run(
            "return performance.getEntriesByType('resource').map((entry) => entry.name)"
        )
        assert all(name.startswith(address) for name in names)
        assert page.complaints() == []


def test_a_frame_that_the_server_lacks_is_said_and_the_page_goes_on(browser, drive, tmp_path):
    out = view(drive, tmp_path / "page").out
    (out / "frames/000006.bin").unlink()
    with serve_folder(out) as address:
        page = Page(browser, address)
        page.run("await carlasc.show(6)")
        assert (
            page.text("#message")
            == "Frame 6 cannot be shown: the server answers 404 for frames/000006.bin"
        )
        assert page.run("return [carlasc.position, byId('slider').value]") == [0, "0"]
        page.run("await carlasc.show(7)")
        assert page.text("#message") == "" and page.text("#frame-label").startswith("frame 7")


def test_a_folder_that_is_opened_from_the_disk_says_what_to_do(browser, drive, tmp_path):
    page = Page(browser, view(Scene(drive, frames=(0, 2)), tmp_path / "page").out / "index.html")
    assert "python -m http.server" in page.text("#message")


def test_the_divider_is_between_the_runs_and_moves_with_the_keyboard(browser, drive, tmp_path):
    shifted = write_blocks(
        tmp_path / "shifted" / "Town01_Light" / "cartesian", 2, shift=6.0, points=False
    )
    page = Page(browser, view(drive, tmp_path / "a.html", beside=shifted).out)
    middle = page.canvas("page_divided")
    press(page, ".divider", KEY["end"])  # all of it shows the first run
    first = page.canvas()
    press(page, ".divider", KEY["home"])
    second = page.canvas()
    # 6 m farther ahead
    assert middle_of(red_pixels(second))[1] < middle_of(red_pixels(first))[1] - 10
    half = middle.shape[1] // 2
    rows = slice(60, None)  # below the titles
    assert np.array_equal(middle[rows, : half - 24], first[rows, : half - 24])
    assert np.array_equal(middle[rows, half + 24 : -24], second[rows, half + 24 : -24])
    press(page, ".divider", KEY["right"], KEY["right"])
    assert page.run("return document.querySelector('.divider').ariaValueNow") == "10"
    assert page.text("#frame-label").startswith("frame 0")  # the arrow keys moved the divider alone
    page.run("carlasc.divider.set(0.5)")
    handle = page.browser.find_element("css selector", ".divider")
    pytest.importorskip("selenium.webdriver").ActionChains(page.browser).drag_and_drop_by_offset(
        handle, 150, 0
    ).perform()
    assert page.run("return carlasc.panels.share") == pytest.approx(
        0.5 + 150 / middle.shape[1], abs=0.01
    )
    assert (
        page.run(
            "carlasc.divider.set(1); return carlasc.pick(...args)?.panel.run ?? 'none'",
            *middle_of(red_pixels(first)),
        )
        == 0
    )
    assert (
        page.run(
            "carlasc.divider.set(0); return carlasc.pick(...args)?.panel.run ?? 'none'",
            *middle_of(red_pixels(second)),
        )
        == 1
    )
    assert page.complaints() == []


def test_scores_are_plotted_and_lead_to_the_worst_frame(browser, compared):
    page = Page(browser, compared, (1300, 760))
    page.picture("page_scores")
    assert page.text("#score").startswith("100.0 % ")
    page.click("#worst")
    assert page.text("#frame-label").startswith("frame 9")
    scores = page.run("return carlasc.scene.scores.miou")
    assert min(scores[0]) == scores[0][9] and page.text("#score").startswith(
        f"{100 * scores[0][9]:.1f} % "
    )
    assert "frame 9" in page.run("return byId('plot').getAttribute('aria-label')")
    box = page.run(
        "const b = byId('plot').getBoundingClientRect(); return [b.left, b.top, b.width, b.height]"
    )
    for share, frame in ((0.0, 0), (4 / 11, 4), (1.0, 11)):
        click_at(page, box[0] + 2 + share * (box[2] - 4), box[1] + box[3] / 2)
        page.run(
            "while (carlasc.position !== args[0]) await new Promise((done) => setTimeout(done, 10))",
            frame,
        )
        assert page.text("#frame-label").startswith(f"frame {frame}")
    choose(page, "#metric", "iou")
    assert page.run("return byId('plot').getAttribute('aria-label')").startswith("IoU of 12 frames")
    assert page.complaints() == []


def test_colours_show_the_evidence(browser, drive_page):
    page = Page(browser, drive_page)
    red = red_pixels(page.canvas())
    page.click("[data-layer='flow']")
    page.click("[data-layer='path']")
    choose(page, "#color-by", "evidence")
    picture = page.canvas("page_evidence")
    column, row = (round(value) for value in middle_of(red))
    # inferred
    assert colored(picture[row - 4 : row + 5, column - 4 : column + 5], (240, 200, 40)).any()
    assert not red_pixels(picture).any()
    counts = dict(
        re.findall(r"^(.+)\n([\d,]+)$", page.text("#ramp table"), re.M)
        or re.findall(r"^(.+) ([\d,]+)$", page.text("#ramp table"), re.M)
    )
    voxels = page.run(
        "return Array.from({ length: 25 }, (_, id) => carlasc.contents.grids[0].label.filter((l) "
        "=> l === id).length)"
    )
    assert int(counts["inferred: no scan saw it"].replace(",", "")) == voxels[4]
    assert int(counts["in the body of an actor"].replace(",", "")) == voxels[10]
    assert int(counts["seen by this scan"].replace(",", "")) == voxels[7]
    choose(page, "#color-by", "confidence")
    assert "0.5 or less" in page.text("#ramp")
    sure = page.canvas("page_confidence")
    assert colored(sure, (253, 231, 37)).mean() > 0.1  # the road: 1
    # the red block: 0.6
    assert colored(sure[row - 4 : row + 5, column - 4 : column + 5], (63, 41, 111)).any()
    choose(page, "#color-by", "views")
    assert page.text("#ramp .ramp-ends") == "0\n40"
    page.run("carlasc.pick(...args)", column, row)
    card = page.text("#card")
    assert "0.60" in card and "inferred: no scan saw it" in card
    assert page.complaints() == []


def test_data_without_classes_are_shown_by_height_at_first(browser, tmp_path):
    folder = write_blocks(tmp_path / "Train" / "Town01_Light" / "cartesian", 1)
    for file in folder.glob("**/*.label"):
        labels = np.fromfile(file, np.uint32)
        np.where(labels > 0, 3 if file.parent.name == "evaluation" else 0, 0).astype(
            labels.dtype
        ).tofile(file)
    page = Page(browser, view(folder, tmp_path / "a.html").out)
    assert page.run("return document.getElementById('color-by').value") == "height" and page.text(
        "#ramp"
    ).startswith("HEIGHT")
    ramp = [
        colored(page.canvas("page_height"), color).mean() for color in ((68, 1, 84), (253, 231, 37))
    ]
    choose(page, "#color-by", "class")
    assert min(ramp) > 0.001 and not colored(page.canvas(), (253, 231, 37)).any()
    assert page.complaints() == []


def test_modes_without_data_are_not_offered(browser, blocks, tmp_path):
    page = Page(browser, view(blocks, tmp_path / "a.html").out)
    assert page.text("#color-by").split() == ["class", "height", "votes"]
    assert not page.browser.find_element("css selector", "#follow").is_displayed()
    assert page.browser.find_elements("css selector", "[data-layer='path']") == []


@pytest.fixture
def phone(browser):
    """A browser like that of a phone: 390 x 844 CSS pixels, and fingers."""
    screen = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    browser.execute_cdp_cmd(
        "Emulation.setTouchEmulationEnabled", {"enabled": True, "maxTouchPoints": 5}
    )
    yield browser
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})


def test_on_a_phone_nothing_is_cut_off_and_fingers_hit_what_they_touch(phone, compared):
    page = Page(phone, compared, (390, 844))
    page.picture("page_phone")
    wrong = page.run(
        "const found = [];"
        "if (document.documentElement.scrollWidth > 390) found.push('the page is wider than the "
        "screen');"
        "for (const e of document.querySelectorAll('header button, footer button, footer select, "
        "#slider, .chips button, #titles span')) {"
        "  if (!e.offsetParent) continue; const b = e.getBoundingClientRect();"
        "  if (b.left < 0 || b.right > 390) found.push(`${e.id || e.textContent} is cut off`);"
        "  if (!e.closest('#titles') && (b.height < 39.5 || b.width < 30)) found.push(`${e.id || "
        "e.textContent} is small: ${b.width} x ${b.height}`);"
        "}"
        "return found"
    )
    assert wrong == []
    # three would be too narrow
    assert page.text("#panel-buttons") and page.run("return carlasc.panels.shown.length") == 1
    height = page.canvas().shape[0]
    page.click("#options")
    assert (
        page.browser.find_element("css selector", "#options").get_attribute("aria-expanded")
        == "false"
    )
    assert page.canvas("page_phone_folded").shape[0] > 1.3 * height
    assert page.complaints() == []


def test_on_a_phone_a_finger_rotates_and_a_tap_reads_a_voxel(phone, drive_page):
    page = Page(phone, drive_page, (390, 844))
    before = page.run("return carlasc.panels.camera.position.toArray()")

    def touch(kind, *points):
        points = [{"x": x, "y": y} for x, y in points]
        phone.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", (200, 300))
    for x in range(200, 300, 10):
        touch("touchMove", (x, 300))
    touch("touchEnd")
    page.run("")
    after = page.run("return carlasc.panels.camera.position.toArray()")
    assert np.linalg.norm(np.subtract(after, before)) > 5
    page.click("#view-top")
    x, y = page.run(
        "const b = byId('stage').getBoundingClientRect(); return [b.left + b.width / 2, b.top + "
        "b.height / 2 + 60]"
    )
    touch("touchStart", (x, y))
    touch("touchEnd")
    page.run("")
    assert "Road (7)" in page.text("#card")


def test_controls_have_names_for_screen_readers(browser, compared):
    page = Page(browser, compared, (1300, 760))
    browser.execute_cdp_cmd("Accessibility.enable", {})
    nodes = browser.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    browser.execute_cdp_cmd("Accessibility.disable", {})
    named = [
        (node["role"]["value"], node.get("name", {}).get("value", ""))
        for node in nodes
        if not node.get("ignored", False)
    ]
    controls = [
        (role, name)
        for role, name in named
        if role in ("button", "slider", "combobox", "image", "img", "table")
    ]
    assert len(controls) > 25 and all(name.strip() for _, name in controls)
    roles = {role for role, _ in named}
    assert {"banner", "main", "complementary", "contentinfo", "slider"} <= roles
    assert any(name.startswith("Divider: ") for role, name in controls if role == "slider")
    assert any(name.startswith("mIoU of 12 frames") for _, name in controls)
    page.run("await carlasc.show(3)")
    assert page.run("return byId('status').textContent").startswith("frame 3")
    assert "frame 3" in page.run("return byId('canvas').getAttribute('aria-label')")


def test_the_keyboard_moves_the_camera_and_reads_a_voxel(browser, drive_page):
    page = Page(browser, drive_page)
    page.run("const s = byId('canvas'); s.focus()")
    where = "return carlasc.panels.camera.position.toArray()"
    start = page.run(where)
    press(page, "#canvas", KEY["shift"] + KEY["right"])
    turned = page.run(where)
    assert (
        np.linalg.norm(turned) == pytest.approx(np.linalg.norm(start), rel=0.05)
        and turned[0] > start[0] + 3
    )
    press(page, "#canvas", "+")
    assert page.run(where)[1] < turned[1] - 1
    press(page, "#canvas", "2")
    press(page, "#canvas", KEY["enter"])
    assert page.text("#card") != ""
    press(page, "#canvas", KEY["right"])
    page.run("while (carlasc.position !== 1) await new Promise((done) => setTimeout(done, 10))")
    press(page, "#canvas", KEY["end"])
    page.run("while (carlasc.position !== 11) await new Promise((done) => setTimeout(done, 10))")
    button = page.browser.find_element("css selector", "[data-layer='points']")
    button.send_keys(" ")  # on a button, the space bar presses it, and nothing plays
    assert (
        button.get_attribute("aria-pressed") == "true"
        and page.run("return carlasc.playing") is False
    )


def test_the_page_follows_the_system_in_colours_and_motion(browser, drive_page):
    features = [
        {"name": "prefers-color-scheme", "value": "dark"},
        {"name": "prefers-reduced-motion", "value": "reduce"},
    ]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    try:
        browser.get(drive_page.absolute().as_uri())
        page = Page.__new__(Page)
        page.browser = browser
        page.run(
            "while (!document.documentElement.dataset.ready) await new Promise((done) => "
            "setTimeout(done, 20))"
        )
        assert page.run("return document.documentElement.dataset.theme") == "dark"
        assert np.median(page.canvas("page_dark")[:40]) < 60
        seconds = page.run(
            "const from = performance.now(); carlasc.play(true); while (carlasc.position < 2) "
            "await new Promise((done) => setTimeout(done, 10)); carlasc.play(false); return "
            "(performance.now() - from) / 1000"
        )
        assert 0.9 < seconds < 10  # a second per frame
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


@pytest.fixture(scope="module")
def actors(tmp_path_factory):
    """A drive straight ahead, three frames, whose red block has a box, a number in the grid, and a
    velocity that no point has.
    """
    folder = write_blocks(
        tmp_path_factory.mktemp("actors") / "Town01_Light" / "cartesian", 3, points=False
    )
    add_poses(folder, [0.0] * 3, step_m=1.0)
    writer = FolderSink(folder.parent).sequence(folder.name)
    for frame in range(3):
        pose = translation((10.0 + frame, 5, 0))[None]
        box = Boxes.from_poses(
            np.array([7], np.uint32), np.array([4], np.uint32), pose, np.array([[3.0, 3, 3]])
        )
        writer.write("boxes", frame, box.to_table())
    add_actors(folder, number=7, speed_m_s=6.0)
    return folder


def test_boxes_tracks_velocities_and_actors_are_drawn(browser, actors, tmp_path):
    page = Page(browser, view(actors, tmp_path / "scene.html").out, (1000, 700))
    names = page.run(
        "return [...document.querySelectorAll('[data-layer]')].map((e) => e.textContent)"
    )
    assert names == ["Grid", "Flow", "Boxes", "Tracks", "Path", "Car"]
    page.run("await carlasc.step(2)")
    page.click("[data-layer='grid']")
    for layer in ("boxes", "tracks", "flow"):
        before = page.canvas()
        page.click(f"[data-layer='{layer}']")
        assert 20 < (page.canvas() != before).any(-1).sum() < 0.1 * before[..., 0].size, layer
    box = page.run(
        "return Array.from(carlasc.panels.actorBoxes.lines[0].geometry.attributes.position.array)"
    )
    ends = np.reshape(box, (-1, 3))[:24]
    # right, up, back
    assert np.allclose(
        [ends.min(axis=0), ends.max(axis=0)], [[3.5, -1.5, -13.5], [6.5, 1.5, -10.5]]
    )
    track = page.run(
        "return Array.from(carlasc.panels.tracks.lines[0].geometry.attributes.position.array)"
    )
    assert np.allclose(
        np.reshape(track, (-1, 3)), [[5, 0, -8], [5, 0, -10], [5, 0, -10], [5, 0, -12]], atol=1e-4
    )
    page.click("[data-layer='grid']")
    choose(page, "#color-by", "actor")
    assert page.run("return document.querySelector('#ramp tbody').textContent").startswith(
        "actor 7"
    )
    picture = page.canvas("page_actors")
    assert not red_pixels(picture).any() and colored(picture, (0xE6, 0x67, 0xB0)).sum() > 30
    assert page.complaints() == []
