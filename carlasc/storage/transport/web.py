"""The clients of web servers, through urllib3, and of the Hugging Face Hub.

Requests are sent in the thread that needs the answer, redirections are followed here.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from html import unescape
from typing import Any
from urllib.parse import unquote, urljoin, urlsplit

from carlasc.errors import ArgumentError, CarlascError, import_extra, without_credentials
from carlasc.storage.transport.clients import Client, FileSystemClient
from carlasc.storage.transport.failures import StatusError, WholeFileError, WrongAnswerError

PARTIAL = 206
"""The status of an answer to a request for a range."""

_PIECE = 256 << 10  # bytes per piece of a body
_MOST_BYTES = 1 << 30  # limit for files that are read whole; larger files are read in ranges
_MOST_OF_PAGE = 1 << 26  # maximum bytes of a page that lists a folder
_SLOWEST = 1000  # bytes per second
_REDIRECTIONS = 10
_LINK = re.compile(r"""<a\s[^>]*?href=["']([^"']+)""", re.IGNORECASE)


class WebClient(Client):
    """The client of a web server, which can only be read.

    Its only storage option is `headers`, the headers of each request.
    """

    read_only = "a web server, which can only be read"

    def __init__(self, url: str, options: Mapping[str, Any]) -> None:
        super().__init__(url, options)
        parse_url = import_extra("urllib3", "remote").util.parse_url
        for name in self.options.keys() - {"headers"}:
            raise ArgumentError(
                name, expected="`headers`, the storage option of web servers", found="another one"
            )
        self._login = unquote(parse_url(url).auth or "")

    def open(self) -> Any:
        """Return the pool of connections."""
        urllib3 = import_extra("urllib3", "remote")
        return urllib3.PoolManager(maxsize=self.settings.requests, timeout=self.settings.timeout_s)

    @contextmanager
    def answer(self, url: str, headers: Mapping[str, str], method: str = "GET") -> Iterator[Any]:
        """Send one request, follow redirections, and yield the answer of urllib3, with any status.
        Its body is not read yet.

        Raises:
            CarlascError: the request was redirected in a loop, to a URL that is not http(s), or
                from https to http.
            Exception: the server cannot be reached (an error of urllib3).
        """
        sent = {**self.options.get("headers", {}), **headers}
        if self._login:
            make_headers = import_extra("urllib3", "remote").make_headers
            sent |= make_headers(basic_auth=self._login)
        place = url
        for _ in range(_REDIRECTIONS):
            answer = self.connection.request(
                method, place, headers=sent, retries=False, redirect=False, preload_content=False
            )
            try:
                target = answer.get_redirect_location()
                if not target:
                    yield answer
                    return
            finally:
                answer.close()
            before = urlsplit(place)
            place = urljoin(place, target)
            after = urlsplit(place)
            if after.scheme not in (before.scheme, "https"):
                break
            if after.netloc != before.netloc:  # credentials are for the first server alone
                sent = {name: sent[name] for name in sent if name.lower() in ("range", "if-range")}
        raise CarlascError(
            without_credentials(url),
            expected="a file",
            found="a redirection in a loop, to another scheme, or from https to http",
            advice="check the URL",
        )

    def pieces(self, answer: Any) -> Iterator[bytes]:
        """Yield the body of an answer as it arrives.

        Raises:
            TimeoutError: for the time without data that the settings allow, less than a kilobyte
                per second has arrived.
            Exception: the connection broke (an error of urllib3).
        """
        count = 0
        began = time.monotonic()
        while piece := answer.read1(_PIECE, decode_content=False):
            yield piece
            count = count + len(piece)
            elapsed_s = time.monotonic() - began
            if elapsed_s > self.settings.timeout_s and count < _SLOWEST * elapsed_s:
                raise TimeoutError(f"{count} bytes in {elapsed_s:.0f} s")

    def get(
        self,
        url: str,
        start: int | None = None,
        end: int | None = None,
        headers: Mapping[str, str] | None = None,
        most: int = _MOST_BYTES,
    ) -> bytes:
        """Return bytes of a file with one request.

        A server may send more than it announced, even an endless body: more than `most` bytes of a
        whole file are refused.
        """
        wanted = dict(headers or {})
        if start is not None and end is not None:
            most = end - start
            wanted["Range"] = f"bytes={start}-{end - 1}"
        with self.answer(url, wanted) as answer:
            if answer.status == 416:  # the range starts after the end of the file
                return b""
            if answer.status == 404:
                raise FileNotFoundError(url)
            if answer.status >= 300:
                raise StatusError(answer.status)
            if start is not None and end is not None:
                if answer.status != PARTIAL:
                    # A server that announces ranges may send one when it is asked again.
                    has_ranges = answer.headers.get("Accept-Ranges") == "bytes"
                    kind = WrongAnswerError if has_ranges else WholeFileError
                    raise kind("the whole file instead of a range")
                check_range(answer.headers.get("Content-Range"), start, end)
            data = bytearray()
            for piece in self.pieces(answer):
                data += piece
                if len(data) > most:
                    raise WrongAnswerError(f"more than {most} bytes")
        return bytes(data)

    def about(self, url: str) -> tuple[int, str] | None:
        """Describe a file, from the headers of an answer. Some servers refuse HEAD."""
        for method in ("HEAD", "GET"):
            with self.answer(url, {}, method) as answer:
                headers = answer.headers
                status = answer.status
            if status == 404:
                return None
            if status < 300:
                if headers.get("Content-Type", "").startswith("text/html"):
                    return None
                if (size := headers.get("Content-Length", "")).isdecimal():
                    return int(size), headers.get("ETag") or headers.get("Last-Modified", "")
        raise StatusError(status) if status >= 300 else WrongAnswerError("no length")

    def entries(self, url: str) -> dict[str, bool]:
        """List a folder, from the links in its page."""
        folder = f"{url.partition('?')[0].rstrip('/')}/"
        try:
            page = self.get(url if "?" in url else folder, most=_MOST_OF_PAGE)
        except FileNotFoundError:
            return {}
        names = {}
        for link in _LINK.findall(page.decode(errors="replace")):
            place = re.split("[?#]", urljoin(folder, unescape(link)))[0]
            name, slash, more = place.removeprefix(folder).partition("/")
            if place.startswith(folder) and name and not more:
                names[unquote(name)] = bool(slash)
        return names

    def files(self, url: str) -> dict[str, tuple[int, str]]:
        """List all files below a folder."""
        if (about := self.about(url)) is not None:
            return {"": about}
        return {
            f"{name}/{path}".rstrip("/"): own
            for name in self.entries(url)
            for path, own in self.files(f"{url}/{name}").items()
        }


class HubClient(FileSystemClient):
    """The client of the Hugging Face Hub.

    The library lists files. Bytes are fetched here, because it repeats requests by its own rules,
    and does not compare the range that it receives with the one that it requested.
    """

    read_only = "the Hugging Face Hub, where each file would be a commit"

    def __init__(self, url: str, options: Mapping[str, Any]) -> None:
        super().__init__(url, options)
        import_extra("huggingface_hub", "hub")
        self._web = WebClient("https://huggingface.co", {})

    def get(self, url: str, start: int | None = None, end: int | None = None) -> bytes:
        """Return bytes of a file with one request."""
        hub = import_extra("huggingface_hub.utils", "hub")
        headers = hub.build_hf_headers(token=self.connection.token)
        return self._web.get(self.connection.url(url), start, end, headers)


def check_range(header: str | None, start: int, end: int) -> None:
    """Compare the header Content-Range, "bytes 0-99/1000", with the requested range.

    The file may end before the range does.

    Args:
        header: the header; None if the server sent none.
        start: first requested byte.
        end: end of the requested range, exclusive.

    Raises:
        WrongAnswerError: the header has another range.
    """
    found = re.fullmatch(r"bytes (\d+)-(\d+)/.*", header or f"bytes {start}-{start}/*")
    if found is None or int(found[1]) != start or int(found[2]) >= end:
        raise WrongAnswerError("another range of the file")
