"""Other data sets into the CarlaSC layout, and back."""

from carlasc.converting.axes import mirror_boxes, mirror_grid, mirror_points, mirror_poses, mirror_spec
from carlasc.converting.exporting import ExportResult, export
from carlasc.converting.frames import VOXEL_FILES
from carlasc.converting.protocol import (
    Converter,
    Exporter,
    FrameContent,
    FrameHandle,
    Recording,
    Split,
    VoxelContent,
)
from carlasc.converting.registry import converter_names, load_converter
from carlasc.converting.results import ConvertResult, Failure
from carlasc.converting.run import convert
from carlasc.storage.metadata import Axes

__all__ = [
    "VOXEL_FILES",
    "Axes",
    "ConvertResult",
    "Converter",
    "ExportResult",
    "Exporter",
    "Failure",
    "FrameContent",
    "FrameHandle",
    "Recording",
    "Split",
    "VoxelContent",
    "convert",
    "converter_names",
    "export",
    "load_converter",
    "mirror_boxes",
    "mirror_grid",
    "mirror_points",
    "mirror_poses",
    "mirror_spec",
]
