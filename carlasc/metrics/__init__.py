"""Scores of grids: confusion and completeness, rays, segments, uncertainty and time; the conventions of the benchmarks; scores over data sets."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
