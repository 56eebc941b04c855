"""The class tables of the data sets, and the remaps between them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType

import numpy as np

from carlasc.core.arrays import LabelArray
from carlasc.core.classes import BUILT_IN, ClassTable, Remap, color_of
from carlasc.core.classes import table_from_json as table_from_json  # noqa: PLC0414 (part of it)
from carlasc.core.classes import table_named as table_named  # noqa: PLC0414 (part of it)
from carlasc.core.classes import table_to_json as table_to_json  # noqa: PLC0414 (part of it)
from carlasc.errors import ArgumentError, FormatError, check_choice


def lines_of(table: str) -> list[list[str]]:
    """Return the words of each line of a table."""
    return [line.split() for line in table.strip().splitlines()]


# name, colour, 11-class id; ids in order: docs/format.md#classes
_CARLA = [
    (name, color_of(rgb), int(merged))
    for name, *rgb, merged in lines_of("""
    Free 255 255 255 0
    Building 70 70 70 1
    Fence 100 40 40 2
    Other 55 90 80 3
    Pedestrian 220 20 60 4
    Pole 153 153 153 5
    RoadLine 157 234 50 6
    Road 128 64 128 6
    Sidewalk 244 35 232 8
    Vegetation 107 142 35 9
    Vehicle 0 0 142 10
    Wall 102 102 156 2
    TrafficSign 220 220 0 5
    Sky 70 130 180 3
    Ground 81 0 81 7
    Bridge 150 100 100 3
    RailTrack 230 150 140 3
    GuardRail 180 165 180 2
    TrafficLight 250 170 30 5
    Static 110 190 160 3
    Dynamic 170 120 50 3
    Water 45 60 150 3
    Terrain 145 170 100 7
""")
]
CARLA = ClassTable(
    "carla",
    {i: name for i, (name, _, _) in enumerate(_CARLA)},
    {i: color for i, (_, color, _) in enumerate(_CARLA)},
    movable=frozenset({4, 10}),
    deformable=frozenset({4}),
    ground=frozenset({6, 7, 8, 14, 15, 16, 21, 22}),
    geometry_only=3,  # Other
    ground_only=14,  # Ground
    num_channels=25,  # as in every published params.json, although only 23 classes exist
)
_CARLASC11 = lines_of("""
    Free 245 150 100
    Building 245 230 100
    Barrier 150 60 30
    Other 180 30 80
    Pedestrian 255 80 100
    Pole 30 30 255
    Road 200 40 255
    Ground 90 30 150
    Sidewalk 255 0 255
    Vegetation 255 150 255
    Vehicles 75 0 75
""")
CARLASC11 = ClassTable(
    "carlasc11",
    {i: name for i, (name, *_) in enumerate(_CARLASC11)},
    {i: color_of(rgb) for i, (_, *rgb) in enumerate(_CARLASC11)},
    movable=frozenset({4, 10}),
    deformable=frozenset({4}),
    ground=frozenset({6, 7, 8}),
    geometry_only=3,  # Other
    ground_only=7,  # Ground
)

# raw id, name, colour, class of the benchmark (0: ignored)
_KITTI = [
    (int(raw), name, color_of(rgb), int(trained))
    for raw, name, *rgb, trained in lines_of("""
    0 unlabeled 255 255 255 0
    1 outlier 90 90 90 0
    10 car 80 130 240 1
    11 bicycle 90 215 235 2
    13 bus 60 90 200 5
    15 motorcycle 40 70 150 3
    16 on-rails 30 50 110 5
    18 truck 100 50 180 4
    20 other-vehicle 60 90 230 5
    30 person 230 40 40 6
    31 bicyclist 240 70 190 7
    32 motorcyclist 150 40 100 8
    40 road 128 64 128 9
    44 parking 240 160 240 10
    48 sidewalk 90 20 90 11
    49 other-ground 160 20 80 12
    50 building 230 190 40 13
    51 fence 240 130 60 14
    52 other-structure 220 150 30 0
    60 lane-marking 160 230 170 9
    70 vegetation 30 160 40 15
    71 trunk 130 70 30 16
    72 terrain 150 220 90 17
    80 pole 230 220 150 18
    81 traffic-sign 240 30 20 19
    99 other-object 80 220 210 0
    252 moving-car 80 130 240 1
    253 moving-bicyclist 240 70 190 7
    254 moving-person 230 40 40 6
    255 moving-motorcyclist 150 40 100 8
    256 moving-on-rails 30 50 110 5
    257 moving-bus 60 90 200 5
    258 moving-truck 100 50 180 4
    259 moving-other-vehicle 60 90 230 5
