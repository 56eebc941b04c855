"""The page in a browser: what it draws, what its buttons do. Screenshots stay in test-output/."""

import numpy as np
import pytest
from helpers.displays.browser import Page
from helpers.readers.pixels import blue_pixels, middle_of, red_pixels
from helpers.scenes.road_blocks import write_blocks

from carlasc.core.grids import GridSpec
from carlasc.viewing import Scene, view


@pytest.fixture(scope="module")
def page_file(blocks, tmp_path_factory):
    return view(blocks, tmp_path_factory.mktemp("page") / "scene.html").out


@pytest.fixture
def page(browser, page_file):
    opened = Page(browser, page_file)
    yield opened
    assert opened.complaints() == []


def test_it_draws_without_a_network(page):
    canvas = page.canvas("page")
    assert len(np.unique(canvas.reshape(-1, 3), axis=0)) > 200
    assert page.text("#title") == "Train / Town01_Light"
    assert (
        page.run("return performance.getEntriesByType('resource').map((entry) => entry.name)") == []
    )


@pytest.mark.slow
def test_left_ahead_and_up_are_where_they_should_be(page):
    canvas = page.canvas()
    vehicle = canvas.shape[1] / 2
    red, blue = middle_of(red_pixels(canvas)), middle_of(blue_pixels(canvas))
    # x = +10, y = +5: ahead and to the right
    assert red[0] > vehicle + 30 and red[1] < canvas.shape[0] / 2
    assert blue[0] < vehicle - 30 and blue[1] > red[1]  # x = -8, y = -6: behind and to the left
    page.click("#view-top")
    above = page.canvas("page_above")
    red, blue = middle_of(red_pixels(above)), middle_of(blue_pixels(above))
    assert red[0] > vehicle + 30 and red[1] < above.shape[0] / 2 - 30
    assert blue[0] < vehicle - 30 and blue[1] > above.shape[0] / 2 + 30
    page.run("carlasc.panels.camera.position.set(0, -1, 60); carlasc.panels.controls.update()")
    level = page.canvas()
    # seen from the ground it stands upwards
    assert middle_of(red_pixels(level))[1] < level.shape[0] / 2 + 10
    assert middle_of(red_pixels(level))[0] > vehicle


@pytest.mark.slow
def test_data_with_y_on_the_left_is_drawn_so(browser, tmp_path):
    folder = write_blocks(
        tmp_path / "kitti" / "cartesian", frames=1, metadata={"frame": "kitti"}, points=False
    )
    page = Page(browser, view(folder, tmp_path / "scene.html").out)
    canvas = page.canvas()
    assert middle_of(red_pixels(canvas))[0] < canvas.shape[1] / 2 - 30
    assert middle_of(blue_pixels(canvas))[0] > canvas.shape[1] / 2 + 30
    assert page.complaints() == []


@pytest.mark.slow
def test_the_slider_moves_the_frame(page):
    before = middle_of(red_pixels(page.canvas()))
    page.run(
        "const s = document.getElementById('slider'); s.value = 2; s.dispatchEvent(new "
        "Event('input')); while (carlasc.position !== 2) await new Promise((done) => "
        "setTimeout(done, 10))"
    )
    after = middle_of(red_pixels(page.canvas("page_last_frame")))
    assert after[1] < before[1] - 3  # farther ahead is higher up in the picture
    assert page.text("#frame-label") == "frame 2 · 0.2 s"
    page.click("#next")
    page.run("while (carlasc.position !== 0) await new Promise((done) => setTimeout(done, 10))")
    assert page.text("#frame-label").startswith("frame 0")


@pytest.mark.slow
def test_play_goes_through_the_frames_until_it_is_stopped(page):
    page.click("#play")
    seen = page.run(
        "const seen = new Set(); const until = performance.now() + 20000; while (seen.size < 3 && "
        "performance.now() < until) { seen.add(carlasc.position); await new Promise((done) => "
        "setTimeout(done, 10)); } return [...seen].sort()"
    )
    assert seen == [0, 1, 2]
    assert page.text("#play") == "Stop"
    page.click("#play")
    assert (
        page.run(
            "while (carlasc.runs) await new Promise((done) => setTimeout(done, 10)); return "
            "carlasc.playing"
        )
        is False
    )


