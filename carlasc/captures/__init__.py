"""Raw captures of many sensors: reading them, and recording them in a simulated town or on a CARLA
server.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
