"""Errors are asserted by their kind and their parts, not by their words."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from carlasc.errors import CarlascError


@contextmanager
def refused(kind: type[CarlascError], **parts: str) -> Iterator[pytest.ExceptionInfo[CarlascError]]:
    """Expect an error of a kind in a block, each of whose named parts contains a text:

    with refused(ArgumentError, where="history", found="4"):
    """
    with pytest.raises(kind) as error:
        yield error
    for name, text in parts.items():
        assert text in getattr(error.value, name), f"{name}: {vars(error.value)}"
