import pytest
from hypothesis import given
from hypothesis import strategies as st

from carlasc.errors import ArgumentError
from carlasc.running import Part


@given(st.integers(0, 200), st.integers(1, 40))
def test_the_parts_take_every_item_once_in_order_and_evenly(items, count):
    taken = [Part(number, count).take(range(items)) for number in range(1, count + 1)]
    assert [item for part in taken for item in part] == list(range(items))
    assert max(map(len, taken)) - min(map(len, taken)) <= 1


def test_a_part_is_written_as_it_is_read():
    assert Part.parse(" 2/4 ") == Part(2, 4)
    assert str(Part(2, 4)) == "2/4"
    assert Part().take([1, 2, 3]) == [1, 2, 3]


@pytest.mark.parametrize("text", ["5/4", "0/4", "1/0", "2", "a/b", "-1/4", "1/4/2", ""])
def test_other_texts_are_refused(text):
    with pytest.raises(ArgumentError) as error:
        Part.parse(text)
    assert (error.value.where, error.value.found) == ("part", text)
    assert "\n" not in str(error.value)
