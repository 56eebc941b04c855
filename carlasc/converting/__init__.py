"""Other data sets into the CarlaSC layout, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlasc.core.axes import mirror_boxes, mirror_grid, mirror_points, mirror_poses, mirror_spec
from carlasc.loading import late_names
from carlasc.storage.metadata import Axes

if TYPE_CHECKING:
    from carlasc.converting.exporter import Exported, Exporter, Files, FrameExporter, SequenceExporter, SequenceFile
    from carlasc.converting.exporting import export
    from carlasc.converting.layout_options import FlowSource, LayoutOptions
    from carlasc.converting.protocol import (
        Cloud,
        Converter,
        FrameHandle,
        Recording,
        Sensor,
        Split,
        Trajectory,
        VoxelContent,
    )
    from carlasc.converting.registry import (
        OptionDeclaration,
        converter_names,
        exporter_names,
        load_converter,
        load_exporter,
        option_declarations,
        read_options,
        remaps_to_carla,
    )
    from carlasc.converting.resampling import TargetFrame, is_same, resample_to, resampling_notes
    from carlasc.converting.results import ConvertResult, ExportResult, Failure
    from carlasc.converting.run import convert
    from carlasc.converting.scan_stage import VOXEL_FILES
else:
    __getattr__, __dir__ = late_names(
        __name__,
        {
            "exporter": ("Exported", "Exporter", "Files", "FrameExporter", "SequenceExporter", "SequenceFile"),
            "exporting": ("export",),
            "layout_options": ("FlowSource", "LayoutOptions"),
            "protocol": (
                "Cloud",
                "Converter",
                "FrameHandle",
                "Recording",
                "Sensor",
                "Split",
                "Trajectory",
                "VoxelContent",
            ),
            "registry": (
                "OptionDeclaration",
                "converter_names",
                "exporter_names",
                "load_converter",
                "load_exporter",
                "option_declarations",
                "read_options",
                "remaps_to_carla",
            ),
            "resampling": ("TargetFrame", "is_same", "resample_to", "resampling_notes"),
            "results": ("ConvertResult", "ExportResult", "Failure"),
            "run": ("convert",),
            "scan_stage": ("VOXEL_FILES",),
        },
    )

__all__ = [
    "VOXEL_FILES",
    "Axes",
    "Cloud",
    "ConvertResult",
    "Converter",
    "ExportResult",
    "Exported",
    "Exporter",
    "Failure",
    "Files",
    "FlowSource",
    "FrameExporter",
    "FrameHandle",
    "LayoutOptions",
    "OptionDeclaration",
    "Recording",
    "Sensor",
    "SequenceExporter",
    "SequenceFile",
    "Split",
    "TargetFrame",
    "Trajectory",
    "VoxelContent",
    "convert",
    "converter_names",
    "export",
    "exporter_names",
    "is_same",
    "load_converter",
    "load_exporter",
    "mirror_boxes",
    "mirror_grid",
    "mirror_points",
    "mirror_poses",
    "mirror_spec",
    "option_declarations",
    "read_options",
    "remaps_to_carla",
    "resample_to",
    "resampling_notes",
]
