"""The layout on disk, and the sources and sinks that read and write it: folders, zips, URLs, packed
stores; downloads.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
