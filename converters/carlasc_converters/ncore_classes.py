"""Classes of the boxes of NCore's recordings, whose names are those of the data set that a
recording was made from.
"""

from __future__ import annotations

from carlasc.core.classes import ClassTable, Color, Remap
from carlasc.core.tables import CARLA

# Name, colour, class of CARLA, and the names of NVIDIA's Physical AI data, Waymo, nuScenes and
# Argoverse 2 that belong to it.
_CLASSES: tuple[tuple[str, Color, str, str], ...] = (
    ("Unlabelled", (0, 0, 0), "Free", ""),
    ("Ground", (128, 64, 128), "Ground", ""),
    ("Background", (90, 90, 90), "Other", ""),
    (
        "Vehicle", (0, 0, 142), "Vehicle",
        "automobile car vehicle van truck bus trailer heavy_truck other_vehicle train_or_tram_car "
        "construction_vehicle emergency_vehicle articulated_bus box_truck large_vehicle "
        "message_board_trailer railed_vehicle regular_vehicle school_bus traffic_light_trailer "
        "truck_cab vehicular_trailer",
    ),
    ("Two-wheeler", (255, 61, 99), "Vehicle", "bicycle motorcycle wheeled_device"),
    ("Rider", (240, 70, 190), "Pedestrian", "rider cyclist bicyclist motorcyclist wheeled_rider"),
    ("Person", (220, 20, 60), "Pedestrian", "person pedestrian stroller wheelchair "
                                            "official_signaler"),
    ("Animal", (70, 130, 180), "Dynamic", "animal dog"),
    ("Sign", (220, 220, 0), "TrafficSign", "sign stop_sign mobile_pedestrian_crossing_sign"),
    ("Pole", (153, 153, 153), "Pole", "bollard"),
    ("Obstacle", (47, 79, 79), "Static", "barrier traffic_cone construction_cone "
                                         "construction_barrel"),
    ("Other object", (170, 120, 50), "Dynamic", "unknown protruding_object"),
)  # fmt: skip
_IDS = {name: index for index, (name, *_) in enumerate(_CLASSES)}
_BY_NAME = {name: index for index, (*_, names) in enumerate(_CLASSES) for name in names.split()}
OTHER_OBJECT = _IDS["Other object"]
"""The class of an object whose name is not known."""

NCORE = ClassTable(
    "ncore",
    {index: name for name, index in _IDS.items()},
    {index: color for index, (_, color, *_) in enumerate(_CLASSES)},
    movable=frozenset(
        _IDS[name]
        for name in ("Vehicle", "Two-wheeler", "Rider", "Person", "Animal", "Other object")
    ),
    deformable=frozenset(_IDS[name] for name in ("Rider", "Person", "Animal")),
    ground=frozenset({_IDS["Ground"]}),
    geometry_only=_IDS["Background"],
)
NCORE_TO_CARLA = Remap(
    "ncore_to_carla",
    NCORE,
    CARLA,
    {index: CARLA.id_of(target) for index, (_, _, target, _) in enumerate(_CLASSES)},
)


def class_of_name(name: str) -> int | None:
    """Return the id of the class to which the name of an object's class belongs; None if the name
    is not known.
    """
    return _BY_NAME.get(name.lower())
