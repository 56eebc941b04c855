"""Where sequences are read from and written to."""

from carlasc.sources.base import Metadata, Sequence, SequenceWriter, Sink, Source
from carlasc.sources.folder import FolderSink, FolderSource
from carlasc.sources.opening import open

__all__ = ["FolderSink", "FolderSource", "Metadata", "Sequence", "SequenceWriter", "Sink", "Source", "open"]
