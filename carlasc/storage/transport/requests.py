"""Parallel requests to object stores and web servers through fsspec, with retries.

Object stores answer some requests with "503 Slow Down", close connections, or send less than they
announced. Such requests are sent again, after a random time whose limit doubles at each attempt.
The retries of s3fs and botocore are turned off, because they would multiply with these.
`carlasc.storage.transport.servers` has the code for each kind of server,
`carlasc.storage.transport.failures` decides which failures are temporary.
"""

from __future__ import annotations

import dataclasses
import gc
import os
import random
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from carlasc.errors import ArgumentError, CarlascError, import_extra
from carlasc.storage.transport.failures import is_temporary
from carlasc.storage.transport.servers import (
    HTTP,
    HUB,
    S3,
    bounded_response,
    get,
    get_from_hub,
    http_answer,
    read_piece,
    status_error,
)

_EXTRAS = {  # the package that a scheme needs, and the extra that installs it
    "http": ("aiohttp", "remote"),
    "https": ("aiohttp", "remote"),
    "s3": ("s3fs", "remote"),
    "s3a": ("s3fs", "remote"),
    HUB: ("huggingface_hub", "hub"),
}
_RANDOM = random.SystemRandom()  # independent of `random.seed`, and different in forked processes
_PIECE = 256 << 10  # bytes per piece of a body

_Answer = TypeVar("_Answer")


@dataclass(frozen=True)
class RemoteSettings:
    """Settings of requests.

    Each field is read from an environment variable: `requests` from CARLASC_REMOTE_REQUESTS.

    Attributes:
        requests: maximum number of parallel requests of one call.
        attempts: number of attempts before the error is raised.
        backoff_s: attempt n + 1 follows after a random time of at most `backoff_s` * 2 ** (n - 1)
            and at most `longest_wait_s`.
        longest_wait_s: maximum time between two attempts, seconds.
        timeout_s: maximum time without data from a server, seconds.
    """

    requests: int = 32
    attempts: int = 7
    backoff_s: float = 0.25  # fact: backoff
    longest_wait_s: float = 10.0  # fact: longest-wait
    timeout_s: float = 30.0

    @classmethod
    def from_environment(cls) -> RemoteSettings:
        """Return the settings of this process.

        Raises:
            ArgumentError: a variable is not a positive number.
        """
        given: dict[str, Any] = {}
        for field in dataclasses.fields(cls):
            name = f"CARLASC_REMOTE_{field.name.upper()}"
            if (text := os.environ.get(name)) is None:
                continue
            kind = int if field.type == "int" else float
            try:
                given[field.name] = kind(text)
            except ValueError:
                given[field.name] = 0
            if not 0 < given[field.name] < 1e6:
                expected = "a positive integer" if kind is int else "a positive number"
                raise ArgumentError(name, expected=expected, found=repr(text))
        return cls(**given)

    def draw_wait_s(self, attempts: int) -> float:
        """Return the time to wait after a number of attempts.

        It is random, so that many clients do not retry at the same moment.
        """
        return _RANDOM.uniform(0, min(self.backoff_s * 2.0 ** (attempts - 1), self.longest_wait_s))


@dataclass(frozen=True)
class Request:
    """One request.

    Attributes:
        name: method of fsspec file systems, such as "info" or "pipe_file", or "get" for the
            function of `servers`.
        url: URL of the file; several URLs if the method takes several.
        data: bytes to send, the second argument of the method; None if it has no second argument.
        options: further keyword arguments of the method.
        check: called with the answer. If it raises an error, the request counts as failed.
    """

    name: str
    url: str | list[str]
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    check: Callable[[Any], None] | None = None
    data: bytes | None = None

    def arguments(self) -> tuple[Any, ...]:
        """Return the positional arguments of the method.

        They are positional because file systems name the data differently.
        """
        return (self.url,) if self.data is None else (self.url, self.data)


