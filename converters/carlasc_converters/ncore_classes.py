"""Classes of the boxes of NCore's recordings, whose names are those of the data set that a
recording was made from.
"""

from __future__ import annotations

from carlasc_converters.class_rows import class_rows, tables_of

# name, colour, class of CARLA; ids in order
_CLASSES = class_rows("""
    Unlabelled 0 0 0 Free
    Ground 128 64 128 Ground
    Background 90 90 90 Other
    Vehicle 0 0 142 Vehicle
    Two-wheeler 255 61 99 Vehicle
    Rider 240 70 190 Pedestrian
    Person 220 20 60 Pedestrian
    Animal 70 130 180 Dynamic
    Sign 220 220 0 TrafficSign
    Pole 153 153 153 Pole
    Obstacle 47 79 79 Static
    Other object 170 120 50 Dynamic
""")
_IDS = {name: index for index, (name, _, _) in enumerate(_CLASSES)}
# The names of NVIDIA's Physical AI data, Waymo, nuScenes and Argoverse 2 that belong to each.
_MEMBERS = {
    "Vehicle": (
        "automobile car vehicle van truck bus trailer heavy_truck other_vehicle "
        "train_or_tram_car construction_vehicle emergency_vehicle articulated_bus "
        "box_truck large_vehicle message_board_trailer railed_vehicle regular_vehicle "
        "school_bus traffic_light_trailer truck_cab vehicular_trailer"
    ),
    "Two-wheeler": "bicycle motorcycle wheeled_device",
    "Rider": "rider cyclist bicyclist motorcyclist wheeled_rider",
    "Person": "person pedestrian stroller wheelchair official_signaler",
    "Animal": "animal dog",
    "Sign": "sign stop_sign mobile_pedestrian_crossing_sign",
    "Pole": "bollard",
    "Obstacle": "barrier traffic_cone construction_cone construction_barrel",
    "Other object": "unknown protruding_object",
}
_BY_NAME = {name.lower(): label for name, label in _IDS.items()} | {
    name: _IDS[of] for of, names in _MEMBERS.items() for name in names.split()
}
OTHER_OBJECT = _IDS["Other object"]
"""The class of an object whose name is not known."""

NCORE, NCORE_TO_CARLA = tables_of(
    "ncore",
    _CLASSES,
    movable=frozenset(
        _IDS[name]
        for name in ("Vehicle", "Two-wheeler", "Rider", "Person", "Animal", "Other object")
    ),
    deformable=frozenset(_IDS[name] for name in ("Rider", "Person", "Animal")),
    ground=frozenset({_IDS["Ground"]}),
    geometry_only=_IDS["Background"],
)


def class_of_name(name: str) -> int | None:
    """Return the id of the class to which the name of an object's class belongs; None if the name
    is not known.
    """
    return _BY_NAME.get(name.lower())
