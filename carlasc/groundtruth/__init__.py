"""Ground truth: observations are turned into votes and votes into grids, and a run does so for a whole data set."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
