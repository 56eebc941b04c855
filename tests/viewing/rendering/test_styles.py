import numpy as np
import pytest
from helpers.readers.pictures import Image

from carlasc.errors import ArgumentError, ConflictError
from carlasc.viewing import Scene, StyleOptions, render
from carlasc.viewing.rendering.pages import draw_legend, entry_width, font_of, wrap_text

pytest.importorskip("embreex")


@pytest.mark.parametrize(
    ("name", "size", "dpi", "pixels", "written"),
    [
        ("screen", None, None, (1280, 720), None),
        ("screen", (321, 200), None, (321, 200), None),
        ("screen", "640x360", None, (640, 360), None),
        ("screen", "640x360", 96, (640, 360), 96),
        ("screen", "2in x 1.5in", None, (600, 450), 300),
        ("paper", None, None, (1039, 591), 300),
        ("paper", "8.8cmx5cm", 600, (2079, 1181), 600),
        ("paper", "88x50mm", None, (1039, 591), 300),
        ("paper", "900x500", None, (900, 500), 300),
        ("paper", (900, 500), 150, (900, 500), 150),
    ],
)
def test_sizes_are_pixels_or_lengths_at_a_number_of_pixels_per_inch(
    name, size, dpi, pixels, written
):
    sheet = StyleOptions(name, size, dpi).sheet
    assert (sheet.size, sheet.dpi) == (pixels, written)


@pytest.mark.parametrize(
    "size", ["big", "8.8cm", "1280x", "8.5x5", "8.8cmx5", "8ftx5ft", "-5x5", "nanxnan", "1x2x3", ""]
)
def test_a_size_that_is_none_is_refused(size):
    with pytest.raises(ArgumentError, match="size: expected WIDTHxHEIGHT"):
        StyleOptions(size=size)


@pytest.mark.parametrize(
    ("name", "dpi", "where"),
    [("poster", None, "style"), ("paper", 3, "dpi"), ("paper", np.nan, "dpi")],
)
def test_an_unknown_style_and_impossible_resolutions_are_refused(name, dpi, where):
    with pytest.raises(ArgumentError, match=f"^{where}: "):
        StyleOptions(name, dpi=dpi)


def test_type_on_paper_is_eight_points_high_at_any_resolution():
    assert [StyleOptions("paper", dpi=dpi).sheet.font_size for dpi in (300, 600)] == [33, 67]
    assert StyleOptions().sheet.font_size is None


def test_a_picture_on_paper_says_its_resolution_and_has_its_legend_in_a_file_of_its_own(
    blocks, tmp_path
):
    result = render(
        Scene(blocks, frames=(0, 1)),
        tmp_path / "scene.png",
        style=StyleOptions(name="paper", size="5cmx3cm"),
    )
    assert result.legend == tmp_path / "scene.legend.png"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.legend.png", "scene.png"]
    with Image.open(result.out) as picture, Image.open(result.legend) as legend:
        for image in (picture, legend):
            assert image.info["dpi"] == pytest.approx((300, 300), abs=0.01)
        assert picture.size == (591, 354)
        without = render(
            Scene(blocks, frames=(0, 1)),
            tmp_path / "b.png",
            style=StyleOptions(size=(591, 354), legend=False),
        ).out
        assert np.array_equal(np.asarray(picture), np.asarray(Image.open(without)))
        shown = np.asarray(legend)
        for color in ([220, 20, 60], [0, 0, 142], [128, 64, 128]):  # pedestrian, vehicle, road
            assert (np.abs(shown.astype(int) - color).max(-1) <= 2).any(), color


def test_without_a_legend_no_file_of_one_is_written(blocks, tmp_path):
    result = render(
        Scene(blocks, frames=(0, 1)),
        tmp_path / "scene.png",
        style=StyleOptions(name="paper", size=(200, 120), legend=False),
    )
    assert result.legend is None and list(tmp_path.iterdir()) == [result.out]


def test_a_picture_for_a_screen_says_no_resolution(blocks, tmp_path):
    with Image.open(
        render(
            Scene(blocks, frames=(0, 1)), tmp_path / "a.png", style=StyleOptions(size=(160, 90))
        ).out
    ) as picture:
        assert "dpi" not in picture.info


def test_a_legend_that_exists_is_replaced_only_when_asked(blocks, tmp_path):
    (tmp_path / "a.legend.png").write_bytes(b"mine")
    options = {"style": StyleOptions(name="paper", size=(200, 120))}
    with pytest.raises(ConflictError, match="legend"):
        render(Scene(blocks, frames=(0, 1)), tmp_path / "a.png", **options)
    assert [path.name for path in tmp_path.iterdir()] == ["a.legend.png"]
    render(Scene(blocks, frames=(0, 1)), tmp_path / "a.png", overwrite=True, **options)
    assert (tmp_path / "a.legend.png").read_bytes().startswith(b"\x89PNG")


def test_a_film_has_no_style_of_paper(blocks, tmp_path):
    with pytest.raises(ArgumentError, match="style: expected screen for a film"):
        render(blocks, tmp_path / "a.mp4", style=StyleOptions(name="paper"))
    assert list(tmp_path.iterdir()) == []


def test_a_legend_alone_is_as_narrow_as_asked_and_clips_nothing():
    from carlasc.core.tables import CARLA
    from carlasc.viewing.colors import ClassColors

    entries = ClassColors(CARLA).entries(range(23))
    heights = []
    for width in (400, 900, 4000):
        legend = draw_legend(entries, 20, width)
        heights.append(legend.shape[0])
        assert legend.shape[1] <= width
        assert (legend[:, [0, -1]] == 255).all() and (legend[[0, -1]] == 255).all()
    assert heights[0] > heights[1] > heights[2]
    narrow = draw_legend(entries[:1], 20, 10)
    assert narrow.shape[1] >= entry_width(entries[0], font_of(20))


def test_captions_are_broken_into_at_most_three_lines_that_fit():
    font = font_of(20)
    lines = wrap_text("(a) ground truth of twenty sensors " * 6, font, 180)
    assert len(lines) == 3 and lines[-1].endswith("...")
    assert all(font.getlength(line) <= 180 for line in lines)
    assert wrap_text("(a) short", font, 180) == ["(a) short"]
    assert wrap_text("", font, 180) == [""]
