"""The layout on disk, and the sources and sinks that read and write it: folders, zips, URLs, packed stores; downloads."""

from carlasc.storage.downloads import download
from carlasc.storage.folders.folder import FolderSink, FolderSource
from carlasc.storage.metadata import Axes, Metadata
from carlasc.storage.opening import as_source, open
from carlasc.storage.packing import pack, unpack
from carlasc.storage.protocol import Sequence, SequenceWriter, Sink, Source

__all__ = [
    "Axes",
    "FolderSink",
    "FolderSource",
    "Metadata",
    "Sequence",
    "SequenceWriter",
    "Sink",
    "Source",
    "as_source",
    "download",
    "open",
    "pack",
    "unpack",
]
