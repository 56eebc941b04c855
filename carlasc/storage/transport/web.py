"""The client of web servers: aiohttp, through the file system of fsspec."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

from carlasc.errors import CarlascError, import_extra, without_credentials
from carlasc.storage.transport.clients import FileSystemClient, check_range
from carlasc.storage.transport.failures import WrongAnswerError

_PIECE = 256 << 10  # bytes per piece of a body
_MOST_BYTES = 1 << 30  # limit for files that are read whole; larger files are read in ranges
_MOST_OF_PAGE = 1 << 26  # maximum bytes of a page that lists a folder
_SLOWEST = 1000  # bytes per second
_LONGEST_PIECE_S = 0.5  # maximum time to collect the bytes of one piece


@dataclass(frozen=True)
class HttpAnswer:
    """The answer of a web server.

    Attributes:
        status: HTTP status.
        reason: reason phrase of the status.
        headers: headers; names are case-insensitive.
        first: the first bytes of the body.
        more: returns the next bytes; empty at the end of the body.
        error: error of aiohttp if the status is 400 or more.
    """

    status: int
    reason: str
    headers: Mapping[str, str]
    first: bytes
    more: Callable[[], bytes]
    error: Exception | None

    def pieces(self) -> Iterator[bytes]:
        """Yield the body."""
        piece = self.first
        while piece:
            yield piece
            piece = self.more()


class WebClient(FileSystemClient):
    """The client of a web server."""

    def __init__(self, url: str, options: Mapping[str, Any]) -> None:
        super().__init__(url, options)
        import_extra("aiohttp", "remote")

    def open(self, **more: Any) -> Any:
        """Return the file system, with limits for silent servers and endless pages."""
        from aiohttp import ClientTimeout

        timeout = self.settings.timeout_s
        silence = ClientTimeout(total=None, sock_connect=timeout, sock_read=timeout)
        limits = {"timeout": silence, "response_class": _bounded_response(timeout)}
        limits |= self.options.get("client_kwargs", {})
        return super().open(client_kwargs=limits)

    def get(self, url: str, start: int | None = None, end: int | None = None) -> bytes:
        """Return bytes of a file with one request."""
        from fsspec.asyn import sync

        fs = self.connection
        return bytes(sync(fs.loop, get, fs, url, self.settings.timeout_s, start, end))

    def entries(self, url: str) -> dict[str, int | None]:
        """List a folder, from the links in its page."""
        return super().entries(url if "?" in url else f"{url}/")

    def _own_name(self, url: str) -> str:
        return url.strip("/")

    @contextmanager
    def answer(self, headers: Mapping[str, str]) -> Iterator[HttpAnswer]:
        """Send one request for the file, and yield its answer. Its body can be read in pieces.

        Args:
            headers: headers of the request.

        Raises:
            CarlascError: the request was redirected in a loop, to a URL that is not http(s), or
                from https to http.
            Exception: the server cannot be reached (an error of aiohttp).
        """
        from fsspec.asyn import sync

        fs, answer = self.connection, None

        async def begin() -> tuple[Any, bytes, Exception | None]:
            answer = await _answer(fs, self.url, {"Accept-Encoding": "identity", **headers})
            error = None
            try:
                first = await _read_piece(answer.content, _PIECE)
                answer.raise_for_status()
            except BaseException as failure:
                if answer.status < 400 or not isinstance(failure, Exception):
                    answer.close()
                    raise
                error = failure
            return answer, first, error

        try:
            answer, first, error = sync(fs.loop, begin)
            more = partial(sync, fs.loop, _read_piece, answer.content, _PIECE)
            yield HttpAnswer(answer.status, answer.reason or "", answer.headers, first, more, error)
        finally:
            if answer is not None:
                fs.loop.call_soon_threadsafe(answer.close)


async def get(fs: Any, url: str, patience_s: float, start: int | None, end: int | None) -> bytes:
    """Return the bytes [start, end) of a file, or the whole file.

    Args:
        fs: the file system of fsspec.
        url: URL of the file.
        patience_s: maximum time during which the server may send less than a kilobyte per second.
        start: first byte; None for the whole file.
        end: end of the range, exclusive; None for the whole file.

    Raises:
        FileNotFoundError: the file does not exist.
        WrongAnswerError: the answer does not fit the request.
        aiohttp.ClientError: the request failed.
    """
    wanted = {} if start is None or end is None else {"Range": f"bytes={start}-{end - 1}"}
    async with await _answer(fs, url, wanted) as answer:
        if answer.status == 416:
            return b""
        if answer.status == 404:
            raise FileNotFoundError(url)
        answer.raise_for_status()
        if start is not None and answer.status != 206:
            raise WrongAnswerError("the whole file instead of a range")
        most = _MOST_BYTES if start is None or end is None else end - start
        data = await _read_body(answer.content, most, patience_s)
    if start is not None:
        check_range(answer.headers.get("Content-Range"), start, end)
    return data


async def _answer(fs: Any, url: str, headers: Mapping[str, str]) -> Any:
    """Send a request, with `headers` and those of the file system, and return the answer of
    aiohttp. The body is not read yet.
    """
    session = await fs.set_session()
    settings = dict(fs.kwargs)
    together = {**settings.pop("headers", {}), **headers}
    nowhere = CarlascError(
        without_credentials(url),
        expected="a file",
        found="a redirection in a loop, to another scheme, or from https to http",
        advice="check the URL",
    )
    try:
        answer = await session.get(fs.encode_url(url), headers=together, **settings)
    except Exception as error:
        # Since 3.10, aiohttp has a separate error for other schemes.
        if "Redirect" in type(error).__name__ or type(error) is ValueError:
            raise nowhere from None
        raise
    schemes = [step.url.scheme for step in answer.history] + [answer.url.scheme]
    if "https" in schemes and "http" in schemes[schemes.index("https") :]:
        answer.close()
        raise nowhere
    return answer


async def _read_piece(content: Any, most: int) -> bytes:
    """Return the next bytes of a body: at most `most`, fewer if they arrive slowly, empty at the
    end.

    When a connection breaks, aiohttp drops received bytes. This function returns them, and the next
    call raises the error.
    """
    data, began = bytearray(), time.monotonic()
    try:
        while len(data) < most and time.monotonic() - began < _LONGEST_PIECE_S:
            if not (more := await content.read(most - len(data))):
                break
            data += more
    except Exception:
        if not data:
            raise
    return bytes(data)


@cache
def _bounded_response(patience_s: float) -> Any:
    """Return a subclass of the response of aiohttp that limits the size and time of bodies. fsspec
    reads listings with it.
    """
    from aiohttp import ClientResponse

    class BoundedResponse(ClientResponse):
        async def read(self) -> bytes:
            return await _read_body(self.content, _MOST_OF_PAGE, patience_s)

        async def text(self, encoding: str | None = None, errors: str = "strict") -> str:
            return (await self.read()).decode(encoding or self.charset or "utf-8", errors)

    return BoundedResponse


async def _read_body(content: Any, most: int, patience_s: float) -> bytes:
    """Read a body of at most `most` bytes.

    A server may send more than it announced, even an endless body.

    Raises:
        WrongAnswerError: the body has more bytes.
        TimeoutError: after `patience_s`, less than a kilobyte per second has arrived.
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


_pauses_lock = threading.Lock()
_pauses = 0  # blocks of `garbage_collection_paused` that run, in all threads
_was_enabled = False  # whether garbage collection was on before the first of them


@contextmanager
def garbage_collection_paused() -> Iterator[None]:
    """Turn garbage collection off while a library with a global lock, such as h5py, reads a file
    object with requests.

    Garbage collection on the thread of fsspec could free an object of that library, which needs the
    same lock: a deadlock. Before the block starts, a collection in progress on that thread is
    finished.
    """
    global _pauses, _was_enabled  # noqa: PLW0603 (garbage collection is one for all threads)
    import asyncio

    from fsspec.asyn import get_loop, sync

    with _pauses_lock:
        _was_enabled = gc.isenabled() if _pauses == 0 else _was_enabled
        _pauses += 1
        gc.disable()
    try:
        # after this, no collection is in progress on that thread
        sync(get_loop(), asyncio.sleep, 0)
        yield
    finally:
        with _pauses_lock:
            _pauses -= 1
            if _pauses == 0 and _was_enabled:
                gc.enable()
