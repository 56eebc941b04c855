"""The motion of actors: moving points are grouped into segments in each scan, and segments are
linked into tracks over time.

"World" is the frame of the poses, which is the sensor frame of the first scan.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
