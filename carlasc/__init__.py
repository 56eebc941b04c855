"""`carlasc`: the SDK for CarlaSC, the data set of complete semantic scenes without ghost trails.

Importing it is fast: a public name, or a subpackage such as `carlasc.metrics`, is loaded on first
use.
"""

import lazy_loader

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
