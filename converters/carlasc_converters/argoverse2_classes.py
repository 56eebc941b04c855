"""The classes of Argoverse 2: the categories of its boxes, and two classes for points outside of
boxes.
"""

from __future__ import annotations

from carlasc_converters.class_rows import class_rows, tables_of

# The ids are those of the data set's scene flow labels: the categories in alphabetical order, from
# 1. Points have no labels. The last two ids, which the data set does not have, are for points
# outside of boxes.
# Name, colour, class of CARLA.
_CATEGORIES = class_rows("""
    NONE 255 255 255 Free
    ANIMAL 70 130 180 Dynamic
    ARTICULATED_BUS 255 127 80 Vehicle
    BICYCLE 220 20 60 Vehicle
    BICYCLIST 240 70 190 Pedestrian
    BOLLARD 153 153 153 Pole
    BOX_TRUCK 255 120 90 Vehicle
    BUS 255 69 0 Vehicle
    CONSTRUCTION_BARREL 90 70 50 Static
    CONSTRUCTION_CONE 47 79 79 Static
    DOG 100 150 200 Dynamic
    LARGE_VEHICLE 200 90 40 Vehicle
    MESSAGE_BOARD_TRAILER 190 130 20 Vehicle
    MOBILE_PEDESTRIAN_CROSSING_SIGN 230 230 60 TrafficSign
    MOTORCYCLE 255 61 99 Vehicle
    MOTORCYCLIST 150 40 100 Pedestrian
    OFFICIAL_SIGNALER 0 0 128 Pedestrian
    PEDESTRIAN 0 0 230 Pedestrian
    RAILED_VEHICLE 30 50 110 Vehicle
    REGULAR_VEHICLE 255 158 0 Vehicle
    SCHOOL_BUS 255 215 0 Vehicle
    SIGN 220 220 0 TrafficSign
    STOP_SIGN 200 30 30 TrafficSign
    STROLLER 240 128 128 Pedestrian
    TRAFFIC_LIGHT_TRAILER 250 170 30 Vehicle
    TRUCK 255 99 71 Vehicle
    TRUCK_CAB 230 80 60 Vehicle
    VEHICULAR_TRAILER 255 140 0 Vehicle
    WHEELCHAIR 138 43 226 Pedestrian
    WHEELED_DEVICE 219 112 147 Vehicle
    WHEELED_RIDER 180 90 200 Pedestrian
    BACKGROUND 180 180 180 Other
    GROUND 128 64 128 Ground
""")
_IDS = {name: index for index, (name, _, _) in enumerate(_CATEGORIES)}
_STANDING = (
    "BOLLARD CONSTRUCTION_BARREL CONSTRUCTION_CONE MOBILE_PEDESTRIAN_CROSSING_SIGN SIGN STOP_SIGN"
).split()
# and animals: their shape changes as they walk
_PEOPLE = "ANIMAL DOG OFFICIAL_SIGNALER PEDESTRIAN".split()
_NO_BOXES = ("NONE", "BACKGROUND", "GROUND")

ARGOVERSE2, TO_CARLA = tables_of(
    "argoverse2",
    _CATEGORIES,
    movable=frozenset(
        index for name, index in _IDS.items() if name not in (*_STANDING, *_NO_BOXES)
    ),
    deformable=frozenset(_IDS[name] for name in _PEOPLE),
    ground=frozenset({_IDS["GROUND"]}),
    geometry_only=_IDS["BACKGROUND"],
)
CATEGORIES = {name: index for name, index in _IDS.items() if name not in _NO_BOXES}
"""Class id of each category of boxes."""
