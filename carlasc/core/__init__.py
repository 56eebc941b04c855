"""Values that know nothing of files: transforms, cells and grids, scans, boxes, class tables and the remaps between them."""

from carlasc.core.boxes import BOXES_DTYPE, Boxes
from carlasc.core.classes import ClassTable, Color, Remap, class_weights
from carlasc.core.evidence import VoxelFlag
from carlasc.core.frames import FrameRange, Frames
from carlasc.core.geometry import (
    Transform,
    check_rigid,
    invert,
    quaternions_of,
    relative_to,
    rotate_vectors,
    rotation_z,
    rotations_of,
    transform_points,
    translation,
)
from carlasc.core.grids import Coordinates, Grid, GridSpec
from carlasc.core.scans import Scan
from carlasc.core.tables import (
    CARLA,
    CARLASC11,
    REMAPS,
    SEMANTICKITTI,
    SEMANTICKITTI19,
    SEMANTICPOSS,
    TABLES,
    TRAIN_VOXEL_COUNTS,
    remap_named,
    remaps_between,
    table_from_json,
    table_named,
    table_to_json,
    to_table,
)

__all__ = [
    "BOXES_DTYPE",
    "CARLA",
    "CARLASC11",
    "REMAPS",
    "SEMANTICKITTI",
    "SEMANTICKITTI19",
    "SEMANTICPOSS",
    "TABLES",
    "TRAIN_VOXEL_COUNTS",
    "Boxes",
    "ClassTable",
    "Color",
    "Coordinates",
    "FrameRange",
    "Frames",
    "Grid",
    "GridSpec",
    "Remap",
    "Scan",
    "Transform",
    "VoxelFlag",
    "check_rigid",
    "class_weights",
    "invert",
    "quaternions_of",
    "relative_to",
    "remap_named",
    "remaps_between",
    "rotate_vectors",
    "rotation_z",
    "rotations_of",
    "table_from_json",
    "table_named",
    "table_to_json",
    "to_table",
    "transform_points",
    "translation",
]
