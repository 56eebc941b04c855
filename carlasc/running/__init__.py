"""Calling one function with many items in parallel: in new processes, in an executor of the caller,
or on a cluster.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
