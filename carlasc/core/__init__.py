"""Values without files: transforms, cells and grids, scans, boxes, class tables and the remaps
between them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
