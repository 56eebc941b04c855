"""Parts of a run: each is done by a command of its own, on any machine that reaches the same output."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self, TypeVar

from carlasc.errors import ArgumentError

Item = TypeVar("Item")


@dataclass(frozen=True)
class Part:
    """One of several parts of a run. Together, the parts do each item exactly once, whatever order they run in.

    Attributes:
        number: number of this part, from 1.
        count: number of parts.

    Raises:
        ArgumentError: the number is not between 1 and the count.
    """

    number: int = 1
    count: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise ArgumentError("part", expected="I/N with I from 1 to N, such as 2/4", found=str(self))

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read "2/4".

        Raises:
            ArgumentError: the text is not of this form, or the number is not between 1 and the count.
        """
        match = re.fullmatch(r"([0-9]+)/([0-9]+)", text.strip())
        if match is None:
            raise ArgumentError("part", expected="I/N with I from 1 to N, such as 2/4", found=text)
        return cls(int(match[1]), int(match[2]))

    def take(self, items: Sequence[Item]) -> Sequence[Item]:
        """Return the items of this part: a stretch of them, so that what neighbours share is read by few parts."""
        begin, end = (len(items) * number // self.count for number in (self.number - 1, self.number))
        return items[begin:end]

    def refuse(self, overwrite: bool) -> None:
        """Refuse to replace what exists, where other parts may have made it.

        Raises:
            ArgumentError: something is to be replaced, and there are several parts.
        """
        if self.count > 1 and overwrite:
            raise ArgumentError(
                "overwrite",
                expected="nothing with `part`, because parts would remove what other parts make",
                found="True",
                advice="remove what exists first",
            )

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"
