"""Hostile servers: what they send is refused, and nothing that they say leads to other files, to
other hosts with credentials, or to no end.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path

from faults.hostile import Case
from faults.hostile_files import Content, hostile_zips, made, scans_zip

DOWNLOAD = "download out --split val --extract --base-url {url}"
QUICK = (
    ("CARLASC_REMOTE_ATTEMPTS", "2"),
    ("CARLASC_REMOTE_BACKOFF_S", "0.01"),
    ("CARLASC_REMOTE_TIMEOUT_S", "2"),
)
Answer = Callable[[BaseHTTPRequestHandler], None]


def cases() -> Iterator[Case]:
    """Yield the cases."""
    yield from _downloads()
    if find_spec("urllib3"):
        yield from _remote()


def serving(answer: Answer, path: str = "") -> Callable[[Path], AbstractContextManager[str]]:
    """Return a function that runs a server in a process of its own, whose every answer is
    `answer`'s, and yields its address.
    """

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, format: str, *args: object) -> None:
            pass

        def do_GET(self) -> None:
            self.close_connection = True
            with suppress(BrokenPipeError, ConnectionResetError):  # the client has had enough
                answer(self)

        do_HEAD = do_GET

    @contextmanager
    def serve(place: Path) -> Iterator[str]:
        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        server.daemon_threads = True
        child = os.fork()
        if not child:
            os.chdir(place)
            server.serve_forever(0.05)
        address = f"http://127.0.0.1:{server.server_port}{path}"
        server.server_close()
        try:
            yield address
        finally:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)

    return serve


def head(handler: BaseHTTPRequestHandler, status: int, **headers: str) -> None:
    """Send a status and headers; "_" stands for "-" in their names."""
    handler.send_response(status)
    for name, value in headers.items():
        handler.send_header(name.replace("_", "-"), value)
    handler.end_headers()


def sent(content: Content) -> Answer:
    """Return the answers of a sound server that has one file."""

    @cache
    def body_of_file() -> bytes:
        return made(content).replace(b"/{place}", str(Path.cwd()).encode())

    def answer(handler: BaseHTTPRequestHandler) -> None:
        wanted, content = handler.headers.get("Range"), body_of_file()
        if wanted is None:
            head(handler, 200, Content_Length=str(len(content)), ETag='"1"', Accept_Ranges="bytes")
            body = content
        else:
            first, last = (int(number) for number in wanted.removeprefix("bytes=").split("-"))
            body = content[first : last + 1]
            span = f"bytes {first}-{first + len(body) - 1}/{len(content)}"
            head(
                handler,
                206,
                Content_Length=str(len(body)),
                Content_Range=span,
                ETag='"1"',
                Accept_Ranges="bytes",
            )
        if handler.command == "GET":
            handler.wfile.write(body)

    return answer


def redirect(place: str) -> Answer:
    """Return answers that send the client elsewhere."""
    return lambda handler: head(handler, 302, Location=place, Content_Length="0")


def endless(
    first: bytes = b"", pause_s: float = 0.0, piece: int = 1 << 20, **headers: str
) -> Answer:
    """Return answers whose body has no end."""

    def answer(handler: BaseHTTPRequestHandler) -> None:
        head(handler, 206 if "Content_Range" in headers else 200, **headers)
        handler.wfile.write(first)
        while handler.command == "GET":
            handler.wfile.write(bytes(piece))
            time.sleep(pause_s)

    return answer


def _downloads() -> Iterator[Case]:
    for name, content in hostile_zips().items():
        yield Case(
            f"download of a zip with {name}",
            _nothing,
            DOWNLOAD,
            "val_cartesian.zip",
            serving(sent(content)),
        )
    whole = scans_zip({})
    answers: dict[str, Answer] = {
        "that redirects to a file": redirect("file:///etc/passwd"),
        "that redirects to FTP": redirect("ftp://127.0.0.1/x"),
        "that redirects to data": redirect("data:,PK"),
        "that redirects to no host": redirect("http://"),
        "that redirects in a circle": redirect("/val_cartesian.zip"),
        "that claims 10^17 bytes": lambda handler: (
            head(handler, 206, Content_Range=f"bytes 0-1/{10**17}", Content_Length="2")
            or handler.wfile.write(b"PK")
        ),
        "that sends a page": sent(b"<html>\x1b[2J</html>"),
        "that sends PK and no zip": sent(b"PK" + bytes(5000)),
        "that sends half of a zip": sent(whole[: len(whole) // 2]),
    }
    for name, answer in answers.items():
        names = "" if "10^17" in name else "val_cartesian.zip"
        yield Case(f"download from a server {name}", _nothing, DOWNLOAD, names, serving(answer))


def _leak(handler: BaseHTTPRequestHandler) -> None:
    """Redirect to another name of this machine, and note whether the credentials come along."""
    if handler.headers.get("Host", "").startswith("127."):
        port = handler.server.server_address[1]  # type: ignore[index]
        head(handler, 302, Location=f"http://localhost:{port}/zarr.json", Content_Length="0")
        return
    if handler.headers.get("Authorization"):
        Path("leaked.txt").write_text(handler.headers["Authorization"])
    head(handler, 200, Content_Length="2")
    handler.wfile.write(b"{}" if handler.command == "GET" else b"")


def _with_password(
    serve: Callable[[Path], AbstractContextManager[str]],
) -> Callable[[Path], AbstractContextManager[str]]:
    @contextmanager
    def serve_it(place: Path) -> Iterator[str]:
        with serve(place) as url:
            yield url.replace("://", "://user:password@")

    return serve_it


def _remote() -> Iterator[Case]:
    one, claimed = "bytes 0-0/1000", "bytes 0-99999/100000"
    answers: dict[str, tuple[Answer, str]] = {
        "that redirects to a file": (redirect("file:///etc/passwd"), "/x.zip"),
        "that redirects in a circle": (redirect("/x.zip"), "/x.zip"),
        "that sends a body without end": (endless(b"{"), "/x.zarr"),
        "that claims 10^15 bytes and sends zeros": (endless(b"", Content_Length=str(10**15)), "/x.zarr"),
        "that ignores ranges, without end": (endless(b"PK\x03\x04", Accept_Ranges="bytes"), "/x.zip"),
        "that sends ranges without end": (endless(b"PK\x03\x04", Accept_Ranges="bytes", Content_Range=one), "/x.zip"),
        "that sends other ranges": (endless(b"PK", Accept_Ranges="bytes", Content_Range=claimed, Content_Length="100000"), "/x.zip"),
        "that sends a byte a second": (endless(b"", 1.0, 1, Content_Length="1000000"), "/x.zarr"),
        "whose metadata is nested deeply": (sent(b'{"a":' * 100_000 + b"1" + b"}" * 100_000), "/x.zarr"),
        "whose file is no zip": (sent(b"PK\x03\x04" + bytes(4000)), "/x.zip"),
    }  # fmt: skip
    for name, (answer, path) in answers.items():
        yield Case(
            f"a server {name}",
            _nothing,
            "unpack {url} out",
            "127.0.0.1",
            serving(answer, path),
            environment=QUICK,
        )
    serve = _with_password(serving(_leak, "/x.zarr"))
    yield Case(
        "a server that redirects to another one, with credentials",
        _nothing,
        "unpack {url} out",
        "127.0.0.1",
        serve,
        environment=QUICK,
        forbidden=(b"password",),
    )
    for name in ("a member '../victim.txt'", "a bomb"):
        content = hostile_zips()[name]
        yield Case(
            f"a zip read from a server with {name}",
            _nothing,
            "unpack {url} out",
            "x.zip",
            serving(sent(content), "/x.zip"),
            environment=QUICK,
        )


def _nothing(work: Path) -> None:
    """Everything is on the server."""
