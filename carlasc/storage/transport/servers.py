"""Fetching bytes from each kind of server with one checked request.

fsspec file systems list and describe files. This module fetches the bytes, so that answers are
checked, and that one rule for retries holds for s3fs, botocore and huggingface_hub. `PRIVATE` lists
undocumented names of other packages that this needs; a test fails with the version of the package
if one of them is removed.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import cache
from typing import Any

from carlasc.errors import CarlascError, import_extra, without_credentials
from carlasc.storage.transport.failures import WrongAnswerError, ends_before

PRIVATE: Mapping[str, tuple[str, ...]] = {
    "fsspec.asyn.AsyncFileSystem": (
        "_cat_file",
        "_find",
        "_info",
        "_ls",
        "_pipe_file",
        "_rm",
        "_rm_file",
    ),
    "s3fs.S3FileSystem": ("_call_s3", "_metadata"),
}
"""Undocumented methods by class.

For fsspec, they are the coroutines of asynchronous file systems.
"""

HUB = "hf"
"""The scheme of the URLs of the Hugging Face Hub (`hf://datasets/ORG/NAME/...`)."""
S3, HTTP = ("s3", "s3a"), ("http", "https")
_MOST_BYTES = 1 << 30  # limit for files that are read whole; larger files are read in ranges
_MOST_OF_PAGE = 1 << 26  # maximum bytes of a page that lists a folder
_SLOWEST = 1000  # bytes per second
_LONGEST_PIECE_S = 0.5  # maximum time to collect the bytes of one piece


async def get(
    fs: Any,
    scheme: str,
    url: str,
    patience_s: float,
    start: int | None = None,
    end: int | None = None,
) -> bytes:
    """Return the bytes [start, end) of a file, or the whole file.

    Args:
        fs: the fsspec file system, with asyncio.
        scheme: scheme of the URL.
        url: URL of the file.
        patience_s: maximum time during which a web server may send less than a kilobyte per second.
        start: first byte; None for the whole file.
        end: end of the range, exclusive; None for the whole file.

    Raises:
        FileNotFoundError: the file does not exist.
        WrongAnswerError: the answer does not fit the request.
        Exception: the request failed, with an error of the package that sent it.
    """
    if scheme in S3:
        return await _get_s3(fs, url, start, end)
    if scheme in HTTP:
        return await _get_http(fs, url, start, end, patience_s)
    return bytes(await fs._cat_file(url, start=start, end=end))


async def _get_s3(fs: Any, url: str, start: int | None, end: int | None) -> bytes:
    bucket, key, version = fs.split_path(url)
    wanted: dict[str, Any] = {"Bucket": bucket, "Key": key} | (
        {"VersionId": version} if version else {}
    )
    if start is not None and end is not None:
        wanted["Range"] = f"bytes={start}-{end - 1}"
    try:
        answer = await fs._call_s3("get_object", fs.req_kw, **wanted)
    except OSError as error:
        if ends_before(error):
            return b""
        raise
    async with answer["Body"] as body:
        data = bytes(await body.read())
    if start is not None:
        check_range(answer.get("ContentRange"), start, end)
    return data


async def _get_http(
    fs: Any, url: str, start: int | None, end: int | None, patience_s: float
) -> bytes:
    wanted = {} if start is None or end is None else {"Range": f"bytes={start}-{end - 1}"}
    async with await http_answer(fs, url, wanted) as answer:
        if answer.status == 416:
            return b""
        if answer.status == 404:
            raise FileNotFoundError(url)
        answer.raise_for_status()
        if start is not None and answer.status != 206:
            raise WrongAnswerError("the whole file instead of a range")
        most = _MOST_BYTES if start is None or end is None else end - start
        data = await read_body(answer.content, most, patience_s)
    if start is not None:
        check_range(answer.headers.get("Content-Range"), start, end)
    return data


async def http_answer(fs: Any, url: str, headers: Mapping[str, str]) -> Any:
    """Send a request for a file to a web server, and return the answer of aiohttp.

    The body is not read yet.

    Args:
        fs: the fsspec file system for web servers.
        url: URL of the file.
        headers: headers in addition to those in the options of the file system.

    Raises:
        CarlascError: the request was redirected in a loop, to a URL that is not http(s), or from
            https to http.
        aiohttp.ClientError: the request failed.
    """
    session = await fs.set_session()
    settings = dict(fs.kwargs)
    together = {**settings.pop("headers", {}), **headers}
    try:
        answer = await session.get(fs.encode_url(url), headers=together, **settings)
    except Exception as error:
        # Since 3.10, aiohttp has a separate error for other schemes.
        if "Redirect" in type(error).__name__ or type(error) is ValueError:
            raise _leads_nowhere(url) from None
        raise
    schemes = [step.url.scheme for step in answer.history] + [answer.url.scheme]
    if "https" in schemes and "http" in schemes[schemes.index("https") :]:
        answer.close()
        raise _leads_nowhere(url)
    return answer


def _leads_nowhere(url: str) -> CarlascError:
    return CarlascError(
        without_credentials(url),
        expected="a file",
        found="a redirection in a loop, to another scheme, or from https to http",
        advice="check the URL",
    )


def status_error(answer: Any) -> Exception | None:
    """Return the error of an answer of aiohttp with a status of 400 or more; otherwise None."""
    try:
        answer.raise_for_status()
    except Exception as error:  # noqa: BLE001 (aiohttp is imported where it is used)
        return error
    return None


async def read_piece(content: Any, most: int) -> bytes:
    """Return the next bytes of a body: at most `most`, fewer if they arrive slowly, empty at the
    end.

    When a connection breaks, aiohttp drops received bytes. This function returns them, and the next
    call raises the error.

    Args:
        content: the body of an answer of aiohttp.
        most: largest number of bytes.
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


