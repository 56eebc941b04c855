"""Requests to object stores and web servers, through fsspec: many side by side, and tried again when a server fails.

Object stores answer some requests with "503 Slow Down", close connections, or send less than they announced. Such requests are sent
again, after a random time that doubles at each attempt. s3fs and botocore retry too, each by rules of its own, which would multiply:
their retries are turned off, so that this module alone decides how often and how long. Answers are compared with the range that was asked for.
"""

from __future__ import annotations

import dataclasses
import os
import random
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, NoReturn

from carlasc.errors import ArgumentError, CarlascError, MissingDataError, StorageError, import_extra
from carlasc.storage.folders.bodies import MOST_BYTES, WrongAnswerError, bounded_response, check_range, read_body
from carlasc.storage.folders.hub import HUB, get_from_hub, is_offline

_EXTRAS = {  # the package that a scheme needs, and the extra that installs it
    "http": ("aiohttp", "remote"),
    "https": ("aiohttp", "remote"),
    "s3": ("s3fs", "remote"),
    "s3a": ("s3fs", "remote"),
    HUB: ("huggingface_hub", "hub"),
}
_S3, _HTTP = ("s3", "s3a"), ("http", "https")
_RANDOM = random.SystemRandom()  # of its own: a failure must not change what a program draws, nor two forks wait alike
_BUSY = frozenset({408, 409, 425, 429})  # of the statuses below 500, those of requests that may succeed later
_BUSY_CODES = frozenset({"SlowDown", "RequestTimeout", "Throttling", "ThrottlingException", "OperationAborted"})
_SENT_AGAIN = (  # names of errors of the connection, as aiohttp, botocore, requests and httpx have them
    "ConnectionError", "ClientConnectionError", "ClientPayloadError", "HTTPClientError", "ResponseParserError", "FlexibleChecksumError",
    "FSTimeoutError", "IncompleteRead", "IncompleteReadError", "HttpProcessingError", "ChunkedEncodingError",
    "ResponseStreamingError", "TransferEncodingError", "TransportError",
)  # fmt: skip


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
        self.is_s3 = self.scheme in _S3
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

    def _fsspec_options(self) -> dict[str, Any]:
        """Return the storage options, with the settings of s3fs and aiohttp that leave retries and listings to this package."""
        timeout, options = self.settings.timeout_s, dict(self.options)
        if self.is_s3:
            config = {"connect_timeout": timeout, "read_timeout": timeout, "retries": {"total_max_attempts": 1}}
            config["max_pool_connections"] = self.settings.requests
            options["config_kwargs"] = config | options.get("config_kwargs", {})
        if self.scheme in (*_S3, "gs", "gcs"):
            options.setdefault("use_listings_cache", False)  # trees keep listings, and know what was written
        if self.scheme in _HTTP:
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
                longest = min(self.settings.backoff_s * 2 ** (attempt - 1), self.settings.longest_wait_s)
                time.sleep(_RANDOM.uniform(0, longest))  # at random, so that many clients do not come back at once
            for place, answer in zip(waiting, self._send_once([requests[i] for i in waiting]), strict=True):
                answers[place] = answer
            waiting = [i for i in waiting if isinstance(answers[i], BaseException) and is_temporary(answers[i])]
            if not waiting:
                break
        for answer in answers:
            if isinstance(answer, BaseException) and not isinstance(answer, Exception):
                raise answer  # an interruption
        return answers

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


async def _gather(fs: Any, requests: Sequence[Request], settings: RemoteSettings, scheme: str) -> list[Any]:
    import asyncio  # here, because it takes a twentieth of a second, which commands on local files need not wait

    gate = asyncio.Semaphore(settings.requests)

    async def one(request: Request) -> Any:
        async with gate:
            if request.name == "get":
                answer = await _get(fs, scheme, str(request.url), settings.timeout_s, **request.options)
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


def _get(
    fs: Any, scheme: str, url: str, patience_s: float, start: int | None = None, end: int | None = None
) -> Awaitable[bytes]:
    """Return the bytes [start, end) of a file, or the whole file; from a web server that sends them within reason."""
    if scheme in _S3:
        return _get_s3(fs, url, start, end)
    if scheme in _HTTP:
        return _get_http(fs, url, start, end, patience_s)
    return fs._cat_file(url, start=start, end=end)


async def _get_s3(fs: Any, url: str, start: int | None, end: int | None) -> bytes:
    bucket, key, version = fs.split_path(fs._strip_protocol(url))
    wanted: dict[str, Any] = {"Bucket": bucket, "Key": key} | ({"VersionId": version} if version else {})
    if start is not None and end is not None:
        wanted["Range"] = f"bytes={start}-{end - 1}"
    try:
        answer = await fs._call_s3("get_object", fs.req_kw, **wanted)
    except OSError as error:
        if _status_and_code(error)[0] == 416:  # the range starts behind the end of the file
            return b""
        raise
    async with answer["Body"] as body:
        data = bytes(await body.read())
    if start is not None:
        check_range(answer.get("ContentRange"), start, end)
    return data


