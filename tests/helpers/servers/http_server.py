"""A local HTTP server with ranges, that can be told to misbehave."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Site:
    """What a server has and how it behaves; change it while it runs.

    Attributes:
        files: path -> bytes.
        url: where it listens.
        ranges: whether it knows ranges at all (and says so at the first request).
        etags: whether it sends a file's ETag.
        weak: whether these are weak ETags, to which no If-Range may refer.
        lengths: whether it tells a file's Content-Length.
        drop_after: closes the connection after so many bytes of a body, None never.
        ignore_ranges_after: after so many requests, sends the whole file where a range was asked
            for.
        shift_range: sends the right bytes under a Content-Range that is off by so many.
        content_type: what it calls its files.
        redirect: path -> path that it sends the client on to.
        status: the status that it answers every request with, None for those of a sound server.
        length_off: added to the Content-Length of ranges.
        before: called with the number of the request, before it is answered.
        requests: the Range header of each request for a body.
    """

    files: dict[str, bytes]
    url: str = ""
    ranges: bool = True
    etags: bool = True
    weak: bool = False
    lengths: bool = True
    drop_after: int | None = None
    ignore_ranges_after: int | None = None
    shift_range: int = 0
    content_type: str = "application/zip"
    redirect: dict[str, str] = field(default_factory=dict)
    status: int | None = None
    length_off: int = 0
    before: Callable[[int], None] | None = None
    requests: list[str | None] = field(default_factory=list)
    sent: int = 0


@contextmanager
def serve(site: Site) -> Iterator[Site]:
    """Run a server for a site on a free port of this machine."""

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            pass

        def do_GET(self) -> None:
            path = self.path.partition("?")[0]
            if path in site.redirect:
                self.send_response(302)
                self.send_header("Location", site.redirect[path])
                self.end_headers()
                return
            site.requests.append(self.headers.get("Range"))
            if site.before is not None:
                site.before(len(site.requests))
            if site.status is not None or path not in site.files:
                self.send_error(site.status or 404)
                return
            self._answer(site.files[path])

        def _answer(self, content: bytes) -> None:
            etag = f'{"W/" if site.weak else ""}"{hashlib.md5(content).hexdigest()}"'
            wanted = self.headers.get("Range")
            ignored = (
                site.ignore_ranges_after is not None
                and len(site.requests) > site.ignore_ranges_after
            )
            partial = site.ranges and wanted is not None and not ignored
            if site.etags and self.headers.get("If-Range") not in (None, "" if site.weak else etag):
                partial = False
            body = content
            if partial and wanted is not None:
                first, last = (int(number) for number in wanted.removeprefix("bytes=").split("-"))
                body = content[first : last + 1]
                self.send_response(206)
                shift = site.shift_range if first else 0
                span = f"bytes {first + shift}-{first + shift + len(body) - 1}/{len(content)}"
                self.send_header("Content-Range", span)
            else:
                self.send_response(200)
            if site.etags:
                self.send_header("ETag", etag)
            if site.lengths:
                self.send_header(
                    "Content-Length", str(len(body) + (site.length_off if len(body) > 2 else 0))
                )
            self.send_header("Content-Type", site.content_type)
            self.end_headers()
            if site.drop_after is not None and len(body) > site.drop_after:
                body = body[: site.drop_after]
                self.close_connection = True
            try:
                self.wfile.write(body)
                site.sent += len(body)
            except (BrokenPipeError, ConnectionResetError):
                self.close_connection = True  # the client has had enough

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    site.url = f"http://127.0.0.1:{server.server_port}"
    try:
        yield site
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