""")
]
SEMANTICKITTI = ClassTable(
    "semantickitti",
    {i: name for i, name, _, _ in _KITTI},
    {i: color for i, _, color, _ in _KITTI},
    moving=frozenset(range(252, 260)),
    movable=frozenset({10, 11, 13, 15, 16, 18, 20, 30, 31, 32, *range(252, 260)}),
    deformable=frozenset({30, 254}),
    ground=frozenset({40, 44, 48, 49, 60, 72}),
    geometry_only=99,  # other-object
    ground_only=49,  # other-ground
)
_KITTI19 = {0: "unlabeled"} | {
    k: name for i, name, _, k in _KITTI if k and i < 252 and i not in (13, 16, 60)
}
SEMANTICKITTI19 = ClassTable(
    "semantickitti19",
    dict(sorted(_KITTI19.items())),
    {0: (255, 255, 255)}
    | {k: color for i, _, color, k in _KITTI if k and i < 252 and i not in (13, 16, 60)},
    movable=frozenset(range(1, 9)),
    deformable=frozenset({6}),
    ground=frozenset({9, 10, 11, 12, 17}),
    ground_only=12,  # other-ground
)


def id_map(table: str) -> dict[int, int]:
    """Return the map of ids that a text such as "1->7 14..19->10 12,13->4" says."""
    mapping: dict[int, int] = {}
    for entry in table.split():
        left, right = entry.split("->")
        for part in left.split(","):
            first, _, last = part.partition("..")
            mapping |= dict.fromkeys(range(int(first), int(last or first) + 1), int(right))
    return mapping


_POSS_NAMES = {0: "unlabeled", 4: "person", 5: "people", 6: "rider", 7: "car", 8: "trunk"}
_POSS_NAMES |= {9: "plants", 10: "sign 1", 11: "sign 2", 12: "sign 3", 13: "pole", 14: "trashcan"}
_POSS_NAMES |= {15: "building", 16: "cone/stone", 17: "fence", 21: "bike", 22: "ground"}
_POSS_TO_CARLA = {0: 0} | id_map(
    "4..6->4 7,21->10 8,9->9 10..12->12 13->5 14->20 15->1 16->19 17->2 22->14 1..3,18..20->0"
)
SEMANTICPOSS = ClassTable(
    "semanticposs",
    {i: _POSS_NAMES.get(i, f"class {i}") for i in sorted(_POSS_TO_CARLA)},
    {i: _CARLA[_POSS_TO_CARLA[i]][1] for i in sorted(_POSS_TO_CARLA)},
    movable=frozenset({4, 5, 6, 7, 21}),
    deformable=frozenset({4, 5}),
    ground=frozenset({22}),
)


# tags of CARLA 0.9.14 and later, in order, and CarlaOcc's Rock
_TAGS = lines_of("""
    None 255 255 255
    Road 128 64 128
    Sidewalk 244 35 232
    Building 70 70 70
    Wall 102 102 156
    Fence 100 40 40
    Pole 153 153 153
    TrafficLight 250 170 30
    TrafficSign 220 220 0
    Vegetation 107 142 35
    Terrain 145 170 100
    Sky 70 130 180
    Pedestrian 220 20 60
    Rider 255 0 0
    Car 0 0 142
    Truck 0 0 70
    Bus 0 60 100
    Train 0 80 100
    Motorcycle 0 0 230
    Bicycle 119 11 32
    Static 110 190 160
    Dynamic 170 120 50
    Other 55 90 80
    Water 45 60 150
    RoadLine 157 234 50
    Ground 81 0 81
    Bridge 150 100 100
    RailTrack 230 150 140
    GuardRail 180 165 180
    Rock 180 130 70
""")


def _tags(name: str, number: int) -> ClassTable:
    return ClassTable(
        name,
        {tag: label for tag, (label, *_) in enumerate(_TAGS[:number])},
        {tag: color_of(rgb) for tag, (_, *rgb) in enumerate(_TAGS[:number])},
        movable=frozenset(range(12, 20)),
        deformable=frozenset({12}),
        ground=frozenset({1, 2, 10, 23, 24, 25, 26, 27}),
        geometry_only=22,  # Other
    )


CARLA0914 = _tags("carla0.9.14", 29)
CARLAOCC = _tags("carlaocc", 30)

# the classes of SSCBench, and their raw ids in its files
_SSCBENCH = [
    (name, int(raw))
    for name, raw in lines_of("""
    empty 0
    car 10
    bicycle 11
    motorcycle 15
    truck 18
    other-vehicle 20
    person 30
    road 40
    parking 44
    sidewalk 48
    other-ground 49
    building 50
    fence 51
    vegetation 70
    terrain 72
    pole 80
    traffic-sign 81
    other-structure 52
    other-object 99
