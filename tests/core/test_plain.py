from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypedDict

import pytest

from carlasc.core.plain import from_plain


@dataclass(frozen=True)
class Part:
    count: int
    share: float | None
    sizes: tuple[float, float]


class Loose(TypedDict):
    count: int


GOOD = {"count": 3, "share": 1, "sizes": [0.5, 2], "more": "ignored"}


def test_objects_become_dataclasses_and_lists_tuples():
    assert from_plain(GOOD, Part) == Part(3, 1.0, (0.5, 2.0))
    assert from_plain([GOOD], tuple[Part, ...]) == (Part(3, 1.0, (0.5, 2.0)),)
    assert from_plain({"a": GOOD}, Mapping[str, Part]) == {"a": Part(3, 1.0, (0.5, 2.0))}
    assert from_plain(None, Part | None) is None
    assert from_plain({"count": 2, "more": [1]}, Loose) == {"count": 2, "more": [1]}
    assert from_plain([{}], Any) == [{}]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": True}, "bool in the value.count"),
        ({"count": 1.5}, "float in the value.count"),
        ({"count": 10**30}, "a number of more than 64 bits in the value.count"),
        ({"share": -(10**400)}, "a number of more than 64 bits in the value.share"),
        ({"share": "1"}, "str in the value.share"),
        ({"share": float("nan")}, "float in the value.share"),
        ({"sizes": [1]}, "1 values in the value.sizes, not 2"),
        ({"sizes": {"0": 1}}, "dict in the value.sizes"),
        ({"sizes": [1, None]}, "NoneType in the value.sizes"),
    ],
)
def test_other_types_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        from_plain(GOOD | change, Part | None)


def test_a_missing_key_and_another_container_are_named():
    with pytest.raises(ValueError, match="no sizes in the value"):
        from_plain({"count": 1, "share": None}, Part)
    with pytest.raises(ValueError, match="list in the value"):
        from_plain([], Part)
    with pytest.raises(ValueError, match="int in the value"):
        from_plain(3, Mapping[str, Part])
