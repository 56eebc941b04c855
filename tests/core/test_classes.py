import json

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
    table_from_json,
    table_named,
    table_to_json,
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
        # the whole list: the message leaves out the middle of a long one
        found = caught.value.found.split(", ")
        assert found == [f"{i} ({n} times)" for i, n in sorted(unknown.items())]
    else:
        assert remap(labels).tolist() == [remap.mapping[i] for i in ids]


def test_kitti_goes_to_carla_and_back_where_the_format_says_so():
    there, back = REMAPS["semantickitti_to_carla"], REMAPS["carla_to_semantickitti"]
    assert there(np.array([10, 252, 31, 60, 44, 71, 99], np.uint16)).tolist() == [
        10,
        10,
        4,
        6,
        14,
        9,
        3,
    ]
    assert back(np.array([1, 6, 7, 10, 22], np.uint8)).tolist() == [50, 60, 40, 10, 72]


def test_carla_0914_tags_become_ours():
    assert REMAPS["carla0914_to_carla"](np.array([1, 3, 12, 14, 19, 28], np.uint32)).tolist() == [
        7,
        1,
        4,
        10,
        10,
        17,
    ]


def test_ids_that_are_no_class_are_named():
    CARLA.check(np.array([0, 22], np.uint32), "a.label")
    with pytest.raises(FormatError) as error:
        CARLA.check(np.array([0, 30, 30, 24], np.uint32), "a.label")
    assert error.value.where == "a.label"
    assert error.value.found == "24 (1 times), 30 (2 times) of 4 labels"


@pytest.mark.parametrize(
    ("table", "ids", "proposed"),
    [
        (CARLA, [7, 24], "carla0.9.14"),  # vote channels of the format, but no classes of it
        (SEMANTICKITTI, [0, 3, 19], "semantickitti19"),
        (CARLA, [0, 29], "carlaocc"),
        (SEMANTICKITTI, [0, 17, 200], None),
    ],
)
def test_ids_without_a_class_are_refused_with_a_table_that_has_them(table, ids, proposed):
    with pytest.raises(FormatError) as error:
        table.check(np.array(ids, np.uint16), "a.label")
    assert (f'"classes": "{proposed}"' in error.value.advice) == (proposed is not None)


def test_a_table_whose_free_id_is_another_is_read_with_free_first():
    first = TABLES["occnet"].with_free_first
    assert (first.names[0], first.names[16], first.free) == ("free", "car", 0)
    assert 16 in first.movable and 0 not in first.movable
    assert CARLA.with_free_first is CARLA


def test_weights_follow_the_published_rule():
    weights = class_weights(TRAIN_VOXEL_COUNTS, REMAPS["carlasc11"])
    assert weights.shape == (11,)
    assert weights[0] == pytest.approx(1 / np.log(4166593275 + 0.001))
    assert weights[6] == pytest.approx(1 / np.log(6452733 + 229316930 + 0.001))
    rare = class_weights(np.array([10**6, 5, 0, 2000]))
    assert rare[1] == rare[3] == pytest.approx(1 / np.log(2000.001))
    assert rare[2] == 0


def test_names_that_do_not_exist_are_answered_with_those_that_do():
    for kind, ask, name, known in (
        (ArgumentError, remap_named, "x", "carlasc11"),
        (FormatError, table_named, "x", "carla"),
        (ArgumentError, CARLA.id_of, "Spaceship", "Vehicle"),
    ):
        with pytest.raises(kind) as error:
            ask(name)
        assert known in error.value.expected and name in str(error.value)
    assert CARLA.id_of("vehicle") == 10


def test_a_table_must_colour_what_it_names():
    with pytest.raises(ArgumentError) as error:
        ClassTable("t", {0: "a"}, {})
    assert error.value.where == "class table t" and error.value.found.endswith(" 0")
    with pytest.raises(ArgumentError) as error:
        Remap("r", CARLA, CARLASC11, {3: 99})
    assert "3 -> 99" in error.value.found