class Requests:
    """Sends requests to the file system of one URL.

    It can be pickled; each process opens its own connections.
    """

    def __init__(self, url: str, options: Mapping[str, Any] | None = None) -> None:
        """Keep the URL and the fsspec storage options. No request is sent yet.

        Raises:
            DependencyError: the URL needs a package that is not installed.
            ArgumentError: a setting in the environment is not valid.
        """
        self.url, self.options = url, dict(options or {})
        self.scheme = url.partition("://")[0]
        self.is_s3 = self.scheme in S3
        self.settings = RemoteSettings.from_environment()
        self._opened: tuple[int, Any] | None = None
        if self.scheme in _EXTRAS:
            import_extra(*_EXTRAS[self.scheme])

    @property
    def fs(self) -> Any:
        """The file system of this process.

        All threads share it; a forked process creates a new one.
        """
        from fsspec.core import url_to_fs

        if self._opened is None or self._opened[0] != os.getpid():
            try:
                fs = url_to_fs(self.url, **self._fsspec_options())[0]
            except (ValueError, ImportError) as error:
                raise CarlascError(self.url, problem=f"cannot be opened: {error}") from None
            if self.is_s3:
                fs.retries = 1
            self._opened = (os.getpid(), fs)
        return self._opened[1]

    def path_of(self, url: str) -> str:
        """Return the name of a URL in the listings of the file system."""
        from fsspec.core import url_to_fs

        return str(url_to_fs(url, **self._fsspec_options())[1])

    def _fsspec_options(self) -> dict[str, Any]:
        """Return the storage options, with retries and listing caches of s3fs and aiohttp turned
        off.
        """
        timeout, options = self.settings.timeout_s, dict(self.options)
        if self.is_s3:
            config = {
                "connect_timeout": timeout,
                "read_timeout": timeout,
                "retries": {"total_max_attempts": 1},
            }
            config["max_pool_connections"] = self.settings.requests
            options["config_kwargs"] = config | options.get("config_kwargs", {})
        if self.scheme in (*S3, "gs", "gcs"):
            # trees cache listings, and update them after writing
            options.setdefault("use_listings_cache", False)
        if self.scheme in HTTP:
            from aiohttp import ClientTimeout

            silence = ClientTimeout(total=None, sock_connect=timeout, sock_read=timeout)
            bounded = {"timeout": silence, "response_class": bounded_response(timeout)}
            options["client_kwargs"] = bounded | options.get("client_kwargs", {})
        return options

    def send(self, requests: Sequence[Request], attempts: int | None = None) -> list[Any]:
        """Send requests, several at a time. Requests with temporary failures are sent again.

        Returns:
            One answer per request, in their order: the data of the server, or the exception of a
            failed request.
        """
        attempts = attempts or self.settings.attempts
        answers: list[Any] = [None] * len(requests)
        waiting = list(range(len(requests)))
        for attempt in range(attempts):
            if attempt:
                time.sleep(self.settings.draw_wait_s(attempt))
            for place, answer in zip(
                waiting, self._send_once([requests[i] for i in waiting]), strict=True
            ):
                answers[place] = answer
            waiting = [
                i
                for i in waiting
                if isinstance(answers[i], BaseException) and is_temporary(answers[i])
            ]
            if not waiting:
                break
        for answer in answers:
            if isinstance(answer, BaseException) and not isinstance(answer, Exception):
                raise answer  # an interruption
        return answers

    def persist(
        self,
        work: Callable[[], _Answer],
        count: Callable[[], int] = lambda: 0,
        stop: threading.Event | None = None,
    ) -> _Answer:
        """Call a function that sends a request, again after temporary failures, as `send` does.

        Args:
            work: the function.
            count: returns the number of bytes received so far. After progress, attempts are counted
                from one again.
            stop: ends the waiting when it is set.

        Returns:
            The result of `work`.

        Raises:
            Exception: the error of the last attempt.
        """
        attempts, before = 0, count()
        while True:
            try:
                return work()
            except Exception as error:
                arrived = count()
                attempts, before = (1 if arrived > before else attempts + 1), arrived
                if attempts >= self.settings.attempts or not is_temporary(error):
                    raise
                if (stop or threading.Event()).wait(self.settings.draw_wait_s(attempts)):
                    raise

    @contextmanager
    def answer(self, headers: Mapping[str, str]) -> Iterator[HttpAnswer]:
        """Send one request for the file to a web server, and yield its answer.

        Its body can be read in pieces.

        Args:
            headers: headers of the request.

        Raises:
            CarlascError: the request was redirected in a loop, to a URL that is not http(s), or
                from https to http.
            Exception: the server cannot be reached (an error of aiohttp).
        """
        from fsspec.asyn import sync

        fs, answer = self.fs, None

        async def begin() -> tuple[Any, bytes, Exception | None]:
            found = await http_answer(fs, self.url, {"Accept-Encoding": "identity", **headers})
            try:
                return found, await read_piece(found.content, _PIECE), status_error(found)
            except BaseException:
                found.close()
                raise

        try:
            answer, first, error = sync(fs.loop, begin)
            more = partial(sync, fs.loop, read_piece, answer.content, _PIECE)
            yield HttpAnswer(answer.status, answer.reason or "", answer.headers, first, more, error)
        finally:
            if answer is not None:
                fs.loop.call_soon_threadsafe(answer.close)

    def _send_once(self, requests: Sequence[Request]) -> list[Any]:
        fs = self.fs
        # a file system without asyncio, which several threads may use
        if self.scheme == HUB and len(requests) > 1:
            with ThreadPoolExecutor(min(self.settings.requests, len(requests))) as threads:
                return list(threads.map(partial(_plain_call, fs, self.settings), requests))
        if not fs.async_impl:
            return [_plain_call(fs, self.settings, request) for request in requests]
        from fsspec.asyn import sync

        return sync(fs.loop, partial(_gather, fs, requests, self.settings, self.scheme))

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_opened": None}


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


