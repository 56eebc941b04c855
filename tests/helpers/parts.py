"""Checks of the parts of an error, instead of the words of its message."""

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
    """Check that a block raises an error of a kind, in whose parts regular expressions are found.

    Args:
        kind: the class of the error.
        **parts: expressions by part: `where`, `problem`, `expected`, `found`, `advice`.
    """
    with pytest.raises(kind) as caught:
        yield caught
    for name, expression in parts.items():
        part = str(getattr(caught.value, name))
        assert re.search(expression, part), f"{name}: {part!r} does not match {expression!r}"
