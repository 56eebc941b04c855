import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from carlasc.core.tables import CARLA, SEMANTICKITTI
from carlasc.errors import ArgumentError
from carlasc.viewing.colors import ClassColors, Entry
from carlasc.viewing.rendering.pages import draw_page, plan_page

pytest.importorskip("PIL")

ALL = ClassColors(CARLA).entries(range(23))
MANY = ClassColors(SEMANTICKITTI).entries(SEMANTICKITTI.names)


def boxes_of(page):
    """Every rectangle of a page: panels, titles, entries of the legend, as (x0, y0, x1, y1)."""
    boxes = page.panels + page.titles + page.entry_boxes
    return [(box.x, box.y, box.x + box.width, box.y + box.height) for box in boxes]


@settings(deadline=None, max_examples=150)
@given(
    st.integers(200, 2600),
    st.integers(150, 1600),
    st.integers(1, 6),
    st.booleans(),
    st.sampled_from([[], ALL[:1], ALL[:5], ALL[:12], ALL, MANY]),
    st.sampled_from([1.0, 1.4, 16 / 9]),
)
def test_nothing_overlaps_and_nothing_is_clipped(width, height, panels, titled, legend, aspect):
    page = plan_page((width, height), panels, titled=titled, legend=legend, aspect=aspect)
    rectangles = boxes_of(page)
    assert len(page.panels) == panels
    for x0, y0, x1, y1 in rectangles:
        assert 0 <= x0 <= x1 <= width and 0 <= y0 <= y1 <= height
    for i, (ax0, ay0, ax1, ay1) in enumerate(rectangles):
        for bx0, by0, bx1, by1 in rectangles[i + 1 :]:
            assert ax1 <= bx0 or bx1 <= ax0 or ay1 <= by0 or by1 <= ay0
    assert min(min(box.width, box.height) for box in page.panels) >= 1


@pytest.mark.parametrize("size", [(640, 360), (1280, 720), (1920, 1080), (720, 1280), (800, 800)])
@pytest.mark.parametrize("panels", [1, 2, 3, 4])
def test_every_class_is_named_and_the_panels_have_most_of_the_page(size, panels):
    page = plan_page(size, panels, titled=panels > 1, legend=ALL)
    assert page.entries == ALL
    area = sum(box.width * box.height for box in page.panels)
    assert area > 0.5 * size[0] * size[1]


def test_entries_without_space_are_counted():
    page = plan_page((160, 120), 1, titled=False, legend=MANY)
    assert page.entries[-1].name == f"and {len(MANY) - len(page.entries) + 1} more"


def test_square_pictures_have_their_legend_beside_them_wide_ones_below():
    square = plan_page((1280, 720), 1, titled=False, legend=ALL[:8], aspect=1.0)
    wide = plan_page((1280, 720), 1, titled=False, legend=ALL[:8])
    assert square.panels[0].height == 720
    assert min(box.x for box in square.entry_boxes) >= square.panels[0].x + square.panels[0].width
    assert wide.panels[0].width == 1280
    assert min(box.y for box in wide.entry_boxes) >= wide.panels[0].y + wide.panels[0].height


def test_swatches_and_titles_are_drawn_at_their_positions():
    legend = [Entry("red", (200, 0, 0)), Entry("blue", (0, 0, 200))]
    page = plan_page((400, 300), 2, titled=True, legend=legend)
    pictures = [
        np.full((box.height, box.width, 3), 90 + 60 * i, np.uint8)
        for i, box in enumerate(page.panels)
    ]
    drawn = draw_page(
        page,
        pictures,
        ["left", "a title that is much too long for the place that it has got"],
        [None, "empty"],
    )
    for entry, box in zip(page.entries, page.entry_boxes, strict=True):
        middle = drawn[box.y + box.height // 2, box.x + page.font_size // 2]
        assert tuple(middle) == entry.color
    for box in page.titles:
        assert (drawn[box.y : box.y + box.height, box.x : box.x + box.width] < 128).any()
    first, second = page.panels
    assert (drawn[first.y : first.y + first.height, first.x : first.x + first.width] == 90).all()
    # the note
    assert (
        drawn[second.y : second.y + second.height, second.x : second.x + second.width] != 150
    ).any()


@pytest.mark.parametrize("size", [(10, 10), (0, 500), (-5, 500), (100_000, 500)])
def test_an_impossible_size_is_refused(size):
    with pytest.raises(ArgumentError, match="size"):
        plan_page(size, 1, titled=False, legend=[])
