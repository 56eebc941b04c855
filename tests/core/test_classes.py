import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from carlasc.core.classes import ClassTable, Remap, class_weights
from carlasc.core.tables import (
    CARLA,
    CARLASC11,
    REMAPS,
    SEMANTICKITTI,
    SEMANTICKITTI19,
    TABLES,
    TRAIN_VOXEL_COUNTS,
    remap_named,
    table_named,
)
from carlasc.errors import ArgumentError, FormatError


def test_the_tables_are_those_of_the_format():
    assert CARLA.num_channels == 25
    assert [CARLA.names[i] for i in (0, 4, 6, 7, 10, 22)] == [
        "Free",
        "Pedestrian",
        "RoadLine",
        "Road",
        "Vehicle",
        "Terrain",
    ]
    assert CARLA.dtype == np.uint8
    assert SEMANTICKITTI.dtype == np.uint16  # moving classes go over 255
    assert len(SEMANTICKITTI19.names) == 20
    assert len(CARLASC11.names) == 11
    assert SEMANTICKITTI.moving == set(range(252, 260))


def test_the_golden_remap_is_ours(golden):
    with np.load(golden / "loader.npz") as loader:
        table = loader["remap"]
    remap = REMAPS["carlasc11"]
    assert {i: int(table[i]) for i in range(23)} == dict(remap.mapping)


@pytest.mark.parametrize("name", sorted(REMAPS))
def test_a_remap_takes_every_id_and_leaves_its_input(name):
    remap = REMAPS[name]
    ids = np.array(sorted(remap.mapping), np.uint32)
    before = ids.copy()
    mapped = remap(ids)
    assert mapped.tolist() == [remap.mapping[int(i)] for i in ids]
    assert mapped.dtype == remap.target.dtype
    assert (ids == before).all()


@given(st.lists(st.integers(0, 300), min_size=1))
def test_remapping_refuses_just_the_ids_it_does_not_know(ids):
    remap = REMAPS["semantickitti19"]
    labels = np.array(ids, np.uint32)
    unknown = {i: ids.count(i) for i in set(ids) if i not in remap.mapping}
    assert remap.unknown(labels) == unknown
    if unknown:
        with pytest.raises(FormatError) as caught:
            remap(labels, "000000.label")
        assert all(f"{i} ({n} times)" in str(caught.value) for i, n in unknown.items())
    else:
        assert remap(labels).tolist() == [remap.mapping[i] for i in ids]


def test_kitti_goes_to_carla_and_back_where_the_format_says_so():
    there, back = REMAPS["semantickitti_to_carla"], REMAPS["carla_to_semantickitti"]
    assert there(np.array([10, 252, 31, 60, 44, 71, 99], np.uint16)).tolist() == [10, 10, 4, 6, 14, 9, 3]
    assert back(np.array([1, 6, 7, 10, 22], np.uint8)).tolist() == [50, 60, 40, 10, 72]


def test_carla_0914_tags_become_ours():
    assert REMAPS["carla0914_to_carla"](np.array([1, 3, 12, 14, 19, 28], np.uint32)).tolist() == [7, 1, 4, 10, 10, 17]


def test_ids_beyond_the_vote_channels_are_named():
    CARLA.check(np.array([0, 24], np.uint32), "a.label")
    with pytest.raises(FormatError, match=r"a.label: expected class ids 0..24 \(table carla\), found 30 on 2 of 3"):
        CARLA.check(np.array([0, 30, 30], np.uint32), "a.label")


def test_weights_follow_the_published_rule():
    weights = class_weights(TRAIN_VOXEL_COUNTS, REMAPS["carlasc11"])
    assert weights.shape == (11,)
    assert weights[0] == pytest.approx(1 / np.log(4166593275 + 0.001))
    assert weights[6] == pytest.approx(1 / np.log(6452733 + 229316930 + 0.001))
    rare = class_weights(np.array([10**6, 5, 0, 2000]))
    assert rare[1] == rare[3] == pytest.approx(1 / np.log(2000.001))
    assert rare[2] == 0


def test_names_that_do_not_exist_are_answered_with_those_that_do():
    with pytest.raises(ArgumentError, match="expected one of .*carlasc11"):
        remap_named("x")
    with pytest.raises(FormatError, match="expected one of carla"):
        table_named("x")
    with pytest.raises(ArgumentError, match="Vehicle"):
        CARLA.id_of("Spaceship")
    assert CARLA.id_of("vehicle") == 10


def test_a_table_must_colour_what_it_names():
    with pytest.raises(ArgumentError, match="different ids"):
        ClassTable("t", {0: "a"}, {})
    with pytest.raises(ArgumentError, match="3 -> 99"):
        Remap("r", CARLA, CARLASC11, {3: 99})


def test_palettes_have_a_colour_for_every_channel():
    for table in TABLES.values():
        assert table.palette.shape == (table.num_channels, 3)
        assert tuple(table.palette[max(table.names)]) == tuple(table.colors[max(table.names)])
