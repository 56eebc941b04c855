"""The classes of other benchmarks, and maps to and from them: Occ3D-nuScenes, OpenOccupancy,
SSCBench and CarlaOcc, for scores and exports.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from carlasc.core.classes import ClassTable, Remap, color_of
from carlasc.core.tables import (
    CARLA,
    SEMANTICKITTI,
    SEMANTICKITTI19,
    id_map,
    lines_of,
    remap_named,
)

IGNORED = -1
"""Target of classes that a benchmark ignores: voxels of such a class are not scored."""


def _table(name: str, names: str, free: int) -> ClassTable:
    words = names.split()
    grey = {
        i: (110 + 13 * i % 120, 90 + 29 * i % 130, 80 + 47 * i % 140) for i in range(len(words))
    }
    return ClassTable(name, dict(enumerate(words)), grey | {free: (255, 255, 255)})


SSCBENCH = _table(
    "sscbench",
    "empty car bicycle motorcycle truck other-vehicle person road parking sidewalk other-ground "
    "building fence vegetation terrain pole traffic-sign other-structure other-object",
    0,
)
_NUSCENES = (
    "barrier bicycle bus car construction-vehicle motorcycle pedestrian traffic-cone trailer truck "
    "driveable-surface other-flat sidewalk terrain manmade vegetation"
)
OCC3D = _table("occ3d", f"others {_NUSCENES} free", 17)
OPENOCCUPANCY = _table("openoccupancy", f"empty {_NUSCENES}", 0)

Maps = Mapping[str, Mapping[int, int]]
"""Name of a class table -> id -> id of a benchmark's class, or IGNORED."""

# The maps of CARLA are as in the published map of CarlaOcc. The 23 old tags have one class Vehicle,
# mapped to car. The 11 classes of the paper merge others: Barrier has fences, walls and guard
# rails; Pole has signs and lights; Ground includes terrain. For SemanticKITTI, SSCBench has its own
# table; Occ3D follows CarlaOcc: riders are people, signs are others, outliers are noise.
_TO_OCC3D = {
    "carla": id_map(
        "0,13->17 1,5,11,15->15 2,17->1 3,12,18..20->0 4->7 6,7->11 8->13 9->16 10->4 "
        "14,22->14 16,21->12"
    ),
    "carlasc11": id_map("0->17 1,5->15 2->1 3->0 4->7 6->11 7->14 8->13 9->16 10->4"),
    "semantickitti": id_map(
        "0->17 1->-1 10,252->4 11->2 13,257->3 15->6 16,256->9 18,258->10 20,81,99,259->0 "
        "30..32,253..255->7 40,44,60->11 48->13 49->12 50,52,80->15 51->1 70,71->16 72->14"
    ),
}
_TO_SSCBENCH = {
    "carla": id_map(
        "0,13->0 1->11 2,17->12 3,19,20->18 4->6 5->15 6,7->7 8->9 9->13 10->1 11,15->17 "
        "12,18->16 14,16,21->10 22->14"
    ),
    "carlasc11": id_map("0->0 1->11 2->12 3->18 4->6 5->15 6->7 7->14 8->9 9->13 10->1"),
    "semantickitti": id_map(
        "0->0 1,31,32,71,253,255->-1 10,252->1 11->2 13,16,20,256,257,259->5 15->3 "
        "18,258->4 30,254->6 40,60->7 44->8 48->9 49->10 50->11 51->12 52->17 70->13 72->14 "
        "80->15 81->16 99->18"
    ),
}


def _published(maps: dict[str, dict[int, int]], benchmark: ClassTable) -> Maps:
    """Return maps, with those of the 19 classes of SemanticKITTI and of the benchmark itself."""
    raw = maps["semantickitti"]
    trained = {i: raw[SEMANTICKITTI.id_of(name)] for i, name in SEMANTICKITTI19.names.items()}
    own = {i: i for i in benchmark.names}
    maps = maps | {"semantickitti19": trained, benchmark.name: own}
    return MappingProxyType({name: dict(sorted(ids.items())) for name, ids in maps.items()})


TO_OCC3D = _published(_TO_OCC3D, OCC3D)
TO_SSCBENCH = _published(_TO_SSCBENCH, SSCBENCH)
OCC3D_TO_OPENOCCUPANCY: Mapping[int, int] = MappingProxyType(
    {0: IGNORED, 17: 0} | {i: i for i in range(1, 17)}
)
"""Class of Occ3D -> class of OpenOccupancy, where "others" are noise."""

SSCBENCH_TO_RAW: Mapping[int, int] = MappingProxyType(
    dict(enumerate((0, 10, 11, 15, 18, 20, 30, 40, 44, 48, 49, 50, 51, 70, 72, 80, 81, 52, 99)))
)
"""Class of SSCBench -> raw id of SemanticKITTI in its files."""

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
CARLAOCC = ClassTable(
    "carlaocc",
    {tag: name for tag, (name, *_) in enumerate(_TAGS)},
    {tag: color_of(rgb) for tag, (_, *rgb) in enumerate(_TAGS)},
    movable=frozenset(range(12, 20)),
    deformable=frozenset({12}),
    ground=frozenset({1, 2, 10, 23, 24, 25, 26, 27}),
    geometry_only=22,  # Other
)
CARLAOCC_TO_CARLA = Remap(
    "carlaocc_to_carla",
    CARLAOCC,
    CARLA,
    {**remap_named("carla0914_to_carla").mapping, 29: CARLA.id_of("Terrain")},
)