async def _get_http(fs: Any, url: str, start: int | None, end: int | None, patience_s: float) -> bytes:
    session = await fs.set_session()
    settings = dict(fs.kwargs)
    headers = dict(settings.pop("headers", {}))
    if start is not None and end is not None:
        headers["Range"] = f"bytes={start}-{end - 1}"
    async with session.get(fs.encode_url(url), headers=headers, **settings) as answer:
        if answer.status == 416:
            return b""
        fs._raise_not_found_for_status(answer, url)
        if start is not None and answer.status != 206:
            raise WrongAnswerError("the whole file instead of a range")
        most = MOST_BYTES if start is None or end is None else end - start
        data = await read_body(answer.content, most, patience_s)
    if start is not None:
        check_range(answer.headers.get("Content-Range"), start, end)
    return data


def is_temporary(error: BaseException) -> bool:
    """Whether a request that failed with an error may succeed when it is sent again."""
    if is_offline(error):
        return False
    if _is_of_connection(error):
        return True
    status, code = _status_and_code(error)
    if code in _BUSY_CODES or status in _BUSY:
        return True
    if status is not None:
        return status >= 500 and status != 501  # not implemented
    return isinstance(error, WrongAnswerError | TimeoutError | ConnectionError)


def _is_of_connection(error: BaseException) -> bool:
    return any(kind.__name__ in _SENT_AGAIN for kind in type(error).__mro__)


def _causes(error: BaseException) -> Iterator[BaseException]:
    found: BaseException | None = error
    for _ in range(5):
        if found is None:
            return
        yield found
        found = found.__cause__


def _status_and_code(error: BaseException) -> tuple[int | None, str]:
    """Return the HTTP status of an error, and the code of an S3 error ("NoSuchBucket"), where it has them."""
    for cause in (
        () if _is_of_connection(error) else _causes(error)
    ):  # aiohttp's errors of payloads have a "code" of their own
        answer = getattr(cause, "response", None)
        if isinstance(answer, Mapping):  # botocore
            status = answer.get("ResponseMetadata", {}).get("HTTPStatusCode")
            code = str(answer.get("Error", {}).get("Code", ""))
            return (status if isinstance(status, int) else None), code
        for holder, name in ((cause, "status"), (cause, "code"), (answer, "status_code")):
            found = getattr(holder, name, None)
            if isinstance(found, int) and 100 <= found < 600:
                return found, ""
    return None, ""


def exists_error(error: object) -> bool:
    """Whether a create-only put failed because the file exists."""
    return isinstance(error, FileExistsError) or (
        isinstance(error, BaseException) and _status_and_code(error)[0] == 412
    )


def bucket_is_missing(error: BaseException) -> bool:
    """Whether the bucket of an S3 URL does not exist."""
    return _status_and_code(error)[1] == "NoSuchBucket"


def fail(where: str, error: BaseException, *, writing: bool = False) -> NoReturn:
    """Raise the error of a request as one line that holds no credentials.

    The messages of other libraries are left out: they may hold a URL's signature or a key. For the same reason, the error has no cause.

    Raises:
        MissingDataError: the file or the bucket does not exist.
        StorageError: it cannot be written (where `writing`).
        CarlascError: anything else.
    """
    if isinstance(error, CarlascError):
        raise error
    status, code = _status_and_code(error)
    kind: type[CarlascError] = StorageError if writing else CarlascError
    verb = "cannot be written" if writing else "cannot be read"
    if code == "NoSuchBucket":
        raise (StorageError if writing else MissingDataError)(
            where, expected="a bucket that exists", found="no such bucket", advice="check its name, or create it"
        ) from None
    if isinstance(error, FileNotFoundError) and not writing:
        raise MissingDataError(where, expected="a file", found="nothing") from None
    if isinstance(error, PermissionError) or status in (401, 403):
        raise kind(
            where,
            problem=f"{verb}: access was refused ({code or status or 'no permission'})",
            advice="check the credentials and what they are permitted to do",
        ) from None
    if "Credential" in type(error).__name__:
        raise kind(
            where,
            problem=f"{verb}: no credentials were found",
            advice="set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or FSSPEC_S3_ANON=true for a public bucket",
        ) from None
    if is_offline(error):
        raise kind(where, problem=f"{verb}: HF_HUB_OFFLINE is set", advice="unset it to use the network") from None
    if is_temporary(error):
        raise kind(
            where,
            problem=f"{verb}: the server failed at each attempt, last with {_describe(error)}",
            advice="try again later",
        ) from None
    raise kind(where, problem=f"{verb}: {_describe(error)}") from None


def _describe(error: BaseException) -> str:
    status, code = _status_and_code(error)
    if isinstance(error, WrongAnswerError):
        return str(error)
    parts = [str(status) if status else "", code if code != str(status) else ""]
    if text := " ".join(part for part in parts if part):
        return text
    reason = getattr(error, "strerror", None)
    name = type(error).__name__
    return f"{name} ({reason})" if isinstance(reason, str) and type(error).__module__ == "builtins" else name
