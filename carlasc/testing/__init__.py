"""Contract tests for your own Source, Sink or converter, and data to try them on.

The contract tests need pytest. See `docs/howto/source.md` and `docs/howto/converter.md` for
examples.
"""

from importlib.util import find_spec
from typing import Any

import lazy_loader

from carlasc.errors import DependencyError

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

if find_spec("pytest") is None:  # `help(carlasc)` shows the names that work without it
    __all__ = [name for name in __all__ if not name.endswith("Contract")]
    __dir__ = __all__.copy
else:
    import pytest

    # so that failures show the compared values
    pytest.register_assert_rewrite("carlasc.testing.contracts", "carlasc.testing.converters")


def __getattr__(name: str) -> Any:
    try:
        return _load(name)
    except ModuleNotFoundError as error:
        if error.name != "pytest":
            raise
        raise DependencyError(
            "pytest is not installed", advice="install it with `pip install pytest`"
        ) from error
