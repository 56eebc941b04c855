"""Classes that other data sets tell apart and CarlaSC does not, above all kinds of vehicles: what exports make of them.

CarlaSC has one class for vehicles, so a map by way of its classes makes cars of buses and bicycles. Tables of converters whose classes say
more keep that.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Kind(NamedTuple):
    """What a kind of object is in other data sets.

    Attributes:
        occ3d: class of Occ3D; OpenOccupancy's are the same.
        raw: raw id of SemanticKITTI, which SSCBench's files hold too.
        category: category of Argoverse 2, 0 for none.
    """

    occ3d: int
    raw: int
    category: int


_KINDS = {  # vehicles as CarlaOcc publishes them for CARLA's tags, where it has them
    "bicycle": Kind(2, 11, 3),
    "motorcycle": Kind(6, 15, 14),
    "truck": Kind(10, 18, 25),
    "bus": Kind(3, 13, 7),
    "train": Kind(9, 16, 18),
    "trailer": Kind(9, 20, 27),
    "construction": Kind(5, 20, 11),
    "other": Kind(0, 20, 11),
    "cone": Kind(8, 99, 9),
    "flat": Kind(12, 49, 0),
    "parking": Kind(11, 44, 0),
}
_TABLES = {  # name of a class table -> kind -> names of its classes
    "carlaocc": {"truck": "Truck", "bus": "Bus", "train": "Train", "motorcycle": "Motorcycle", "bicycle": "Bicycle"},
    "kitti": {"truck": "Truck", "train": "Tram", "other": "Misc"},
    "kitti360": {
        "bicycle": "bicycle",
        "motorcycle": "motorcycle",
        "truck": "truck",
        "bus": "bus",
        "train": "train",
        "trailer": "caravan, trailer",
        "other": "unknown vehicle",
        "parking": "parking",
    },
    "nuscenes": {
        "bicycle": "vehicle.bicycle",
        "motorcycle": "vehicle.motorcycle",
        "truck": "vehicle.truck",
        "bus": "vehicle.bus.bendy, vehicle.bus.rigid",
        "trailer": "vehicle.trailer",
        "construction": "vehicle.construction",
        "other": "vehicle.emergency.ambulance, vehicle.emergency.police",
        "cone": "movable_object.trafficcone",
        "flat": "flat.other",
    },
    "argoverse2": {
        "bicycle": "BICYCLE",
        "motorcycle": "MOTORCYCLE",
        "truck": "BOX_TRUCK, LARGE_VEHICLE, TRUCK, TRUCK_CAB",
        "bus": "ARTICULATED_BUS, BUS, SCHOOL_BUS",
        "train": "RAILED_VEHICLE",
        "trailer": "MESSAGE_BOARD_TRAILER, TRAFFIC_LIGHT_TRAILER, VEHICULAR_TRAILER",
        "other": "WHEELED_DEVICE",
        "cone": "CONSTRUCTION_CONE",
    },
}
KINDS: Mapping[str, Mapping[str, Kind]] = MappingProxyType(
    {
        table: {name: _KINDS[kind] for kind, names in kinds.items() for name in names.split(", ")}
        for table, kinds in _TABLES.items()
    }
)
"""Name of a class table -> name of a class -> what it is in other data sets."""
