"""The layout on disk, and the sources and sinks that read and write it: folders, zips, URLs, packed stores; downloads."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlasc.loading import late_names

if TYPE_CHECKING:
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
else:
    __getattr__, __dir__ = late_names(
        __name__,
        {
            "caching": ("Cache",),
            "downloads": ("download",),
            "finishing": ("finish",),
            "folders.folder": ("FolderSink", "FolderSource"),
            "metadata": ("Axes", "Metadata"),
            "opening": ("as_source", "open"),
            "packing": ("pack",),
            "protocol": ("Sequence", "Source"),
            "sinks": ("SequenceWriter", "Sink"),
            "unpacking": ("unpack",),
        },
    )

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
