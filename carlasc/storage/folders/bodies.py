"""Bodies of a web server's answers, which may be longer than it says, slow, or without end."""

from __future__ import annotations

import time
from functools import cache
from typing import Any

MOST_BYTES = 1 << 30  # of a file that is read whole: larger ones are read in ranges
_MOST_OF_PAGE = 1 << 26  # bytes of a page that lists a folder
_SLOWEST = 1000  # bytes per second


class WrongAnswerError(Exception):
    """A server sent something other than what was asked for: it is asked again."""


@cache
def bounded_response(patience_s: float) -> Any:
    """Return aiohttp's class of answers, which fsspec reads whole where it lists a page, with bodies of bounded length and time."""
    from aiohttp import ClientResponse

    class Bounded(ClientResponse):
        async def read(self) -> bytes:
            if self._body is None:
                self._body = await read_body(self.content, _MOST_OF_PAGE, patience_s)
            return self._body

    return Bounded


async def read_body(content: Any, most: int, patience_s: float) -> bytes:
    """Read a body of at most `most` bytes. A server can send more than it says, and without end.

    Raises:
        WrongAnswerError: there are more.
        TimeoutError: after `patience_s`, less than a kilobyte a second has arrived.
    """
    data, began = bytearray(), time.monotonic()
    async for piece in content.iter_any():
        data += piece
        if len(data) > most:
            raise WrongAnswerError(f"more than {most} bytes")
        elapsed_s = time.monotonic() - began
        if elapsed_s > patience_s and len(data) < _SLOWEST * elapsed_s:
            raise TimeoutError(f"{len(data)} bytes in {elapsed_s:.0f} s")
    return bytes(data)


def check_range(found: str | None, start: int, end: int | None) -> None:
    """Compare the header Content-Range, "bytes 0-99/1000", with the range that was asked for; the file may end before it.

    Raises:
        WrongAnswerError: it is another range.
    """
    first, _, last = (found or "").removeprefix("bytes ").partition("/")[0].partition("-")
    if found is not None and not (first == str(start) and last.isdigit() and (end is None or int(last) < end)):
        raise WrongAnswerError("another range of the file")
