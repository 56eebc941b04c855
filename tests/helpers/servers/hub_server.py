"""A server that answers as the Hugging Face Hub does, for data sets that are folders of this
machine.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from urllib.parse import unquote, urlsplit

_API = re.compile(r"/api/datasets/([^/]+/[^/]+)(?:/(revision|tree)/[^/]+)?/?(.*)")
_FILE = re.compile(r"/datasets/([^/]+/[^/]+)/resolve/[^/]+/(.*)")


class Hub(ThreadingHTTPServer):
    """The server.

    Attributes:
        folders: the folder of each data set, by "ORG/NAME".
        private: names of data sets that nobody may read without the token "secret".
        faults: statuses that the next requests for files are answered with; 0 sends the whole file
            instead of a range.
        requests: paths of all requests.
    """

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.folders: dict[str, Path] = {}
        self.private: set[str] = set()
        self.faults: list[int] = []
        self.requests: list[str] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class _Handler(BaseHTTPRequestHandler):
    server: Hub

    def log_message(self, format: str, *args: object) -> None:
        pass

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path = unquote(urlsplit(self.path).path)
        self.server.requests.append(path)
        if found := _FILE.fullmatch(path):
            self._send_file(found[1], found[2])
        elif found := _API.fullmatch(path):
            self._describe(found[1], found[2] == "tree", found[3])
        else:
            self._send(404, b"")

    def _describe(self, name: str, listing: bool, path: str) -> None:
        folder = self._folder(name)
        if folder is None:
            return
        if not listing:
            self._send(200, json.dumps({"id": name, "sha": "0" * 40, "siblings": []}).encode())
        elif not (folder / path).is_dir():
            self._send(404, b"{}", "EntryNotFound")
        else:
            recursive = "recursive=true" in self.path.lower()
            entries = (folder / path).rglob("*") if recursive else (folder / path).iterdir()
            rows = [
                {
                    "type": "directory" if entry.is_dir() else "file",
                    "oid": f"{entry.stat().st_mtime_ns:040x}",
                    "size": 0 if entry.is_dir() else entry.stat().st_size,
                    "path": entry.relative_to(folder).as_posix(),
                }
                for entry in sorted(entries)
            ]
            self._send(200, json.dumps(rows).encode())

    def _send_file(self, name: str, path: str) -> None:
        folder = self._folder(name)
        if folder is None:
            return
        fault = self.server.faults.pop() if self.server.faults else None
        if fault:
            self._send(fault, b"")
            return
        if not (folder / path).is_file():
            self._send(404, b"", "EntryNotFound")
            return
        data = (folder / path).read_bytes()
        wanted = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if wanted is None or fault == 0:
            self._send(200, data)
        elif int(wanted[1]) >= len(data):
            self._send(416, b"")
        else:
            part = data[int(wanted[1]) : int(wanted[2]) + 1]
            self._send(
                206,
                part,
                content_range=f"bytes {wanted[1]}-{int(wanted[1]) + len(part) - 1}/{len(data)}",
            )

    def _folder(self, name: str) -> Path | None:
        """Return the folder of a data set; answer and return None if there is none that the client
        may see.
        """
        hidden = (
            name in self.server.private and self.headers.get("authorization") != "Bearer secret"
        )
        if name not in self.server.folders or hidden:
            self._send(401, b"{}", "RepoNotFound")
            return None
        return self.server.folders[name]

    def _send(self, status: int, data: bytes, error: str = "", content_range: str = "") -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Accept-Ranges", "bytes")  # as the servers of the Hub do
        if error:
            self.send_header("X-Error-Code", error)
        if content_range:
            self.send_header("Content-Range", content_range)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)


@contextmanager
def hub_server() -> Iterator[Hub]:
    """Run the server while the block runs."""
    with Hub() as server:
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
