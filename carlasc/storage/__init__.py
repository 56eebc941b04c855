"""The layout on disk, and the sources and sinks that read and write it: folders, zips, URLs, packed stores; downloads."""

from carlasc.storage.caching import Cache
from carlasc.storage.downloads import download
from carlasc.storage.finishing import finish
from carlasc.storage.folders.folder import FolderSink, FolderSource
from carlasc.storage.metadata import Axes, Metadata
from carlasc.storage.opening import as_source, open
from carlasc.storage.packing import pack
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.sinks import SequenceWriter, Sink
from carlasc.storage.unpacking import unpack

__all__ = [
    "Axes",
    "Cache",
    "FolderSink",
    "FolderSource",
    "Metadata",
    "Sequence",
    "SequenceWriter",
    "Sink",
    "Source",
    "as_source",
    "download",
    "finish",
    "open",
    "pack",
    "unpack",
]
