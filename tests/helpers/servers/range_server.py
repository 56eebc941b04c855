"""A local HTTP server of a folder, with ranges, HEAD and ETags, as object stores have them.

It counts what it sends.

`python tests/helpers/servers/range_server.py FOLDER DELAY_S` prints its URL and serves until its
input is closed, in a process of its own. It waits before it answers, as a store does that is far
away.
"""

from __future__ import annotations

import os
import re
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

_BLOCK = 1 << 20


@dataclass
class Served:
    """A folder that is served.

    Attributes:
        folder: the folder.
        url: where it is served.
        sent: bytes of the bodies sent, by path.
        asked: requests for the size and the ETag alone, by path.
        broken: whether bodies end after half of their bytes.
        before: called with the path of each request for a body, before it is answered.
    """

    folder: Path
    url: str = ""
    sent: Counter[str] = field(default_factory=Counter)
    asked: Counter[str] = field(default_factory=Counter)
    broken: bool = False
    before: Callable[[str], object] | None = None


@contextmanager
def serve_folder(folder: Path) -> Iterator[Served]:
    """Serve a folder on a free port of this machine."""
    served = Served(folder)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True
        wbufsize = 1 << 16  # headers in one packet

        def log_message(self, format: str, *args: object) -> None:
            pass

        def do_HEAD(self) -> None:
            served.asked[self.path.strip("/")] += 1
            self._answer(with_body=False)

        def do_GET(self) -> None:
            if served.before is not None:
                served.before(self.path.strip("/"))
            self._answer(with_body=True)

        def _answer(self, with_body: bool) -> None:
            path = folder / self.path.strip("/")
            if not path.is_file():
                self.send_error(404)
                return
            with path.open("rb") as file:
                found = os.fstat(file.fileno())
                wanted = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
                first, last = (int(wanted[1]), int(wanted[2])) if wanted else (0, found.st_size - 1)
                last = min(last, found.st_size - 1)
                self.send_response(206 if wanted else 200)
                if wanted:
                    self.send_header("Content-Range", f"bytes {first}-{last}/{found.st_size}")
                self.send_header("Accept-Ranges", "bytes")
                self.send_header("ETag", f'"{found.st_mtime_ns:x}-{found.st_size:x}"')
                self.send_header("Content-Type", "application/octet-stream")
                self.send_header("Content-Length", str(last + 1 - first))
                self.end_headers()
                if with_body:
                    self._send(file.fileno(), first, last + 1)

        def _send(self, source: int, start: int, end: int) -> None:
            self.wfile.flush()
            if served.broken:
                self.close_connection, end = True, (start + end) // 2
            served.sent[self.path.strip("/")] += end - start
            try:
                while start < end:
                    start += os.sendfile(
                        self.connection.fileno(), source, start, min(_BLOCK, end - start)
                    )
            except (BrokenPipeError, ConnectionResetError):
                self.close_connection = True  # the client was ended

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    served.url = f"http://127.0.0.1:{server.server_port}"
    try:
        yield served
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


if __name__ == "__main__":
    with serve_folder(Path(sys.argv[1])) as at:
        delay_s = float(sys.argv[2])
        at.before = lambda _: time.sleep(delay_s)
        print(at.url, flush=True)
        sys.stdin.read()