@pytest.mark.parametrize(
    ("values", "expected", "found"),
    [
        ({"names": {-1: "a"}, "colors": {-1: (0, 0, 0)}}, "0..65535", "-1"),
        ({"names": {70000: "a"}, "colors": {70000: (0, 0, 0)}}, "0..65535", "70000"),
        ({"colors": {0: (0, 0, 256)}}, "0..255", "(0, 0, 256) for 0"),
        ({"ground": frozenset({1})}, "ground", "1"),
        ({"moving": frozenset({2})}, "moving", "2"),
        ({"geometry_only": 1}, "geometry_only", "1"),
        ({"names": {3: "a"}, "colors": {3: (0, 0, 0)}, "num_channels": 3}, "above 3", "3"),
    ],
)
def test_a_table_that_contradicts_itself_is_refused(values, expected, found):
    with pytest.raises(ArgumentError) as error:
        ClassTable(**{"name": "t", "names": {0: "a"}, "colors": {0: (0, 0, 0)}} | values)
    assert error.value.where == "class table t"
    assert expected in error.value.expected and found in error.value.found


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_tables_come_back_from_json(table):
    assert ClassTable.from_dict(json.loads(json.dumps(table.to_dict())), "a.json") == table
    assert (
        table_from_json(table.to_dict(), "a.json")
        is table_from_json(table_to_json(table), "a.json")
        is table
    )


LAB = {
    "name": "lab",
    "names": {"0": "none", "7": "floor"},
    "colors": {"0": [0, 0, 0], "7": [1, 2, 3]},
    "ground": [7],
}


def test_a_table_of_ones_own_is_kept_whole():
    table = table_from_json(LAB, "a.json")
    assert table == ClassTable(
        "lab", {0: "none", 7: "floor"}, {0: (0, 0, 0), 7: (1, 2, 3)}, ground=frozenset({7})
    )
    assert (table.num_channels, table.geometry_id) == (8, 7)
    assert table_to_json(table) == LAB | {"num_channels": 8}


@pytest.mark.parametrize(
    ("change", "where", "found"),
    [
        ({"names": None}, "classes", ""),
        ({"colors": {"0": [0, 0, 0]}}, "class table lab", "7"),
        ({"colors": {"0": [0, 0], "7": [0, 0, 0]}}, "classes", ""),
        ({"movable": [9]}, "class table lab", "9"),
        ({"moveable": [7]}, "classes", "moveable"),
        ({"name": "carla"}, "classes", "carla"),
    ],
)
def test_a_damaged_table_in_a_file_is_named(change, where, found):
    with pytest.raises(FormatError) as error:
        table_from_json(LAB | change, "a.json")
    assert error.value.where == f"a.json: {where}" and found in error.value.found
    with pytest.raises(FormatError) as error:
        table_from_json({"name": "lab"}, "a.json")
    assert error.value.where == "a.json: classes" and "names" in error.value.expected


def test_ground_and_actors_have_roles_in_every_table():
    for table in TABLES.values():
        assert table.ground and table.movable and 0 not in table.ground
        assert not table.ground & table.movable
        assert table.deformable <= table.movable and table.moving <= table.movable
    assert [CARLA.names[i] for i in sorted(CARLA.ground)] == (
        ["RoadLine", "Road", "Sidewalk", "Ground", "Bridge", "RailTrack", "Water", "Terrain"]
    )
    assert (CARLA.names[CARLA.geometry_id], SEMANTICKITTI.names[SEMANTICKITTI.geometry_id]) == (
        "Other",
        "other-object",
    )


def test_palettes_have_a_colour_for_every_channel():
    for table in TABLES.values():
        assert table.palette.shape == (table.num_channels, 3)
        assert tuple(table.palette[max(table.names)]) == tuple(table.colors[max(table.names)])