""")
]
SSCBENCH = ClassTable(
    "sscbench",
    dict(enumerate(name for name, _ in _SSCBENCH)),
    {i: SEMANTICKITTI.colors[raw] for i, (_, raw) in enumerate(_SSCBENCH)},
    movable=frozenset(range(1, 7)),
    deformable=frozenset({6}),
    ground=frozenset({7, 8, 9, 10, 14}),
)
SSCBENCH_TO_RAW: Mapping[int, int] = MappingProxyType(
    {i: raw for i, (_, raw) in enumerate(_SSCBENCH)}
)
"""Class of SSCBench -> raw id of SemanticKITTI in its files."""

# the classes of nuScenes-lidarseg, with the colours in which papers draw them
_NUSCENES = {
    name: color_of(rgb)
    for name, *rgb in lines_of("""
    barrier 255 120 50
    bicycle 255 192 203
    bus 235 225 20
    car 0 150 245
    construction-vehicle 0 225 225
    motorcycle 255 165 0
    pedestrian 255 0 0
    traffic-cone 245 215 130
    trailer 135 60 0
    truck 160 32 240
    driveable-surface 255 0 255
    other-flat 139 137 137
    sidewalk 75 0 75
    terrain 150 240 80
    manmade 190 190 210
    vegetation 0 175 0
