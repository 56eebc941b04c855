"""The classes of other benchmarks, and maps to and from them: Occ3D-nuScenes, OpenOccupancy,
SSCBench and CarlaOcc, for scores and exports.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from carlasc.core.classes import ClassTable, Color, Remap
from carlasc.core.tables import CARLA, SEMANTICKITTI, SEMANTICKITTI19, remap_named

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

# CARLA class -> (Occ3D, SSCBench), as in the published map of CarlaOcc. The 23 old tags have one
# class Vehicle, mapped to car.
_CARLA = {
    0: (17, 0), 1: (15, 11), 2: (1, 12), 3: (0, 18), 4: (7, 6), 5: (15, 15), 6: (11, 7), 7: (11, 7), 8: (13, 9), 9: (16, 13), 10: (4, 1),
    11: (15, 17), 12: (0, 16), 13: (17, 0), 14: (14, 10), 15: (15, 17), 16: (12, 10), 17: (1, 12), 18: (0, 16), 19: (0, 18), 20: (0, 18),
    21: (12, 10), 22: (14, 14),
}  # fmt: skip
# The 11 classes of the paper merge others: Barrier has fences, walls and guard rails; Pole has
# signs and lights; Ground includes terrain.
_CARLASC11 = {
    0: (17, 0), 1: (15, 11), 2: (1, 12), 3: (0, 18), 4: (7, 6), 5: (15, 15), 6: (11, 7), 7: (14, 14), 8: (13, 9), 9: (16, 13), 10: (4, 1),
}  # fmt: skip
# The column of SSCBench is its own table. The column of Occ3D follows CarlaOcc: riders are people,
# signs are others, outliers are noise.
_SEMANTICKITTI = {
    0: (17, 0), 1: (IGNORED, IGNORED), 10: (4, 1), 11: (2, 2), 13: (3, 5), 15: (6, 3), 16: (9, 5), 18: (10, 4), 20: (0, 5), 30: (7, 6),
    31: (7, IGNORED), 32: (7, IGNORED), 40: (11, 7), 44: (11, 8), 48: (13, 9), 49: (12, 10), 50: (15, 11), 51: (1, 12), 52: (15, 17),
    60: (11, 7), 70: (16, 13), 71: (16, IGNORED), 72: (14, 14), 80: (15, 15), 81: (0, 16), 99: (0, 18), 252: (4, 1), 253: (7, IGNORED),
    254: (7, 6), 255: (7, IGNORED), 256: (9, 5), 257: (3, 5), 258: (10, 4), 259: (0, 5),
}  # fmt: skip
_SEMANTICKITTI19 = {
    i: _SEMANTICKITTI[SEMANTICKITTI.id_of(name)] for i, name in SEMANTICKITTI19.names.items()
}
_MAPS = {
    "carla": _CARLA,
    "carlasc11": _CARLASC11,
    "semantickitti": _SEMANTICKITTI,
    "semantickitti19": _SEMANTICKITTI19,
}

Maps = Mapping[str, Mapping[int, int]]
"""Name of a class table -> id -> id of a benchmark's class, or IGNORED."""

TO_OCC3D: Maps = MappingProxyType(
    {name: {i: occ3d for i, (occ3d, _) in table.items()} for name, table in _MAPS.items()}
    | {"occ3d": {i: i for i in OCC3D.names}}
)
TO_SSCBENCH: Maps = MappingProxyType(
    {name: {i: sscbench for i, (_, sscbench) in table.items()} for name, table in _MAPS.items()}
    | {"sscbench": {i: i for i in SSCBENCH.names}}
)
OCC3D_TO_OPENOCCUPANCY: Mapping[int, int] = MappingProxyType(
    {0: IGNORED, 17: 0} | {i: i for i in range(1, 17)}
)
"""Class of Occ3D -> class of OpenOccupancy, where "others" are noise."""

SSCBENCH_TO_RAW: Mapping[int, int] = MappingProxyType(
    dict(enumerate((0, 10, 11, 15, 18, 20, 30, 40, 44, 48, 49, 50, 51, 70, 72, 80, 81, 52, 99)))
)
"""Class of SSCBench -> raw id of SemanticKITTI in its files."""

# tags of CARLA 0.9.14 and later, in order, and CarlaOcc's Rock
_TAGS: tuple[tuple[str, Color], ...] = (
    ("None", (255, 255, 255)), ("Road", (128, 64, 128)), ("Sidewalk", (244, 35, 232)), ("Building", (70, 70, 70)),
    ("Wall", (102, 102, 156)), ("Fence", (100, 40, 40)), ("Pole", (153, 153, 153)), ("TrafficLight", (250, 170, 30)),
    ("TrafficSign", (220, 220, 0)), ("Vegetation", (107, 142, 35)), ("Terrain", (145, 170, 100)), ("Sky", (70, 130, 180)),
    ("Pedestrian", (220, 20, 60)), ("Rider", (255, 0, 0)), ("Car", (0, 0, 142)), ("Truck", (0, 0, 70)), ("Bus", (0, 60, 100)),
    ("Train", (0, 80, 100)), ("Motorcycle", (0, 0, 230)), ("Bicycle", (119, 11, 32)), ("Static", (110, 190, 160)),
    ("Dynamic", (170, 120, 50)), ("Other", (55, 90, 80)), ("Water", (45, 60, 150)), ("RoadLine", (157, 234, 50)),
    ("Ground", (81, 0, 81)), ("Bridge", (150, 100, 100)), ("RailTrack", (230, 150, 140)), ("GuardRail", (180, 165, 180)),
    ("Rock", (180, 130, 70)),
)  # fmt: skip
CARLAOCC = ClassTable(
    "carlaocc",
    {tag: name for tag, (name, _) in enumerate(_TAGS)},
    {tag: color for tag, (_, color) in enumerate(_TAGS)},
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
