"""A compiled function, whose cache the tests look at."""

import numba


@numba.njit(cache=True)
def add_one(number: int) -> int:
    return number + 1