@pytest.mark.slow
def test_a_class_is_toggled_and_counted(page):
    voxels = page.run(
        "return carlasc.contents.grids[0].label.filter((label) => label === 4).length"
    )
    assert page.text("tr:has([data-class='4']) td:nth-child(2)") == str(voxels)
    assert red_pixels(page.canvas()).sum() > 100
    page.click("[data-class='4']")
    assert not red_pixels(page.canvas("page_without_pedestrians")).any()
    assert blue_pixels(page.canvas()).any()
    page.click("[data-class='4']")
    assert red_pixels(page.canvas()).sum() > 100


@pytest.mark.slow
def test_a_hidden_class_stays_hidden_in_the_next_frame(page):
    page.click("[data-class='4']")
    page.run("await carlasc.step(1)")
    assert not red_pixels(page.canvas()).any()


@pytest.mark.slow
def test_layers_are_toggled(page):
    grid = page.canvas()
    page.click("[data-layer='grid']")
    page.click("[data-layer='vehicle']")
    page.click("[data-layer='flow']")
    empty = page.canvas()
    assert not red_pixels(empty).any()
    page.click("[data-layer='flow']")
    arrow = page.canvas()
    assert 20 < (arrow != empty).any(-1).sum() < 0.1 * grid[..., 0].size
    page.click("[data-layer='points']")
    points = page.canvas("page_points")
    assert red_pixels(points).sum() > 50


@pytest.mark.slow
def test_a_picked_voxel_shows_its_class_votes_and_position(page):
    column, row = middle_of(red_pixels(page.canvas()))
    page.run("carlasc.pick(...args)", float(column), float(row))
    page.picture("page_picked")
    card = page.text("#card")
    assert "Pedestrian (4)" in card and "votes\n7" in card
    x, y, z = page.run("return carlasc.picked.center")
    assert abs(x - 10) < 1.3 and abs(y - 5) < 1.3 and abs(z) < 1.3
    cell = page.run("return carlasc.picked.cell")
    assert np.allclose(
        GridSpec.published().with_size((64, 64, 4)).centers()[tuple(cell)], (x, y, z), atol=1e-4
    )
    assert page.run("return carlasc.pick(3, 3)") is None
    assert page.text("#card") == ""


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["height", "votes"])
def test_colours_can_show_height_or_votes(page, mode):
    before = page.canvas()
    page.run(
        "const s = document.getElementById('color-by'); s.value = args[0]; s.dispatchEvent(new "
        "Event('change'))",
        mode,
    )
    after = page.canvas(f"page_{mode}")
    assert (before != after).any(-1).mean() > 0.1
    assert page.text("#ramp h2").lower().startswith(mode)


@pytest.mark.slow
def test_prediction_truth_and_errors_are_side_by_side_and_rotate_together(
    browser, blocks, tmp_path
):
    prediction = write_blocks(
        tmp_path / "pred" / "Town01_Light" / "cartesian", shift=3.0, points=False
    )
    result = view(Scene(prediction, truth=blocks), tmp_path / "scene.html")
    assert result.panels == ("prediction", "truth", "errors")
    page = Page(browser, result.out, (1200, 640))
    canvas = page.canvas("page_compared")
    third = canvas.shape[1] // 3
    predicted, true = (red_pixels(canvas[:, i * third : (i + 1) * third]) for i in (0, 1))
    assert middle_of(predicted)[1] < middle_of(true)[1] - 5  # predicted 3 m farther ahead
    page.click("#view-top")
    turned = page.canvas()
    for i in range(3):
        assert (
            turned[:, i * third : (i + 1) * third] != canvas[:, i * third : (i + 1) * third]
        ).any(-1).mean() > 0.1

    column, row = middle_of(red_pixels(turned[:, third : 2 * third]))
    page.run("carlasc.pick(...args)", float(column + third), float(row))
    assert page.run("return carlasc.picked.lines.errors") in (
        "right class",
        "missed: predicted free",
    )
    assert page.run("return carlasc.picked.class") == "Pedestrian"
    page.click("[data-panel='errors']")
    page.click("[data-panel='prediction']")
    assert page.text("#titles") == "truth"
    page.click("[data-panel='truth']")  # one stays
    assert page.text("#titles") == "truth"
    assert page.complaints() == []


