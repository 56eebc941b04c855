"""Requests to object stores and web servers, through fsspec: many side by side, and tried again when a server fails.

Object stores answer some requests with "503 Slow Down", close connections, or send less than they announced. Such requests are sent
again, after a random time that doubles at each attempt. s3fs and botocore retry too, each by rules of its own, which would multiply:
their retries are turned off, so that this module alone decides how often and how long. `carlasc.storage.transport.servers` does what differs
between servers, `carlasc.storage.transport.failures` says which failures are temporary.
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
_RANDOM = random.SystemRandom()  # of its own: a failure must not change what a program draws, nor two forks wait alike
_PIECE = 256 << 10  # bytes of a body that is read in pieces

_Answer = TypeVar("_Answer")


@dataclass(frozen=True)
class RemoteSettings:
    """How requests are sent. Each field is read from an environment variable: `requests` from CARLASC_REMOTE_REQUESTS.

    Attributes:
        requests: greatest number of requests that one call has open at the same time.
        attempts: how often a request is sent before its error is reported.
        backoff_s: the wait before attempt n + 1 is random, up to this time by 2 ** (n - 1), and at most `longest_wait_s`.
        longest_wait_s: greatest wait between two attempts.
        timeout_s: longest silence of a server.
    """

    requests: int = 32
    attempts: int = 7
    backoff_s: float = 0.25
    longest_wait_s: float = 10.0
    timeout_s: float = 30.0

    @classmethod
    def from_environment(cls) -> RemoteSettings:
        """Return the settings of this process.

        Raises:
            ArgumentError: a variable holds something other than a positive number.
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
                expected = "a positive whole number" if kind is int else "a positive number"
                raise ArgumentError(name, expected=expected, found=repr(text))
        return cls(**given)

    def draw_wait_s(self, attempts: int) -> float:
        """Return the wait after so many attempts: at random, so that many clients do not come back at once."""
        return _RANDOM.uniform(0, min(self.backoff_s * 2.0 ** (attempts - 1), self.longest_wait_s))


@dataclass(frozen=True)
class Request:
    """One request.

    Attributes:
        name: method of fsspec's file systems, such as "info" or "pipe_file", or "get" for this module's own.
        url: what it is about; several, where the method takes several.
        data: what is sent, as the method's second argument; None if it takes none.
        options: further arguments of the method.
        check: called with the answer; an error that it raises counts as that of the request.
    """

    name: str
    url: str | list[str]
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    check: Callable[[Any], None] | None = None
    data: bytes | None = None

    def arguments(self) -> tuple[Any, ...]:
        """Return the positional arguments of the method; file systems name the data differently."""
        return (self.url,) if self.data is None else (self.url, self.data)


class Requests:
    """Sends requests to the file system of one URL. It can be pickled; each process opens its own connections."""

    def __init__(self, url: str, options: Mapping[str, Any] | None = None) -> None:
        """Remember the URL and fsspec's storage options; nothing is requested yet.

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
        """The file system of this process. It is shared by the process's threads; after a fork there is a new one."""
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
        """Return how the file system names a URL in its listings."""
        from fsspec.core import url_to_fs

        return str(url_to_fs(url, **self._fsspec_options())[1])

    def _fsspec_options(self) -> dict[str, Any]:
        """Return the storage options, with the settings of s3fs and aiohttp that leave retries and listings to this package."""
        timeout, options = self.settings.timeout_s, dict(self.options)
        if self.is_s3:
            config = {"connect_timeout": timeout, "read_timeout": timeout, "retries": {"total_max_attempts": 1}}
            config["max_pool_connections"] = self.settings.requests
            options["config_kwargs"] = config | options.get("config_kwargs", {})
        if self.scheme in (*S3, "gs", "gcs"):
            options.setdefault("use_listings_cache", False)  # trees keep listings, and know what was written
        if self.scheme in HTTP:
            from aiohttp import ClientTimeout

            silence = ClientTimeout(total=None, sock_connect=timeout, sock_read=timeout)
            bounded = {"timeout": silence, "response_class": bounded_response(timeout)}
            options["client_kwargs"] = bounded | options.get("client_kwargs", {})
        return options

    def send(self, requests: Sequence[Request], attempts: int | None = None) -> list[Any]:
        """Send requests, several at a time, and those that failed again.

        Returns:
            The answers, in the order of the requests: what the server sent, or the exception of a request that failed.
        """
        attempts = attempts or self.settings.attempts
        answers: list[Any] = [None] * len(requests)
        waiting = list(range(len(requests)))
        for attempt in range(attempts):
            if attempt:
                time.sleep(self.settings.draw_wait_s(attempt))
            for place, answer in zip(waiting, self._send_once([requests[i] for i in waiting]), strict=True):
                answers[place] = answer
            waiting = [i for i in waiting if isinstance(answers[i], BaseException) and is_temporary(answers[i])]
            if not waiting:
                break
        for answer in answers:
            if isinstance(answer, BaseException) and not isinstance(answer, Exception):
                raise answer  # an interruption
        return answers

    def persist(
        self, work: Callable[[], _Answer], count: Callable[[], int] = lambda: 0, stop: threading.Event | None = None
    ) -> _Answer:
        """Call a function that sends a request, and again after failures that may be temporary, as `send` does.

        Args:
            work: the function.
            count: returns how many bytes have arrived: attempts count anew where there are more than before.
            stop: ends the waiting when it is set.

        Returns:
            What `work` returns.

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
        """Ask a web server for the file once, and yield its answer, of which the body is read in pieces.

        Args:
            headers: those of the request.

        Raises:
            CarlascError: the request was redirected in a circle, to no web server, or from https to http.
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
        if (
            self.scheme == HUB and len(requests) > 1
        ):  # a file system that knows no asyncio, and may be used by several threads
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
        status: its status.
        reason: what the server calls it.
        headers: its headers; case does not matter.
        first: the first bytes of the body.
        more: returns the next bytes, none at the end of the body.
        error: that of aiohttp, where the status is 400 or more.
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
    """Whether garbage is collected: off while anybody needs it off."""

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
    """Let a library that holds a lock of its own wait for requests, as h5py does when it reads a file object.

    A collection of garbage on fsspec's thread could free an object of that library, which needs the same lock: each would wait for the
    other for ever. So nothing is collected meanwhile, nor does that thread begin in the middle of a collection.
    """
    import asyncio

    from fsspec.asyn import get_loop, sync

    _COLLECTING.stop()
    try:
        sync(get_loop(), asyncio.sleep, 0)  # when this has run, no collection is under way on that thread
        yield
    finally:
        _COLLECTING.resume()


async def _gather(fs: Any, requests: Sequence[Request], settings: RemoteSettings, scheme: str) -> list[Any]:
    import asyncio  # here, because it takes a twentieth of a second, which commands on local files need not wait

    gate = asyncio.Semaphore(settings.requests)

    async def one(request: Request) -> Any:
        async with gate:
            if request.name == "get":
                answer = await get(fs, scheme, str(request.url), settings.timeout_s, **request.options)
            else:
                answer = await getattr(fs, f"_{request.name}")(*request.arguments(), **request.options)
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
