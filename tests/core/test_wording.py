"""Numbers and names in messages."""

import pytest

from carlasc.core.wording import count, first_names


@pytest.mark.parametrize(
    "arguments, text",
    [
        ((1, "frame"), "1 frame"),
        ((0, "frame"), "0 frames"),
        ((12345, "file"), "12,345 files"),
        ((2, "box", "boxes"), "2 boxes"),
    ],
)
def test_a_noun_agrees_with_its_number(arguments, text):
    assert count(*arguments) == text


def test_names_after_the_first_few_are_counted():
    assert first_names(["a", "b", "c"], most=2) == "a, b and 1 more"
    assert first_names(["a", "b"], most=2) == "a, b"
