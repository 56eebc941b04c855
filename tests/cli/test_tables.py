"""Tables of the command line: readable at every width of a terminal."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from carlasc.cli.tables import print_table

WIDTHS = (60, 80, 120, 160)
NAMES = [
    *"Free Building Barrier Other Pedestrian Pole Road Ground Sidewalk Vegetation Vehicles".split(),
    *(f"moving-other-vehicle-{number}" for number in range(23)),
]


def printed(width, *arguments, **options):
    file = io.StringIO()
    print_table(*arguments, console=Console(width=width, file=file), **options)
    return file.getvalue()


def cells(text):
    """Return the cells of each line of the bodies of all printed parts."""
    lines = [line for line in text.splitlines() if line.startswith("│")]
    return [[cell.strip() for cell in line.strip("│").split("│")] for line in lines]


def scores(count):
    figures = [f"{number / 3:.2f}" for number in range(count)]
    header = ["Network", *NAMES[:count], "mIoU", "mIoU w/o free", "Accuracy"]
    return header, [["lmscnet", *figures, "51.33", "49.10", "93.22"]]


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("count", [11, 20, 34])
def test_a_table_of_many_classes_has_one_class_per_row(width, count):
    header, rows = scores(count)
    text = printed(width, header, rows, title="IoU of each class")
    assert text.startswith("IoU of each class\n")
    assert cells(text) == [
        [name, figure] for name, figure in zip(header[1:], rows[0][1:], strict=True)
    ]
    assert max(map(len, text.splitlines())) <= width


def test_a_table_of_few_classes_is_turned_only_where_it_does_not_fit():
    header, rows = scores(7)
    assert cells(printed(160, header, rows)) == rows
    assert cells(printed(60, header, rows)) == [
        list(pair) for pair in zip(header[1:], rows[0][1:], strict=True)
    ]


@pytest.mark.parametrize(("columns", "turned"), [(10, False), (11, True)])
def test_more_than_ten_columns_are_turned_even_where_they_fit(columns, turned):
    header, row = ["n", *map(str, range(columns))], ["x", *["1"] * columns]
    assert len(cells(printed(160, header, [row]))) == (columns if turned else 1)


@pytest.mark.parametrize("width", WIDTHS)
def test_what_is_still_too_wide_is_printed_in_parts_with_the_names_of_the_rows(width):
    header = ["Sequence", *NAMES[:20]]
    rows = [
        [f"Train/Town{n:02d}_Heavy/cartesian", *(f"{n}.{c:02d}" for c in range(20))]
        for n in range(9)
    ]
    text = printed(width, header, rows)
    found = {name: [] for name in NAMES[:20]}
    for name, *figures in cells(text):
        found[name] += figures
    assert found == {
        name: [row[place + 1] for row in rows] for place, name in enumerate(NAMES[:20])
    }
    assert max(map(len, text.splitlines())) <= width
    for row in rows:
        assert row[0].split("/")[1] + "/" in text


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("count", [11, 20, 34])
def test_rows_that_must_stay_rows_stay_so_at_every_width(width, count):
    header = [
        "Class",
        "points",
        "points %",
        "voxels",
        "voxels %",
        *(f"{s} voxels %" for s in ("Train", "Val", "Test")),
    ]
    rows = [
        [name, "12,345,678", "10.00", "123,456,789", "99.99", "1.00", "2.00", "3.00"]
        for name in NAMES[:count]
    ]
    found = {name: [] for name in NAMES[:count]}
    text = printed(width, header, rows, turn=False)
    for name, *figures in cells(text):
        found[name] += figures
    assert found == {row[0]: row[1:] for row in rows}
    assert max(map(len, text.splitlines())) <= width


def test_long_texts_are_wrapped_between_words_and_words_are_never_broken():
    fields = "bev, flow, instances, labels, points, poses, times"
    rows = [["a", fields, "evaluation, evaluation_256x256x16"], ["b", fields, "evaluation"]]
    for width in (40, 60, 80):
        text = printed(width, ["Sequence", "Fields", "Grids"], rows)
        words = set(re.findall(r"[\w,]+", text))
        assert set(fields.split()) | {"evaluation,", "evaluation_256x256x16", "Sequence"} <= words
    assert cells(printed(101, ["Sequence", "Fields", "Grids"], rows)) == rows


def test_numbers_are_aligned_at_the_right_and_markup_is_text():
    text = printed(60, ["Name", "Points"], [["[red]x", "5"], ["y", "12,345"]], title="[bold]title")
    assert "│ [red]x │      5 │" in text
    assert text.startswith("[bold]title\n")


def test_a_table_without_rows_has_its_header():
    text = printed(60, ["Name", *map(str, range(12))], [], turn=True)
    assert "Name" in text and cells(text) == []


def test_names_from_data_do_not_steer_the_terminal():
    console = Console(width=80, record=True, file=io.StringIO())
    print_table(
        ["\x1b[2JName", "B"],
        [["a\x1b]0;x\x07", "[/bold]"]],
        title="\u202eT",
        console=console,
    )
    text = console.export_text()
    assert all(part in text for part in ("\\x1b[2JName", "a\\x1b]0;x\\x07", "[/bold]", "\\u202eT"))
    assert not {"\x1b", "\x07", "\u202e"} & set(text)
