"""An S3 server on this machine, and a proxy before it that makes the faults of real ones."""

from __future__ import annotations

import http.client
import logging
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

KEY, SECRET, BUCKET = "AKIAEXAMPLEOFAKEY", "a-very-secret-secret", "carlasc-tests"
# (number of the request, method, path) -> name of a fault
Fault = Callable[[int, str, str], str | None]


@contextmanager
def s3_server() -> Iterator[str]:
    """Yield the endpoint of an S3 server that has an empty bucket."""
    moto = pytest.importorskip("moto.server")
    pytest.importorskip("obstore")
    logging.getLogger("werkzeug").setLevel(logging.WARNING)  # not a line for each request
    server = moto.ThreadedMotoServer(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    client_of(endpoint).create_bucket(Bucket=BUCKET)
    yield endpoint
    # buckets outlive a server
    request = urllib.request.Request(f"{endpoint}/moto-api/reset", method="POST")
    urllib.request.urlopen(request).close()
    server.stop()


def client_of(endpoint: str) -> Any:
    """Return a client of the S3 API that is not ours."""
    return pytest.importorskip("boto3").client(
        "s3",
        endpoint_url=endpoint,
        aws_access_key_id=KEY,
        aws_secret_access_key=SECRET,
        region_name="us-east-1",
    )


def options_for(endpoint: str) -> dict[str, Any]:
    """Return fsspec's options for an endpoint."""
    return {"key": KEY, "secret": SECRET, "endpoint_url": endpoint}


def environment_for(endpoint: str) -> dict[str, str]:
    """Return the environment of a command that uses an endpoint."""
    return {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": KEY,
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
        "CARLASC_REMOTE_BACKOFF_S": "0.01",
    }


def every(step: int, fault: str, method: str = "") -> Fault:
    """Return what gives a fault to every so many requests of a method, or of all."""
    seen: Counter[str] = Counter()

    def choose(number: int, found: str, path: str) -> str | None:
        if method and found != method:
            return None
        seen[fault] += 1
        return fault if seen[fault] % step == 0 else None

    return choose


def _error(code: str) -> bytes:
    return f'<?xml version="1.0"?><Error><Code>{code}</Code><Message>key {SECRET}</Message></Error>'.encode()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: FaultyServer

    def log_message(self, format: str, *args: object) -> None:
        pass

    def _handle(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", "0")))
        fault = self.server.next_fault(self.command, self.path)
        if fault == "drop":
            self.close_connection = True
            return
        if fault == "silence":
            time.sleep(3)
            self.close_connection = True
            return
        if fault is not None and fault.isdigit():
            self._answer(int(fault), {}, _error({"503": "SlowDown", "403": "AccessDenied"}[fault]))
            return
        if fault == "other range" and "Range" in self.headers:
            first, _, last = self.headers["Range"].removeprefix("bytes=").partition("-")
            shifted = str(int(last) + 1) if last else ""
            self.headers.replace_header("Range", f"bytes={int(first) + 1}-{shifted}")
        status, headers, data = self._forward(body)
        if fault == "lose the answer":
            self.close_connection = True
        elif fault == "cut":
            self._answer(status, headers, data[: len(data) // 2], len(data))
        elif fault == "too long":
            self._answer(status, headers, data, len(data) + 10)
        elif fault == "too short":
            self._answer(status, headers, data[: len(data) // 2])
        else:
            self._answer(status, headers, data)

    do_GET = do_PUT = do_HEAD = do_POST = do_DELETE = _handle

    def _forward(self, body: bytes) -> tuple[int, dict[str, str], bytes]:
        connection = http.client.HTTPConnection(self.server.behind)
        headers = {name: value for name, value in self.headers.items() if name.lower() != "expect"}
        connection.request(self.command, self.path, body or None, headers)
        answer = connection.getresponse()
        data = answer.read()
        connection.close()
        kept = {
            n: v
            for n, v in answer.getheaders()
            if n.lower() not in ("connection", "transfer-encoding", "server")
        }
        return answer.status, kept, data

    def _answer(
        self, status: int, headers: dict[str, str], data: bytes, length: int | None = None
    ) -> None:
        headers = dict(headers)
        if self.command != "HEAD":
            headers["Content-Length"] = str(len(data) if length is None else length)
        lines = [f"HTTP/1.1 {status} -", *(f"{name}: {value}" for name, value in headers.items())]
        self.wfile.write(
            "\r\n".join([*lines, "", ""]).encode("latin-1")
            + (b"" if self.command == "HEAD" else data)
        )
        self.close_connection = length is not None


class FaultyServer(ThreadingHTTPServer):
    """Hands requests to a server, and answers some of them wrongly.

    Attributes:
        url: its endpoint.
        fault: chooses the fault of each request.
        made: how often each fault was made.
        requests: how often each method was used.
    """

    daemon_threads = True
    request_queue_size = 128

    def __init__(self, behind: str) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.behind = behind.removeprefix("http://")
        self.url = f"http://127.0.0.1:{self.server_port}"
        self._lock = threading.Lock()
        self.reset(lambda number, method, path: None)

    def reset(self, fault: Fault) -> None:
        """Make other faults from now on, and count again."""
        self.fault, self.made, self.requests = fault, Counter[str](), Counter[str]()

    def next_fault(self, method: str, path: str) -> str | None:
        with self._lock:
            self.requests[method] += 1
            fault = self.fault(self.requests.total(), method, path)
            if fault:
                self.made[fault] += 1
            return fault

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of clients that went away."""


@contextmanager
def faulty_server(behind: str) -> Iterator[FaultyServer]:
    """Run a server that makes faults before another one."""
    server = FaultyServer(behind)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()
