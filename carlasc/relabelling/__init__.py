"""Whole data sets with other labels or poses: predicted labels, the classes of pixels, motion that
was found, and refined poses.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
