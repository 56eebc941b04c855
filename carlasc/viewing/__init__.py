"""Viewing sequences: pictures and films, a page for any browser, recordings for other viewers, a
window on the desktop.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
