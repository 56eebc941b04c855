"""Maps to and from the classes of other benchmarks: Occ3D-nuScenes, OpenOccupancy, SSCBench and
CarlaOcc, for scores and exports.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from carlasc.core.classes import ClassTable, Remap
from carlasc.core.tables import (
    CARLA,
    CARLA0914,
    CARLAOCC,
    OCC3D,
    SEMANTICKITTI,
    SEMANTICKITTI19,
    SSCBENCH,
    id_map,
    remap_named,
)

IGNORED = -1
"""Target of classes that a benchmark ignores: voxels of such a class are not scored."""


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
    "carla0.9.14": id_map(
        "0,11->17 1,24->11 2->13 3,4,6,26->15 5,28->1 7,8,20..22->0 9->16 10,25->14 12,13->7 "
        "14->4 15->10 16->3 17->9 18->6 19->2 23,27->12"
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
    "carla0.9.14": id_map(
        "0,11->0 1,24->7 2->9 3->11 4,26->17 5,28->12 6->15 7,8->16 9->13 10->14 12,13->6 14->1 "
        "15->4 16,17->5 18->3 19->2 20..22->18 23,25,27->10"
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
    rock = {CARLAOCC.id_of("Rock"): benchmark.id_of("terrain")}
    maps = maps | {"semantickitti19": trained, benchmark.name: own}
    maps[CARLAOCC.name] = maps[CARLA0914.name] | rock
    return MappingProxyType({name: dict(sorted(ids.items())) for name, ids in maps.items()})


TO_OCC3D = _published(_TO_OCC3D, OCC3D)
TO_SSCBENCH = _published(_TO_SSCBENCH, SSCBENCH)
OCC3D_TO_OPENOCCUPANCY: Mapping[int, int] = MappingProxyType(
    {0: IGNORED, 17: 0} | {i: i for i in range(1, 17)}
)
"""Class of Occ3D -> class of OpenOccupancy, where "others" are noise."""

CARLAOCC_TO_CARLA = Remap(
    "carlaocc_to_carla",
    CARLAOCC,
    CARLA,
    {**remap_named("carla0914_to_carla").mapping, 29: CARLA.id_of("Terrain")},
)
