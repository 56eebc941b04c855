"""Where sequences are read from and written to."""

from carlasc.sources.base import Metadata, Sequence, SequenceWriter, Sink, Source
from carlasc.sources.folder import FolderSink, FolderSource
from carlasc.sources.opening import open  # noqa: A004 (as in `carlasc.open`)

__all__ = ["FolderSink", "FolderSource", "Metadata", "Sequence", "SequenceWriter", "Sink", "Source", "open"]