""")
}


def _nuscenes(name: str, first: str, names: Iterable[str], free: int) -> ClassTable:
    """Return a table of nuScenes' classes: `first` if it is not empty, then `names`; `free` is the
    id of free space.
    """
    order = [name for name in (first, *names) if name]
    if free == len(order):
        order.append("free")
    ids = {name: i for i, name in enumerate(order)}
    colors = {"others": (90, 90, 90), "empty": (255, 255, 255), "free": (255, 255, 255)}
    return ClassTable(
        name,
        dict(enumerate(order)),
        {i: (_NUSCENES | colors)[name] for name, i in ids.items()},
        movable=frozenset(
            ids[n]
            for n in lines_of(
                "bicycle bus car construction-vehicle motorcycle pedestrian trailer truck"
            )[0]
        ),
        deformable=frozenset({ids["pedestrian"]}),
        ground=frozenset(
            ids[n] for n in ("driveable-surface", "other-flat", "sidewalk", "terrain")
        ),
        free=free,
    )


OCC3D = _nuscenes("occ3d", "others", _NUSCENES, 17)
OPENOCCUPANCY = _nuscenes("openoccupancy", "empty", _NUSCENES, 0)
_OCCNET = lines_of(
    "car truck trailer bus construction-vehicle bicycle motorcycle pedestrian traffic-cone barrier "
    "driveable-surface other-flat sidewalk terrain manmade vegetation"
)[0]
OCCNET = _nuscenes("occnet", "", _OCCNET, 16)


REMAPS: Mapping[str, Remap] = MappingProxyType(
    {
        remap.name: remap
        for remap in (
            # Ids 23 and 24 exist only as vote channels; the table in the paper has no class for
            # them.
            Remap("carlasc11", CARLA, CARLASC11, {i: k for i, (_, _, k) in enumerate(_CARLA)}),
            Remap(
                "semantickitti19", SEMANTICKITTI, SEMANTICKITTI19, {i: k for i, _, _, k in _KITTI}
            ),
            Remap(
                "semantickitti_to_carla",
                SEMANTICKITTI,
                CARLA,
                id_map(
                    "10,11,13,15,16,18,20,252,256..259->10 30..32,253..255->4 40->7 60->6 "
                    "44,49->14 48->8 50->1 51->2 52->19 70,71->9 72->22 80->5 81->12 99->3 0,1->0"
                ),
            ),
            Remap(
                "carla_to_semantickitti",
                CARLA,
                SEMANTICKITTI,
                id_map(
                    "0->0 1->50 2->51 3->99 4->30 5->80 6->60 7->40 8->48 9->70 10->10 11->52 "
                    "12->81 13->0 14->49 15->52 16->49 17->51 18->80 19->52 20->99 21->0 22->72"
                ),
            ),
            Remap("semanticposs_to_carla", SEMANTICPOSS, CARLA, _POSS_TO_CARLA),
            # tags of CARLA 0.9.14 and later; those of earlier versions are the ids of the table
            # CARLA above
            Remap(
                "carla0914_to_carla",
                CARLA0914,
                CARLA,
                id_map(
                    "0->0 1->7 2->8 3->1 4->11 5->2 6->5 7->18 8->12 9->9 10->22 11->13 12,13->4 "
                    "14..19->10 20->19 21->20 22->3 23->21 24->6 25->14 26->15 27->16 28->17"
                ),
            ),
        )
    }
)
BUILT_IN.update(
    (table.name, table)
    for table in (
        CARLA, CARLASC11, SEMANTICKITTI, SEMANTICKITTI19, SEMANTICPOSS, CARLA0914, CARLAOCC,
        SSCBENCH, OCC3D, OPENOCCUPANCY, OCCNET,
    )
)  # fmt: skip
TABLES: Mapping[str, ClassTable] = MappingProxyType(BUILT_IN)

TRAIN_VOXEL_COUNTS = np.array(
    [
        4166593275, 42309744, 8550180, 478193, 905663, 2801091, 6452733, 229316930, 112863867,
        29816894, 13839655, 15581458, 221821, 0, 7931550, 467989, 3354, 9201043, 61011, 3796746,
        3217865, 215372, 79669695,
    ],
    np.int64,
)  # fmt: skip
"""(23,) number of voxels of each CARLA class in the training split, in the coarse Cartesian grid.
"""


def classes_from(value: object, where: str) -> tuple[ClassTable, Remap | None]:
    """Return the class table of a file of classes, and its map from the ids of another table.

    Args:
        value: as for `table_from_json`, also with the keys `map` (ids of this table by ids of the
            other one: a mapping, or a text such as "1->7 14..19->10") and `from` (name of the
            other table; without it, carla).
        where: the file, for errors.

    Returns:
        The table, and the remap to it; None without `map`.

    Raises:
        FormatError: the values are not valid.
    """
    if not isinstance(value, Mapping) or not {"map", "from"} & value.keys():
        return table_from_json(value, where), None
    values = dict(value)
    mapping = values.pop("map", {})
    source = table_from_json(values.pop("from", CARLA.name), where)
    table = table_from_json(values, where)
    try:
        ids = id_map(mapping) if isinstance(mapping, str) else mapping
        return table, Remap(table.name, source, table, {int(i): int(new) for i, new in ids.items()})
    except ArgumentError as error:
        raise FormatError(f"{where}: map", expected=error.expected, found=error.found) from error
    except (TypeError, ValueError, AttributeError) as error:
        raise FormatError(
            f"{where}: map",
            expected='ids by ids, or a text such as "1->7 14..19->10"',
            found=error,
        ) from error


def remap_named(name: str) -> Remap:
    """Return the remap with a name in `REMAPS`.

    Raises:
        ArgumentError: no remap has this name.
    """
    check_choice("remap", name, REMAPS)
    return REMAPS[name]


def benchmark_remap(classes: ClassTable) -> Remap | None:
    """Return the remap to the classes that are usually used for training and scores: carlasc11,
    semantickitti19, or None for other tables.
    """
    return next(
        (
            r
            for r in REMAPS.values()
            if r.source == classes and r.name in ("carlasc11", "semantickitti19")
        ),
        None,
    )


def remaps_between(source: ClassTable, target: ClassTable) -> tuple[Remap, ...]:
    """Return the remaps that convert ids of one table to another, in order: none, one, or two with
    the table CARLA in between.

    Raises:
        ArgumentError: no such remaps exist.
    """

    def direct(one: ClassTable, other: ClassTable) -> Remap | None:
        return next((r for r in REMAPS.values() if r.source == one and r.target == other), None)

    if source == target:
        return ()
    if (remap := direct(source, target)) is not None:
        return (remap,)
    first = direct(source, CARLA)
    second = direct(CARLA, target)
    if first is None or second is None:
        ways = sorted(
            {r.target.name for r in REMAPS.values() if r.source == source} | {source.name}
        )
        raise ArgumentError(
            "classes",
            expected=f"one of {', '.join(ways)} for labels of {source.name}",
            found=target.name,
        )
    return first, second


def to_table(labels: LabelArray, source: ClassTable, target: ClassTable, where: str) -> LabelArray:
    """Convert labels of one table to ids of another.

    Args:
        labels: ids of `source`, any shape.
        source: class table of the labels.
        target: class table of the result.
        where: the file or field named in errors.

    Raises:
        ArgumentError: no remaps convert `source` to `target`.
        FormatError: a label is not an id of `source`.
    """
    for remap in remaps_between(source, target):
        labels = remap(labels, where)
    return labels
