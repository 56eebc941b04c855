"""The tests that every Source, every Sink and every converter must pass, for those of your own. They need pytest.

See `docs/howto/source.md` and `docs/howto/converter.md` for examples.
"""

from carlasc.errors import DependencyError

try:
    import pytest
except ImportError as error:
    raise DependencyError("pytest is not installed", advice="install it with `pip install pytest`") from error

pytest.register_assert_rewrite(
    "carlasc.testing.contracts", "carlasc.testing.converters"
)  # failures show the values that were compared

from carlasc.testing.contracts import SinkContract, SourceContract  # noqa: E402
from carlasc.testing.converters import ConverterContract  # noqa: E402
from carlasc.testing.data import published_bytes, write_dataset  # noqa: E402
from carlasc.testing.drives import KINDS, DriveScan, SimulatedDrive, Thing  # noqa: E402

__all__ = [
    "KINDS",
    "ConverterContract",
    "DriveScan",
    "SimulatedDrive",
    "SinkContract",
    "SourceContract",
    "Thing",
    "published_bytes",
    "write_dataset",
]
