"""The tests that every Source, every Sink and every converter must pass, for those of your own. They need pytest.

See `docs/howto/source.md` and `docs/howto/converter.md` for examples.
"""

import lazy_loader

from carlasc.errors import DependencyError

try:
    import pytest
except ImportError as error:
    raise DependencyError("pytest is not installed", advice="install it with `pip install pytest`") from error

pytest.register_assert_rewrite(
    "carlasc.testing.contracts", "carlasc.testing.converters"
)  # failures show the values that were compared

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
