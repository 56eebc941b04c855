"""Ground truth: observations give votes, votes give grids, and a run makes the grids of a whole
data set.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
