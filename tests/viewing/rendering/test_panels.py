import numpy as np
import pytest
from helpers.readers.pictures import Image, read_mp4
from helpers.readers.pixels import blue_pixels, middle_of, red_pixels
from helpers.scenes.road_blocks import write_blocks

from carlasc import Run
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.viewing import CameraOptions, ClassColors, Scene, StyleOptions, render
from carlasc.viewing.rendering import pictures
from carlasc.viewing.rendering.pages import plan_page

pytest.importorskip("embreex")

ABOVE = CameraOptions(view="bev")


def bare(**options):
    """Nothing beside the voxels: no vehicle and no legend."""
    return StyleOptions(ego=False, legend=False, **options)


@pytest.fixture(scope="module")
def moved(tmp_path_factory):
    """The same scene with the red block 4 m farther ahead."""
    return write_blocks(
        tmp_path_factory.mktemp("moved") / "Train" / "Town02_Light" / "cartesian", shift=4.0
    )


@pytest.fixture
def captions(monkeypatch):
    """The texts of the panels that are drawn."""
    drawn = []
    original = pictures.draw_page
    monkeypatch.setattr(
        pictures, "draw_page", lambda *a, **k: drawn.append(a[2]) or original(*a, **k)
    )
    return drawn


def picture(path):
    return np.asarray(Image.open(path).convert("RGB"))


def halves(shown):
    return np.array_split(shown, 2, axis=1)


def test_two_sources_are_drawn_from_the_same_camera(blocks, moved, tmp_path, captions):
    scenes = [Scene(source, frames=(0, 1)) for source in (blocks, moved)]
    result = render(scenes, tmp_path / "a.png", camera=ABOVE, style=bare(size=(600, 330)))
    left, right = halves(picture(result.out))
    still = [middle_of(blue_pixels(part)) for part in (left, right)]
    np.testing.assert_allclose(still[0], still[1], atol=0.01)
    ahead = [middle_of(red_pixels(part)) for part in (left, right)]
    scale = (ahead[0][1] - ahead[1][1]) / 4  # pixels per metre; ahead is up
    assert ahead[0][0] == pytest.approx(ahead[1][0], abs=1)
    assert scale == pytest.approx(
        np.hypot(*np.subtract(ahead[0], still[0])) / np.hypot(18, 11), rel=0.05
    )
    assert captions == [["(a) Train / Town01_Light", "(b) Train / Town02_Light"]]


def test_grids_of_another_size_are_drawn_at_the_same_scale(blocks, tmp_path):
    from carlasc.core.grids import GridSpec

    full = GridSpec.published()
    half = full.with_bounds((-12.8, -12.8, -2.0), (12.8, 12.8, 1.0)).with_size((64, 64, 8))
    small = write_blocks(tmp_path / "Train" / "Small" / "cartesian", spec=half)
    result = render([blocks, small], tmp_path / "a.png", camera=ABOVE, style=bare(size=(600, 330)))
    left, right = halves(picture(result.out))
    np.testing.assert_allclose(
        middle_of(blue_pixels(left)), middle_of(blue_pixels(right)), atol=1.5
    )


def test_frames_of_one_source_become_panels_in_reading_order(blocks, tmp_path, captions):
    result = render(
        [Scene(blocks, frames=(0, 3))],
        tmp_path / "a.png",
        camera=ABOVE,
        style=bare(size=(900, 330), columns=3),
    )
    assert result.frames == (0, 1, 2) and result.pictures == 1
    rows = [
        middle_of(red_pixels(part))[1] for part in np.array_split(picture(result.out), 3, axis=1)
    ]
    assert rows[0] > rows[1] > rows[2]  # the block moves ahead
    assert captions == [["(a) frame 0", "(b) frame 1", "(c) frame 2"]]


