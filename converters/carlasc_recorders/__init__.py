"""Recorders of raw captures: a simulated town, and a CARLA server.

`carlasc` finds them through the entry-point group `carlasc.recorders`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
