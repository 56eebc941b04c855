"""Ranges of a file over HTTP, accepted only if all headers agree with the request."""

from __future__ import annotations

import http.client
import re
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPResponse

from carlasc.errors import CarlascError, FormatError, MissingDataError

TIMEOUT_S = 20.0
_ZIP = b"PK"
_GONE = (401, 403, 404, 410)
_FULL, _PARTIAL = 200, 206


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Follows redirections to web servers only, and from https to https only."""

    def redirect_request(self, req, fp, code, msg, headers, newurl):  # type: ignore[no-untyped-def]  # noqa: ANN
        """Return the request that follows; refuses an address of another kind."""
        scheme = newurl.partition(":")[0].lower()
        if scheme not in ("http", "https") or (req.type == "https" and scheme == "http"):
            raise urllib.error.HTTPError(req.full_url, code, f"to {newurl.partition(':')[0]}:", headers, fp)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


_OPENER = urllib.request.build_opener(_Redirects)


class InterruptionError(Exception):
    """The connection was interrupted or the server failed: the request may be repeated."""


class ChangedError(Exception):
    """The file on the server has changed since the transfer began."""


class RangeIgnoredError(Exception):
    """The server sent the whole file instead of the requested range."""


@dataclass(frozen=True)
class RemoteFile:
    """What a server says of a file.

    Attributes:
        url: its URL.
        size: its bytes; None if the server does not say.
        validator: its ETag, or else its date, which tell whether it has changed; None if the server sends neither.
        ranges: whether the server supports range requests.
    """

    url: str
    size: int | None
    validator: str | None
    ranges: bool


def probe(url: str) -> RemoteFile:
    """Request the first bytes of a zip, to learn its size, whether ranges are supported, and whether it is a zip.

    Raises:
        InterruptionError: the server cannot be reached now.
        MissingDataError: the file does not exist, or access is denied.
        FormatError: the file is not a zip.
    """
    with _request(url, {"Range": f"bytes=0-{len(_ZIP) - 1}"}) as response:
        partial = response.status == _PARTIAL
        start = response.read(len(_ZIP))
        content = response.headers.get("Content-Type", "something unnamed")
        size = _total(response, url) if partial else _length(response)
        validator = _validator(response)
    if start != _ZIP:
        raise FormatError(
            url, expected="a zip", found=f"{content} that begins with {start!r}", advice="has the link moved?"
        )
    return RemoteFile(url, size, validator, partial)


def read_range(file: RemoteFile, start: int, stop: int, piece: int) -> Iterator[bytes]:
    """Yield the bytes [start, stop) of a file in pieces.

    Raises:
        InterruptionError: the connection was interrupted, or the server sent another range; what was yielded is correct.
        ChangedError: the file has changed; nothing was yielded.
        RangeIgnoredError: the server sent the whole file; nothing was yielded.
    """
    headers = {"Range": f"bytes={start}-{stop - 1}"}
    if file.validator is not None and not file.validator.startswith("W/"):
        headers["If-Range"] = file.validator
    with _request(file.url, headers) as response:
        if file.validator is not None and _validator(response) not in (file.validator, None):
            raise ChangedError(file.url)
        if response.status != _PARTIAL:
            raise RangeIgnoredError(file.url)
        if _total(response, file.url) != file.size:
            raise ChangedError(file.url)
        expected = f"bytes {start}-{stop - 1}/{file.size}"
        if response.headers.get("Content-Range", "") != expected:
            raise InterruptionError(f"expected {expected}, found {response.headers.get('Content-Range')}")
        if _length(response) not in (None, stop - start):
            raise InterruptionError(f"expected {stop - start} bytes, found a Content-Length of {_length(response)}")
        yield from _pieces(response, stop - start, piece)


def read_whole(file: RemoteFile, piece: int) -> Iterator[bytes]:
    """Yield a whole file in pieces, from a server without range requests.

    Raises:
        InterruptionError: the connection was interrupted; what was yielded is the beginning of the file.
        ChangedError: the file has changed; nothing was yielded.
    """
    with _request(file.url, {}) as response:
        if (file.validator, file.size) != (_validator(response), _length(response)):
            raise ChangedError(file.url)
        yield from _pieces(response, file.size, piece)


def _pieces(response: HTTPResponse, count: int | None, piece: int) -> Iterator[bytes]:
    left = count
    while left is None or left > 0:
        try:
            data = response.read(piece if left is None else min(piece, left))
        except (OSError, http.client.HTTPException) as error:
            raise InterruptionError(str(error) or type(error).__name__) from error
        if not data:
            break
        if left is not None:
            left -= len(data)
        yield data
    if left:
        raise InterruptionError(f"the connection ended {left} bytes early")


@contextmanager
def _request(url: str, headers: dict[str, str]) -> Iterator[HTTPResponse]:
    request = urllib.request.Request(url, headers={"User-Agent": "carlasc", "Accept-Encoding": "identity", **headers})
    try:
        response = _OPENER.open(request, timeout=TIMEOUT_S)
    except urllib.error.HTTPError as error:
        error.close()
        if 300 <= error.code < 400:  # in a circle, or to no web server
            raise CarlascError(
                url, expected="a file", found=f"a redirection that leads nowhere ({error.reason})"
            ) from error
        if error.code in _GONE:
            raise MissingDataError(url, expected="a file", found=f"status {error.code} ({error.reason})") from error
        raise InterruptionError(f"status {error.code} ({error.reason})") from error
    except (OSError, http.client.HTTPException) as error:
        raise InterruptionError(str(error) or type(error).__name__) from error
    except ValueError as error:
        raise CarlascError(url, expected="a URL", found=f"something else ({error})") from error
    with response:
        yield response


def _validator(response: HTTPResponse) -> str | None:
    return response.headers.get("ETag") or response.headers.get("Last-Modified")


def _length(response: HTTPResponse) -> int | None:
    text = response.headers.get("Content-Length", "")
    return int(text) if re.fullmatch("[0-9]{1,18}", text) else None


def _total(response: HTTPResponse, url: str) -> int:
    """Return the size of the whole file, from Content-Range."""
    text = response.headers.get("Content-Range", "")
    match = re.fullmatch(r"bytes [0-9]+-[0-9]+/([0-9]{1,18})", text)
    if match is None:
        raise InterruptionError(f"{url}: expected a Content-Range, found {text!r}")
    return int(match[1])