def test_several_frames_of_several_sources_have_a_row_for_each_source(
    blocks, moved, tmp_path, captions
):
    scenes = [Scene(source, frames=(0, 3), every=2) for source in (blocks, moved)]
    result = render(scenes, tmp_path / "a.png", camera=ABOVE, style=bare(size=(600, 660)))
    parts = [half for row in np.array_split(picture(result.out), 2, axis=0) for half in halves(row)]
    rows = [middle_of(red_pixels(part))[1] for part in parts]
    scale = (rows[0] - rows[1]) / 2
    np.testing.assert_allclose(rows, rows[0] - scale * np.array([0, 2, 4, 6]), atol=1.5)
    assert captions[0][3] == "(d) Train / Town02_Light, frame 2"


def test_a_film_shows_the_sources_beside_each_other(blocks, moved, tmp_path, captions):
    result = render(
        [blocks, moved],
        tmp_path / "a.mp4",
        camera=ABOVE,
        style=bare(size=(600, 330)),
        run=Run(workers=1),
    )
    _, frames = read_mp4(result.out)
    assert (result.frames, len(frames)) == ((0, 1, 2), 3)
    for frame in frames:
        left, right = (middle_of(red_pixels(part)) for part in halves(frame))
        assert left[1] > right[1]
    assert captions == [["(a) Train / Town01_Light", "(b) Train / Town02_Light"]] * 3


def test_own_captions_follow_the_letters(blocks, moved, tmp_path, captions):
    render(
        [blocks, moved],
        tmp_path / "a.png",
        camera=ABOVE,
        style=bare(size=(400, 230), captions=["before", ""]),
    )
    assert captions == [["(a) before", "(b)"]]


def test_contents_and_views_are_panels_too(blocks, tmp_path, captions):
    camera = CameraOptions(view="both")
    render(
        [Scene(blocks, frames=(0, 1))],
        tmp_path / "a.png",
        what="grid,scan",
        camera=camera,
        style=bare(size=(400, 330)),
    )
    names = [
        "(a) grid, from behind",
        "(b) grid, from above",
        "(c) scan, from behind",
        "(d) scan, from above",
    ]
    assert captions == [names]


def test_impossible_panels_are_refused(blocks, moved, tmp_path):
    right = write_blocks(tmp_path / "data" / "s" / "cartesian", metadata={"axes": "right"})
    late = Scene(moved, frames=(2, 3))
    with pytest.raises(ArgumentError, match="columns"):
        StyleOptions(columns=0)
    cases = [
        ([], {}, ArgumentError, "source: expected at least one"),
        (
            [blocks, moved],
            {"captions": ["one"]},
            ArgumentError,
            "captions: expected one for each of the 2 panels",
        ),
        ([blocks, right], {}, ArgumentError, "the same axes"),
        (blocks, {"captions": ["one"]}, ArgumentError, "captions: expected several"),
        (
            [Scene(blocks, frames=(0, 2)), late],
            {"out": "a.mp4"},
            MissingDataError,
            "frames that all sources have",
        ),
    ]
    for source, options, error, message in cases:
        out = tmp_path / options.pop("out", "a.png")
        with pytest.raises(error, match=message):
            render(source, out, style=StyleOptions(size=(200, 120), **options))
        assert not out.exists()


@pytest.mark.parametrize("count", [1, 2, 3, 5, 7])
@pytest.mark.parametrize("entries", [0, 4, 22])
def test_panels_with_captions_have_one_size_and_nothing_overlaps(count, entries):
    captions = [f"({number}) what is shown in this panel, in some words" for number in range(count)]
    legend = ClassColors(CARLA).entries(range(1, entries + 1))
    page = plan_page((1001, 701), count, titled=False, legend=legend, captions=captions)
    assert len({(box.width, box.height) for box in page.panels}) == 1
    for panel, caption in zip(page.panels, page.titles, strict=True):
        assert panel.y + panel.height <= caption.y and caption.y + caption.height <= 701
        assert panel.x == caption.x and panel.x + panel.width <= 1001
    boxes = page.panels + page.titles + page.entry_boxes
    for i, one in enumerate(boxes):
        for two in boxes[i + 1 :]:
            apart = one.x + one.width <= two.x or two.x + two.width <= one.x
            assert apart or one.y + one.height <= two.y or two.y + two.height <= one.y
