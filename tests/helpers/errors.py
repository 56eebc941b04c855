"""Assertions about errors: their kind and their parts."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeVar

import pytest

from carlasc.errors import CarlascError

_Kind = TypeVar("_Kind", bound=CarlascError)


@contextmanager
def raises(kind: type[_Kind], **parts: str) -> Iterator[pytest.ExceptionInfo[_Kind]]:
    """Assert that a block raises an error of a kind, some parts of which match.

    Args:
        kind: its class.
        **parts: a regular expression that is found in each part: `where`, `problem`, `expected`,
            `found` or `advice`.
    """
    with pytest.raises(kind) as error:
        yield error
    for name, pattern in parts.items():
        part = str(getattr(error.value, name))
        assert re.search(pattern, part), f"{name}: {pattern!r} is not in {part!r}"
