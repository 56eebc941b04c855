"""What metrics have in common that add up frames: two of the same settings can be merged."""

from __future__ import annotations

from typing import ClassVar, Self

from carlasc.errors import ArgumentError


class Summed:
    """A metric that is made of sums."""

    _SETTINGS: ClassVar[tuple[str, ...]]
    """Names of the attributes in which metrics must be equal to be merged."""
    _SUMS: ClassVar[tuple[str, ...]]
    """Names of the attributes that are added."""

    def merge(self, other: Self) -> Self:
        """Add what another metric of the same settings has added up, in any order.

        Raises:
            ArgumentError: its settings differ.
        """
        for name in self._SETTINGS:
            if (mine := getattr(self, name)) != (theirs := getattr(other, name)):
                kind = type(self).__name__
                raise ArgumentError("other", expected=f"a {kind} with {name} {mine}", found=f"one with {theirs}")
        for name in self._SUMS:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        return self