@pytest.mark.slow
def test_wedges_of_a_cylindrical_grid_are_at_their_positions(browser, tmp_path):
    spec = GridSpec.published("cylindrical").with_size((64, 64, 4))
    folder = write_blocks(tmp_path / "Town01_Light" / "cylindrical", frames=1, spec=spec)
    page = Page(browser, view(folder, tmp_path / "scene.html").out)
    page.click("#view-top")
    canvas = page.canvas("page_cylindrical")
    column, row = middle_of(red_pixels(canvas))
    assert column > canvas.shape[1] / 2 + 15 and row < canvas.shape[0] / 2 - 30
    page.run("carlasc.pick(...args)", float(column), float(row))
    x, y, _ = page.run("return carlasc.picked.center")
    assert abs(x - 10) < 1.5 and abs(y - 5) < 1.5
    assert page.complaints() == []


@pytest.mark.slow
def test_points_alone_are_drawn(browser, tmp_path):
    from carlasc.storage.folder import FolderSink

    writer = FolderSink(tmp_path).sequence("scan")
    cloud = np.random.default_rng(0).normal(0, (9, 9, 1, 0), (5000, 4)).astype(np.float32)
    writer.write("points", 0, cloud)
    page = Page(browser, view(tmp_path / "scan", tmp_path / "scene.html").out)
    assert len(np.unique(page.canvas("page_scan").reshape(-1, 3), axis=0)) > 3
    assert page.complaints() == []


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1280, 800), (500, 900)])
@pytest.mark.parametrize("compared", [False, True])
def test_nothing_overlaps_and_nothing_is_cut_off(browser, blocks, tmp_path, size, compared):
    result = view(
        Scene(blocks, truth=blocks if compared else None, frames=(0, 1)), tmp_path / "scene.html"
    )
    page = Page(browser, result.out, size)
    page.picture(f"page_{size[0]}x{size[1]}{'_compared' if compared else ''}")
    found = page.run(
        "const boxes = [...document.querySelectorAll('header button, h1, #subtitle, footer "
        "button, #slider, #frame-label, .chips button, th, tbody .name, tbody .count, #titles "
        "span')]"
        "  .filter((e) => e.offsetParent).map((e) => [e, e.getBoundingClientRect()]);"
        "const wrong = [];"
        "for (const [e, b] of boxes) if (b.left < -0.5 || b.right > window.innerWidth + 0.5) "
        "wrong.push(`${e.id || e.textContent} is cut off`);"
        "boxes.forEach(([e, a], i) => { for (const [f, b] of boxes.slice(i + 1))"
        "  if (a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < "
        "a.bottom - 1 && !e.contains(f) && !f.contains(e))"
        "    wrong.push(`${e.id || e.textContent} overlaps ${f.id || f.textContent}`); });"
        "return wrong"
    )
    assert found == []
    assert page.complaints() == []


@pytest.mark.slow
def test_a_broken_page_says_so(browser, page_file, tmp_path):
    text = page_file.read_text()
    start = text.index('id="frame0">') + len('id="frame0">')
    (tmp_path / "broken.html").write_text(text[:start] + "AAAA" + text[start + 40 :])
    page = Page(browser, tmp_path / "broken.html")
    assert page.text("#message").startswith("This page cannot be drawn")
