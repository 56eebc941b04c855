"""Contract tests for your own Source, Sink or converter. They need pytest.

See `docs/howto/source.md` and `docs/howto/converter.md` for examples.
"""

import lazy_loader

from carlasc.errors import DependencyError

try:
    import pytest
except ImportError as error:
    raise DependencyError(
        "pytest is not installed", advice="install it with `pip install pytest`"
    ) from error

# so that failures show the compared values
pytest.register_assert_rewrite("carlasc.testing.contracts", "carlasc.testing.converters")

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
