"""Inspecting data: contents (`info`), counts of classes (`stats`), checks (`validate`, `audit`,
`holdout`), reports of grids (`report`), cards for publication (`card`), and the installation
(`doctor`).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
