"""A compiled function, whose cache the tests look at."""

from carlasc.core.compiling import cached


@cached
def add_one(number: int) -> int:
    return number + 1