class _Collecting:
    """Turns garbage collection off while at least one thread needs it off."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._was_on = False

    def stop(self) -> None:
        with self._lock:
            if self._users == 0:
                self._was_on = gc.isenabled()
                gc.disable()
            self._users += 1

    def resume(self) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0 and self._was_on:
                gc.enable()


_COLLECTING = _Collecting()


@contextmanager
def holding_a_lock() -> Iterator[None]:
    """Turn garbage collection off while a library with a global lock, such as h5py, reads a file
    object with requests.

    Garbage collection on the thread of fsspec could free an object of that library, which needs the
    same lock: a deadlock. Before the block starts, a collection in progress on that thread is
    finished.
    """
    import asyncio

    from fsspec.asyn import get_loop, sync

    _COLLECTING.stop()
    try:
        # after this, no collection is in progress on that thread
        sync(get_loop(), asyncio.sleep, 0)
        yield
    finally:
        _COLLECTING.resume()


async def _gather(
    fs: Any, requests: Sequence[Request], settings: RemoteSettings, scheme: str
) -> list[Any]:
    # imported here, because it takes 50 ms, and commands on local files do not need it
    import asyncio

    gate = asyncio.Semaphore(settings.requests)

    async def one(request: Request) -> Any:
        async with gate:
            if request.name == "get":
                answer = await get(
                    fs, scheme, str(request.url), settings.timeout_s, **request.options
                )
            else:
                answer = await getattr(fs, f"_{request.name}")(
                    *request.arguments(), **request.options
                )
            if request.check is not None:
                request.check(answer)
            return answer

    return await asyncio.gather(*map(one, requests), return_exceptions=True)


def _plain_call(fs: Any, settings: RemoteSettings, request: Request) -> Any:
    try:
        if request.name == "get" and HUB in fs.protocol:
            answer = get_from_hub(fs, str(request.url), settings.timeout_s, **request.options)
        else:
            name = "cat_file" if request.name == "get" else request.name
            answer = getattr(fs, name)(*request.arguments(), **request.options)
        if request.check is not None:
            request.check(answer)
    except Exception as error:  # noqa: BLE001 (each file system raises its own types)
        return error
    return answer
