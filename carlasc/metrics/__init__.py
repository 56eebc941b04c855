"""Scores of grids: confusion, completeness, rays, segments, uncertainty, consistency over time;
conventions of benchmarks; whole data sets.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