def get_from_hub(
    fs: Any, url: str, timeout_s: float, start: int | None = None, end: int | None = None
) -> bytes:
    """Return the bytes [start, end) of a file of the Hub, or the whole file.

    Args:
        fs: the file system of huggingface_hub.
        url: the file.
        timeout_s: maximum time without data from the server, seconds.
        start: first byte; None for the whole file.
        end: end of the range, exclusive; None for the whole file.

    Raises:
        FileNotFoundError: the file does not exist.
        WrongAnswerError: the answer does not fit the request.
        OSError: the request failed (an error of huggingface_hub).
    """
    hub = import_extra("huggingface_hub.utils", "hub")
    headers = dict(hub.build_hf_headers(token=fs.token))
    if start is not None and end is not None:
        headers["Range"] = f"bytes={start}-{end - 1}"
    answer = hub.get_session().get(fs.url(url), headers=headers, timeout=timeout_s)
    if answer.status_code == 416:  # the range starts after the end of the file
        return b""
    if answer.status_code == 404:
        raise FileNotFoundError(url)
    hub.hf_raise_for_status(answer)
    if start is not None:
        if answer.status_code != 206:
            raise WrongAnswerError("the whole file instead of a range")
        check_range(answer.headers.get("Content-Range"), start, end)
    return bytes(answer.content)


@cache
def bounded_response(patience_s: float) -> Any:
    """Return a subclass of the response of aiohttp that limits the size and time of bodies. fsspec
    reads listings with it.
    """
    from aiohttp import ClientResponse

    class BoundedResponse(ClientResponse):
        async def read(self) -> bytes:
            return await read_body(self.content, _MOST_OF_PAGE, patience_s)

        async def text(self, encoding: str | None = None, errors: str = "strict") -> str:
            return (await self.read()).decode(encoding or self.charset or "utf-8", errors)

    return BoundedResponse


async def read_body(content: Any, most: int, patience_s: float) -> bytes:
    """Read a body of at most `most` bytes.

    A server may send more than it announced, even an endless body.

    Args:
        content: the body of an answer of aiohttp.
        most: largest number of bytes.
        patience_s: maximum time during which the server may send less than a kilobyte per second.

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


def check_range(found: str | None, start: int, end: int | None) -> None:
    """Compare the header Content-Range, "bytes 0-99/1000", with the requested range.

    The file may end before the range does.

    Args:
        found: the header; None if the server sent none.
        start: first requested byte.
        end: end of the requested range, exclusive; None for the end of the file.

    Raises:
        WrongAnswerError: the header has another range.
    """
    first, _, last = (found or "").removeprefix("bytes ").partition("/")[0].partition("-")
    if found is not None and not (
        first == str(start) and last.isdigit() and (end is None or int(last) < end)
    ):
        raise WrongAnswerError("another range of the file")


def check_size(expected: int, data: bytes) -> None:
    """Raise a WrongAnswerError if the number of received bytes is not `expected`."""
    if len(data) != expected:
        raise WrongAnswerError(f"{len(data)} bytes instead of {expected}")
