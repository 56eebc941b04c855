import numpy as np
import pytest
from helpers.readers.pictures import Image
from helpers.readers.pixels import grid_with, has_color, middle_of

from carlasc.core.grids import GridSpec, VoxelFlag
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.storage import layout
from carlasc.storage.files import to_json
from carlasc.storage.folder import FolderSink
from carlasc.viewing import CameraOptions, Scene, StyleOptions, render
from carlasc.viewing.rendering.drawings import EVIDENCE

pytest.importorskip("embreex")

SPEC = GridSpec.published().with_size((64, 64, 4))
# from left to right in a picture from above
CENTERS = [
    (18.0, -15.0, -0.5),
    (18.0, 0.0, -0.5),
    (18.0, 15.0, -0.5),
]
VALUES = {
    "occupied": ([0.55, 0.85, 0.999], np.float16),
    "views": ([1, 5, 900], np.uint16),
    "counts": ([1, 9, 70], np.float32),
    "flags": (
        [
            VoxelFlag.SEEN_NOW,
            VoxelFlag.CONTESTED | VoxelFlag.SEEN_NOW,
            VoxelFlag.INFERRED | VoxelFlag.IN_ACTOR,
        ],
        np.uint8,
    ),
    "seen": ([0, 4, 0b101], np.uint8),
}
SHOWN = {
    "confidence": (0, 3, 6),
    "views": (0, 2, 6),
    "votes": (0, 3, 6),
    "inferred": (0, 2, 3),
    "seen": (0, 1, 2),
}


@pytest.fixture(scope="module")
def certain(tmp_path_factory):
    """Three blocks of one class, each with another value of each kind of evidence; frame 1 has
    classes only.
    """
    root = tmp_path_factory.mktemp("certain")
    writer = FolderSink(root).sequence("Train/Town01_Light/cartesian")
    writer.write_document(layout.params_file(layout.EVALUATION), to_json(SPEC.to_params()))
    places = [grid_with({center: 4}, SPEC, size_m=3.0).labels > 0 for center in CENTERS]
    labels = (4 * np.any(places, axis=0)).astype(np.uint32)
    for frame in (0, 1):
        writer.write("evaluation/labels", frame, labels)
    for part, (values, dtype) in VALUES.items():
        array = np.zeros(SPEC.size, dtype)
        for place, value in zip(places, values, strict=True):
            array[place] = value
        writer.write(f"evaluation/{part}", 0, array)
    return root / "Train/Town01_Light/cartesian"


def colors_of(path, legend):
    """Return the column of the middle of each entry's colour, where it occurs in a picture: a level
    face in the sun has it.
    """
    shown = np.asarray(Image.open(path).convert("RGB")).astype(float)
    columns = {}
    for number, entry in enumerate(legend):
        color = np.array(entry.color, float)
        near = np.abs(shown - color).max(-1) <= 3
        if near.sum() > 20:
            columns[number] = middle_of(near)[0]
    return columns


@pytest.mark.parametrize("color", sorted(SHOWN))
def test_each_block_has_the_colour_of_its_value(certain, tmp_path, color):
    path = render(
        Scene(certain, frames=(0, 1)),
        tmp_path / "a.png",
        color=color,
        camera=CameraOptions(view="bev"),
        style=StyleOptions(ego=False, legend=False, size=(400, 400)),
    ).out
    columns = colors_of(path, EVIDENCE[color].legend)
    assert tuple(sorted(columns, key=columns.get)) == SHOWN[color]  # from left to right


@pytest.mark.parametrize("color", sorted(SHOWN))
def test_the_legend_names_what_the_colours_mean(certain, tmp_path, color):
    legend = EVIDENCE[color].legend
    assert (
        len({entry.name for entry in legend})
        == len({entry.color for entry in legend})
        == len(legend)
    )
    shown = np.asarray(
        Image.open(
            render(
                Scene(certain, frames=(0, 1)),
                tmp_path / "a.png",
                color=color,
                style=StyleOptions(size=(900, 500)),
            ).out
        ).convert("RGB")
    )
    assert all(has_color(shown[400:], entry.color) for entry in legend)


@pytest.mark.parametrize("color", ["confidence", "views", "votes", "inferred"])
def test_a_frame_without_the_field_is_an_error_that_says_how_to_make_it(certain, tmp_path, color):
    with pytest.raises(
        MissingDataError, match="found none in 1 of 2 frames, such as frame 1"
    ) as caught:
        render(Scene(certain, frames=(0, 2)), tmp_path / "a.gif", color=color)
    assert ("--keep-evidence" in str(caught.value)) is (color != "votes")
    assert list(tmp_path.iterdir()) == []


def test_colours_of_evidence_need_a_grid_and_a_known_name(certain, tmp_path, blocks):
    with pytest.raises(ArgumentError, match="color: expected class where no grid is shown"):
        render(blocks, tmp_path / "a.png", what="scan", color="votes")
    with pytest.raises(ArgumentError, match="color: expected one of"):
        render(certain, tmp_path / "a.png", color="entropy")


def test_a_scan_beside_the_grid_keeps_the_colours_of_its_classes(blocks, tmp_path):
    from helpers.readers.pixels import red_pixels

    path = render(
        Scene(blocks, frames=(0, 1)),
        tmp_path / "a.png",
        what="grid,scan",
        color="votes",
        camera=CameraOptions(view="bev"),
        style=StyleOptions(size=(600, 330), legend=False),
    ).out
    left, right = np.array_split(np.asarray(Image.open(path).convert("RGB")), 2, axis=1)
    assert red_pixels(right).any() and not red_pixels(left).any()
