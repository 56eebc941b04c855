"""The tests that every Source and every Sink must pass, for stores of your own. They need pytest.

See `docs/howto/source.md` for an example.
"""

from carlasc.errors import DependencyError

try:
    import pytest
except ImportError as error:
    raise DependencyError("pytest is not installed", advice="install it with `pip install pytest`") from error

pytest.register_assert_rewrite("carlasc.testing.contracts")  # failures show the values that were compared

from carlasc.testing.contracts import SinkContract, SourceContract  # noqa: E402
from carlasc.testing.data import published_bytes, write_dataset  # noqa: E402

__all__ = ["SinkContract", "SourceContract", "published_bytes", "write_dataset"]
