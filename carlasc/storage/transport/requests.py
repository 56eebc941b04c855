"""Sending requests: several at a time, and again after temporary failures.

Object stores answer some requests with "503 Slow Down", close connections, or send less than they
announced. Such requests are sent again, after a random time whose limit doubles at each attempt.
Libraries that would repeat requests themselves are told not to: their retries would multiply with
these.
"""

from __future__ import annotations

import dataclasses
import os
import random
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

from carlasc.errors import ArgumentError
from carlasc.storage.transport.failures import is_temporary

_RANDOM = random.SystemRandom()  # independent of `random.seed`, and different in forked processes

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


def send(
    requests: Sequence[Callable[[], _Answer]], settings: RemoteSettings
) -> list[_Answer | Exception]:
    """Call functions that each send a request, several at a time, each as `persist` does.

    Args:
        requests: the functions; several threads call them.
        settings: how many at a time, and how often.

    Returns:
        One answer per request, in their order, or the exception of a failed request.
    """
    stop = threading.Event()

    def call(request: Callable[[], _Answer]) -> _Answer | Exception:
        try:
            return persist(request, settings, stop=stop)
        except Exception as error:  # noqa: BLE001 (each library raises its own types)
            return error

    if len(requests) < 2:
        return [call(request) for request in requests]
    threads = ThreadPoolExecutor(min(settings.requests, len(requests)))
    try:
        return list(threads.map(call, requests))
    finally:
        stop.set()  # after Ctrl-C, no further request is sent
        threads.shutdown(cancel_futures=True)


def persist(
    work: Callable[[], _Answer],
    settings: RemoteSettings,
    count: Callable[[], int] = lambda: 0,
    stop: threading.Event | None = None,
) -> _Answer:
    """Call a function that sends a request, again after temporary failures.

    Args:
        work: the function.
        settings: how often.
        count: returns the number of bytes received so far. After progress, attempts are counted
            from one again.
        stop: ends the waiting when it is set.

    Returns:
        The result of `work`.

    Raises:
        Exception: the error of the last attempt.
    """
    attempts = 0
    before = count()
    while True:
        try:
            return work()
        except Exception as error:
            arrived = count()
            attempts = 1 if arrived > before else attempts + 1
            before = arrived
            if attempts >= settings.attempts or not is_temporary(error):
                raise
            if (stop or threading.Event()).wait(settings.draw_wait_s(attempts)):
                raise
