import numpy as np
import pytest

from carlasc.core.classes import ClassTable
from carlasc.core.tables import CARLA, CARLASC11, SEMANTICKITTI, TABLES
from carlasc.errors import ArgumentError
from carlasc.viewing.colors import (
    AFTER_CLASSES,
    ERRORS,
    ClassColors,
    Entry,
    colorblind_palette,
    height_colors,
    height_entries,
    merge_legends,
)

# What is left of linear RGB under full blindness (Machado, Oliveira and Fernandes 2009)
SIGHT = {
    "normal": np.eye(3),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.01182, 0.04294, 0.968881],
        ]
    ),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
}
TO_XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.072175],
        [0.0193339, 0.119192, 0.9503041],
    ]
)


def least_difference(colors, sight):
    """Least distance in CIE L*a*b* between any two colours, (N, 3) uint8, as someone sees them."""
    values = colors / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    xyz = np.clip(linear @ SIGHT[sight].T, 0, 1) @ TO_XYZ.T / (0.95047, 1.0, 1.08883)
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    lab = np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], 1)
    distances = np.linalg.norm(lab[:, None] - lab[None], axis=-1)
    return distances[~np.eye(len(lab), dtype=bool)].min()


@pytest.mark.parametrize("sight", SIGHT)
def test_colour_blind_readers_can_distinguish_the_eleven_classes(sight):
    assert least_difference(colorblind_palette(CARLASC11)[1:], sight) > 29


def test_the_papers_own_colours_are_hard_to_distinguish():
    assert least_difference(CARLASC11.palette[1:], "protanopia") < 10


def test_a_class_alone_in_its_group_or_named_like_it_has_the_groups_colour():
    eleven, carla = colorblind_palette(CARLASC11), colorblind_palette(CARLA)
    for name, group in (
        ("Road", "Road"),
        ("Vehicle", "Vehicles"),
        ("Pole", "Pole"),
        ("Vegetation", "Vegetation"),
    ):
        np.testing.assert_array_equal(carla[CARLA.id_of(name)], eleven[CARLASC11.id_of(group)])
    kitti = colorblind_palette(SEMANTICKITTI)
    np.testing.assert_array_equal(kitti[40], eleven[CARLASC11.id_of("Road")])


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_every_table_has_a_palette_without_two_classes_alike(table):
    palette = colorblind_palette(table)
    assert palette.shape == (table.num_channels, 3)
    used = [tuple(palette[i]) for i in table.names if i]
    assert len(set(used)) == len(used)
    assert (255, 255, 255) not in used


def test_an_unknown_table_gets_a_palette_too():
    table = ClassTable(
        "mine", {i: f"thing {i}" for i in range(15)}, dict.fromkeys(range(15), (1, 2, 3))
    )
    palette = colorblind_palette(table)
    assert len(np.unique(palette[1:], axis=0)) == 14


def test_the_legend_names_the_classes_present_by_id_without_free():
    entries = ClassColors(CARLA).entries([10, 0, 4])
    assert entries == [Entry("Pedestrian", (220, 20, 60), 4), Entry("Vehicle", (0, 0, 142), 10)]
    assert ClassColors(CARLA).entries([24])[0].name == "class 24"


def test_legends_are_merged_in_order_each_entry_once():
    one = [Entry("b", (1, 1, 1), 7), Entry("arrow", (0, 0, 0), AFTER_CLASSES)]
    two = [Entry("standing", (9, 9, 9), -1), Entry("a", (2, 2, 2), 3), Entry("b", (1, 1, 1), 7)]
    assert [entry.name for entry in merge_legends([one, two])] == ["standing", "a", "b", "arrow"]


def test_higher_is_lighter():
    ramp = height_colors(np.linspace(-2, 1, 50), -2.0, 1.0).astype(float) @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(ramp) > 0).all()


def test_an_unknown_palette_is_refused():
    with pytest.raises(ArgumentError, match="palette: .* found 'rainbow'"):
        ClassColors(CARLA, "rainbow")


def test_errors_have_their_names_and_colours():
    assert [(entry.name, entry.color) for entry in ClassColors(ERRORS).entries([1, 2, 3, 4])] == [
        ("right class", (205, 209, 214)),
        ("wrong class", (213, 70, 0)),
        ("missed: predicted free", (16, 90, 190)),
        ("invented: free in truth", (240, 200, 40)),
    ]


def test_the_legend_of_heights_goes_from_the_lowest_to_the_highest_before_all_classes():
    entries = height_entries(-2.0, 2.0)
    assert [entry.name for entry in entries] == ["-2.0 m", "-1.0 m", "+0.0 m", "+1.0 m", "+2.0 m"]
    assert [entry.color for entry in entries] == [
        tuple(c) for c in height_colors(np.arange(-2, 3), -2.0, 2.0).tolist()
    ]
    assert merge_legends([ClassColors(CARLA).entries([1]), entries])[:5] == entries


def test_shades_of_a_dark_group_are_lighter_and_of_a_light_group_darker():
    palette = colorblind_palette(CARLA).astype(int)
    fence, wall, guard_rail = (
        palette[CARLA.id_of(name)] for name in ("Fence", "Wall", "GuardRail")
    )
    assert (fence <= wall).all() and (wall <= guard_rail).all() and fence.sum() < wall.sum()
    pole, sign, light = (
        palette[CARLA.id_of(name)] for name in ("Pole", "TrafficSign", "TrafficLight")
    )
    assert (pole >= sign).all() and (sign >= light).all() and pole.sum() > sign.sum()
