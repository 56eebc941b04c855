"""From the classes of a grid or a scan to those of another data set."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np

from carlasc.converting import remaps_to_carla
from carlasc.core.arrays import Int32Array, LabelArray
from carlasc.core.classes import ClassTable
from carlasc.core.tables import lines_of
from carlasc.errors import FormatError

_NONE = -2


class Kind(NamedTuple):
    """The classes of a kind of object in other data sets.

    Attributes:
        occ3d: class of Occ3D; OpenOccupancy's are the same.
        raw: raw id of SemanticKITTI, which SSCBench's files hold too.
        category: category of Argoverse 2, 0 for none.
    """

    occ3d: int
    raw: int
    category: int


# kind, and its classes; vehicles as in CarlaOcc, for CARLA's tags, if it has them
_KINDS = {
    name: Kind(*map(int, numbers))
    for name, *numbers in lines_of("""
    bicycle 2 11 3
    motorcycle 6 15 14
    truck 10 18 25
    bus 3 13 7
    train 9 16 18
    trailer 9 20 27
    construction 5 20 11
    other 0 20 11
    cone 8 99 9
    flat 12 49 0
    parking 11 44 0
""")
}
# name of a class table, kind, names of its classes
_TABLES = [
    line.strip().split(": ")
    for line in """
    carlaocc: truck: Truck
    carlaocc: bus: Bus
    carlaocc: train: Train
    carlaocc: motorcycle: Motorcycle
    carlaocc: bicycle: Bicycle
    kitti: truck: Truck
    kitti: train: Tram
    kitti: other: Misc
    kitti360: bicycle: bicycle
    kitti360: motorcycle: motorcycle
    kitti360: truck: truck
    kitti360: bus: bus
    kitti360: train: train
    kitti360: trailer: caravan, trailer
    kitti360: other: unknown vehicle
    kitti360: parking: parking
    nuscenes: bicycle: vehicle.bicycle
    nuscenes: motorcycle: vehicle.motorcycle
    nuscenes: truck: vehicle.truck
    nuscenes: bus: vehicle.bus.bendy, vehicle.bus.rigid
    nuscenes: trailer: vehicle.trailer
    nuscenes: construction: vehicle.construction
    nuscenes: other: vehicle.emergency.ambulance, vehicle.emergency.police
    nuscenes: cone: movable_object.trafficcone
    nuscenes: flat: flat.other
    argoverse2: bicycle: BICYCLE
    argoverse2: motorcycle: MOTORCYCLE
    argoverse2: truck: BOX_TRUCK, LARGE_VEHICLE, TRUCK, TRUCK_CAB
    argoverse2: bus: ARTICULATED_BUS, BUS, SCHOOL_BUS
    argoverse2: train: RAILED_VEHICLE
    argoverse2: trailer: MESSAGE_BOARD_TRAILER, TRAFFIC_LIGHT_TRAILER, VEHICULAR_TRAILER
    argoverse2: other: WHEELED_DEVICE
    argoverse2: cone: CONSTRUCTION_CONE
""".strip().splitlines()
]
KINDS: Mapping[str, Mapping[str, Kind]] = MappingProxyType(
    {
        table: {
            name: _KINDS[kind]
            for other, kind, names in _TABLES
            if other == table
            for name in names.split(", ")
        }
        for table, _, _ in _TABLES
    }
)
"""Name of a class table -> name of a class -> its kind in other data sets.

Other data sets have more classes than CarlaSC, above all for vehicles. CarlaSC has one class for
vehicles, so that a map through its classes would turn buses and bicycles into cars. With these
entries, the more detailed classes of converters are kept.
"""


def mapping_of(
    maps: Mapping[str, Mapping[int, int]],
    kind: Literal["occ3d", "raw", "category"],
    table: ClassTable,
    where: str,
) -> dict[int, int]:
    """Return the map from the ids of a class table: its own map if it exists, otherwise a map
    through CarlaSC's classes.

    In the second case, classes that CarlaSC does not have are mapped by their kind.

    Args:
        maps: name of a class table -> id -> class of the other data set; "carla" is among them.
        kind: the attribute of a `Kind` that holds its class in the other data set.
        table: class table of the labels.
        where: the sequence, for errors.

    Raises:
        FormatError: no map of the table exists.
    """
    if table.name in maps:
        return dict(maps[table.name])
    remaps = remaps_to_carla(table)
    if remaps is None:
        raise FormatError(
            where,
            expected=f"classes with a map: {', '.join(maps)}, or those of an installed converter",
            found=table.name,
            advice="convert the data again with `--classes carla`",
        )
    mapping = {label: label for label in table.names}
    for remap in remaps:
        mapping = {
            label: remap.mapping[middle]
            for label, middle in mapping.items()
            if middle in remap.mapping
        }
    kinds = KINDS.get(table.name, {})
    return {
        label: getattr(kinds[table.names[label]], kind)
        if table.names[label] in kinds
        else maps["carla"][carla]
        for label, carla in mapping.items()
    }


def lookup_of(mapping: Mapping[int, int]) -> Int32Array:
    """Return a table from ids to classes, -2 for ids without a class; its last entry stands for all
    larger ids.
    """
    lookup = np.full(max(mapping) + 2, _NONE, np.int32)
    lookup[list(mapping)] = list(mapping.values())
    return lookup


def classes_of(labels: LabelArray, lookup: Int32Array, table: ClassTable, where: str) -> Int32Array:
    """Return labels as classes of another data set.

    Args:
        labels: class ids, of any shape.
        lookup: the table that `lookup_of` made.
        table: class table of the ids.
        where: the file or field, for errors.

    Returns:
        Classes in the shape of the labels.

    Raises:
        FormatError: a label has no class.
    """
    beyond = len(lookup) - 1
    classes: Int32Array = lookup[
        labels if np.iinfo(labels.dtype).max <= beyond else np.minimum(labels, beyond)
    ]
    if (classes == _NONE).any():
        bad = int(labels[classes == _NONE][0])
        times = int(np.count_nonzero(labels == bad))
        raise FormatError(
            where, expected=f"class ids of {table.name}", found=f"{bad} ({times} times)"
        )
    return classes
