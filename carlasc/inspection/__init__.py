"""Reading data: what exists (`info`), how much of each class (`stats`), whether it is sound (`validate`, `audit`, `holdout`), how it was made (`report`), and all of that to publish (`card`); and what is installed (`doctor`)."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
