"""Other data sets into the layout, and back."""

from carlasc.converting.exporting import ExportResult, export
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

__all__ = [
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
]
